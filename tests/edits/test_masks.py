"""Painted masks find their surfaces again, exactly or, on another topology, by the nearest old texel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from icheat_usd.edits.masks import _nearest, bind_mask
from icheat_usd.edits.model import SurfaceMask
from icheat_usd.edits.painting import paint_mask, soft_sphere
from icheat_usd.errors import EditError
from icheat_usd.scene import SceneSnapshot
from tests.scenes import Mesh, make_snapshot, quads, translation

F = np.ndarray


def grid(nx: int, ny: int, height: Callable[[F], F] | float = 0.0, *, turn: int = 0, size: float = 1.0) -> Mesh:
    """A square in xz of nx x ny quads, faces in an order and with corners that depend on `turn`."""
    corners = np.array([[[i, j], [i + 1, j], [i + 1, j + 1], [i, j + 1]] for j in range(ny) for i in range(nx)], float)
    corners = np.roll(corners[np.random.default_rng(turn).permutation(nx * ny)], turn, axis=1)
    corners *= np.array([size / nx, size / ny])
    y = height(corners) if callable(height) else np.full(corners.shape[:2], height)
    points = quads(np.stack([corners[..., 0], y, -corners[..., 1]], axis=-1))
    uv = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]])
    n = nx * ny
    return Mesh(points, path="/cloth", face=np.repeat(np.arange(n), 2), face_uv=np.tile(uv, (n, 1, 1)))


def scene(mesh: Mesh, digest: str) -> SceneSnapshot:
    snapshot = make_snapshot([mesh])
    return replace(snapshot, surfaces=tuple(replace(s, topology_digest=digest) for s in snapshot.surfaces))


def weights(snapshot: SceneSnapshot, mask: SurfaceMask, n: int = 400) -> tuple[F, F]:
    """Object-space places all over the surface and the mask's weights there."""
    random = np.random.default_rng(1)
    g = snapshot.geometry
    triangle = random.integers(len(g.points), size=n)
    b = random.dirichlet((1, 1, 1), n).astype(np.float32)
    places = np.einsum("nk,nki->ni", b, g.points[triangle])
    uv = np.einsum("nk,nki->ni", b, g.face_uv[triangle]).astype(np.float32)
    bound = bind_mask(mask, snapshot, "/edit")
    return places, bound.at(np.zeros(n, np.int32), g.face[triangle], uv)


def ramp(places: F) -> F:
    return np.clip(places[:, 0], 0, 1)


def test_another_topology_takes_the_weights_of_the_nearest_surface_and_says_so() -> None:
    old, new = scene(grid(8, 6), "old"), scene(grid(5, 11, turn=2), "new")
    mask = paint_mask(old, ["/cloth"], ramp, resolution=8)
    places, found = weights(new, mask)
    # Half an old texel away at most, sideways, and half a new one where the ramp is clamped at a face's border.
    assert np.abs(found - ramp(places)).max() < 0.5 / (8 * 8) + 0.5 / (5 * 8) + 1 / 255
    (finding,) = bind_mask(mask, new, "/edit").findings
    assert finding.prim == "/edit" and "another topology of /cloth (48 faces then, 55 now)" in finding.message
    assert bind_mask(mask, old, "/edit").findings == ()


def test_carrying_over_gives_the_same_bits_each_time() -> None:
    mask = paint_mask(scene(grid(8, 6), "old"), ["/cloth"], ramp, resolution=8)
    new = scene(grid(5, 11, turn=2), "new")
    first, second = (bind_mask(mask, new, "/edit").texels for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_the_same_faces_in_another_order_find_their_very_weights() -> None:
    """A re-export: every texel lies where an old one lay, so that nothing is lost."""
    old, new = scene(grid(6, 6), "old"), scene(grid(6, 6, turn=1), "new")
    mask = paint_mask(old, ["/cloth"], soft_sphere((0.4, 0, -0.5), 0.1, 0.5), resolution=8)
    fresh = paint_mask(new, ["/cloth"], soft_sphere((0.4, 0, -0.5), 0.1, 0.5), resolution=8)
    carried = bind_mask(mask, new, "/edit")
    np.testing.assert_array_equal(carried.texels[carried.first_face[0] :], fresh.texels)


def test_a_thin_wall_does_not_take_what_is_painted_on_its_other_side() -> None:
    def sheet(nx: int, ny: int) -> Mesh:
        top, below = grid(nx, ny, 0.001), grid(nx, ny)
        points = np.concatenate([top.points, np.asarray(below.points)[:, ::-1]])
        uv = np.concatenate([top.face_uv, np.asarray(below.face_uv)[:, ::-1]])
        return Mesh(
            points, path="/cloth", face=np.concatenate([top.face, np.asarray(below.face) + nx * ny]), face_uv=uv
        )

    mask = paint_mask(scene(sheet(4, 4), "old"), ["/cloth"], lambda p: p[:, 1] > 0.0005, resolution=4)
    places, found = weights(scene(sheet(7, 5), "new"), mask)
    np.testing.assert_array_equal(found, places[:, 1] > 0.0005)


def test_a_mask_that_does_not_know_where_its_faces_lay_is_an_error() -> None:
    mask = replace(paint_mask(scene(grid(4, 4), "old"), ["/cloth"], ramp), rest=None)
    with pytest.raises(EditError, match="another topology of /cloth .16 faces then, 12 now.; paint it again or mute"):
        bind_mask(mask, scene(grid(4, 3), "new"), "/edit")
    # Without digests the number of faces still tells, so that no row is read beyond the last.
    with pytest.raises(EditError, match="another topology"):
        bind_mask(replace(mask, surfaces=(replace(mask.surfaces[0], topology_digest=""),)), scene(grid(4, 3), ""), "/e")


def test_a_deformed_mesh_is_the_same_topology() -> None:
    mask = paint_mask(scene(grid(6, 6), "same"), ["/cloth"], ramp, resolution=8)
    bent = scene(grid(6, 6, lambda c: np.sin(3 * c[..., 0])), "same")
    carried = bind_mask(mask, bent, "/edit")
    assert carried.findings == () and carried.texels is not None
    np.testing.assert_array_equal(carried.texels, mask.texels)


def test_rest_positions_are_those_of_quarter_points_in_object_space() -> None:
    moved = replace(grid(2, 1), transforms=[translation(5, 6, 7)])
    mask = paint_mask(scene(moved, "old"), ["/cloth"], lambda p: p[:, 0] - 5, resolution=4)
    assert mask.rest is not None and mask.rest.shape == (2, 2, 2, 3)
    expected = np.sort([0.125, 0.375, 0.625, 0.875] * 2)
    np.testing.assert_allclose(np.sort(mask.rest[..., 0].reshape(-1)), expected, atol=1e-6)
    assert mask.rest[..., 1].max() == 0.0  # the brush saw y = 6


@pytest.mark.parametrize("flat", [False, True])
def test_the_nearest_place_is_that_of_a_plain_search(flat: bool) -> None:
    random = np.random.default_rng(3)

    def cloud(n: int, spread: float) -> tuple[F, F]:
        places = random.normal(size=(n, 3)) * spread
        if flat:
            places[:, 1] = 0.25
        normals = random.normal(size=(n, 3))
        return places, normals / np.linalg.norm(normals, axis=1, keepdims=True)

    places, normals = cloud(700, 1.0)
    queries, query_normals = cloud(300, 3.0)  # many beyond the grid
    extent = (places.max(axis=0) - places.min(axis=0)).max()
    weight = (2.0 * extent / np.sqrt(len(places))) ** 2
    distance = ((queries[:, None] - places) ** 2).sum(axis=2)
    distance += weight * ((query_normals[:, None] - normals) ** 2).sum(axis=2)
    np.testing.assert_array_equal(_nearest(places, normals, queries, query_normals), distance.argmin(axis=1))


def test_equal_places_give_the_first() -> None:
    places = np.tile([[0.0, 1.0, 2.0], [3.0, 1.0, 2.0]], (20, 1))
    normals = np.tile([0.0, 1.0, 0.0], (40, 1))
    found = _nearest(places, normals, places[:2] + 0.1, normals[:2])
    np.testing.assert_array_equal(found, [0, 1])
