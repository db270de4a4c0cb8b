"""Bins of directions: the octahedral map of the sphere to a square, divided by a grid."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel


@kernel
def octahedral_bin(x, y, z, n):  # type: ignore[no-untyped-def]
    """Bin of a direction of any length in an n by n grid, row by row; y is up, in the middle of the square.

    Cigolle et al. 2014, A Survey of Efficient Representations for Independent Unit Vectors, JCGT 3(2).
    """
    total = abs(x) + abs(y) + abs(z)
    scale = np.float32(0.5) / max(total, np.float32(1e-30))
    a, b = x * scale, z * scale
    half = np.float32(0.5)
    folded_a = half - abs(b)
    folded_b = half - abs(a)
    if y < np.float32(0.0):
        a, b = (folded_a if a >= np.float32(0.0) else -folded_a), (folded_b if b >= np.float32(0.0) else -folded_b)
    column = min(max(np.int32((a + half) * np.float32(n)), np.int32(0)), np.int32(n - 1))
    row = min(max(np.int32((b + half) * np.float32(n)), np.int32(0)), np.int32(n - 1))
    return row * np.int32(n) + column


@parallel_kernel
def bins_of_directions(directions, n, out):  # type: ignore[no-untyped-def]
    """Bins of directions (m, 3) in an n by n grid."""
    for i in prange(len(out)):
        out[i] = octahedral_bin(directions[i, 0], directions[i, 1], directions[i, 2], n)


@kernel
def octahedral_point(a, b):  # type: ignore[no-untyped-def]
    """Point of the octahedron ``|x| + |y| + |z| = 1`` for a place in the square from -1 to 1; not of unit length."""
    y = 1.0 - abs(a) - abs(b)
    if y >= 0.0:
        return a, y, b
    return (1.0 - abs(b) if a >= 0.0 else abs(b) - 1.0), y, (1.0 - abs(a) if b >= 0.0 else abs(a) - 1.0)


@parallel_kernel
def describe_bins(n, parts, direction, solid_angle):  # type: ignore[no-untyped-def]
    """Unit directions of the bins' middles (n * n, 3), and their solid angles from `parts` squared points each.

    A plane at distance h sends ``h dA / |p|^3``; on a face of the octahedron that is ``da db / |p|^3``.
    """
    for i in prange(n * n):
        column, row = i % n, i // n
        x, y, z = octahedral_point((2.0 * column + 1.0) / n - 1.0, (2.0 * row + 1.0) / n - 1.0)
        length = np.sqrt(x * x + y * y + z * z)
        direction[i, 0], direction[i, 1], direction[i, 2] = x / length, y / length, z / length
        total = 0.0
        for j in range(parts):
            for k in range(parts):
                a = 2.0 * (column + (j + 0.5) / parts) / n - 1.0
                b = 2.0 * (row + (k + 0.5) / parts) / n - 1.0
                x, y, z = octahedral_point(a, b)
                total += (x * x + y * y + z * z) ** -1.5
        solid_angle[i] = total * (2.0 / (n * parts)) ** 2


@parallel_kernel
def add_patches(direction, solid_angle, radiance, to_world, stretch, n, light):  # type: ignore[no-untyped-def]
    """Light of patches of a dome, turned by `to_world` (3, 3), added to the bins that their middles fall in.

    `light` (parts, n * n, 4), zero before, receives radiance times solid angle,
    and solid angle, of as many parts of the patches: one thread each, whose sum
    is the same for any number of threads. `stretch` is the determinant of
    `to_world`: scaled directions cover other solid angles.
    """
    parts = len(light)
    for part in prange(parts):
        for i in range(part * len(direction) // parts, (part + 1) * len(direction) // parts):
            dx, dy, dz = direction[i, 0], direction[i, 1], direction[i, 2]
            x = to_world[0, 0] * dx + to_world[0, 1] * dy + to_world[0, 2] * dz
            y = to_world[1, 0] * dx + to_world[1, 1] * dy + to_world[1, 2] * dz
            z = to_world[2, 0] * dx + to_world[2, 1] * dy + to_world[2, 2] * dz
            length2 = x * x + y * y + z * z
            weight = solid_angle[i] * stretch / (length2 * np.sqrt(length2))
            b = octahedral_bin(np.float32(x), np.float32(y), np.float32(z), n)
            for c in range(3):
                light[part, b, c] += weight * radiance[i, c]
            light[part, b, 3] += weight
