"""Places of mask texels on surfaces."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel


@parallel_kernel
def texel_positions(face_begin, points, face_uv, resolution, out):  # type: ignore[no-untyped-def]
    """World position of each texel centre of each control face.

    Triangles are sorted by face; those of face `f` are rows
    ``face_begin[f]:face_begin[f + 1]`` of `points` and `face_uv` (n, 3, ...).
    A texel outside all triangles of its face (the far half of a triangular
    face) extends the triangle that it misses by least.
    """
    for f in prange(len(face_begin) - 1):
        for y in range(resolution):
            for x in range(resolution):
                s = (x + 0.5) / resolution
                t = (y + 0.5) / resolution
                nearest = -1e30
                for k in range(face_begin[f], face_begin[f + 1]):
                    ux = face_uv[k, 1, 0] - face_uv[k, 0, 0]
                    uy = face_uv[k, 1, 1] - face_uv[k, 0, 1]
                    vx = face_uv[k, 2, 0] - face_uv[k, 0, 0]
                    vy = face_uv[k, 2, 1] - face_uv[k, 0, 1]
                    area = ux * vy - uy * vx
                    if area == 0.0:
                        continue
                    px = s - face_uv[k, 0, 0]
                    py = t - face_uv[k, 0, 1]
                    b1 = (px * vy - py * vx) / area
                    b2 = (ux * py - uy * px) / area
                    inside = min(min(b1, b2), 1.0 - b1 - b2)
                    if inside > nearest:
                        nearest = inside
                        for axis in range(3):
                            out[f, y, x, axis] = np.float32(
                                (1.0 - b1 - b2) * points[k, 0, axis] + b1 * points[k, 1, axis] + b2 * points[k, 2, axis]
                            )


@kernel
def _texel_place(place, resolution):  # type: ignore[no-untyped-def]
    x = place * np.float32(resolution) - np.float32(0.5)
    return min(max(x, np.float32(0)), np.float32(resolution - 1))


@kernel
def _low_texel(place, resolution):  # type: ignore[no-untyped-def]
    return min(np.int64(_texel_place(place, resolution)), max(resolution - 2, 0))


@kernel
def _bilinear(texels, uv):  # type: ignore[no-untyped-def]
    """Weight at one place of a face, (resolution, resolution)."""
    n = len(texels)
    x0, y0 = _low_texel(uv[0], n), _low_texel(uv[1], n)
    x1, y1 = min(x0 + 1, n - 1), min(y0 + 1, n - 1)
    x, y = _texel_place(uv[0], n) - np.float32(x0), _texel_place(uv[1], n) - np.float32(y0)
    one = np.float32(1)
    top = texels[y0, x0] * (one - x) + texels[y0, x1] * x
    bottom = texels[y1, x0] * (one - x) + texels[y1, x1] * x
    return top * (one - y) + bottom * y


@kernel
def near_texels(resolution, s, t):  # type: ignore[no-untyped-def]
    """Number of the first of the four texels around a place of a face, and of the one that is nearest."""
    x, y = _texel_place(s, resolution), _texel_place(t, resolution)
    half, most = np.float32(0.5), max(resolution - 2, 0)
    first = min(np.int64(y), most) * resolution + min(np.int64(x), most)
    return first, np.int64(y + half) * resolution + np.int64(x + half)


@kernel
def corner_texels(resolution, s, t):  # type: ignore[no-untyped-def]
    """Numbers of the four texels around a place of a face, row by row, and how far it is towards the later ones."""
    x0, y0 = _low_texel(s, resolution), _low_texel(t, resolution)
    x1, y1 = min(x0 + 1, resolution - 1), min(y0 + 1, resolution - 1)
    x, y = _texel_place(s, resolution) - np.float32(x0), _texel_place(t, resolution) - np.float32(y0)
    return y0 * resolution + x0, y0 * resolution + x1, y1 * resolution + x0, y1 * resolution + x1, x, y


@kernel
def texel_weight(texels, first, corners):  # type: ignore[no-untyped-def]
    """Bilinear weight at `corner_texels` of a face whose first texel is ``texels[first]``."""
    top_left, top_right, left, right, x, y = corners
    one = np.float32(1)
    top = texels[first + top_left] * (one - x) + texels[first + top_right] * x
    bottom = texels[first + left] * (one - x) + texels[first + right] * x
    return top * (one - y) + bottom * y


@parallel_kernel
def bilinear_texels(texels, rows, uv, out):  # type: ignore[no-untyped-def]
    """Weights (n,) at places `uv` (n, 2) of the faces in some rows of `texels` (n_faces, resolution, resolution)."""
    for k in prange(len(rows)):
        out[k] = _bilinear(texels[rows[k]], uv[k])


@parallel_kernel
def touched_places(places, row, uv, changed, out):  # type: ignore[no-untyped-def]
    """Whether one of the four texels around each place has changed; as `bilinear_texels` picks them."""
    resolution = changed.shape[1]
    for k in prange(len(places)):
        face = row[places[k]]
        x0, y0 = _low_texel(uv[places[k], 0], resolution), _low_texel(uv[places[k], 1], resolution)
        x1, y1 = min(x0 + 1, resolution - 1), min(y0 + 1, resolution - 1)
        out[k] = changed[face, y0, x0] or changed[face, y0, x1] or changed[face, y1, x0] or changed[face, y1, x1]
