"""Quick bounces against the exact ones."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from icheat_usd.transport import solve_bounces
from icheat_usd.transport.quick_bounces import build_quick_bounces, cluster_begins
from tests.pipeline import Pipeline
from tests.scenes import cornell


@pytest.fixture(scope="module")
def room() -> Pipeline:
    return Pipeline(cornell(12, 12), n_gather=1500, bounce_rays=128, light_samples=4, n_bounces=9)


def test_clusters_of_single_cells_give_the_exact_bounces(room: Pipeline) -> None:
    direct = room.cell_light.direct[0]
    quick = build_quick_bounces(room.bounces, room.gather.tree, 9, most_clusters=room.gather.n)
    assert len(quick.begin) == room.gather.n + 1
    np.testing.assert_allclose(
        quick.solve(direct), solve_bounces(room.bounces, direct[None], 9)[0], rtol=2e-3, atol=1e-4
    )


@pytest.mark.parametrize("n_bounces", [2, 3, 8])
def test_every_number_of_bounces_is_summed(room: Pipeline, n_bounces: int) -> None:
    direct = room.cell_light.direct[0]
    quick = build_quick_bounces(room.bounces, room.gather.tree, n_bounces, most_clusters=room.gather.n)
    exact = direct.copy()
    last = direct
    for _ in range(n_bounces - 1):
        last = room.bounces.albedo * room.bounces.rows.matmul(last)
        exact += last
    np.testing.assert_allclose(quick.solve(direct), exact, rtol=2e-3, atol=1e-4)


def test_more_clusters_come_closer_to_the_light_of_the_view(room: Pipeline) -> None:
    direct = room.cell_light.direct[0]
    exact = room.transport.to_view(solve_bounces(room.bounces, direct[None], 9)[0])

    def error(radiance: np.ndarray) -> float:
        difference = room.transport.to_view(radiance) - exact
        return float(np.sqrt((difference**2).sum() / (exact**2).sum()))

    few, more = (
        error(build_quick_bounces(room.bounces, room.gather.tree, 9, most_clusters=most).solve(direct))
        for most in (64, 512)
    )
    two_reflections = error(build_quick_bounces(room.bounces, room.gather.tree, 2).solve(direct))
    assert more < 0.6 * few < 0.3 * two_reflections


def test_light_that_follows_a_change_converges_on_the_exact_bounces(room: Pipeline) -> None:
    """Every step takes most of the error away, and a small change starts with a small one."""
    direct = room.cell_light.direct[0]
    before = direct * np.random.default_rng(0).uniform(0.8, 1.2, direct.shape).astype(np.float32)
    exact, exact_before = (solve_bounces(room.bounces, light[None], 40)[0] for light in (direct, before))
    quick = build_quick_bounces(room.bounces, room.gather.tree, 16, most_clusters=64)

    def error(radiance: np.ndarray) -> float:
        return float(np.sqrt(((radiance - exact) ** 2).sum() / (exact**2).sum()))

    followed = quick.follow(exact_before, before, direct)
    assert error(followed) < 0.02 < 0.1 * error(exact_before) + 0.02
    assert error(quick.follow(followed, direct, direct)) < 0.5 * error(followed)
    assert error(followed) < error(quick.solve(direct)) < 0.03


def test_bounces_of_a_part_of_the_cells_come_as_close_within_a_round(room: Pipeline) -> None:
    """A look at every fourth cell leaves little more error than one at all, and less the more parts have been seen."""
    direct = room.cell_light.direct[0]
    before = direct * np.random.default_rng(0).uniform(0.8, 1.2, direct.shape).astype(np.float32)
    exact, start = (solve_bounces(room.bounces, light[None], 40)[0] for light in (direct, before))
    quick = build_quick_bounces(room.bounces, room.gather.tree, 16, most_clusters=32)
    assert np.diff(quick.begin).max() > 32

    def error(radiance: np.ndarray) -> float:
        return float(np.sqrt(((radiance - exact) ** 2).sum() / (exact**2).sum()))

    radiance, errors = quick.follow(start, before, direct, part=(0, 4)), []
    for part in range(1, 5):
        errors.append(error(radiance))
        radiance = quick.follow(radiance, direct, direct, part=(part % 4, 4))
    assert errors[0] < 1.5 * error(quick.follow(start, before, direct)) + 0.002
    assert errors[3] < 0.7 * errors[0]


def test_clusters_are_subtrees_that_cover_all_cells(room: Pipeline) -> None:
    begin = cluster_begins(room.gather.tree, 20)
    assert begin[0] == 0 and begin[-1] == room.gather.n
    assert (np.diff(begin) > 0).all() and np.diff(begin).max() <= 20
    tree = room.gather.tree
    nodes = set(zip(tree.lo.tolist(), tree.hi.tolist(), strict=True))
    for first, last in zip(begin[:-1].tolist(), begin[1:].tolist(), strict=True):
        assert last - first == 1 or (first, last) in nodes


def test_any_number_of_threads_gives_the_same_bits(room: Pipeline) -> None:
    direct = room.cell_light.direct[0]
    quick = build_quick_bounces(room.bounces, room.gather.tree, 9, most_clusters=128)
    both = quick.solve(direct)
    threads = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        np.testing.assert_array_equal(quick.solve(direct), both)
    finally:
        numba.set_num_threads(threads)
