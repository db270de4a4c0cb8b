"""Frames of light sources and vectors in them, as scalars: what samplers of lights and rays that meet them share."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from icheat_usd.kernels._jit import kernel
from icheat_usd.kernels.environment import F32, Floats, Table, image_bilinear

#: Kinds of lights, as in `scene.LightKind`.
SPHERE, DISK, RECT, CYLINDER, DISTANT, DOME = 0, 1, 2, 3, 4, 5

FAR = np.inf  #: distance of lights that are infinitely far away


@kernel
def dot(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> float:
    return ax * bx + ay * by + az * bz


@kernel
def cross(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> Floats:
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@kernel
def normalized(x: float, y: float, z: float) -> Floats:
    length = math.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        return 0.0, 0.0, 0.0
    return x / length, y / length, z / length


@kernel
def world_frame(lights: Table, light: int) -> Floats:
    """`to_world` in double precision as twelve scalars, row by row: they stay in registers, a row view would not."""
    m = lights.to_world
    return (
        float(m[light, 0, 0]), float(m[light, 0, 1]), float(m[light, 0, 2]), float(m[light, 0, 3]),
        float(m[light, 1, 0]), float(m[light, 1, 1]), float(m[light, 1, 2]), float(m[light, 1, 3]),
        float(m[light, 2, 0]), float(m[light, 2, 1]), float(m[light, 2, 2]), float(m[light, 2, 3]),
    )  # fmt: skip


@kernel
def local_frame(tables: Table, light: int) -> Floats:
    """Inverse of the linear part of `to_world`, laid out as `world_frame`."""
    m = tables.to_local
    return (
        m[light, 0, 0], m[light, 0, 1], m[light, 0, 2], 0.0,
        m[light, 1, 0], m[light, 1, 1], m[light, 1, 2], 0.0,
        m[light, 2, 0], m[light, 2, 1], m[light, 2, 2], 0.0,
    )  # fmt: skip


@kernel
def linear_map(m: Floats, x: float, y: float, z: float) -> Floats:
    """M (x, y, z) for the 3 x 3 part of a frame."""
    return (
        m[0] * x + m[1] * y + m[2] * z,
        m[4] * x + m[5] * y + m[6] * z,
        m[8] * x + m[9] * y + m[10] * z,
    )


@kernel
def orthonormal_basis(nx: float, ny: float, nz: float) -> Floats:
    """Two unit vectors that complete a unit normal (Duff et al. 2017, JCGT 6(1))."""
    sign = math.copysign(1.0, nz)
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    return 1.0 + sign * nx * nx * a, sign * b, -sign * nx, b, sign + ny * ny * a, -ny


@kernel
def unit_disk(u1: float, u2: float) -> Floats:
    """Concentric map of the unit square to the unit disk (Shirley & Chiu 1997)."""
    a = 2.0 * u1 - 1.0
    b = 2.0 * u2 - 1.0
    if a == 0.0 and b == 0.0:
        return 0.0, 0.0
    if abs(a) > abs(b):
        r = a
        phi = (math.pi / 4.0) * (b / a)
    else:
        r = b
        phi = math.pi / 2.0 - (math.pi / 4.0) * (a / b)
    return r * math.cos(phi), r * math.sin(phi)


@kernel
def to_solid_angle(pdf_world_area: float, distance: float, cosine: float) -> float:
    return pdf_world_area * distance * distance / cosine


@kernel
def direction_scale(m: Floats, determinant: float, x: float, y: float, z: float) -> float:
    """World solid angle pdf over local one, for the unit local direction (x, y, z)."""
    wx, wy, wz = linear_map(m, x, y, z)
    length = math.sqrt(dot(wx, wy, wz, wx, wy, wz))
    return length * length * length / determinant


@kernel
def plane_axes(m: Floats) -> Floats:
    """World tangents of a disk or rect, its unit normal on the emitting (-Z) side, and |Mx x My|."""
    ax, ay, az = m[0], m[4], m[8]
    bx, by, bz = m[1], m[5], m[9]
    cx, cy, cz = cross(ax, ay, az, bx, by, bz)
    area = math.sqrt(dot(cx, cy, cz, cx, cy, cz))
    if area == 0.0:
        return ax, ay, az, bx, by, bz, 0.0, 0.0, 0.0, 0.0
    # Mz decides the side, so that a mirrored light still shines where its own -Z went
    side = 1.0 if dot(cx, cy, cz, m[2], m[6], m[10]) < 0.0 else -1.0
    return ax, ay, az, bx, by, bz, side * cx / area, side * cy / area, side * cz / area, area


@kernel
def _spherical_rectangle(ex: float, ey: float, x0: float, y0: float, z0: float) -> Floats:
    """Constants of Urena et al. 2013 for a rectangle [x0, x0 + ex] x [y0, y0 + ey] at depth z0 < 0."""
    x1 = x0 + ex
    y1 = y0 + ey
    # z of the unit normals of the planes through the eye and each edge
    l0 = math.sqrt(z0 * z0 + y0 * y0)
    l1 = math.sqrt(z0 * z0 + x1 * x1)
    l2 = math.sqrt(z0 * z0 + y1 * y1)
    l3 = math.sqrt(z0 * z0 + x0 * x0)
    n0z, n1z, n2z, n3z = -y0 / l0, x1 / l1, y1 / l2, -x0 / l3
    g0 = math.acos(min(max(-n0z * n1z, -1.0), 1.0))
    g1 = math.acos(min(max(-n1z * n2z, -1.0), 1.0))
    g2 = math.acos(min(max(-n2z * n3z, -1.0), 1.0))
    g3 = math.acos(min(max(-n3z * n0z, -1.0), 1.0))
    k = 2.0 * math.pi - g2 - g3
    return n0z, n2z, k, g0 + g1 - k


# Below this solid angle the sum of four angles loses its digits; the rectangle is then so far
# away that sampling its area is as good.
_SMALLEST_SPHERICAL_RECTANGLE = 1e-7


@kernel
def rect_frame(m: Floats, width: float, height: float, px: float, py: float, pz: float) -> Floats:
    """Edge lengths, corner (x0, y0) and depth of a rect seen from a point, constants of Urena, its solid angle.

    Depth 0: the point is behind or the rect has no area. Solid angle 0: to be sampled by area.
    """
    ax, ay, az, bx, by, bz, nx, ny, nz, scale = plane_axes(m)
    qx, qy, qz = m[3] - px, m[7] - py, m[11] - pz
    depth = -dot(qx, qy, qz, nx, ny, nz)
    if scale * width * height == 0.0 or depth <= 0.0:
        return 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    la = math.sqrt(dot(ax, ay, az, ax, ay, az))
    lb = math.sqrt(dot(bx, by, bz, bx, by, bz))
    ex = la * width
    ey = lb * height
    x0 = dot(qx, qy, qz, ax, ay, az) / la - 0.5 * ex
    y0 = dot(qx, qy, qz, bx, by, bz) / lb - 0.5 * ey
    square = abs(dot(ax, ay, az, bx, by, bz)) < 1e-6 * la * lb
    if not square or depth < 1e-6 * (ex + ey):
        return ex, ey, x0, y0, depth, 0.0, 0.0, 0.0, 0.0
    b0, b1, k, solid_angle = _spherical_rectangle(ex, ey, x0, y0, -depth)
    if solid_angle < _SMALLEST_SPHERICAL_RECTANGLE:
        solid_angle = 0.0
    return ex, ey, x0, y0, depth, b0, b1, k, solid_angle


@kernel
def rect_image(texels: F32, image: Any, x: float, y: float) -> Floats:
    """Image at (x, y) in [0, 1]^2 of a rect's plane: upright for who looks at its lit side."""
    return image_bilinear(texels, image[0], image[1], image[2], 1.0 - x, 1.0 - y, False)
