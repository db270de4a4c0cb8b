"""Points on the triangles of meshes that emit light, and how probable they are."""

from __future__ import annotations

import math

from icheat_usd.kernels._jit import kernel
from icheat_usd.kernels.environment import (
    F64,
    Floats,
    Table,
    search_cdf,
)
from icheat_usd.kernels.light_geometry import (
    cross,
    dot,
    normalized,
    to_solid_angle,
)

#: Triangles that fill more steradians than this are sampled by solid angle: by area, one that touches the point
#: has a 1 / r^2 without bound. Below it the two hardly differ, and the spherical formulas lose their digits.
_LARGE_SOLID_ANGLE = 1e-3


@kernel
def _angle(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> float:
    """Angle between two unit vectors, exact also near 0 and pi."""
    cx, cy, cz = cross(ax, ay, az, bx, by, bz)
    return math.atan2(math.sqrt(dot(cx, cy, cz, cx, cy, cz)), dot(ax, ay, az, bx, by, bz))


@kernel
def _corner_directions(p: F64, px: float, py: float, pz: float) -> Floats:
    ax, ay, az = normalized(p[0, 0] - px, p[0, 1] - py, p[0, 2] - pz)
    bx, by, bz = normalized(p[1, 0] - px, p[1, 1] - py, p[1, 2] - pz)
    cx, cy, cz = normalized(p[2, 0] - px, p[2, 1] - py, p[2, 2] - pz)
    return ax, ay, az, bx, by, bz, cx, cy, cz


@kernel
def _solid_angle(p: F64, px: float, py: float, pz: float) -> float:
    """Solid angle of a triangle (Van Oosterom & Strackee 1983)."""
    ax, ay, az, bx, by, bz, cx, cy, cz = _corner_directions(p, px, py, pz)
    nx, ny, nz = cross(bx, by, bz, cx, cy, cz)
    triple = abs(dot(ax, ay, az, nx, ny, nz))
    below = 1.0 + dot(ax, ay, az, bx, by, bz) + dot(bx, by, bz, cx, cy, cz) + dot(cx, cy, cz, ax, ay, az)
    return 2.0 * math.atan2(triple, below)


@kernel
def _towards(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> Floats:
    """Unit part of a that is perpendicular to the unit vector b."""
    along = dot(ax, ay, az, bx, by, bz)
    return normalized(ax - along * bx, ay - along * by, az - along * bz)


@kernel
def _sample_spherical_triangle(p: F64, px: float, py: float, pz: float, u1: float, u2: float) -> Floats:
    """Barycentric (2) of a point uniform in the solid angle of a triangle (Arvo 1995); -1 where the formulas fail."""
    ax, ay, az, bx, by, bz, cx, cy, cz = _corner_directions(p, px, py, pz)
    abx, aby, abz = cross(ax, ay, az, bx, by, bz)
    bcx, bcy, bcz = cross(bx, by, bz, cx, cy, cz)
    cax, cay, caz = cross(cx, cy, cz, ax, ay, az)
    shortest = min(
        dot(abx, aby, abz, abx, aby, abz), dot(bcx, bcy, bcz, bcx, bcy, bcz), dot(cax, cay, caz, cax, cay, caz)
    )
    if shortest < 1e-24:
        return -1.0, -1.0
    abx, aby, abz = normalized(abx, aby, abz)
    bcx, bcy, bcz = normalized(bcx, bcy, bcz)
    cax, cay, caz = normalized(cax, cay, caz)
    alpha = _angle(abx, aby, abz, -cax, -cay, -caz)
    beta = _angle(bcx, bcy, bcz, -abx, -aby, -abz)
    gamma = _angle(cax, cay, caz, -bcx, -bcy, -bcz)
    # The part of the triangle between a, b and a point c' on the arc from a to c has u1 of the solid angle.
    part = math.pi + u1 * (alpha + beta + gamma - math.pi)
    cos_alpha, sin_alpha = math.cos(alpha), math.sin(alpha)
    sin_phi = math.sin(part) * cos_alpha - math.cos(part) * sin_alpha
    cos_phi = math.cos(part) * cos_alpha + math.sin(part) * sin_alpha
    k1 = cos_phi + cos_alpha
    k2 = sin_phi - sin_alpha * dot(ax, ay, az, bx, by, bz)
    below = (k2 * sin_phi + k1 * cos_phi) * sin_alpha
    if below == 0.0:
        return -1.0, -1.0
    cos_b = min(max((k2 + (k2 * cos_phi - k1 * sin_phi) * cos_alpha) / below, -1.0), 1.0)
    sin_b = math.sqrt(1.0 - cos_b * cos_b)
    ex, ey, ez = _towards(cx, cy, cz, ax, ay, az)
    dx, dy, dz = cos_b * ax + sin_b * ex, cos_b * ay + sin_b * ey, cos_b * az + sin_b * ez
    cos_theta = 1.0 - u2 * (1.0 - dot(dx, dy, dz, bx, by, bz))
    sin_theta = math.sqrt(max(0.0, 1.0 - cos_theta * cos_theta))
    fx, fy, fz = _towards(dx, dy, dz, bx, by, bz)
    wx, wy, wz = cos_theta * bx + sin_theta * fx, cos_theta * by + sin_theta * fy, cos_theta * bz + sin_theta * fz
    # Where that direction meets the triangle's plane (Moller & Trumbore 1997).
    ex, ey, ez = p[1, 0] - p[0, 0], p[1, 1] - p[0, 1], p[1, 2] - p[0, 2]
    fx, fy, fz = p[2, 0] - p[0, 0], p[2, 1] - p[0, 1], p[2, 2] - p[0, 2]
    qx, qy, qz = cross(wx, wy, wz, fx, fy, fz)
    determinant = dot(ex, ey, ez, qx, qy, qz)
    if determinant == 0.0:
        return -1.0, -1.0
    sx, sy, sz = px - p[0, 0], py - p[0, 1], pz - p[0, 2]
    b1 = min(max(dot(sx, sy, sz, qx, qy, qz) / determinant, 0.0), 1.0)
    rx, ry, rz = cross(sx, sy, sz, ex, ey, ez)
    b2 = min(max(dot(wx, wy, wz, rx, ry, rz) / determinant, 0.0), 1.0 - b1)
    return b1, b2


@kernel
def sample_mesh(
    cdf: F64, triangle_corners: F64, begin: int, end: int, px: float, py: float, pz: float, u1: float, u2: float
) -> Floats:
    """Row of the emissive tables, barycentric (2), point (3), pdf per solid angle."""
    row = search_cdf(cdf, begin, end, u1)
    below = cdf[row - 1] if row > begin else 0.0
    probability = cdf[row] - below
    if probability <= 0.0:
        return row, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    v1 = min(max((u1 - below) / probability, 0.0), 1.0)
    p = triangle_corners[row]
    solid_angle = _solid_angle(p, px, py, pz)
    if solid_angle > _LARGE_SOLID_ANGLE:
        b1, b2 = _sample_spherical_triangle(p, px, py, pz, v1, u2)
        if b1 < 0.0:
            return row, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    # low-distortion map of the square to the triangle (Heitz 2019) keeps strata compact
    elif u2 > v1:
        b1 = 0.5 * v1
        b2 = u2 - b1
    else:
        b2 = 0.5 * u2
        b1 = v1 - b2
    lx = p[0, 0] + b1 * (p[1, 0] - p[0, 0]) + b2 * (p[2, 0] - p[0, 0])
    ly = p[0, 1] + b1 * (p[1, 1] - p[0, 1]) + b2 * (p[2, 1] - p[0, 1])
    lz = p[0, 2] + b1 * (p[1, 2] - p[0, 2]) + b2 * (p[2, 2] - p[0, 2])
    return row, b1, b2, lx, ly, lz, _triangle_pdf(p, probability, solid_angle, px, py, pz, lx, ly, lz)


@kernel
def _triangle_pdf(
    p: F64, probability: float, solid_angle: float, px: float, py: float, pz: float, hx: float, hy: float, hz: float
) -> float:
    """Probability per solid angle of a point on a triangle that is picked with `probability`."""
    if solid_angle > _LARGE_SOLID_ANGLE:
        return probability / solid_angle
    nx, ny, nz = cross(
        p[1, 0] - p[0, 0], p[1, 1] - p[0, 1], p[1, 2] - p[0, 2], p[2, 0] - p[0, 0], p[2, 1] - p[0, 1], p[2, 2] - p[0, 2]
    )
    double_area = math.sqrt(dot(nx, ny, nz, nx, ny, nz))
    dx, dy, dz = hx - px, hy - py, hz - pz
    distance = math.sqrt(dot(dx, dy, dz, dx, dy, dz))
    if double_area == 0.0 or distance == 0.0:
        return 0.0
    cosine = abs(dot(dx, dy, dz, nx, ny, nz)) / (distance * double_area)
    if cosine < 1e-9:
        return 0.0
    return to_solid_angle(2.0 * probability / double_area, distance, cosine)


@kernel
def mesh_pdf(
    lights: Table, tables: Table, light: int, row: int, px: float, py: float, pz: float,
    hx: float, hy: float, hz: float,
) -> float:  # fmt: skip
    """Probability per solid angle with which `sample_mesh` picks the point (hx, hy, hz) of an emissive triangle."""
    probability = tables.triangle_cdf[row] - (
        tables.triangle_cdf[row - 1] if row > lights.triangle_begin[light] else 0.0
    )
    p = tables.triangle_corners[row]
    return _triangle_pdf(p, probability, _solid_angle(p, px, py, pz), px, py, pz, hx, hy, hz)
