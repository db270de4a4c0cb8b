"""Photons on their way: where they leave lights, and how they leave the surfaces that they met."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.environment import F32, F64, Floats, Table, image_bilinear, search_cdf
from icheat_usd.kernels.light_geometry import (
    DISK,
    DISTANT,
    DOME,
    RECT,
    SPHERE,
    linear_map,
    normalized,
    orthonormal_basis,
)
from icheat_usd.kernels.lights import light_shape, sample_shape
from icheat_usd.kernels.random import hash_combine, sobol_pair, uniform

#: Streams of random numbers.
_PLACES, _DIRECTIONS, _SIDES, _CROSSINGS, _REFLECTIONS = 0x9E01, 0x9E02, 0x9E03, 0x9E04, 0x9E05

#: At a grazing angle an interpolated normal may ask for any multiple of the light that arrives.
_MAX_COSINE_RATIO = 8.0

Numbers = np.ndarray


@kernel
def _unit_disk(u: float, v: float) -> Floats:
    r = math.sqrt(u)
    phi = 2.0 * math.pi * v
    return r * math.cos(phi), r * math.sin(phi)


@kernel
def _cosine_about(nx: float, ny: float, nz: float, u: float, v: float) -> Floats:
    """Unit direction about a normal with density cos / pi."""
    x, y = _unit_disk(u, v)
    z = math.sqrt(max(0.0, 1.0 - u))
    sx, sy, sz, tx, ty, tz = orthonormal_basis(nx, ny, nz)
    return x * sx + y * tx + z * nx, x * sy + y * ty + z * ny, x * sz + y * tz + z * nz


@kernel
def _cofactor(m: Floats, x: float, y: float, z: float) -> Floats:
    """Area vector of a surface element with unit normal (x, y, z), carried to the world by a frame."""
    cx = (
        (m[5] * m[10] - m[6] * m[9]) * x + (m[6] * m[8] - m[4] * m[10]) * y + (m[4] * m[9] - m[5] * m[8]) * z,
        (m[2] * m[9] - m[1] * m[10]) * x + (m[0] * m[10] - m[2] * m[8]) * y + (m[1] * m[8] - m[0] * m[9]) * z,
        (m[1] * m[6] - m[2] * m[5]) * x + (m[2] * m[4] - m[0] * m[6]) * y + (m[0] * m[5] - m[1] * m[4]) * z,
    )
    # The cofactor matrix carries outwards to outwards; where a frame mirrors it does so with the other sign.
    determinant = (
        m[0] * (m[5] * m[10] - m[6] * m[9]) - m[1] * (m[4] * m[10] - m[6] * m[8]) + m[2] * (m[4] * m[9] - m[5] * m[8])
    )
    side = -1.0 if determinant < 0.0 else 1.0
    return side * cx[0], side * cx[1], side * cx[2]


@kernel
def _place_on_shape(kind: int, m: Floats, a: float, b: float, u: float, v: float) -> Floats:
    """Place (3), unit normal of the shining side (3) and area per unit of (u, v); area 0 where there is none."""
    if kind == RECT or kind == DISK:
        if kind == RECT:
            x, y = (u - 0.5) * a, (v - 0.5) * b
            measure = a * b
        else:
            x, y = _unit_disk(u, v)
            x, y, measure = x * a, y * a, math.pi * a * a
        nx, ny, nz = _cofactor(m, 0.0, 0.0, 1.0)
        # Mz decides the side, as in direct light: a rect shines to its own -Z, mirrored or not.
        side = -1.0 if nx * m[2] + ny * m[6] + nz * m[10] >= 0.0 else 1.0
        nx, ny, nz = side * nx, side * ny, side * nz
        px, py, pz = linear_map(m, x, y, 0.0)
    elif kind == SPHERE:
        z = 1.0 - 2.0 * u
        r = math.sqrt(max(0.0, 1.0 - z * z))
        x, y = r * math.cos(2.0 * math.pi * v), r * math.sin(2.0 * math.pi * v)
        measure = 4.0 * math.pi * a * a
        nx, ny, nz = _cofactor(m, x, y, z)
        px, py, pz = linear_map(m, a * x, a * y, a * z)
    else:
        y, z = math.cos(2.0 * math.pi * v), math.sin(2.0 * math.pi * v)
        measure = 2.0 * math.pi * a * b
        nx, ny, nz = _cofactor(m, 0.0, y, z)
        px, py, pz = linear_map(m, (u - 0.5) * b, a * y, a * z)
    scale = math.sqrt(nx * nx + ny * ny + nz * nz)
    nx, ny, nz = normalized(nx, ny, nz)
    return px + m[3], py + m[7], pz + m[11], nx, ny, nz, scale * measure


@kernel
def _aimed(rows: F64, cells: F64, u: float, v: float) -> tuple[float, float, float, int]:
    """The unit square warped to a density on a grid: place (2), density, cell.

    `rows` and `cells` (n, n) are cumulative, over the first coordinate and, in each row, the second.
    """
    n = rows.shape[0]
    i = search_cdf(rows, 0, n, u)
    below = rows[i - 1] if i > 0 else 0.0
    p = rows[i] - below
    x = (i + min(max((u - below) / p, 0.0), 1.0)) / n
    column = cells[i]
    j = search_cdf(column, 0, n, v)
    below = column[j - 1] if j > 0 else 0.0
    q = column[j] - below
    y = (j + min(max((v - below) / q, 0.0), 1.0)) / n
    return x, y, p * q * n * n, i * n + j


@parallel_kernel
def emit_from_shape(
    lights: Table, textures: Table, tables: Table, light: int, scene_radius: float, clearance: float, rows: F64,
    cells: F64, first: int, n_total: int, seed: int, position: F32, direction: F32, power: F32, cell: Numbers,
) -> None:  # fmt: skip
    """Photons ``first``, ``first + 1``, ... of the `n_total` of a light that is no mesh.

    `power` receives the flux that each stands for, 0 where there is none. Light from infinitely far
    starts on a disk as wide as the scene's bounding sphere about the origin, before it; other photons
    `clearance` metres from their light, which may lie in the plane of a ceiling. `rows` and `cells` aim the
    places of distant lights on that disk and the directions of others: see `_aimed`; `cell` receives the one chosen.
    """
    kind, m, inverse, size, image = light_shape(lights, textures, tables, light)
    texels, rows_cdf, columns_cdf = textures.texels, tables.rows_cdf, tables.columns_cdf
    places = hash_combine(hash_combine(seed, _PLACES), light)
    directions = hash_combine(hash_combine(seed, _DIRECTIONS), light)
    for i in prange(position.shape[0]):
        u, v = sobol_pair(first + i, places)
        s, t = sobol_pair(first + i, directions)
        u, v, s, t = float(u), float(v), float(s), float(t)
        if kind == DISTANT:
            u, v, aim, cell[i] = _aimed(rows, cells, u, v)
        else:
            s, t, aim, cell[i] = _aimed(rows, cells, s, t)
        red, green, blue = 1.0, 1.0, 1.0
        if kind == DISTANT or kind == DOME:
            if kind == DOME and image[0] < 0:
                wz = 1.0 - 2.0 * s
                r = math.sqrt(max(0.0, 1.0 - wz * wz))
                wx, wy, density = r * math.cos(2.0 * math.pi * t), r * math.sin(2.0 * math.pi * t), 0.25 / math.pi
            else:
                wx, wy, wz, _, density, red, green, blue = sample_shape(
                    kind, m, inverse, size, image, texels, rows_cdf, columns_cdf, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, s, t
                )
            x, y = _unit_disk(u, v)
            weight = math.pi * scene_radius * scene_radius / density if density > 0.0 else 0.0
            sx, sy, sz, tx, ty, tz = orthonormal_basis(wx, wy, wz)
            px = scene_radius * (wx + x * sx + y * tx)
            py = scene_radius * (wy + x * sy + y * ty)
            pz = scene_radius * (wz + x * sz + y * tz)
            wx, wy, wz = -wx, -wy, -wz
        else:
            px, py, pz, nx, ny, nz, area = _place_on_shape(kind, m, size[1], size[2], u, v)
            weight = math.pi * area
            wx, wy, wz = _cosine_about(nx, ny, nz, s, t)
            px, py, pz = px + clearance * wx, py + clearance * wy, pz + clearance * wz
            if kind == RECT and image[0] >= 0:
                # upright for who looks at its lit side
                red, green, blue = image_bilinear(texels, image[0], image[1], image[2], 1.0 - u, 1.0 - v, False)
        weight /= n_total * aim
        position[i, 0] = px
        position[i, 1] = py
        position[i, 2] = pz
        direction[i, 0] = wx
        direction[i, 1] = wy
        direction[i, 2] = wz
        power[i, 0] = weight * red * lights.radiance[light, 0]
        power[i, 1] = weight * green * lights.radiance[light, 1]
        power[i, 2] = weight * blue * lights.radiance[light, 2]


@parallel_kernel
def emit_from_mesh(
    lights: Table, tables: Table, light: int, first: int, n_total: int, seed: int, row: Numbers, barycentric: F32,
    side: Numbers, power: F32,
) -> None:  # fmt: skip
    """Where photons of a mesh light start: rows of the emissive triangles, places on them, and sides.

    `power` lacks the emission of the triangle there. Triangles are chosen as for direct light; both sides shine.
    """
    begin, end = lights.triangle_begin[light], lights.triangle_begin[light + 1]
    cdf, corners = tables.triangle_cdf, tables.triangle_corners
    places = hash_combine(hash_combine(seed, _PLACES), light)
    sides = hash_combine(hash_combine(seed, _SIDES), light)
    for i in prange(row.shape[0]):
        u, v = sobol_pair(first + i, places)
        choice = float(u)
        e = search_cdf(cdf, begin, end, choice)
        below = cdf[e - 1] if e > begin else 0.0
        probability = cdf[e] - below
        row[i] = e
        side[i] = 1 if uniform(sides, first + i, 0) < 0.5 else 0
        weight = 0.0
        b1, b2 = 0.0, 0.0
        if probability > 0.0:
            b1 = 1.0 - math.sqrt(1.0 - min(max((choice - below) / probability, 0.0), 1.0))
            b2 = (1.0 - b1) * float(v)
            weight = 2.0 * math.pi * _triangle_area(corners[e]) / (probability * n_total)
        barycentric[i, 0] = b1
        barycentric[i, 1] = b2
        for c in range(3):
            power[i, c] = weight * lights.radiance[light, c]


@kernel
def _triangle_area(p: F64) -> float:
    ax, ay, az = p[1, 0] - p[0, 0], p[1, 1] - p[0, 1], p[1, 2] - p[0, 2]
    bx, by, bz = p[2, 0] - p[0, 0], p[2, 1] - p[0, 1], p[2, 2] - p[0, 2]
    cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    return 0.5 * math.sqrt(cx * cx + cy * cy + cz * cz)


@parallel_kernel
def directions_from_mesh(normal: F32, light: int, first: int, seed: int, out: F32) -> None:
    """Cosine directions about the normals of the places of `emit_from_mesh`."""
    directions = hash_combine(hash_combine(seed, _DIRECTIONS), light)
    for i in prange(normal.shape[0]):
        s, t = sobol_pair(first + i, directions)
        x, y, z = _cosine_about(
            float(normal[i, 0]), float(normal[i, 1]), float(normal[i, 2]), float(s), float(t)
        )  # fmt: skip
        out[i, 0] = x
        out[i, 1] = y
        out[i, 2] = z


@parallel_kernel
def crossings(share: F32, photon: Numbers, layer: int, seed: int, out: Numbers) -> None:
    """Which photons go straight on, by chance with probability `share`."""
    stream = hash_combine(hash_combine(seed, _CROSSINGS), layer)
    for i in prange(share.shape[0]):
        out[i] = uniform(stream, photon[i], 0) < share[i]


@parallel_kernel
def arriving_power(points: Table, direction: F32, power: F32, out: F32) -> None:
    """Power as what is shaded by the interpolated normal sees it: the flux that arrives times a ratio of cosines.

    The adjoint of shading with an interpolated normal (Veach 1997, section 5.3.2); 0 from below either horizon.
    """
    for i in prange(direction.shape[0]):
        shading = 0.0
        plane = 0.0
        for c in range(3):
            shading -= float(direction[i, c]) * float(points.shading_normal[i, c])
            plane -= float(direction[i, c]) * float(points.normal[i, c])
        ratio = 0.0
        if shading > 0.0 and plane > 0.0:
            ratio = min(shading / plane, _MAX_COSINE_RATIO)
        for c in range(3):
            out[i, c] = ratio * power[i, c]


@parallel_kernel
def reflect_photons(
    normal: F32, albedo: F32, photon: Numbers, bounce: int, seed: int, power: F32, direction: F32, lives: Numbers
) -> None:
    """Diffuse reflection with Russian roulette by the largest albedo: `power` and `lives` in place, new `direction`.

    Directions are about the plane's normal: what leaves a diffuse surface has one radiance in all directions.
    """
    stream = hash_combine(hash_combine(seed, _REFLECTIONS), bounce)
    for i in prange(normal.shape[0]):
        survival = min(max(albedo[i, 0], albedo[i, 1], albedo[i, 2], np.float32(0.05)), np.float32(0.95))
        lives[i] = uniform(stream, photon[i], 0) < survival
        u, v = float(uniform(stream, photon[i], 1)), float(uniform(stream, photon[i], 2))
        x, y, z = _cosine_about(float(normal[i, 0]), float(normal[i, 1]), float(normal[i, 2]), u, v)
        direction[i, 0] = x
        direction[i, 1] = y
        direction[i, 2] = z
        for c in range(3):
            power[i, c] *= albedo[i, c] / survival
