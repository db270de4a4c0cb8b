"""Where rays meet light sources that are no meshes.

Each function answers distance, the probability per solid angle with which the sampler of `kernels.lights` returns
this direction, and the place on the image (2); probability 0 where the ray misses.
"""

from __future__ import annotations

import math
from typing import Any

from icheat_usd.kernels._jit import kernel
from icheat_usd.kernels.environment import (
    F32,
    F64,
    Floats,
    dome_image_pdf,
    image_bilinear,
    latlong_coordinates,
)
from icheat_usd.kernels.light_geometry import (
    CYLINDER,
    DISK,
    DISTANT,
    DOME,
    FAR,
    RECT,
    SPHERE,
    cross,
    direction_scale,
    dot,
    linear_map,
    normalized,
    plane_axes,
    rect_frame,
    rect_image,
    to_solid_angle,
)


@kernel
def _hit_plane(
    kind: int, m: Floats, a: float, b: float, px: float, py: float, pz: float, wx: float, wy: float, wz: float
) -> Floats:
    ax, ay, az, bx, by, bz, nx, ny, nz, scale = plane_axes(m)
    cosine = -dot(wx, wy, wz, nx, ny, nz)
    qx, qy, qz = m[3] - px, m[7] - py, m[11] - pz
    depth = -dot(qx, qy, qz, nx, ny, nz)
    if scale == 0.0 or cosine <= 0.0 or depth <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    t = depth / cosine
    hx, hy, hz = t * wx - qx, t * wy - qy, t * wz - qz
    aa = dot(ax, ay, az, ax, ay, az)
    ab = dot(ax, ay, az, bx, by, bz)
    bb = dot(bx, by, bz, bx, by, bz)
    ha = dot(hx, hy, hz, ax, ay, az)
    hb = dot(hx, hy, hz, bx, by, bz)
    x = (ha * bb - hb * ab) / (scale * scale)
    y = (hb * aa - ha * ab) / (scale * scale)
    if kind == DISK:
        if x * x + y * y > a * a:
            return 0.0, 0.0, 0.0, 0.0
        return t, to_solid_angle(1.0 / (scale * math.pi * a * a), t, cosine), 0.0, 0.0
    if abs(x) > 0.5 * a or abs(y) > 0.5 * b:
        return 0.0, 0.0, 0.0, 0.0
    solid_angle = rect_frame(m, a, b, px, py, pz)[8]
    pdf = 1.0 / solid_angle if solid_angle > 0.0 else to_solid_angle(1.0 / (scale * a * b), t, cosine)
    return t, pdf, x / a + 0.5, y / b + 0.5


@kernel
def _hit_sphere(
    m: Floats,
    inverse: Floats,
    determinant: float,
    radius: float,
    px: float,
    py: float,
    pz: float,
    wx: float,
    wy: float,
    wz: float,
) -> Floats:
    if radius <= 0.0 or determinant == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    qx, qy, qz = linear_map(inverse, m[3] - px, m[7] - py, m[11] - pz)
    qx, qy, qz = qx / radius, qy / radius, qz / radius
    dx, dy, dz = linear_map(inverse, wx, wy, wz)
    length = math.sqrt(dot(dx, dy, dz, dx, dy, dz))
    dx, dy, dz = dx / length, dy / length, dz / length
    d2 = dot(qx, qy, qz, qx, qy, qz)
    along = dot(qx, qy, qz, dx, dy, dz)
    if d2 <= 1.0 or along <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    # distance of the centre from the ray, by the cross product: d2 - along^2 would cancel from afar
    cx, cy, cz = cross(qx, qy, qz, dx, dy, dz)
    inside = 1.0 - dot(cx, cy, cz, cx, cy, cz)
    if inside < 0.0:
        return 0.0, 0.0, 0.0, 0.0
    t = (along - math.sqrt(inside)) * radius / length
    one_minus_cos = (1.0 / d2) / (1.0 + math.sqrt(1.0 - 1.0 / d2))
    pdf = direction_scale(m, determinant, dx, dy, dz) / (2.0 * math.pi * one_minus_cos)
    return t, pdf, 0.0, 0.0


@kernel
def _hit_cylinder(
    m: Floats,
    inverse: Floats,
    determinant: float,
    radius: float,
    length: float,
    px: float,
    py: float,
    pz: float,
    wx: float,
    wy: float,
    wz: float,
) -> Floats:
    if radius <= 0.0 or length <= 0.0 or determinant == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    lx, ly, lz = linear_map(inverse, px - m[3], py - m[7], pz - m[11])
    dx, dy, dz = linear_map(inverse, wx, wy, wz)
    rho = math.sqrt(ly * ly + lz * lz)
    a = dy * dy + dz * dz
    b = -(ly * dy + lz * dz)
    if rho <= radius or a == 0.0 or b <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    offset = ly * dz - lz * dy
    root = a * radius * radius - offset * offset
    if root < 0.0:
        return 0.0, 0.0, 0.0, 0.0
    t = (b - math.sqrt(root)) / a
    if t <= 0.0 or abs(lx + t * dx) > 0.5 * length:
        return 0.0, 0.0, 0.0, 0.0
    y = ly + t * dy
    z = lz + t * dz
    # tangents along the axis and around it (per radian)
    bx, by, bz = linear_map(m, 0.0, -z, y)
    nx, ny, nz = cross(m[0], m[4], m[8], bx, by, bz)
    jacobian = math.sqrt(dot(nx, ny, nz, nx, ny, nz))
    cosine = abs(dot(nx, ny, nz, wx, wy, wz)) / jacobian
    if cosine < 1e-9:
        return 0.0, 0.0, 0.0, 0.0
    half = math.acos(radius / rho)
    return t, to_solid_angle(1.0 / (2.0 * half * length * jacobian), t, cosine), 0.0, 0.0


@kernel
def _hit_distant(m: Floats, angle: float, wx: float, wy: float, wz: float) -> Floats:
    zx, zy, zz = normalized(m[2], m[6], m[10])
    half_sine = math.sin(0.5 * angle)
    chord2 = (wx - zx) * (wx - zx) + (wy - zy) * (wy - zy) + (wz - zz) * (wz - zz)
    if half_sine <= 0.0 or chord2 > 4.0 * half_sine * half_sine:
        return 0.0, 0.0, 0.0, 0.0
    return FAR, 1.0 / (4.0 * math.pi * half_sine * half_sine), 0.0, 0.0


@kernel
def hit_shape(
    kind: int, m: Floats, inverse: Floats, size: Floats, image: Any, texels: F32, rows_cdf: F64, columns_cdf: F32,
    px: float, py: float, pz: float, nx: float, ny: float, nz: float, wx: float, wy: float, wz: float,
) -> Floats:  # fmt: skip
    """Where a ray from a point meets a light that is no mesh: distance, pdf of `sample_shape`, radiance (3)."""
    determinant, a, b = size
    if kind == DOME and image[0] < 0:
        return FAR, max(0.0, dot(nx, ny, nz, wx, wy, wz)) / math.pi, 1.0, 1.0, 1.0
    if kind == DOME:
        if determinant == 0.0:
            return 0.0, 0.0, 0.0, 0.0, 0.0
        begin, width, height, rows_begin, columns_begin = image
        x, y, z = linear_map(inverse, wx, wy, wz)
        x, y, z = normalized(x, y, z)
        pdf = dome_image_pdf(rows_cdf, rows_begin, columns_cdf, columns_begin, width, height, x, y, z)
        s, t = latlong_coordinates(x, y, z)
        red, green, blue = image_bilinear(texels, begin, width, height, s, t, True)
        return FAR, pdf * direction_scale(m, determinant, x, y, z), red, green, blue
    if kind == SPHERE:
        distance, pdf, x, y = _hit_sphere(m, inverse, determinant, a, px, py, pz, wx, wy, wz)
    elif kind == CYLINDER:
        distance, pdf, x, y = _hit_cylinder(m, inverse, determinant, a, b, px, py, pz, wx, wy, wz)
    elif kind == DISTANT:
        distance, pdf, x, y = _hit_distant(m, a, wx, wy, wz)
    else:
        distance, pdf, x, y = _hit_plane(kind, m, a, b, px, py, pz, wx, wy, wz)
    if pdf <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    if kind != RECT or image[0] < 0:
        return distance, pdf, 1.0, 1.0, 1.0
    red, green, blue = rect_image(texels, image, x, y)
    return distance, pdf, red, green, blue
