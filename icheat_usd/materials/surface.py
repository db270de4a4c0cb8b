"""From places on triangles to surfaces with a material."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from icheat_usd.scene import F32, Hits, SceneSnapshot, SurfacePoints


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
        "specular_edge": (np.float32, ()),
        "roughness": (np.float32, ()),
        "opacity": (np.float32, ()),
        "ior": (np.float32, ()),
    }
    columns: list[Any] = []
    for name in SurfacePoints._fields:
        kind, tail = shapes.get(name, (np.float32, (3,)))
        columns.append(np.empty((n, *tail), kind))
    return SurfacePoints(*columns)


def take_points(points: SurfacePoints, rows: ArrayLike) -> SurfacePoints:
    """Points `rows` (indices, mask or slice) as contiguous copies."""
    index: Any = rows
    columns: list[Any] = [np.array(column[index], order="C") for column in points]
    return SurfacePoints(*columns)


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

    out = empty_points(len(hits.instance))
    rows = np.require(directions, np.float32, ["C", "W"])
    surface.shade_hits(snapshot.geometry, snapshot.materials, snapshot.textures, hits, rows, out)
    return out


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
    from icheat_usd.kernels import surface

    owners = np.require(instance, np.int32, ["C", "W"])
    out = empty_points(len(owners))
    surface.points_on_surface(
        snapshot.geometry,
        snapshot.materials,
        snapshot.textures,
        owners,
        np.require(triangle, np.int32, ["C", "W"]),
        np.require(barycentric, np.float32, ["C", "W"]).reshape(-1, 2),
        np.require(np.broadcast_to(np.asarray(side, np.uint8), owners.shape), np.uint8, ["C", "W"]),
        out,
    )
    return out
