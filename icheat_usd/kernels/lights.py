"""Points and directions on light sources, and how probable they are.

Every sampler answers for one receiving point with a unit direction, the distance to the
light, the probability per solid angle and the place on the light's image. Shapes are
treated in their own space and carried to the world by the linear map M of `to_world`; a
probability per solid angle p' there is ``p' |M d|^3 / |det M|`` in the world (d a unit
direction, local), an area element of a surface with tangents a, b is scaled by |Ma x Mb|.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel
from icheat_usd.kernels.environment import (
    F32,
    F64,
    Floats,
    Table,
    image_bilinear,
    latlong_coordinates,
    sample_dome_image,
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
    local_frame,
    normalized,
    orthonormal_basis,
    plane_axes,
    rect_frame,
    rect_image,
    to_solid_angle,
    unit_disk,
    world_frame,
)


class LightTables(NamedTuple):
    """What sampling needs beside `scene.Lights`: inverses and cumulative distributions."""

    to_local: NDArray[np.float64]  #: (n, 3, 3) inverse of the linear part of `to_world`; zeros where singular
    determinant: NDArray[np.float64]  #: (n,) |det| of the linear part
    columns_begin: NDArray[np.int64]  #: (n,) textured DOME: start in `columns_cdf`, else -1
    columns_cdf: NDArray[np.float32]  #: per dome (height, width): cumulative over each row
    rows_begin: NDArray[np.int64]  #: (n,) textured DOME: start in `rows_cdf`, else -1
    rows_cdf: NDArray[np.float64]  #: per dome (height,)
    triangle_cdf: NDArray[np.float64]  #: (n_emissive,) cumulative over each MESH light's triangles
    triangle_corners: NDArray[np.float64]  #: (n_emissive, 3, 3) world space
    triangle_emission: NDArray[np.float32]  #: (n_emissive, 3) mean emission of the material, over both sides


@kernel
def _sample_spherical_rectangle(
    b0: float,
    b1: float,
    k: float,
    solid_angle: float,
    x0: float,
    y0: float,
    z0: float,
    x1: float,
    y1: float,
    u1: float,
    u2: float,
) -> Floats:
    au = u1 * solid_angle + k
    fu = (math.cos(au) * b0 - b1) / math.sin(au)
    cu = math.copysign(1.0, fu) / math.sqrt(fu * fu + b0 * b0)
    cu = min(max(cu, -1.0 + 1e-15), 1.0 - 1e-15)
    xu = min(max(-(cu * z0) / math.sqrt(1.0 - cu * cu), x0), x1)
    d2 = xu * xu + z0 * z0
    d = math.sqrt(d2)
    h0 = y0 / math.sqrt(d2 + y0 * y0)
    h1 = y1 / math.sqrt(d2 + y1 * y1)
    hv = h0 + u2 * (h1 - h0)
    yv = hv * d / math.sqrt(1.0 - hv * hv) if hv * hv < 1.0 - 1e-12 else y1
    return xu, min(max(yv, y0), y1)


@kernel
def place_in_rect(frame: Floats, u1: float, u2: float) -> Floats:
    """Where in [0, 1]^2 a rect is looked at from the point that `rect_frame` sees it from, evenly in solid angle."""
    ex, ey, x0, y0, depth, b0, b1, k, solid_angle = frame
    if solid_angle <= 0.0:
        return u1, u2
    xu, yv = _sample_spherical_rectangle(b0, b1, k, solid_angle, x0, y0, -depth, x0 + ex, y0 + ey, u1, u2)
    return (xu - x0) / ex, (yv - y0) / ey


@kernel
def _sample_rect(
    m: Floats, width: float, height: float, px: float, py: float, pz: float, u1: float, u2: float
) -> Floats:
    frame = rect_frame(m, width, height, px, py, pz)
    depth, solid_angle = frame[4], frame[8]
    if depth <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    x, y = place_in_rect(frame, u1, u2)
    sx = (x - 0.5) * width
    sy = (y - 0.5) * height
    dx = m[3] - px + m[0] * sx + m[1] * sy
    dy = m[7] - py + m[4] * sx + m[5] * sy
    dz = m[11] - pz + m[8] * sx + m[9] * sy
    distance = math.sqrt(dot(dx, dy, dz, dx, dy, dz))
    pdf = (
        1.0 / solid_angle
        if solid_angle > 0.0
        else to_solid_angle(1.0 / (plane_axes(m)[9] * width * height), distance, depth / distance)
    )
    return dx / distance, dy / distance, dz / distance, distance, pdf, x, y


@kernel
def _sample_disk(m: Floats, radius: float, px: float, py: float, pz: float, u1: float, u2: float) -> Floats:
    ax, ay, az, bx, by, bz, nx, ny, nz, scale = plane_axes(m)
    area = scale * math.pi * radius * radius
    qx, qy, qz = m[3] - px, m[7] - py, m[11] - pz
    depth = -dot(qx, qy, qz, nx, ny, nz)
    if area == 0.0 or depth <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    x, y = unit_disk(u1, u2)
    x *= radius
    y *= radius
    dx, dy, dz = qx + ax * x + bx * y, qy + ay * x + by * y, qz + az * x + bz * y
    distance = math.sqrt(dot(dx, dy, dz, dx, dy, dz))
    pdf = to_solid_angle(1.0 / area, distance, depth / distance)
    return dx / distance, dy / distance, dz / distance, distance, pdf, 0.0, 0.0


@kernel
def _sample_sphere(
    m: Floats, inverse: Floats, determinant: float, radius: float, px: float, py: float, pz: float, u1: float, u2: float
) -> Floats:
    """Cone that the sphere fills, in the space where it is the unit sphere; emits outwards only."""
    if radius <= 0.0 or determinant == 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    qx, qy, qz = linear_map(inverse, m[3] - px, m[7] - py, m[11] - pz)
    qx, qy, qz = qx / radius, qy / radius, qz / radius
    d2 = dot(qx, qy, qz, qx, qy, qz)
    if d2 <= 1.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    d = math.sqrt(d2)
    zx, zy, zz = qx / d, qy / d, qz / d
    one_minus_cos = (1.0 / d2) / (1.0 + math.sqrt(1.0 - 1.0 / d2))
    c = u1 * one_minus_cos
    cos_theta = 1.0 - c
    sin2 = c * (2.0 - c)
    sin_theta = math.sqrt(sin2)
    phi = 2.0 * math.pi * u2
    sx, sy, sz, tx, ty, tz = orthonormal_basis(zx, zy, zz)
    a = sin_theta * math.cos(phi)
    b = sin_theta * math.sin(phi)
    dx = a * sx + b * tx + cos_theta * zx
    dy = a * sy + b * ty + cos_theta * zy
    dz = a * sz + b * tz + cos_theta * zz
    t = d * cos_theta - math.sqrt(max(0.0, 1.0 - d2 * sin2))
    pdf = direction_scale(m, determinant, dx, dy, dz) / (2.0 * math.pi * one_minus_cos)
    wx, wy, wz = linear_map(m, dx * radius * t, dy * radius * t, dz * radius * t)
    distance = math.sqrt(dot(wx, wy, wz, wx, wy, wz))
    if distance == 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    return wx / distance, wy / distance, wz / distance, distance, pdf, 0.0, 0.0


@kernel
def _sample_cylinder(
    m: Floats,
    inverse: Floats,
    determinant: float,
    radius: float,
    length: float,
    px: float,
    py: float,
    pz: float,
    u1: float,
    u2: float,
) -> Floats:
    """Lateral surface about X, the part of it that faces the point; no caps, emits outwards only."""
    if radius <= 0.0 or length <= 0.0 or determinant == 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    ox, oy, oz = px - m[3], py - m[7], pz - m[11]
    lx, ly, lz = linear_map(inverse, ox, oy, oz)
    rho = math.sqrt(ly * ly + lz * lz)
    if rho <= radius:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    half = math.acos(radius / rho)  # beyond it the tangent plane hides the point, in any affine picture
    phi = math.atan2(lz, ly) + half * (2.0 * u2 - 1.0)
    c = math.cos(phi)
    s = math.sin(phi)
    wx, wy, wz = linear_map(m, (u1 - 0.5) * length, radius * c, radius * s)
    ax, ay, az = m[0], m[4], m[8]
    bx, by, bz = linear_map(m, 0.0, -radius * s, radius * c)
    nx, ny, nz = cross(ax, ay, az, bx, by, bz)
    jacobian = math.sqrt(dot(nx, ny, nz, nx, ny, nz))
    dx, dy, dz = wx - ox, wy - oy, wz - oz
    distance = math.sqrt(dot(dx, dy, dz, dx, dy, dz))
    if jacobian == 0.0 or distance == 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    cosine = abs(dot(nx, ny, nz, dx, dy, dz)) / (jacobian * distance)
    if cosine < 1e-9:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    pdf = to_solid_angle(1.0 / (2.0 * half * length * jacobian), distance, cosine)
    return dx / distance, dy / distance, dz / distance, distance, pdf, 0.0, 0.0


@kernel
def _sample_distant(m: Floats, angle: float, u1: float, u2: float) -> Floats:
    """Cone about local +Z; a half-angle of zero is one direction whose `radiance` is an irradiance (pdf 1)."""
    zx, zy, zz = normalized(m[2], m[6], m[10])
    if angle <= 0.0:
        return zx, zy, zz, FAR, 1.0, 0.0, 0.0
    half_sine = math.sin(0.5 * angle)
    one_minus_cos = 2.0 * half_sine * half_sine
    c = u1 * one_minus_cos
    r = math.sqrt(max(0.0, c * (2.0 - c)))
    phi = 2.0 * math.pi * u2
    sx, sy, sz, tx, ty, tz = orthonormal_basis(zx, zy, zz)
    a = r * math.cos(phi)
    b = r * math.sin(phi)
    w = 1.0 - c
    return (
        a * sx + b * tx + w * zx,
        a * sy + b * ty + w * zy,
        a * sz + b * tz + w * zz,
        FAR,
        1.0 / (2.0 * math.pi * one_minus_cos),
        0.0,
        0.0,
    )


@kernel
def _sample_plain_dome(nx: float, ny: float, nz: float, u1: float, u2: float) -> Floats:
    x, y = unit_disk(u1, u2)
    z = math.sqrt(max(0.0, 1.0 - x * x - y * y))
    sx, sy, sz, tx, ty, tz = orthonormal_basis(nx, ny, nz)
    return (
        x * sx + y * tx + z * nx,
        x * sy + y * ty + z * ny,
        x * sz + y * tz + z * nz,
        FAR,
        z / math.pi,
        0.0,
        0.0,
    )


@kernel
def light_shape(lights: Table, textures: Table, tables: Table, light: int) -> tuple[int, Floats, Floats, Floats, Any]:
    """Kind, world and local frame, (|det|, sizes), and where the image and its distributions begin; all scalars.

    Handing whole tables from one function to another costs more than most samplers do.
    """
    texture = lights.texture[light]
    image = (-1, 0, 0, 0, 0)
    if texture >= 0:
        image = (
            int(textures.begin[texture]),
            int(textures.width[texture]),
            int(textures.height[texture]),
            int(tables.rows_begin[light]),
            int(tables.columns_begin[light]),
        )
    size = (float(tables.determinant[light]), float(lights.size[light, 0]), float(lights.size[light, 1]))
    return int(lights.kind[light]), world_frame(lights, light), local_frame(tables, light), size, image


@kernel
def sample_shape(
    kind: int, m: Floats, inverse: Floats, size: Floats, image: Any, texels: F32, rows_cdf: F64, columns_cdf: F32,
    px: float, py: float, pz: float, nx: float, ny: float, nz: float, u1: float, u2: float,
) -> Floats:  # fmt: skip
    """Direction to the light (3), distance, pdf per solid angle, radiance (3), for every kind but MESH.

    Radiance is relative to `lights.radiance`. pdf 0 means that the light does not reach the point.
    Domes with an image are sampled in proportion to it, others by the cosine about the normal.
    """
    determinant, a, b = size
    if kind == DOME and image[0] >= 0:
        begin, width, height, rows_begin, columns_begin = image
        x, y, z, pdf = sample_dome_image(rows_cdf, rows_begin, columns_cdf, columns_begin, width, height, u1, u2)
        if pdf <= 0.0 or determinant == 0.0:
            return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        s, t = latlong_coordinates(x, y, z)
        red, green, blue = image_bilinear(texels, begin, width, height, s, t, True)
        pdf *= direction_scale(m, determinant, x, y, z)
        wx, wy, wz = linear_map(m, x, y, z)
        wx, wy, wz = normalized(wx, wy, wz)
        return wx, wy, wz, FAR, pdf, red, green, blue
    if kind == SPHERE:
        wx, wy, wz, distance, pdf, x, y = _sample_sphere(m, inverse, determinant, a, px, py, pz, u1, u2)
    elif kind == DISK:
        wx, wy, wz, distance, pdf, x, y = _sample_disk(m, a, px, py, pz, u1, u2)
    elif kind == RECT:
        wx, wy, wz, distance, pdf, x, y = _sample_rect(m, a, b, px, py, pz, u1, u2)
    elif kind == CYLINDER:
        wx, wy, wz, distance, pdf, x, y = _sample_cylinder(m, inverse, determinant, a, b, px, py, pz, u1, u2)
    elif kind == DISTANT:
        wx, wy, wz, distance, pdf, x, y = _sample_distant(m, a, u1, u2)
    else:
        wx, wy, wz, distance, pdf, x, y = _sample_plain_dome(nx, ny, nz, u1, u2)
    if kind != RECT or image[0] < 0 or pdf <= 0.0:
        return wx, wy, wz, distance, pdf, 1.0, 1.0, 1.0
    red, green, blue = rect_image(texels, image, x, y)
    return wx, wy, wz, distance, pdf, red, green, blue
