"""Photons near a place: a tree of boxes over points sorted along a Morton curve, and kernel density estimates."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.light_geometry import orthonormal_basis
from icheat_usd.kernels.random import hash_combine, sobol_pair

LEAF = 8  #: photons of a leaf, scanned one by one
_DEPTH = 64
_BLOCK = 64  # queries that share a stack

F32 = NDArray[np.float32]


class PhotonTree(NamedTuple):
    """Points in Morton order and a full binary tree of boxes over leaves of `LEAF` of them, as a heap from node 1."""

    position: F32  #: (n, 3)
    normal: F32  #: (n, 3) unit
    box: F32  #: (2 * n_leaves, 12) lowest and highest corner, and those of the normals; an empty box is inverted
    n_leaves: int  #: a power of two


@parallel_kernel
def morton_codes(position: F32, normal: F32, low: np.ndarray, scale: float, out: np.ndarray) -> None:
    """Morton codes of points, those of one axis-aligned direction together; `scale` takes metres to 2^19 cells."""
    for i in prange(position.shape[0]):
        facing, most = 0, np.float32(0.0)
        for c in range(3):
            if abs(normal[i, c]) > most:
                facing, most = 2 * c + (1 if normal[i, c] > 0.0 else 0), abs(normal[i, c])
        code = np.uint64(facing) << np.uint64(60)
        for c in range(3):
            x = np.uint64(min(max((np.float64(position[i, c]) - low[c]) * scale, 0.0), 524287.0))
            x = (x | (x << np.uint64(32))) & np.uint64(0x1F00000000FFFF)
            x = (x | (x << np.uint64(16))) & np.uint64(0x1F0000FF0000FF)
            x = (x | (x << np.uint64(8))) & np.uint64(0x100F00F00F00F00F)
            x = (x | (x << np.uint64(4))) & np.uint64(0x10C30C30C30C30C3)
            x = (x | (x << np.uint64(2))) & np.uint64(0x1249249249249249)
            code |= x << np.uint64(c)
        out[i] = code


@kernel
def fill_boxes(position: F32, normal: F32, n_leaves: int, box: F32) -> None:
    """Boxes of the leaves, then of what is above them."""
    for node in range(2 * n_leaves - 1, 0, -1):
        for part in range(2):
            values = position if part == 0 else normal
            for c in range(3):
                low, high, first = np.float32(np.inf), np.float32(-np.inf), 6 * part + c
                if node >= n_leaves:
                    begin = (node - n_leaves) * LEAF
                    for i in range(begin, min(begin + LEAF, values.shape[0])):
                        low, high = min(low, values[i, c]), max(high, values[i, c])
                else:
                    low = min(box[2 * node, first], box[2 * node + 1, first])
                    high = max(box[2 * node, first + 3], box[2 * node + 1, first + 3])
                box[node, first] = low
                box[node, first + 3] = high


@kernel
def _outside(box: F32, node: int, x: float, y: float, z: float, nx: float, ny: float, nz: float, agree: float) -> float:
    """Squared distance to a box; infinite if no normal in it agrees."""
    best = max(nx * box[node, 6], nx * box[node, 9])
    best += max(ny * box[node, 7], ny * box[node, 10])
    best += max(nz * box[node, 8], nz * box[node, 11])
    # not so in empty boxes, whose distance is infinite in any case
    if best < agree:
        return np.inf
    dx = max(box[node, 0] - x, x - box[node, 3], 0.0)
    dy = max(box[node, 1] - y, y - box[node, 4], 0.0)
    dz = max(box[node, 2] - z, z - box[node, 5], 0.0)
    return dx * dx + dy * dy + dz * dz


@kernel
def _sink(distance: F32, index: np.ndarray, count: int, d: float, i: int) -> None:
    """Replace the root of a max-heap."""
    at = 0
    while True:
        child = 2 * at + 1
        if child >= count:
            break
        if child + 1 < count and distance[child + 1] > distance[child]:
            child += 1
        if distance[child] <= d:
            break
        distance[at] = distance[child]
        index[at] = index[child]
        at = child
    distance[at] = d
    index[at] = i


@kernel
def _rise(distance: F32, index: np.ndarray, count: int, d: float, i: int) -> None:
    """Append to a max-heap of `count` entries."""
    at = count
    while at > 0 and distance[(at - 1) // 2] < d:
        distance[at] = distance[(at - 1) // 2]
        index[at] = index[(at - 1) // 2]
        at = (at - 1) // 2
    distance[at] = d
    index[at] = i


@kernel
def _nearest(
    position: F32, normal: F32, box: F32, n_leaves: int, x: float, y: float, z: float, nx: float, ny: float, nz: float,
    limit: float, agree: float, flatness: float, distance: F32, index: np.ndarray, stack: np.ndarray, bound: F32,
) -> int:  # fmt: skip
    """Fill the max-heap (distance, index) with the nearest points whose normals agree; how many there are.

    Squared distances, and not those alone: off the plane of the query they count `flatness` times.
    """
    k = distance.shape[0]
    count = 0
    extra = flatness * flatness - 1.0
    depth = 0
    node = np.int64(1)
    near = _outside(box, 1, x, y, z, nx, ny, nz, agree)
    while True:
        if near < (distance[0] if count == k else limit):
            if node >= n_leaves:
                begin = (node - n_leaves) * LEAF
                for i in range(begin, min(begin + LEAF, position.shape[0])):
                    if normal[i, 0] * nx + normal[i, 1] * ny + normal[i, 2] * nz < agree:
                        continue
                    dx, dy, dz = position[i, 0] - x, position[i, 1] - y, position[i, 2] - z
                    off = dx * nx + dy * ny + dz * nz
                    d = np.float32(dx * dx + dy * dy + dz * dz + extra * off * off)
                    if count < k:
                        if d < limit:
                            _rise(distance, index, count, d, i)
                            count += 1
                    elif d < distance[0]:
                        _sink(distance, index, count, d, i)
            else:
                left = _outside(box, 2 * node, x, y, z, nx, ny, nz, agree)
                right = _outside(box, 2 * node + 1, x, y, z, nx, ny, nz, agree)
                first = 2 * node if left <= right else 2 * node + 1
                stack[depth] = 4 * node + 1 - first
                bound[depth] = max(left, right)
                depth += 1
                node, near = first, min(left, right)
                continue
        if depth == 0:
            return count
        depth -= 1
        node, near = stack[depth], bound[depth]


@kernel
def _search_block(
    tree: tuple, query: F32, query_normal: F32, begin: int, end: int, k: int, limit: float, agree: float,
    flatness: float, index: np.ndarray, distance: F32, radius: F32,
) -> None:  # fmt: skip
    stack = np.empty(_DEPTH, np.int64)
    bound = np.empty(_DEPTH, np.float64)
    found_distance, found = np.empty(k, np.float32), np.empty(k, np.int32)
    for q in range(begin, end):
        count = _nearest(
            tree.position, tree.normal, tree.box, tree.n_leaves,
            np.float64(query[q, 0]), np.float64(query[q, 1]), np.float64(query[q, 2]),
            np.float64(query_normal[q, 0]), np.float64(query_normal[q, 1]), np.float64(query_normal[q, 2]),
            limit, agree, flatness, found_distance, found, stack, bound,
        )  # fmt: skip
        for j in range(k):
            index[q, j] = found[j] if j < count else -1
            distance[q, j] = found_distance[j] if j < count else np.float32(np.inf)
        radius[q] = found_distance[0] if count == k else limit


@parallel_kernel
def nearest_photons(
    tree: tuple, query: F32, query_normal: F32, max_radius: float, agree: float, flatness: float, index: np.ndarray,
    distance: F32, radius: F32,
) -> None:  # fmt: skip
    """The nearest points of each query (n, k): rows (-1: fewer), squared distances, and the squared radius of all.

    Points further than `max_radius`, or whose normal is not within the cosine `agree` of the query's, do not count.
    The furthest of k sets the radius.
    """
    n = query.shape[0]
    for block in prange((n + _BLOCK - 1) // _BLOCK):
        _search_block(
            tree, query, query_normal, block * _BLOCK, min(n, (block + 1) * _BLOCK), index.shape[1],
            max_radius * max_radius, agree, flatness, index, distance, radius,
        )  # fmt: skip


@parallel_kernel
def probe_rays(
    query: F32, query_normal: F32, radius: F32, n_probes: int, flatness: float, seed: int, origin: F32, direction: F32
) -> None:
    """Rays (n * n_probes) that look for the surface about each query, spread as the Epanechnikov kernel weighs it.

    Each starts above the disk and is as long as the kernel is thick there, twice: it ends below.
    """
    for q in prange(query.shape[0]):
        nx, ny, nz = np.float64(query_normal[q, 0]), np.float64(query_normal[q, 1]), np.float64(query_normal[q, 2])
        sx, sy, sz, tx, ty, tz = orthonormal_basis(nx, ny, nz)
        r = math.sqrt(np.float64(radius[q]))
        sequence = hash_combine(seed, q)
        for j in range(n_probes):
            u, v = sobol_pair(j, sequence)
            # Share of the kernel 2 (1 - s) / pi within sqrt(s): 2 s - s^2.
            s = 1.0 - math.sqrt(1.0 - np.float64(u))
            along = r * math.sqrt(s)
            height = r * math.sqrt(1.0 - s) / flatness
            x = along * math.cos(2.0 * math.pi * np.float64(v))
            y = along * math.sin(2.0 * math.pi * np.float64(v))
            ray = q * n_probes + j
            origin[ray, 0] = query[q, 0] + x * sx + y * tx + height * nx
            origin[ray, 1] = query[q, 1] + x * sy + y * ty + height * ny
            origin[ray, 2] = query[q, 2] + x * sz + y * tz + height * nz
            direction[ray, 0] = -2.0 * height * nx
            direction[ray, 1] = -2.0 * height * ny
            direction[ray, 2] = -2.0 * height * nz


@parallel_kernel
def lopsided(position: F32, query: F32, index: np.ndarray, radius: F32, most: float, out: np.ndarray) -> None:
    """Where the mean of the photons found lies further from the query than `most` radii: something divides them."""
    for q in prange(index.shape[0]):
        x, y, z, count = 0.0, 0.0, 0.0, 0
        for j in range(index.shape[1]):
            i = index[q, j]
            if i >= 0:
                x += np.float64(position[i, 0]) - query[q, 0]
                y += np.float64(position[i, 1]) - query[q, 1]
                z += np.float64(position[i, 2]) - query[q, 2]
                count += 1
        limit = most * count
        out[q] = x * x + y * y + z * z > limit * limit * radius[q]


@parallel_kernel
def sum_photons(
    power: F32, light: np.ndarray, index: np.ndarray, distance: F32, radius: F32, visible: np.ndarray, coverage: F32,
    out: F32,
) -> None:  # fmt: skip
    """Irradiance of each light (n_lights, n, 3) from the photons that `nearest_photons` found.

    Epanechnikov kernel 2 (1 - d^2 / r^2) / (pi r^2), over the share `coverage` of it that lies on the surface.
    """
    for q in prange(index.shape[0]):
        for c in range(out.shape[0]):
            for axis in range(3):
                out[c, q, axis] = 0.0
        scale = 2.0 / (math.pi * radius[q] * coverage[q])
        for j in range(index.shape[1]):
            i = index[q, j]
            if i >= 0 and visible[q, j] != 0:
                weight = np.float32(scale * (1.0 - distance[q, j] / radius[q]))
                for axis in range(3):
                    out[light[i], q, axis] += weight * power[i, axis]
