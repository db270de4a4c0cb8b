"""Direct light at surface points: shadow rays to fill, and their sums."""

from __future__ import annotations

import math

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.dome_rays import DISTANCE, PDF, RADIANCE
from icheat_usd.kernels.environment import F32, F64, Table
from icheat_usd.kernels.guide import find_row, image_density, plain_dome_pdf
from icheat_usd.kernels.light_hits import hit_shape
from icheat_usd.kernels.light_rays import ask_rays, find_rays, make_asked
from icheat_usd.kernels.light_triangles import mesh_pdf, sample_mesh
from icheat_usd.kernels.lights import light_shape
from icheat_usd.kernels.random import hash_combine, sobol_pair
from icheat_usd.kernels.vector import dot, row3

_DOME = 5
_CHUNK = 256  # points that share buffers

I32 = NDArray[np.int32]
I64 = NDArray[np.int64]


@parallel_kernel
def fill_analytic(
    lights: Table,
    textures: Table,
    tables: Table,
    guide: Table,
    light: int,
    position: F32,
    normal: F32,
    shading_normal: F32,
    instance: I32,
    draws: I64,
    n_samples: int,
    seed: int,
    cosine: bool,
    direction: F32,
    distance: F32,
    pdf: F32,
    radiance: F32,
) -> None:
    """Shadow rays of every point to one light that is no mesh.

    Rows of the outputs are point-major, `n_samples` each. `radiance` holds L / (pdf n_samples),
    times the shading cosine if `cosine`; zero below either horizon. `draws` (n, 2) are each point's sequence of
    random numbers and the number in it of the first one.
    """
    n = len(instance)
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        _fill_chunk(
            chunk * _CHUNK, min(n, (chunk + 1) * _CHUNK), lights, textures, tables, guide, light, position, normal,
            shading_normal, instance, draws, n_samples, seed, cosine, direction, distance, pdf, radiance,
        )  # fmt: skip


@kernel
def _fill_chunk(  # type: ignore[no-untyped-def]
    first, end, lights, textures, tables, guide, light, position, normal, shading_normal, instance, draws, n_samples,
    seed, cosine, direction, distance, pdf, radiance,
):  # fmt: skip
    shape = light_shape(lights, textures, tables, light)
    texels, rows_cdf, columns_cdf = textures.texels, tables.rows_cdf, tables.columns_cdf
    axis, split, child, rows, bands, columns = guide
    red, green, blue = lights.radiance[light, 0], lights.radiance[light, 1], lights.radiance[light, 2]
    asked = make_asked()
    ray = asked.ray
    i, k = first, 0
    while i < end:
        n, i, k = ask_rays(
            asked, i, k, end, instance, draws, n_samples, seed, light, shape[0], axis, split, child, rows, position,
            shading_normal,
        )  # fmt: skip
        find_rays(
            n, asked, shape, texels, rows_cdf, columns_cdf, bands, columns, position, normal, shading_normal
        )  # fmt: skip
        for a in range(n):
            if ray[a, PDF] <= 0.0:
                continue
            at = asked.point[a]
            row = at * n_samples + asked.sample[a]
            weight = 1.0 / (ray[a, PDF] * n_samples)
            if cosine:
                weight *= dot((ray[a, 0], ray[a, 1], ray[a, 2]), row3(shading_normal, at))
            for c in range(3):
                direction[row, c] = ray[a, c]
            distance[row] = ray[a, DISTANCE]
            pdf[row] = ray[a, PDF]
            radiance[row, 0] = ray[a, RADIANCE] * weight * red
            radiance[row, 1] = ray[a, RADIANCE + 1] * weight * green
            radiance[row, 2] = ray[a, RADIANCE + 2] * weight * blue


@parallel_kernel
def fill_mesh(
    lights: Table,
    tables: Table,
    light: int,
    position: F32,
    normal: F32,
    shading_normal: F32,
    instance: I32,
    draws: I64,
    n_samples: int,
    seed: int,
    cosine: bool,
    direction: F32,
    distance: F32,
    pdf: F32,
    radiance: F32,
    emissive: I64,
    barycentric: F32,
) -> None:
    """Shadow rays of every point to one MESH light; as `fill_analytic`.

    `radiance` lacks the emission of the triangles, whose rows and places are in `emissive` (-1: no ray)
    and `barycentric`.
    """
    begin, end = lights.triangle_begin[light], lights.triangle_begin[light + 1]
    cdf, corners = tables.triangle_cdf, tables.triangle_corners
    for i in prange(position.shape[0]):
        if instance[i] < 0:
            continue
        sequence = hash_combine(hash_combine(hash_combine(seed, 0x11), draws[i, 0]), light)
        px, py, pz = float(position[i, 0]), float(position[i, 1]), float(position[i, 2])
        for k in range(n_samples):
            u1, u2 = sobol_pair(draws[i, 1] + k, sequence)
            e, b1, b2, lx, ly, lz, p = sample_mesh(cdf, corners, begin, end, px, py, pz, float(u1), float(u2))
            if p <= 0.0:
                continue
            dx, dy, dz = lx - px, ly - py, lz - pz
            t = math.sqrt(dx * dx + dy * dy + dz * dz)
            wx, wy, wz = dx / t, dy / t, dz / t
            shading_cosine = wx * shading_normal[i, 0] + wy * shading_normal[i, 1] + wz * shading_normal[i, 2]
            if shading_cosine <= 0.0 or wx * normal[i, 0] + wy * normal[i, 1] + wz * normal[i, 2] <= 0.0:
                continue
            weight = 1.0 / (p * n_samples)
            if cosine:
                weight *= shading_cosine
            row = i * n_samples + k
            direction[row, 0] = wx
            direction[row, 1] = wy
            direction[row, 2] = wz
            distance[row] = t
            pdf[row] = p
            emissive[row] = e
            barycentric[row, 0] = b1
            barycentric[row, 1] = b2
            for c in range(3):
                radiance[row, c] = weight * lights.radiance[light, c]


@parallel_kernel
def sum_rays(values: F32, begin: I64, out: F32) -> None:
    """out[p] += sum of the rows begin[p]:begin[p + 1] of `values` (m, 3)."""
    for i in prange(out.shape[0]):
        r = 0.0
        g = 0.0
        b = 0.0
        for k in range(begin[i], begin[i + 1]):
            r += values[k, 0]
            g += values[k, 1]
            b += values[k, 2]
        out[i, 0] += np.float32(r)
        out[i, 1] += np.float32(g)
        out[i, 2] += np.float32(b)


@parallel_kernel
def fill_specular_numbers(draws: I64, n_samples: int, seed: int, out: F32) -> None:
    """Random pairs (n n_samples, 2) for the specular rays of each point; `draws` as in `fill_analytic`."""
    for i in prange(draws.shape[0]):
        sequence = hash_combine(hash_combine(seed, 0x12), draws[i, 0])
        for k in range(n_samples):
            u1, u2 = sobol_pair(draws[i, 1] + k, sequence)
            out[i * n_samples + k, 0] = u1
            out[i * n_samples + k, 1] = u2


@parallel_kernel
def meet_analytic(
    lights: Table,
    textures: Table,
    tables: Table,
    guide: Table,
    light: int,
    position: F32,
    shading_normal: F32,
    direction: F32,
    distance: F32,
    pdf: F64,
    radiance: F32,
) -> None:
    """Where rays from surface points meet a light that is no mesh; rows of those that miss stay zero."""
    kind, m, inverse, size, image = light_shape(lights, textures, tables, light)
    texels, rows_cdf, columns_cdf = textures.texels, tables.rows_cdf, tables.columns_cdf
    axis, split, child, rows, bands, columns = guide
    for i in prange(position.shape[0]):
        t, p, r, g, b = hit_shape(
            kind,
            m,
            inverse,
            size,
            image,
            texels,
            rows_cdf,
            columns_cdf,
            float(position[i, 0]),
            float(position[i, 1]),
            float(position[i, 2]),
            float(shading_normal[i, 0]),
            float(shading_normal[i, 1]),
            float(shading_normal[i, 2]),
            float(direction[i, 0]),
            float(direction[i, 1]),
            float(direction[i, 2]),
        )
        if t <= 0.0:
            continue
        if kind == _DOME:
            px, py, pz = float(position[i, 0]), float(position[i, 1]), float(position[i, 2])
            nx, ny, nz = float(shading_normal[i, 0]), float(shading_normal[i, 1]), float(shading_normal[i, 2])
            wx, wy, wz = float(direction[i, 0]), float(direction[i, 1]), float(direction[i, 2])
            guided = find_row(axis, split, child, rows, light, px, py, pz, nx, ny, nz)
            if guided >= 0 and image[0] >= 0:
                p *= image_density(bands, columns, guided, rows_cdf, columns_cdf, image, inverse, wx, wy, wz)
            elif guided >= 0:
                p = plain_dome_pdf(bands, columns, guided, nx, ny, nz, wx, wy, wz)
        distance[i] = t
        pdf[i] = p
        radiance[i, 0] = r * lights.radiance[light, 0]
        radiance[i, 1] = g * lights.radiance[light, 1]
        radiance[i, 2] = b * lights.radiance[light, 2]


@parallel_kernel
def mesh_pdfs(lights: Table, tables: Table, light: I32, row: I64, position: F32, end: F32, out: F64) -> None:
    """Density with which each emissive triangle `row` of `light` is sampled at `end`, seen from `position`."""
    for i in prange(len(row)):
        out[i] = mesh_pdf(
            lights,
            tables,
            light[i],
            row[i],
            float(position[i, 0]),
            float(position[i, 1]),
            float(position[i, 2]),
            float(end[i, 0]),
            float(end[i, 1]),
            float(end[i, 2]),
        )
