"""Direct light that a view reflects under lights that stay: shadow rays in rounds, more where noise would show."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from icheat_usd.lighting import LightSampler, build_light_sampler, reflected_direct, samples_per_light
from icheat_usd.materials import take_points
from icheat_usd.progress import Progress, silent
from icheat_usd.relight.grain import Grain, order_of_tiles
from icheat_usd.samples import ViewSamples
from icheat_usd.scene import F32, SceneSnapshot
from icheat_usd.tracing import Tracer

#: Rounds that all view samples have, whose differences tell of noise; and those at what is grainy.
ROUNDS, ROUNDS_AT_GRAIN = 4, 16
#: Of the view samples, that are taken for grainy at most: as many rays again.
MOST_GRAINY = 1 / 3
_NAME = "light the view samples"
_RAYS_PER_STEP = 1 << 16


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
    out = np.empty((len(counts), view.n, 3), np.float32)
    for done in look_in_rounds(snapshot, tracer, sampler, view, seed, counts, out):
        progress(_NAME, done)
    progress(_NAME, 1.0)
    return out


def look_in_rounds(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    sampler: LightSampler,
    view: ViewSamples,
    seed: int,
    counts: Sequence[int],
    out: F32,
) -> Iterator[float]:
    """`light_view` in steps of some tens of milliseconds, each of which says how much is done.

    Parameters
    ----------
    counts : (n_lights,)
        Shadow rays of each light.
    out : (n_lights, n_view, 3)
        Receives what is found: at the end, and before more is looked at where that is grainy.
    """
    is_in_rounds = min(counts, default=0) >= ROUNDS
    of_round = [-(-count // ROUNDS) for count in counts] if is_in_rounds else counts
    at_once = max(_RAYS_PER_STEP // max(sum(of_round), 1), 1)
    n_rounds = np.zeros(view.n, np.float32)
    grain, total = Grain(order_of_tiles(view)), np.zeros((len(counts), view.n, 3), np.float32)
    samples, runs = np.arange(view.n), grain.runs
    for turn in range(ROUNDS_AT_GRAIN if is_in_rounds else 1):
        if turn in (ROUNDS, 2 * ROUNDS):
            np.divide(total, n_rounds[:, None], out=out)
            runs = grain.grainy(runs, np.zeros(view.n, np.bool_), int(MOST_GRAINY * len(grain.runs)))
            samples = grain.samples(runs)
        if not len(samples):
            break
        found = np.zeros((view.n, 3), np.float32)
        for first in range(0, len(samples), at_once):
            some = samples[first : first + at_once]
            # The next rays of each one's sequence.
            sequence = np.stack([some, np.full_like(some, turn)], axis=1)
            points, eye = take_points(view.points, some), view.to_eye[some]
            of_lights = reflected_direct(snapshot, tracer, sampler, points, eye, seed, of_round, sequence)
            total[:, some] += of_lights
            found[some] = of_lights.sum(axis=0)
            yield (turn + (first + len(some)) / len(samples)) / ROUNDS_AT_GRAIN
        grain.add(found, samples)
        n_rounds[samples] += 1
    np.divide(total, n_rounds[:, None], out=out)
