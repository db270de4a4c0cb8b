"""Bounces of lights that are moved from rest: what few rays get wrong of them there is not wrong again."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.relight.known_bounces import KnownBounces
from icheat_usd.relight.light_work import Following
from icheat_usd.relight.lights import LiveLights
from icheat_usd.scene import F32
from icheat_usd.transport import Bounces, SparseRows, solve_bounces
from icheat_usd.transport.quick_bounces import build_quick_bounces
from tests.pipeline import Pipeline
from tests.relight.test_known_noise import Kind, dome, rect, room
from tests.relight.test_live_lights import settle


@pytest.fixture(scope="module")
def scene() -> Pipeline:
    return Pipeline(room(rect(0.0)), n_gather=1500, bounce_rays=512)


def noisy(bounces: Bounces) -> Bounces:
    """With a few rays of each row: every eighth entry, as often."""
    rows, rng = bounces.rows, np.random.default_rng(1)
    kept = rng.random(rows.n_entries) < 1 / 8
    before = np.concatenate([[0], np.cumsum(kept)]).astype(np.int64)
    few = SparseRows(before[rows.indptr], rows.indices[kept], rows.weights[kept] * np.float32(8), rows.n_columns)
    return Bounces(rows, bounces.albedo, few)


def rms(values: F32) -> float:
    return float(np.sqrt((values.astype(np.float64) ** 2).mean()))


def test_light_of_all_bounces_stays_where_errors_of_few_rays_are_taken(scene: Pipeline) -> None:
    bounces, direct = noisy(scene.bounces), scene.cell_light.direct[0]
    exact = solve_bounces(bounces, direct[None], 16)[0]
    quick = build_quick_bounces(bounces, scene.gather.tree, 16)
    off = quick.off_balance(exact, direct)
    assert off is not None
    np.testing.assert_allclose(
        off, direct + quick.albedo * bounces.few.matmul(exact) - exact, rtol=0.02, atol=0.01 * rms(exact)
    )
    taken, plain = exact.copy(), exact.copy()
    for part in range(8):
        quick.follow(taken, direct - off, direct - off, taken, (part, 8))
        quick.follow(plain, direct, direct, plain, (part, 8))
    assert rms(taken - exact) < 2e-3 * rms(exact) < 0.02 * rms(exact) < rms(plain - exact)
    assert build_quick_bounces(bounces, scene.gather.tree, 4).off_balance(exact, direct) is None


@pytest.mark.parametrize("common", [0.0, 0.4, 1.0, 1.7])
def test_as_much_of_an_error_is_taken_as_two_lights_have_in_common(common: float) -> None:
    """Rows whose noise is independent: errors that are left are the least that a share of the known ones can leave."""
    n, rng = 640, np.random.default_rng(2)
    rows = rng.standard_normal((n, n)) / np.sqrt(n)
    rest = rng.random((n, 3))
    light = common * rest + 0.3 * rng.standard_normal((n, 3))
    direct = np.ones((n, 3), np.float32)
    known = KnownBounces((rows @ rest).astype(np.float32), rest.astype(np.float32), direct)
    np.testing.assert_allclose(known.before, direct - rows @ rest, rtol=1e-5, atol=1e-6)
    less, _ = known.take_from(direct, light.astype(np.float32))
    assert known.before is less
    taken = direct - less
    left = [rms(rows @ light - share * (rows @ rest)) for share in np.linspace(0, 2, 41)]
    assert rms(rows @ light - taken) < 1.1 * min(left)


def test_of_a_light_that_is_dimmed_or_jumps_as_much_less_is_taken() -> None:
    rng = np.random.default_rng(3)
    direct, radiance, error = rng.random((3, 640, 3)).astype(np.float32)
    dimmed = direct * np.float32((0.6, 1.0, 0.0))
    known = KnownBounces(error, radiance, direct)
    np.testing.assert_allclose(dimmed - known.take_from(dimmed, radiance)[0], error * (0.6, 1, 0), rtol=1e-4, atol=1e-6)
    brighter = KnownBounces(error, radiance, direct).take_from(2 * direct, radiance)[0]
    np.testing.assert_allclose(2 * direct - brighter, error, rtol=1e-4, atol=1e-6)
    one, other = direct.copy(), direct.copy()
    one[:320], other[320:] = 0, 0
    np.testing.assert_array_equal(KnownBounces(error, radiance, one).take_from(other, radiance)[0], other)


def test_nothing_is_taken_of_a_light_that_was_dark() -> None:
    dark = np.zeros((32, 3), np.float32)
    direct = np.ones((32, 3), np.float32)
    np.testing.assert_array_equal(KnownBounces(dark, dark, dark).take_from(direct, direct)[0], direct)


@pytest.mark.parametrize("light", [rect, dome])
def test_bounces_of_a_light_moved_from_rest_are_closer_to_all_bounces(
    scene: Pipeline, light: Kind, monkeypatch: pytest.MonkeyPatch
) -> None:
    bounces = noisy(scene.bounces)

    def error() -> float:
        """After ten frames of a short way."""
        step = 0.02 if light is rect else 2.0
        parts = scene.tracer, scene.view, scene.gather, bounces
        lights = LiveLights(room(light(0.0)), *parts, n_bounces=16, light_samples=4, seed=3)
        settle(lights)
        for frame in range(1, 11):
            lights.change(0, to_world=light(step * frame).to_world)
        direct = lights._lights[0].direct
        assert direct is not None
        exact = solve_bounces(bounces, direct[None], 16)[0]
        return rms(lights.radiance[0] - exact) / rms(exact)

    known = error()
    monkeypatch.setattr(Following, "know_bounces", lambda *_: None)
    assert known < 0.6 * error()


def test_a_light_that_moves_on_once_its_bounces_are_solved_starts_from_these(scene: Pipeline) -> None:
    """Though its view is not at its best yet: what was looked at before no longer counts."""
    bounces = noisy(scene.bounces)
    parts = scene.tracer, scene.view, scene.gather, bounces
    lights = LiveLights(room(dome(0.0)), *parts, n_bounces=16, light_samples=4, seed=3)
    settle(lights)
    lights.change(0, to_world=dome(40.0).to_world)
    work = lights._lights[0].work
    assert work is not None and not work.is_solved
    while lights.refine() and not work.is_solved:
        pass
    assert lights._lights[0].work is work and work.direct is not None
    solved = solve_bounces(bounces, work.direct[None], 16)[0]
    np.testing.assert_allclose(lights.radiance[0], solved, rtol=1e-4, atol=1e-5)
    lights.change(0, to_world=dome(40.5).to_world)
    direct = lights._lights[0].direct
    assert direct is not None
    exact = solve_bounces(bounces, direct[None], 16)[0]
    # Following the look before, it was .021 off.
    assert rms(lights.radiance[0] - exact) < 0.01 * rms(exact)
