"""Masks painted from positions, looked up where rays land."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.edits.binding import bind
from icheat_usd.edits.model import Edit, EditStack, KeyedPayload, Payload, Selection
from icheat_usd.edits.painting import paint_mask, soft_sphere
from icheat_usd.errors import EditError
from icheat_usd.materials import points_on_surface
from tests.scenes import Mesh, make_snapshot, quad_scene, translation


def points(snapshot, triangle, barycentric, instance=0):
    n = len(triangle)
    return points_on_surface(
        snapshot,
        np.full(n, instance, np.int32),
        np.asarray(triangle, np.int32),
        np.asarray(barycentric, np.float32),
        np.zeros(n, np.uint8),
    )


def masks_at(snapshot, mask, where):
    everywhere = Selection(frozenset(surface.path for surface in snapshot.surfaces))
    payload = Payload("scale", {}, receiver_mask=mask)
    edit = Edit("/e", "scale", {}, everywhere, everywhere, keys=(KeyedPayload(payload, 1.0),))
    return bind(EditStack("/s", (edit,)), snapshot).receiver_masks(where)[0]


def random_barycentric(n, seed=0):
    u = np.random.default_rng(seed).uniform(size=(n, 2))
    return np.where(u.sum(axis=1, keepdims=True) > 1, 1 - u, u)


def test_a_painted_linear_function_is_found_again_where_rays_land():
    """Bilinear texels hold a linear function exactly, but for one byte's rounding and half a texel at the borders."""
    snapshot = quad_scene(size=2.0)
    mask = paint_mask(snapshot, ["/quad"], lambda p: (p[:, 0] + p[:, 2] + 2) / 4, resolution=16)
    where = points(snapshot, [0, 1] * 100, random_barycentric(200))
    expected = (where.position[:, 0] + where.position[:, 2] + 2) / 4
    inner = np.abs(where.position[:, [0, 2]]).max(axis=1) < 1 - 1 / 16
    np.testing.assert_allclose(masks_at(snapshot, mask, where)[inner], expected[inner], atol=0.5 / 255 + 1e-5)


def test_triangular_faces_are_painted_up_to_their_long_edge():
    snapshot = make_snapshot([Mesh([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], path="/triangle")])
    mask = paint_mask(snapshot, ["/triangle"], lambda p: 0.5 * (p[:, 0] + p[:, 1]), resolution=8)
    where = points(snapshot, [0] * 3, [[0.5, 0.5], [0.3, 0.7], [0.6, 0.4]])
    np.testing.assert_allclose(masks_at(snapshot, mask, where), 0.5, atol=0.01)


def test_each_instance_is_painted_for_itself():
    triangles = [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]
    snapshot = make_snapshot([Mesh(triangles, transforms=[translation(0, 0, 0), translation(5, 0, 0)], path="/many")])
    mask = paint_mask(snapshot, ["/many"], soft_sphere((0, 0, 0), 2.0, 3.0))
    assert masks_at(snapshot, mask, points(snapshot, [0], [[0.2, 0.2]], instance=0))[0] == 1
    assert masks_at(snapshot, mask, points(snapshot, [0], [[0.2, 0.2]], instance=1))[0] == 0


def test_soft_sphere_falls_from_one_to_zero():
    weights = soft_sphere((1, 0, 0), 1.0, 2.0)(np.array([[1, 0, 0], [1.9, 0, 0], [2.5, 0, 0], [3.1, 0, 0]], np.float32))
    np.testing.assert_allclose(weights, [1, 1, 0.5, 0], atol=1e-6)


def test_nothing_to_paint_is_an_error():
    with pytest.raises(EditError, match="nothing to paint"):
        paint_mask(quad_scene(), ["/elsewhere"], soft_sphere((0, 0, 0), 1, 2))
    with pytest.raises(EditError, match="inner < outer"):
        soft_sphere((0, 0, 0), 2, 1)


def test_a_mask_for_another_scene_or_topology_is_an_error():
    snapshot = quad_scene()
    mask = paint_mask(snapshot, ["/quad"], soft_sphere((0, 0, 0), 1, 2))
    other = make_snapshot([Mesh([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], path="/other")])
    with pytest.raises(EditError, match="another scene"):
        masks_at(other, mask, points(other, [0], [[0, 0]]))


def test_surfaces_that_the_brush_did_not_touch_are_not_kept():
    far = Mesh([[[9, 0, 0], [10, 0, 0], [9, 1, 0]]], path="/far")
    snapshot = make_snapshot([Mesh([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], path="/near"), far])
    mask = paint_mask(snapshot, ["/near", "/far"], soft_sphere((0, 0, 0), 1, 2))
    assert [surface.path for surface in mask.surfaces] == ["/near"] and len(mask.texels) == len(mask.rest) == 1
    assert masks_at(snapshot, mask, points(snapshot, [1], [[0.2, 0.2]], instance=1))[0] == 0
    nothing = paint_mask(snapshot, ["/near", "/far"], soft_sphere((0, 0, 9), 1, 2))
    assert len(nothing.surfaces) == 2 and not nothing.texels.any()
