"""Closer looks at gather cells against plain loops, and against the light that they stand for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from icheat_usd.kernels.closer_look import (
    add_changes_of_runs,
    copy_runs,
    noise_of_runs,
    shadow_noise_of_cells,
    take_closer_looks,
    weighted_light,
)
from icheat_usd.kernels.place_columns import RUN
from icheat_usd.lighting.change import one_light
from icheat_usd.lighting.quick import Shining, shining_points
from icheat_usd.relight import closer_look
from icheat_usd.relight.closer_look import N_BESIDE, CloserLook, runs_beside, share_out_looks
from icheat_usd.relight.lights import LiveLights
from icheat_usd.scene import F32, I32, I64, Bool, LightControls, LightKind, SceneSnapshot
from icheat_usd.steps import all_steps
from icheat_usd.transport import Transport
from icheat_usd.transport.influence import influence_on_view
from tests.pipeline import Pipeline
from tests.scenes import Light, cornell_meshes, look_at, make_snapshot, rotation, translation

#: Just above the floor, so that light falls off within a cell; and a beam that lights a part of the floor.
NEAR = Light(LightKind.SPHERE, (9, 9, 9), translation(0.3, -0.9, 0.2)[:3], (0.02, 0.0), path="/near")
GRAZING = Light(
    LightKind.RECT, (5, 5, 5), (translation(-0.2, -0.9, 0.0) @ rotation((0, 1, 0), 90))[:3], (0.6, 0.1), path="/grazing"
)
#: Half in a box.
SUNK = Light(LightKind.SPHERE, (9, 9, 9), translation(0.1, -0.7, 0.0)[:3], (0.1, 0.0), path="/sunk")
SUN = Light(LightKind.DISTANT, (3, 3, 3), rotation((0, 1, 0), 35)[:3], (0.2, 0.0), path="/sun")


def room(light: Light) -> SceneSnapshot:
    return make_snapshot(cornell_meshes(), lights=[light], camera=look_at((0, 0, 3.9), fov=39.3, width=16, height=12))


def first_look(pipeline: Pipeline, seed: int, rows: Transport | None = None) -> LiveLights:
    return LiveLights(
        pipeline.snapshot, pipeline.tracer, pipeline.view, pipeline.gather, pipeline.bounces, n_bounces=4,
        light_samples=16, seed=seed, rows=rows,
    )  # fmt: skip


def error(found: F32, expected: F32, area: F32) -> float:
    weight = area[:, None].astype(np.float64)
    return float(np.sqrt((((found - expected) * weight) ** 2).sum() / ((expected * weight) ** 2).sum()))


@pytest.mark.parametrize("light", [NEAR, GRAZING, SUN], ids=lambda light: light.path[1:])
def test_a_first_look_has_less_than_half_of_the_noise(light: Light, monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline = Pipeline(room(light), n_gather=2048)
    closer, plain = [], []
    for seed in range(4):
        lights = first_look(pipeline, seed)
        found = lights.radiance[0].copy()
        with monkeypatch.context() as patch:
            patch.setattr(CloserLook, "improve", lambda *_: None)
            unimproved = first_look(pipeline, seed).radiance[0].copy()
        while lights.refine():
            pass
        closer.append(error(found, lights.radiance[0], pipeline.gather.area))
        plain.append(error(unimproved, lights.radiance[0], pipeline.gather.area))
    assert np.mean(plain) > 0.02
    assert np.mean(closer) < 0.5 * np.mean(plain)


def test_a_sun_that_turns_is_as_well_known_as_at_a_first_look() -> None:
    """Its patch goes over cells that looked dark before."""
    turned = [Light(LightKind.DISTANT, (3, 3, 3), rotation((0, 1, 0), 35 - k)[:3], (0.01, 0.0)) for k in range(8)]
    pipeline = Pipeline(room(turned[-1]), n_gather=2048)
    moved, first = [], []
    for seed in range(4):
        fresh = first_look(pipeline, seed)
        lights = first_look(pipeline, seed)
        for light in turned:
            lights.change(0, to_world=light.to_world)
        looks = [fresh._lights[0].direct.copy(), lights._lights[0].direct.copy()]
        while fresh.refine():
            pass
        known = fresh._lights[0].direct
        for errors, look in zip((first, moved), looks, strict=True):
            errors.append(error(look, known, pipeline.gather.area))
    assert np.mean(moved) < 1.1 * np.mean(first)


@pytest.mark.parametrize(("n_runs", "what"), [(12, "what was known at rest"), (96, "what lies beside in space")])
def test_borders_of_a_sun_are_found_by(n_runs: int, what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not all runs are looked at, so that it matters which."""
    monkeypatch.setattr(closer_look, "MOST_RUNS_OF_SUN", n_runs)
    turned = [Light(LightKind.DISTANT, (3, 3, 3), rotation((0, 1, 0), 35 - k)[:3], (0.01, 0.0)) for k in range(4)]
    start, end = Pipeline(room(turned[0]), n_gather=2048), Pipeline(room(turned[-1]), n_gather=2048)
    found: list[list[float]] = [[], []]
    for seed in range(4):
        known = first_look(end, seed)
        while known.refine():
            pass
        for errors, has_it in zip(found, (False, True), strict=True):
            with monkeypatch.context() as patch:
                if not has_it and what == "what was known at rest":
                    patch.setattr(CloserLook, "know", lambda *_: None)
                elif not has_it:
                    patch.setattr(closer_look, "BESIDE", 0.0)
                lights = first_look(start, seed)
                while lights.refine():
                    pass
                for light in turned[1:]:
                    lights.change(0, to_world=light.to_world)
            errors.append(error(lights._lights[0].direct, known._lights[0].direct, end.gather.area))
    assert np.mean(found[1]) < 0.9 * np.mean(found[0]), found


def test_where_a_sun_was_long_ago_is_not_looked_at_for_ever() -> None:
    """What a closer look found there is known from then on: hardly more is looked at than if it never was there."""
    sun, far = (Light(LightKind.DISTANT, (3, 3, 3), rotation((0, 1, 0), k)[:3], (0.01, 0.0)) for k in (35, -35))
    rested, other = Pipeline(room(sun), n_gather=2048), Pipeline(room(far), n_gather=2048)
    counts = []
    for seed in range(4):
        lights = first_look(rested, seed)
        while lights.refine():
            pass
        n_looked_at = [n_runs_of_closer_look(first_look(other, seed))]
        for _ in range(3):
            lights.change(0, to_world=far.to_world)
            n_looked_at.append(n_runs_of_closer_look(lights))
        counts.append(n_looked_at)
    fresh, first, _, last = np.mean(counts, axis=0)
    assert first > 1.2 * last > 0
    assert last - fresh < 0.25 * (first - fresh)


def n_runs_of_closer_look(lights: LiveLights) -> int:
    following = lights._lights[0].following
    assert following is not None and following.patches is not None
    return int(following.patches._looked_at.sum())


def test_little_noise_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where cells beside each other get the same light, no ray is sent."""
    pipeline = Pipeline(room(SUN), n_gather=512)
    lights = first_look(pipeline, 0)
    assert lights._around.patches is not None
    look = CloserLook(lights._around.patches, pipeline.gather, lights._around.beside)
    even = np.ones((pipeline.gather.n, 3), np.float32)
    assert len(look._noisy_runs(even, pipeline.gather.area)) == len(look._border_runs(even)) == 0
    monkeypatch.setattr(closer_look, "MOST_RUNS", 2)
    spotted = even.copy()
    spotted[::50] = 9.0
    assert 2 < len(look._noisy_runs(spotted, pipeline.gather.area)) <= 6


def dark_look(light: Light) -> tuple[Pipeline, CloserLook, tuple[SceneSnapshot, F32, I32, Shining, F32]]:
    """All runs of a room are looked at and no ray gets through; and what `CloserLook._noise_of_shadows` is given."""
    pipeline = Pipeline(room(light), n_gather=512)
    lights = first_look(pipeline, 0)
    assert lights._around.patches is not None
    look = CloserLook(lights._around.patches, pipeline.gather, lights._around.beside)
    look._looked_at[:], look._found[:] = 1, 0.0
    alone, shining = one_light(pipeline.snapshot, 0), shining_points(pipeline.snapshot, 0, by_form=True)
    runs, even = np.arange(look._patches.n_runs, dtype=np.int32), np.ones((pipeline.gather.n, 3), np.float32)
    return pipeline, look, (alone, even, runs, shining, pipeline.gather.importance)


@pytest.mark.parametrize("light", [SUN, SUNK, GRAZING])
def test_noise_is_where_something_hides_the_light(light: Light) -> None:
    """None where no light gets, little where all rays are clear."""
    pipeline, look, given = dark_look(light)
    shining, noise = given[3], []
    of_cells = look._noise_of_shadows(*given)[0].copy()
    clear = look._whole[: look._patches.n, None] if len(shining.form) else np.float32(1.0)
    for hidden in ((), range(0, look._patches.n, 3)):
        look._found[:] = clear
        look._found[list(hidden)] = 0.0
        found, left = look._noise_of_shadows(*given)
        noise.append(found.sum())
    assert 0.0 < left < noise[1] and noise[0] < 0.05 * noise[1]
    # Where the light has a closed form, what faces away is known from what is hidden.
    if not len(shining.form):
        assert not of_cells.any()
        return
    towards = np.array(light.to_world)[:3, 3] - pipeline.gather.patch_points.position
    faces = np.einsum("ij,ij->i", towards, pipeline.gather.patch_points.normal) > 0.0
    of_cell = np.logical_or.reduceat(faces, pipeline.gather.cell_begin[:-1])
    assert np.count_nonzero(~of_cell) > 20 < np.count_nonzero(of_cells)
    far = light.kind == LightKind.RECT  # parts of it may be above a horizon that its middle is below
    assert far or not of_cells[~of_cell].any()


def test_noise_is_of_what_a_light_is_told_to_bring() -> None:
    """A quarter of the light has a quarter of the noise, and what is not lit has none."""
    pipeline, look, (plain, *given) = dark_look(GRAZING)
    receivers = (np.arange(plain.n_instances) % 2).astype(np.uint8)
    whole, quarter, part = (
        look._noise_of_shadows(alone, *given)[0].copy()
        for alone in (
            plain,
            replace(plain, light_controls=(LightControls(diffuse=0.25),)),
            replace(plain, light_controls=(LightControls(receivers=receivers),)),
        )
    )
    np.testing.assert_allclose(quarter, whole / 16.0, rtol=1e-5)
    is_lit = receivers[pipeline.gather.points.instance] > 0
    assert np.count_nonzero(whole[~is_lit]) > 20 < np.count_nonzero(part)
    assert not part[~is_lit].any()


@pytest.mark.parametrize(("light", "limit", "part"), [(GRAZING, "WORST_CELLS", 0.4), (SUNK, "WORST_RUNS", 0.8)])
def test_cells_in_part_of_whose_light_something_stands_are_looked_at_again(
    light: Light, limit: str, part: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    pipeline = Pipeline(room(light), n_gather=2048)
    importance = pipeline.gather.importance
    errors: dict[int, list[float]] = {0: [], getattr(closer_look, limit): []}
    for seed in range(8):
        for most, found in errors.items():
            monkeypatch.setattr(closer_look, limit, most)
            lights = first_look(pipeline, seed)
            direct = lights._lights[0].direct.copy()
            while lights.refine():
                pass
            found.append(error(direct, lights._lights[0].direct, importance))
    without, with_them = map(np.mean, errors.values())
    assert with_them < part * without


def test_once_lights_have_rested_looks_go_by_what_the_image_shows() -> None:
    """If half of the cells are said to be out of sight, these are left alone."""
    pipeline = Pipeline(room(GRAZING), n_gather=2048, rays=128)
    lights = first_look(pipeline, 0, pipeline.transport)
    assert lights._around.influence is None
    while lights.refine():
        pass
    influence = lights._around.influence
    assert influence is not None and np.array_equal(
        influence, all_steps(influence_on_view(pipeline.transport, pipeline.gather.importance))
    )

    def noisy_cells(is_seen: Bool) -> Bool:
        lights._around.influence = is_seen.astype(np.float32)
        lights.change(0, to_world=GRAZING.to_world)
        following = lights._lights[0].following
        assert following is not None and following.patches is not None
        return following.patches._noise_of_cells > 0.0

    every = noisy_cells(np.ones(2048, np.bool_))
    half = np.cumsum(every) < np.count_nonzero(every) // 2
    for is_seen in (half, ~half):
        found = noisy_cells(is_seen)
        assert np.count_nonzero(found) > 50 and not found[~is_seen].any()


def cells_in_runs(rng: np.random.Generator) -> tuple[I64, I64, I64, int]:
    """First patch point of each of 40 cells, first and last cell of each run, patch points of a run."""
    per_run = 16
    cell_begin = np.concatenate([[0], np.cumsum(rng.integers(1, 9, 40))]).astype(np.int64)
    first = np.arange(0, cell_begin[-1], per_run)
    begin = np.searchsorted(cell_begin, first, side="right") - 1
    end = np.searchsorted(cell_begin, np.minimum(first + per_run, cell_begin[-1]) - 1, side="right")
    return cell_begin, begin, end, per_run


@pytest.mark.parametrize("is_whole_known", [False, True])
def test_noise_of_shadows_is_that_of_a_plain_loop(is_whole_known: bool) -> None:
    """The mean of p (1 - p) over a beta distribution; of cells between two runs what was looked at counts."""
    rng = np.random.default_rng(6)
    cell_begin, begin, end, per_run = cells_in_runs(rng)
    n = int(cell_begin[-1])
    of_patches = rng.random((n, 3)).astype(np.float32)
    of_patches[rng.random(n) < 0.4] = 0.0
    runs = np.array([1, 2, 4, 5, 6, len(begin) - 1], np.int32)
    # All of one run are in sight, and none of another.
    of_patches[5 * per_run : 6 * per_run], of_patches[1 * per_run : 2 * per_run] = 1.0, 0.0
    whole = np.where(rng.random(n) < 0.7, rng.uniform(1, 5, n), 0.0).astype(np.float32)
    looked_at = np.zeros(len(begin), np.uint8)
    looked_at[runs] = 1
    weight, found = rng.random(40).astype(np.float32), np.zeros(40)
    given = whole if is_whole_known else whole[:0]
    shadow_noise_of_cells(runs, begin, end, cell_begin, per_run, looked_at, of_patches, given, weight, found)

    level = of_patches.sum(axis=1, dtype=np.float64)
    is_clear = level > 0
    most = np.where(whole > 0, whole, level) if is_whole_known else level
    has_ray = most > 0 if is_whole_known else np.ones(n, np.bool_)
    for cell in range(40):
        mine = np.arange(cell_begin[cell], cell_begin[cell + 1])
        mine = mine[looked_at[mine // per_run] > 0]
        expected, rays = 0.0, np.count_nonzero(has_ray[mine])
        if rays:
            of_run = np.arange(mine[0] // per_run * per_run, min(n, (mine[0] // per_run + 1) * per_run))
            share = (np.count_nonzero(is_clear[of_run]) + 0.5) / (np.count_nonzero(has_ray[of_run]) + 1)
            clear, bright = np.count_nonzero(is_clear[mine]), mine if (most[mine] > 0).any() else of_run
            light = most[bright][most[bright] > 0].mean() if (most[bright] > 0).any() else 0.0
            hidden = stats.beta(clear + share, rays - clear + 1 - share).expect(lambda p: p * (1 - p))
            expected = (weight[cell] * light) ** 2 * hidden * rays / len(mine) ** 2
        np.testing.assert_allclose(found[cell], expected, rtol=1e-5, atol=1e-12)
    assert np.count_nonzero(found) > 8


def test_looks_are_shared_out_so_that_least_noise_is_left() -> None:
    """Less than with as many looks at each of any number of the noisiest cells."""
    noise = np.sort(np.random.default_rng(3).lognormal(0.0, 2.0, 200))[::-1]
    looks = share_out_looks(noise, 64)
    assert 48 < looks.sum() <= 64 and looks.max() == closer_look.MOST_LOOKS and (np.diff(looks) <= 0).all()
    assert set(looks) <= {0, 1, 2, 4, 8, 16}

    def left(looks: I64) -> float:
        """Of variance; one ray of each patch point was sent before."""
        return float((noise**2 / np.maximum(looks * closer_look.N_EVEN, 1)).sum())

    for each in (1, 2, 4, 8, 16):
        assert left(looks) < left(np.where(np.arange(200) < 64 // each, each, 0))
    assert (share_out_looks(np.ones(10), 20) == 2).all()
    assert (share_out_looks(np.ones(10), 1000) == closer_look.MOST_LOOKS).all()
    assert not len(share_out_looks(np.empty(0), 64)) and share_out_looks(np.ones(10), 5).tolist() == [1] * 5 + [0] * 5


def test_light_of_all_cells_is_their_weighted_sum() -> None:
    rng = np.random.default_rng(7)
    direct, weight = rng.random((50, 3)).astype(np.float32), rng.random(50).astype(np.float32)
    expected = (weight[:, None].astype(np.float64) * direct).sum()
    np.testing.assert_allclose(weighted_light(direct, weight), expected, rtol=1e-6)


def test_noise_of_runs_is_that_of_a_plain_loop() -> None:
    rng = np.random.default_rng(1)
    direct, area = rng.random((50, 3)).astype(np.float32), rng.random(50).astype(np.float32)
    begin, end = np.array([0, 6, 20, 50]), np.array([7, 20, 50, 50])
    found = np.empty((2, 4))
    noise_of_runs(direct, area, begin, end, found)
    for run in range(4):
        level, size = direct[begin[run] : end[run]].sum(axis=1, dtype=np.float64), area[begin[run] : end[run]]
        mean = (level * size).sum() / size.sum() if len(size) else 0.0
        np.testing.assert_allclose(found[0, run], ((size * (level - mean)) ** 2).sum(), rtol=1e-5)
        np.testing.assert_allclose(found[1, run], (size * level).sum(), rtol=1e-5)


def test_changes_and_copies_of_runs_are_those_of_plain_loops() -> None:
    rng = np.random.default_rng(3)
    direct, before = rng.random((2, 50, 3)).astype(np.float32)
    area = rng.random(50).astype(np.float32)
    begin, end = np.array([0, 6, 20, 50]), np.array([7, 20, 50, 50])
    found = np.ones(4)
    add_changes_of_runs(direct, before, area, begin, end, found)
    for run in range(4):
        cells = slice(begin[run], end[run])
        change = area[cells] * (direct[cells] - before[cells]).sum(axis=1, dtype=np.float64)
        np.testing.assert_allclose(found[run], 1 + (change**2).sum(), rtol=1e-5)
    out = before.copy()
    copy_runs(np.array([0, 2], np.int32), begin, end, direct, out)
    np.testing.assert_array_equal(out, np.concatenate([direct[:7], before[7:20], direct[20:]]))


def test_runs_beside_one_are_the_nearest() -> None:
    rng = np.random.default_rng(4)
    places = rng.random((20 * RUN + 5, 3)).astype(np.float32)
    found = runs_beside(places)
    centre = np.array([places[first : first + RUN].mean(axis=0) for first in range(0, len(places), RUN)])
    for run, near in enumerate(found):
        distance = np.linalg.norm(centre - centre[run], axis=1)
        distance[run] = np.inf
        assert set(near) == set(np.argsort(distance)[:N_BESIDE])


def test_where_there_are_few_runs_each_is_beside_itself() -> None:
    np.testing.assert_array_equal(np.sort(runs_beside(np.eye(3, dtype=np.float32))), np.zeros((1, N_BESIDE)))
    assert set(runs_beside(np.random.default_rng(5).random((2 * RUN, 3)).astype(np.float32)).ravel()) == {0, 1}
    assert runs_beside(np.empty((0, 3), np.float32)).shape == (0, N_BESIDE)


def test_cells_get_the_mean_of_what_was_looked_at() -> None:
    """Cells of runs that were looked at, of a cell between two runs the part that was; all others stay."""
    rng = np.random.default_rng(2)
    cell_begin, begin, end, per_run = cells_in_runs(rng)
    n = int(cell_begin[-1])
    of_patches = rng.random((n, 3)).astype(np.float32)
    runs = np.array([1, 2, 5], np.int32)
    looked_at = np.zeros(len(begin), np.uint8)
    looked_at[runs] = 1
    direct = np.full((40, 3), -1, np.float32)
    take_closer_looks(runs, begin, end, cell_begin, per_run, looked_at, of_patches, direct)
    for cell in range(40):
        mine = np.arange(cell_begin[cell], cell_begin[cell + 1])
        mine = mine[looked_at[mine // per_run] > 0]
        expected = of_patches[mine].mean(axis=0) if len(mine) else np.full(3, -1.0)
        np.testing.assert_allclose(direct[cell], expected, rtol=1e-6)
