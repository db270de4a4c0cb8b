"""Places on surfaces, and the order of gather samples."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.random import hash_combine, sobol_pair, to_unit


@kernel
def _triangle_area(points, to_world, instance, triangle):  # type: ignore[no-untyped-def]
    ax = np.float64(points[triangle, 1, 0]) - points[triangle, 0, 0]
    ay = np.float64(points[triangle, 1, 1]) - points[triangle, 0, 1]
    az = np.float64(points[triangle, 1, 2]) - points[triangle, 0, 2]
    bx = np.float64(points[triangle, 2, 0]) - points[triangle, 0, 0]
    by = np.float64(points[triangle, 2, 1]) - points[triangle, 0, 1]
    bz = np.float64(points[triangle, 2, 2]) - points[triangle, 0, 2]
    m = to_world[instance]
    ux = m[0, 0] * ax + m[0, 1] * ay + m[0, 2] * az
    uy = m[1, 0] * ax + m[1, 1] * ay + m[1, 2] * az
    uz = m[2, 0] * ax + m[2, 1] * ay + m[2, 2] * az
    vx = m[0, 0] * bx + m[0, 1] * by + m[0, 2] * bz
    vy = m[1, 0] * bx + m[1, 1] * by + m[1, 2] * bz
    vz = m[2, 0] * bx + m[2, 1] * by + m[2, 2] * bz
    cx = uy * vz - uz * vy
    cy = uz * vx - ux * vz
    cz = ux * vy - uy * vx
    return 0.5 * np.sqrt(cx * cx + cy * cy + cz * cz)


@parallel_kernel
def instance_areas(points, mesh_begin, instance_mesh, to_world, out):  # type: ignore[no-untyped-def]
    """World area of each instance (n,), square metres."""
    for i in prange(len(out)):
        total = 0.0
        mesh = instance_mesh[i]
        for t in range(mesh_begin[mesh], mesh_begin[mesh + 1]):
            total += _triangle_area(points, to_world, np.int64(i), t)
        out[i] = total


@parallel_kernel
def spread_by_area(  # type: ignore[no-untyped-def]
    points, mesh_begin, instance_mesh, to_world, area, slot_instance, slot_begin, slot_seed, triangle, uv
):
    """Area-uniform places on each slot's instance: places ``slot_begin[s]:slot_begin[s + 1]`` lie on slot s.

    One stratum of area per place, walked in the order of the triangles; places
    that share a triangle are spread over it by a low-discrepancy sequence.
    """
    for s in prange(len(slot_instance)):
        begin, end = slot_begin[s], slot_begin[s + 1]
        n = end - begin
        if n > 0:
            i = slot_instance[s]
            mesh = instance_mesh[i]
            last = mesh_begin[mesh + 1] - 1
            t = mesh_begin[mesh]
            reached = _triangle_area(points, to_world, i, t)
            within = 0
            for k in range(n):
                wanted = (k + to_unit(hash_combine(hash_combine(slot_seed[s], 0), k))) / n * area[i]
                while reached < wanted and t < last:
                    t += 1
                    reached += _triangle_area(points, to_world, i, t)
                    within = 0
                u, v = sobol_pair(within, hash_combine(slot_seed[s], t + 1))
                within += 1
                # Square to triangle without folding keeps the sequence's distances (Heitz 2019).
                if v > u:
                    u *= np.float32(0.5)
                    v -= u
                else:
                    v *= np.float32(0.5)
                    u -= v
                triangle[begin + k] = t
                uv[begin + k, 0] = u
                uv[begin + k, 1] = v


@kernel
def _split_group(position, normal, turn, begin, end, node, order, lo, mid, hi):  # type: ignore[no-untyped-def]
    """Median splits of ``order[begin:end]``, longest axis of position and turned normal first."""
    stack = np.empty((64, 3), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2] = begin, end, node
    depth = 1
    while depth > 0:
        depth -= 1
        first, last, p = stack[depth, 0], stack[depth, 1], stack[depth, 2]
        widest = np.float32(-1.0)
        axis = 0
        for c in range(6):
            low = np.float32(np.inf)
            high = np.float32(-np.inf)
            for e in range(first, last):
                x = position[order[e], c] if c < 3 else turn * normal[order[e], c - 3]
                low = min(low, x)
                high = max(high, x)
            if high - low > widest:
                widest = high - low
                axis = c
        members = order[first:last].copy()
        key = np.empty(last - first, np.float32)
        for e in range(last - first):
            key[e] = position[members[e], axis] if axis < 3 else turn * normal[members[e], axis - 3]
        order[first:last] = members[np.argsort(key, kind="mergesort")]
        middle = (first + last) // 2
        lo[p], mid[p], hi[p] = first, middle, last
        if last - middle > 1:
            stack[depth, 0], stack[depth, 1], stack[depth, 2] = middle, last, p + middle - first
            depth += 1
        if middle - first > 1:
            stack[depth, 0], stack[depth, 1], stack[depth, 2] = first, middle, p + 1
            depth += 1


@parallel_kernel
def split_groups(position, normal, turn, group_begin, group_node, order, lo, mid, hi):  # type: ignore[no-untyped-def]
    """Subtree of every group; `turn` (n_groups,) is what a turn of the normal by one radian counts in metres."""
    for g in prange(len(group_node)):
        if group_begin[g + 1] - group_begin[g] > 1:
            _split_group(
                position, normal, turn[g], group_begin[g], group_begin[g + 1], group_node[g], order, lo, mid, hi
            )


@kernel
def basis(nx, ny, nz):  # type: ignore[no-untyped-def]
    """Two unit vectors that complete a unit normal to a right-handed frame (Duff et al. 2017, JCGT 6(1))."""
    sign = np.float32(1.0) if nz >= np.float32(0.0) else np.float32(-1.0)
    a = np.float32(-1.0) / (sign + nz)
    b = nx * ny * a
    return (
        np.float32(1.0) + sign * nx * nx * a,
        sign * b,
        -sign * nx,
        b,
        sign + ny * ny * a,
        -ny,
    )


@kernel
def unit_circle(turns):  # type: ignore[no-untyped-def]
    """Cosine and sine of an angle in turns from 0 to 1, to 2e-7: without a call, so loops of it become vector code."""
    quarter = np.float32(np.floor(np.float32(4.0) * turns + np.float32(0.5)))
    x = (np.float32(4.0) * turns - quarter) * np.float32(1.5707963267948966)
    x2 = x * x
    # Minimax polynomials on a quarter of a turn about zero (Cephes, sinf and cosf).
    s = x + x * x2 * (
        np.float32(-1.6666654611e-1) + x2 * (np.float32(8.3321608736e-3) - x2 * np.float32(1.9515295891e-4))
    )
    c = np.float32(-1.388731625493765e-3) + x2 * np.float32(2.443315711809948e-5)
    c = np.float32(1.0) - np.float32(0.5) * x2 + x2 * x2 * (np.float32(4.166664568298827e-2) + x2 * c)
    turned = np.int32(quarter)
    odd = (turned & np.int32(1)) != 0
    cosine, sine = (s, c) if odd else (c, s)
    if ((turned + np.int32(1)) & np.int32(2)) != 0:
        cosine = -cosine
    if (turned & np.int32(2)) != 0:
        sine = -sine
    return cosine, sine


@kernel
def cosine_lobe(u, v):  # type: ignore[no-untyped-def]
    """Unit direction about +z with density cos / pi, from the unit square."""
    radius = np.float32(np.sqrt(u))
    cosine, sine = unit_circle(v)
    return radius * cosine, radius * sine, np.float32(np.sqrt(max(np.float32(0.0), np.float32(1.0) - u)))


@kernel
def cosine_direction(nx, ny, nz, u, v):  # type: ignore[no-untyped-def]
    """Unit direction about a normal with density cos / pi, from the unit square."""
    x, y, z = cosine_lobe(u, v)
    tx, ty, tz, bx, by, bz = basis(nx, ny, nz)
    return x * tx + y * bx + z * nx, x * ty + y * by + z * ny, x * tz + y * bz + z * nz


@parallel_kernel
def cosine_rays(  # type: ignore[no-untyped-def]
    position, shading_normal, normal, point_begin, n_rays, seed, stream, point, origins, directions
):
    """`n_rays` stratified cosine rays per row; direction zero where one points into the surface.

    Row r spreads its rays evenly over points ``point_begin[r]:point_begin[r + 1]``;
    `point` receives the one of each ray. Successive points of the sequence are
    themselves stratified, so each point of a row gets good directions of its
    own. The row draws from the sequence of ``(seed, stream[r])``.
    """
    for r in prange(len(stream)):
        row_seed = hash_combine(seed, stream[r])
        first, count = point_begin[r], point_begin[r + 1] - point_begin[r]
        for k in range(n_rays):
            i = first + k * count // n_rays
            u, v = sobol_pair(k, row_seed)
            x, y, z = cosine_direction(shading_normal[i, 0], shading_normal[i, 1], shading_normal[i, 2], u, v)
            if x * normal[i, 0] + y * normal[i, 1] + z * normal[i, 2] <= np.float32(0.0):
                x, y, z = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            ray = r * n_rays + k
            directions[ray, 0] = x
            directions[ray, 1] = y
            directions[ray, 2] = z
            for c in range(3):
                origins[ray, c] = position[i, c]
            point[ray] = i
