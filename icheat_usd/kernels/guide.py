"""Which parts of a dome to sample from where: piecewise constant densities, looked up by place and normal.

A guide warps the two random numbers of a dome's own sampler, the *plane* of the dome: for an image the
numbers of `sample_dome_image`, so that a cell of the plane holds the same share of the image's light
everywhere; for a dome without an image the z and the longitude of the sphere. Its density there times
the plain sampler's is the guided one, exactly.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.environment import F32, F64, Floats, Table, dome_image_numbers, search_cdf
from icheat_usd.kernels.light_geometry import linear_map, normalized
from icheat_usd.kernels.lights import light_shape, sample_shape
from icheat_usd.kernels.random import hash_combine, hash_u32, to_unit

I32 = NDArray[np.int32]
I64 = NDArray[np.int64]

#: Cells of a plane: bands along the second random number, columns along the first.
BANDS, COLUMNS = 32, 32

#: Classes of normals: the six half axes, by the largest component.
CLASSES = 6

#: Of the samples of a guided dome without an image, the share that keeps to the cosine.
COSINE_SHARE = 0.25

_DOME = 5


class Guide(NamedTuple):
    """A tree over places whose leaves, per class of normals and light, may have a density over the plane."""

    axis: NDArray[np.int32]  #: (n_nodes,) inner node: coordinate that it splits; -1: leaf
    split: NDArray[np.float32]  #: (n_nodes,) inner node: places below it go left
    child: NDArray[np.int32]  #: (n_nodes,) inner node: left child, the right one follows it; leaf: its number
    row: NDArray[np.int32]  #: (n_lights, n_leaves * CLASSES) row of the distributions; -1: sample plainly
    bands: NDArray[np.float32]  #: (n_rows, BANDS) cumulative probability
    columns: NDArray[np.float32]  #: (n_rows, BANDS * COLUMNS) cumulative over each band


@kernel
def normal_class(nx: float, ny: float, nz: float) -> int:
    ax, ay, az = abs(nx), abs(ny), abs(nz)
    if ax >= ay and ax >= az:
        return 0 if nx >= 0.0 else 1
    if ay >= az:
        return 2 if ny >= 0.0 else 3
    return 4 if nz >= 0.0 else 5


@kernel
def find_leaf(axis: I32, split: F32, child: I32, px: float, py: float, pz: float) -> int:
    node = 0
    while axis[node] >= 0:
        a = axis[node]
        value = px if a == 0 else (py if a == 1 else pz)
        node = child[node] if value < split[node] else child[node] + 1
    return int(child[node])


@kernel
def find_row(
    axis: I32, split: F32, child: I32, rows: I32, light: int,
    px: float, py: float, pz: float, nx: float, ny: float, nz: float,
) -> int:  # fmt: skip
    """Row of the density to sample `light` with at a place with a normal; -1: plainly."""
    if rows.shape[1] == 0:
        return -1
    leaf = find_leaf(axis, split, child, px, py, pz)
    return int(rows[light, leaf * CLASSES + normal_class(nx, ny, nz)])


@kernel
def warp(bands: F32, columns: F32, row: int, u1: float, u2: float) -> Floats:
    """Numbers of the plane with the guide's density, and that density; keeps strata together."""
    band = search_cdf(bands[row], 0, BANDS, u2)
    below = bands[row, band - 1] if band > 0 else 0.0
    p_band = bands[row, band] - below
    first = band * COLUMNS
    k = search_cdf(columns[row], first, first + COLUMNS, u1)
    left = columns[row, k - 1] if k > first else 0.0
    p_column = columns[row, k] - left
    if p_band <= 0.0 or p_column <= 0.0:
        return 0.0, 0.0, 0.0
    v1 = (k - first + min(max((u1 - left) / p_column, 0.0), 1.0)) / COLUMNS
    v2 = (band + min(max((u2 - below) / p_band, 0.0), 1.0)) / BANDS
    return v1, v2, p_band * p_column * (BANDS * COLUMNS)


@kernel
def density(bands: F32, columns: F32, row: int, v1: float, v2: float) -> float:
    """Density of `warp` at a place of the plane."""
    band = min(max(int(v2 * BANDS), 0), BANDS - 1)
    k = band * COLUMNS + min(max(int(v1 * COLUMNS), 0), COLUMNS - 1)
    p_band = bands[row, band] - (bands[row, band - 1] if band > 0 else 0.0)
    p_column = columns[row, k] - (columns[row, k - 1] if k > band * COLUMNS else 0.0)
    return p_band * p_column * (BANDS * COLUMNS)


@kernel
def sphere_direction(v1: float, v2: float) -> Floats:
    z = 1.0 - 2.0 * v2
    r = math.sqrt(max(0.0, 1.0 - z * z))
    phi = 2.0 * math.pi * v1
    return r * math.cos(phi), r * math.sin(phi), z


@kernel
def sphere_numbers(x: float, y: float, z: float) -> Floats:
    """Inverse of `sphere_direction`."""
    v1 = math.atan2(y, x) / (2.0 * math.pi)
    return v1 - math.floor(v1), 0.5 * (1.0 - z)


@kernel
def plain_dome_pdf(
    bands: F32, columns: F32, row: int, nx: float, ny: float, nz: float, wx: float, wy: float, wz: float
) -> float:
    """Probability per solid angle of a guided direction to a dome without an image."""
    v1, v2 = sphere_numbers(wx, wy, wz)
    cosine = max(0.0, nx * wx + ny * wy + nz * wz)
    guided = density(bands, columns, row, v1, v2) / (4.0 * math.pi)
    return COSINE_SHARE * cosine / math.pi + (1.0 - COSINE_SHARE) * guided


@kernel
def image_density(
    bands: F32, columns: F32, row: int, rows_cdf: F64, columns_cdf: F32, image: tuple[int, ...], inverse: Floats,
    wx: float, wy: float, wz: float,
) -> float:  # fmt: skip
    """Factor by which the guide changes the probability of a direction to a dome with an image."""
    x, y, z = linear_map(inverse, wx, wy, wz)
    x, y, z = normalized(x, y, z)
    v1, v2 = dome_image_numbers(rows_cdf, image[3], columns_cdf, image[4], image[1], image[2], x, y, z)
    return density(bands, columns, row, v1, v2)


# Learning ---------------------------------------------------------------------------------------------


@parallel_kernel
def find_keys(axis: I32, split: F32, child: I32, position: F32, normal: F32, out: I64) -> None:
    """Leaf x CLASSES + class of the normal, of each point."""
    for i in prange(len(out)):
        leaf = find_leaf(axis, split, child, position[i, 0], position[i, 1], position[i, 2])
        out[i] = leaf * CLASSES + normal_class(normal[i, 0], normal[i, 1], normal[i, 2])


@parallel_kernel
def plane_places(
    lights: Table, textures: Table, tables: Table, light: int, seed: int, direction: F32, level: F32
) -> None:
    """Some places in each cell of a dome's plane.

    Parameters
    ----------
    direction : (BANDS * COLUMNS, k, 3) float32, out
        Towards the dome.
    level : (BANDS * COLUMNS, k) float32, out
        Radiance over the plain sampler's probability, relative to the light; 0 where it sends nothing.
    """
    kind, m, inverse, size, image = light_shape(lights, textures, tables, light)
    texels, rows_cdf, columns_cdf = textures.texels, tables.rows_cdf, tables.columns_cdf
    for cell in prange(BANDS * COLUMNS):
        for k in range(level.shape[1]):
            word = hash_combine(hash_combine(hash_combine(seed, 0x13), light), cell * level.shape[1] + k)
            v1 = (cell % COLUMNS + to_unit(hash_u32(word))) / COLUMNS
            v2 = (cell // COLUMNS + to_unit(hash_u32(hash_u32(word)))) / BANDS
            level[cell, k] = 0.0
            if image[0] >= 0:
                wx, wy, wz, t, pdf, red, green, blue = sample_shape(
                    kind, m, inverse, size, image, texels, rows_cdf, columns_cdf, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, v1, v2
                )
                if pdf > 0.0:
                    level[cell, k] = (0.2126 * red + 0.7152 * green + 0.0722 * blue) / pdf
            else:
                wx, wy, wz = sphere_direction(v1, v2)
                level[cell, k] = 4.0 * math.pi
            direction[cell, k, 0] = wx
            direction[cell, k, 1] = wy
            direction[cell, k, 2] = wz


@parallel_kernel
def fill_pilot(
    towards: F32,
    level: F32,
    begin: I64,
    first: int,
    position: F32,
    normal: F32,
    shading_normal: F32,
    seed: int,
    point: I64,
    direction: F32,
    value: F32,
) -> None:
    """One ray per cell of the plane for each group of points `begin[i]:begin[i + 1]`, each from a point of the group.

    `towards` and `level` are of `plane_places`. `value` is the unshadowed contribution to irradiance, `level` times
    cosine; 0 where the point's horizon hides the direction.
    """
    cells = BANDS * COLUMNS
    for i in prange(len(begin) - 1):
        stream = hash_combine(hash_combine(seed, 0x17), first + i)
        for cell in range(cells):
            word = hash_combine(stream, cell)
            p = begin[i] + int(word) % (begin[i + 1] - begin[i])
            k = int(hash_u32(word)) % level.shape[1]
            wx, wy, wz = towards[cell, k, 0], towards[cell, k, 1], towards[cell, k, 2]
            cosine = wx * shading_normal[p, 0] + wy * shading_normal[p, 1] + wz * shading_normal[p, 2]
            if cosine <= 0.0 or wx * normal[p, 0] + wy * normal[p, 1] + wz * normal[p, 2] <= 0.0:
                continue
            row = i * cells + cell
            point[row] = p
            direction[row, 0] = wx
            direction[row, 1] = wy
            direction[row, 2] = wz
            value[row] = level[cell, k] * cosine


@parallel_kernel
def smooth_planes(square: F32, out: F32) -> None:
    """Binomial 3 x 3 filter over each plane (n, BANDS * COLUMNS); columns go round, bands end."""
    for i in prange(len(square)):
        for band in range(BANDS):
            for column in range(COLUMNS):
                total = 0.0
                for dy in range(-1, 2):
                    y = min(max(band + dy, 0), BANDS - 1)
                    for dx in range(-1, 2):
                        x = (column + dx) % COLUMNS
                        weight = (2.0 if dy == 0 else 1.0) * (2.0 if dx == 0 else 1.0) / 16.0
                        total += weight * square[i, y * COLUMNS + x]
                out[i, band * COLUMNS + column] = total


@parallel_kernel
def accumulate_planes(weight: F32, bands: F32, columns: F32) -> None:
    """Cumulative distributions of planes of weights (n, BANDS * COLUMNS)."""
    for i in prange(len(weight)):
        whole = 0.0
        for band in range(BANDS):
            for column in range(COLUMNS):
                whole += weight[i, band * COLUMNS + column]
        reached = 0.0
        for band in range(BANDS):
            first = band * COLUMNS
            total = 0.0
            for column in range(COLUMNS):
                total += weight[i, first + column]
            partial = 0.0
            for column in range(COLUMNS):
                partial += weight[i, first + column]
                columns[i, first + column] = partial / total if total > 0.0 else (column + 1.0) / COLUMNS
            columns[i, first + COLUMNS - 1] = 1.0
            reached += total
            bands[i, band] = reached / whole
        bands[i, BANDS - 1] = 1.0
