"""From places on triangles to surfaces with a material."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from icheat_usd.scene import F32, I32, U8, Bool, Hits, SceneSnapshot, SurfacePoints

_PLACE = SurfacePoints._fields.index("albedo")


def empty_points(n: int) -> SurfacePoints:
    """`n` points with undefined contents, for kernels to fill."""
    shapes: dict[str, tuple[type[np.generic], tuple[int, ...]]] = {
        "instance": (np.int32, ()),
        "triangle": (np.int32, ()),
        "face": (np.int32, ()),
        "side": (np.uint8, ()),
        "delta": (np.uint8, ()),
        "barycentric": (np.float32, (2,)),
        "face_uv": (np.float32, (2,)),
        "specular_edge": (np.float32, (3,)),
        "roughness": (np.float32, ()),
        "opacity": (np.float32, ()),
        "ior": (np.float32, ()),
    }
    columns: list[Any] = []
    for name in SurfacePoints._fields:
        kind, tail = shapes.get(name, (np.float32, (3,)))
        columns.append(np.empty((n, *tail), kind))
    return SurfacePoints(*columns)


def take_points(points: SurfacePoints, rows: ArrayLike | slice) -> SurfacePoints:
    """Points `rows` (indices, mask or slice) as contiguous copies."""
    columns: list[Any]
    if isinstance(rows, slice):
        columns = [np.array(column[rows], order="C") for column in points]
    else:
        index = np.asarray(rows)
        index = np.flatnonzero(index) if index.dtype == np.bool_ else index
        # A quarter of the time of indexing.
        columns = [np.take(column, index, axis=0) for column in points]
    return SurfacePoints(*columns)


def nonzero_rows(colors: F32) -> Bool:
    """Rows of (n, 3) colours that are not black; a fifth of the time of ``any(axis=1)``."""
    result: Bool = (colors[:, 0] != 0) | (colors[:, 1] != 0) | (colors[:, 2] != 0)
    return result


def concatenate_points(*parts: SurfacePoints) -> SurfacePoints:
    """Points of all parts, one after another."""
    columns: list[Any] = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return SurfacePoints(*columns)


def shade_hits(snapshot: SceneSnapshot, hits: Hits, directions: F32) -> SurfacePoints:
    """Surface points of `hits`, seen from the side that the rays come from.

    Parameters
    ----------
    hits : Hits of n rays
    directions : (n, 3) float32
        Of the rays; any length.

    Returns
    -------
    SurfacePoints
        Materials follow UsdPreviewSurface. A point whose surface scatters has delta NONE also where
        ``0 < opacity < 1``: paths go straight on with probability ``1 - opacity``. Emission is that of
        both sides; a cut-out emits nothing. Reflectances are kept in [0, 1].

    Notes
    -----
    Normals authored against the winding of a triangle are turned over; what then
    still dips below the surface is bent to just above it.
    """
    from icheat_usd.kernels import surface

    side = np.empty(len(hits.instance), np.uint8)
    rows = np.require(directions, np.float32, ["C", "W"])
    geometry = snapshot.geometry
    surface.sides_seen(geometry.points, geometry.instance_to_object, hits.instance, hits.triangle, rows, side)
    return _points(snapshot, hits.instance, hits.triangle, hits.u, hits.v, side)


def points_on_surface(
    snapshot: SceneSnapshot, instance: ArrayLike, triangle: ArrayLike, barycentric: ArrayLike, side: ArrayLike
) -> SurfacePoints:
    """Surface points of given places.

    Parameters
    ----------
    instance : (n,) int
        -1 gives the point of a ray that hit nothing.
    triangle : (n,) int
        Rows of `Geometry`.
    barycentric : (n, 2) float
        Weights of corners 1 and 2.
    side : (n,) int
        0 front, 1 back: the side they are seen from.

    Returns
    -------
    SurfacePoints
        As of `shade_hits`.
    """
    owners = np.require(instance, np.int32, ["C", "W"])
    weights = np.asarray(barycentric, np.float32).reshape(-1, 2)
    return _points(
        snapshot,
        owners,
        np.require(triangle, np.int32, ["C", "W"]),
        np.ascontiguousarray(weights[:, 0]),
        np.ascontiguousarray(weights[:, 1]),
        np.require(np.broadcast_to(np.asarray(side, np.uint8), owners.shape), np.uint8, ["C", "W"]),
    )


def _points(snapshot: SceneSnapshot, instance: I32, triangle: I32, u: F32, v: F32, side: U8) -> SurfacePoints:
    from icheat_usd.kernels import surface

    n = len(instance)
    out = empty_points(n)
    st, color = np.empty((n, 2), np.float32), np.empty((n, 3), np.float32)
    # Columns of `SurfacePoints` stand in this order: the place first, then what is seen there.
    place: list[Any] = list(out[:_PLACE])
    seen: list[Any] = list(out[_PLACE:])
    surface.place_points(snapshot.geometry, instance, triangle, u, v, side, st, color, *place)
    materials, material = snapshot.materials, snapshot.geometry.material
    inputs = np.empty((n, 6, 3), np.float32)
    surface.constant_inputs(materials, material, out.instance, out.triangle, color, inputs)
    if (materials.texture >= 0).any():
        surface.sample_inputs(materials, snapshot.textures, material, out.instance, out.triangle, st, inputs)
    surface.reflectances(materials, material, out.instance, out.triangle, inputs, *seen)
    return out
