"""Triangles that overlap: their edges move outwards in their planes, by as much as was asked for."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.kernels.overlap import overlap_triangles

OUTWARDS = 2.0**-22


def grown(triangles: np.ndarray, reach: float = 0.0, farthest: float = np.inf) -> np.ndarray:
    out = np.empty_like(triangles)
    overlap_triangles(triangles, reach, farthest, out)
    return out


def outward(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """How far the corners that begin each edge (n, 3) have moved away from it."""
    normal = np.cross(before[:, 1] - before[:, 0], before[:, 2] - before[:, 0])
    edge = np.roll(before, -1, axis=1) - before
    out = np.cross(edge, normal[:, None])
    out /= np.linalg.norm(out, axis=2, keepdims=True)
    return np.einsum("nek,nek->ne", after - before, out)


def soup(n: int = 200) -> np.ndarray:
    found = np.random.default_rng(1).normal(size=(n, 3, 3))
    edges = np.roll(found, -1, axis=1) - found
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    return found[area > 0.2 * longest**2]  # without slivers


@pytest.mark.parametrize(("reach", "farthest"), [(0.0, np.inf), (100.0, np.inf), (100.0, 8.0)])
def test_every_edge_moves_outwards_by_rounding_of_the_largest_coordinates(reach: float, farthest: float) -> None:
    before = soup()
    own = np.abs(before).max(axis=(1, 2))
    expected = OUTWARDS * (own + np.minimum(reach, farthest * own))
    moved = outward(before, grown(before, reach, farthest))
    np.testing.assert_allclose(moved, np.broadcast_to(expected[:, None], moved.shape), rtol=1e-6)


def test_planes_stay() -> None:
    before = soup()
    normal = np.cross(before[:, 1] - before[:, 0], before[:, 2] - before[:, 0])
    across = np.einsum("nk,njk->nj", normal, grown(before, 100.0) - before)
    assert np.abs(across).max() < 1e-14


def test_corners_of_slivers_stay_near_and_no_edge_moves_inwards() -> None:
    sliver = np.array([[[0, 0, 0], [1, 0, 0], [1, 1e-4, 0]], [[0, 0, 0], [1, 0, 0], [0.5, 1e-6, 0]]], np.float64)
    after = grown(sliver)
    assert np.linalg.norm(after - sliver, axis=2).max() <= 16.001 * OUTWARDS
    assert (outward(sliver, after) > 0).all()


def test_what_has_no_area_stays_as_it_is() -> None:
    point, line = np.ones((3, 3)), np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]], np.float64)
    before = np.stack([point, line])
    np.testing.assert_array_equal(grown(before, 10.0), before)
