"""Direct light that a view reflects under lights that stay: shadow rays in rounds, more of them where they would show."""

from __future__ import annotations

import numpy as np

from icheat_usd.lighting import build_light_sampler, reflected_direct, samples_per_light
from icheat_usd.materials import take_points
from icheat_usd.progress import Progress, silent
from icheat_usd.relight.grain import Grain, order_of_tiles
from icheat_usd.samples import ViewSamples
from icheat_usd.scene import F32, I64, SceneSnapshot
from icheat_usd.tracing import Tracer

#: Rounds that all view samples have, whose differences tell of noise; and those at what is grainy.
ROUNDS, ROUNDS_AT_GRAIN = 4, 16
#: Of the view samples, that are taken for grainy at most: as many rays again.
MOST_GRAINY = 1 / 3
_NAME = "light the view samples"


def light_view(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    view: ViewSamples,
    *,
    light_samples: int = 16,
    dome_samples: int | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> F32:
    """Direct light that the view samples reflect.

    Parameters
    ----------
    light_samples : int
        Shadow rays per light and view sample. From `ROUNDS` on, those in tiles of 8 x 8 pixels that are grainy under
        all lights, such as at the borders of shadows, get up to four times as many, a third of the view at most.
    dome_samples : int, optional
        The same for domes; four times `light_samples` by default.

    Returns
    -------
    (n_lights, n_view, 3) float32, radiance, scene-linear
        See `reflected_direct`.
    """
    progress(_NAME, 0.0)
    sampler = build_light_sampler(snapshot, tracer, view.points, seed)
    counts = samples_per_light(snapshot, light_samples, dome_samples)
    if min(counts, default=0) < ROUNDS:
        direct = reflected_direct(snapshot, tracer, sampler, view.points, view.to_eye, seed, counts)
        progress(_NAME, 1.0)
        return direct
    of_round = [-(-count // ROUNDS) for count in counts]

    def look(samples: I64, turn: int) -> F32:
        """What a round brings to some samples, by the next rays of each one's sequence."""
        points, eye = take_points(view.points, samples), view.to_eye[samples]
        sequence = np.stack([samples, np.full_like(samples, turn)], axis=1)
        return reflected_direct(snapshot, tracer, sampler, points, eye, seed, of_round, sequence)

    every = np.arange(view.n)
    grain, total, n_rounds = Grain(order_of_tiles(view)), np.zeros((len(counts), view.n, 3), np.float32), 0 * every
    samples, runs = every, grain.runs
    for turn in range(ROUNDS_AT_GRAIN):
        if turn in (ROUNDS, 2 * ROUNDS):
            runs = grain.grainy(runs, np.zeros(view.n, np.bool_), int(MOST_GRAINY * len(grain.runs)))
            samples = grain.samples(runs)
        if not len(samples):
            break
        found = look(samples, turn)
        total[:, samples] += found
        n_rounds[samples] += 1
        of_all = np.zeros((view.n, 3), np.float32)
        of_all[samples] = found.sum(axis=0)
        grain.add(of_all, samples)
        progress(_NAME, (turn + 1) / ROUNDS_AT_GRAIN)
    progress(_NAME, 1.0)
    total /= n_rounds[:, None].astype(np.float32)
    return total
