"""Where more shadow rays are sent at rest: at borders of shadows, where they show, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.kernels.place_columns import RUN
from icheat_usd.lighting import build_light_sampler, reflected_direct
from icheat_usd.lighting.quick import Places
from icheat_usd.relight import light_work
from icheat_usd.relight.grain import LEAST_GRAIN, OF_ALL, Grain
from icheat_usd.relight.lights import LiveLights
from icheat_usd.scene import F32, LightKind
from tests.pipeline import Pipeline
from tests.scenes import Light, Material, Mesh, box, cornell_meshes, look_at, make_snapshot, rotation, translation

ROUNDS = 8


def places(n: int, rng: np.random.Generator) -> Places:
    """Of `n` view samples, in any order; where they are does not matter."""
    n_runs = -(-n // RUN)
    row = rng.permutation(n).astype(np.int32)
    nothing = np.zeros((0, RUN), np.float32)
    bounds, column = np.zeros((n_runs, 4, 3), np.float32), np.zeros((n_runs, 1), np.int32)
    return Places(row, np.zeros(n, np.int32), bounds, nothing, column, np.zeros(n_runs, np.bool_))


def test_grain_is_that_of_a_plain_loop() -> None:
    """From all rounds at once, instead of their sums; the last run is not full."""
    rng = np.random.default_rng(2)
    tiles = places(5 * RUN + 9, rng)
    # Noise of runs: none, none that shows, just enough to show, much, and as much where it does not matter.
    spread = np.array([0.0, 0.02, 0.287, 0.5, 2.0, 2.0], np.float32)[np.argsort(tiles.row) // RUN]
    rounds = (1 + spread[None, :, None] * (rng.random((ROUNDS, tiles.n, 3)) - 0.5)).astype(np.float32)
    grain, known = Grain(tiles.row), np.zeros(tiles.n, np.bool_)
    for found in rounds:
        total = grain.add(found)
    np.testing.assert_allclose(total, rounds.sum(axis=0), rtol=1e-6)
    known[tiles.row[4 * RUN : 5 * RUN]] = True
    expected = []
    level = rounds.mean(axis=2, dtype=np.float64)
    for run in range(6):
        samples = tiles.row[run * RUN : (run + 1) * RUN]
        variance = level[:, samples].var(axis=0, ddof=1) / ROUNDS * ~known[samples]
        if np.sqrt(variance.mean()) > LEAST_GRAIN * (level[:, samples].mean() + OF_ALL * level.mean()):
            expected.append(run)
    every = np.arange(6, dtype=np.int32)
    assert grain.grainy(every, known).tolist() == expected == [2, 3, 5]
    assert grain.grainy(every[:4], known).tolist() == [2, 3]
    first = Grain(tiles.row)
    first.add(rounds[0])
    assert not len(first.grainy(every, known))  # one round says nothing
    # More rounds at one run leave the level of all as it is.
    grain.add(rounds[0], grain.samples(every[3:4]))
    assert grain.grainy(every, known).tolist() == [2, 3, 5]


def test_rounds_at_some_runs_leave_the_others_alone() -> None:
    rng = np.random.default_rng(3)
    tiles = places(2 * RUN + 5, rng)
    grain, found = Grain(tiles.row), rng.random((tiles.n, 3)).astype(np.float32)
    before = grain.add(found).copy()
    samples = grain.samples(np.array([0, 2], np.int32))
    np.testing.assert_array_equal(np.sort(samples), np.sort(np.r_[tiles.row[:RUN], tiles.row[2 * RUN :]]))
    np.testing.assert_array_equal(grain.add(found, samples), before[samples] + found[samples])
    others = grain.samples(np.array([1], np.int32))
    np.testing.assert_array_equal(grain.add(np.zeros_like(found), others), before[others])


@pytest.fixture(scope="module", params=["beside", "inside"])
def scene(request: pytest.FixtureRequest) -> Pipeline:
    """A block that casts a soft shadow, of a light above all view samples or so large that all are next to it."""
    size, place = ((0.2, 0.2), 0.95) if request.param == "beside" else ((1.9, 1.9), 0.95)
    down = (translation(0, place, 0) @ rotation((1, 0, 0), -90))[:3].astype(np.float32)
    light = Light(LightKind.RECT, (5, 5, 5), down, size, path="/rect")
    camera = look_at((0, 0, 3.9), fov=39.3, width=48, height=36)
    meshes = [*cornell_meshes(), Mesh(box(0.35, (0.2, -0.3, 0.1)), Material(0.7), path="/block")]
    return Pipeline(make_snapshot(meshes, lights=[light], camera=camera), n_gather=100, bounce_rays=16)


def at_rest(scene: Pipeline) -> F32:
    parts = scene.snapshot, scene.tracer, scene.view, scene.gather, scene.bounces
    lights = LiveLights(*parts, n_bounces=1, light_samples=32, seed=3)
    while lights.refine():
        pass
    return lights.view_direct[0]


def test_borders_of_shadows_get_as_little_noise_as_from_more_rays_everywhere(
    scene: Pipeline, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = scene.view.points
    sampler = build_light_sampler(scene.snapshot, scene.tracer, points)
    true = reflected_direct(scene.snapshot, scene.tracer, sampler, points, scene.view.to_eye, 5, 2048)[0]
    found = at_rest(scene)
    monkeypatch.setattr(light_work, "_MORE", 1)
    plain = at_rest(scene)
    changed = (found != plain).any(axis=1)
    assert 0.02 < changed.mean() < 0.9
    off = [float(np.square(light - true)[changed].sum()) for light in (found, plain)]
    assert off[0] < off[1] / 2
