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
    dome_image_pdf,
    image_bilinear,
    latlong_coordinates,
    sample_dome_image,
    search_cdf,
)

_SPHERE, _DISK, _RECT, _CYLINDER, _DISTANT, _DOME, _MESH = 0, 1, 2, 3, 4, 5, 6
_FAR = np.inf


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
def _dot(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> float:
    return ax * bx + ay * by + az * bz


@kernel
def _cross(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> Floats:
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
def _unit_disk(u1: float, u2: float) -> Floats:
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
def _to_solid_angle(pdf_world_area: float, distance: float, cosine: float) -> float:
    return pdf_world_area * distance * distance / cosine


@kernel
def _plane_axes(m: Floats) -> Floats:
    """World tangents of a disk or rect, its unit normal on the emitting (-Z) side, and |Mx x My|."""
    ax, ay, az = m[0], m[4], m[8]
    bx, by, bz = m[1], m[5], m[9]
    cx, cy, cz = _cross(ax, ay, az, bx, by, bz)
    area = math.sqrt(_dot(cx, cy, cz, cx, cy, cz))
    if area == 0.0:
        return ax, ay, az, bx, by, bz, 0.0, 0.0, 0.0, 0.0
    # Mz decides the side, so that a mirrored light still shines where its own -Z went
    side = 1.0 if _dot(cx, cy, cz, m[2], m[6], m[10]) < 0.0 else -1.0
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
def _rect_frame(m: Floats, width: float, height: float, px: float, py: float, pz: float) -> Floats:
    """Edge lengths, corner (x0, y0) and depth of a rect seen from a point, constants of Urena, its solid angle.

    Depth 0: the point is behind or the rect has no area. Solid angle 0: to be sampled by area.
    """
    ax, ay, az, bx, by, bz, nx, ny, nz, scale = _plane_axes(m)
    qx, qy, qz = m[3] - px, m[7] - py, m[11] - pz
    depth = -_dot(qx, qy, qz, nx, ny, nz)
    if scale * width * height == 0.0 or depth <= 0.0:
        return 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    la = math.sqrt(_dot(ax, ay, az, ax, ay, az))
    lb = math.sqrt(_dot(bx, by, bz, bx, by, bz))
    ex = la * width
    ey = lb * height
    x0 = _dot(qx, qy, qz, ax, ay, az) / la - 0.5 * ex
    y0 = _dot(qx, qy, qz, bx, by, bz) / lb - 0.5 * ey
    square = abs(_dot(ax, ay, az, bx, by, bz)) < 1e-6 * la * lb
    if not square or depth < 1e-6 * (ex + ey):
        return ex, ey, x0, y0, depth, 0.0, 0.0, 0.0, 0.0
    b0, b1, k, solid_angle = _spherical_rectangle(ex, ey, x0, y0, -depth)
    if solid_angle < _SMALLEST_SPHERICAL_RECTANGLE:
        solid_angle = 0.0
    return ex, ey, x0, y0, depth, b0, b1, k, solid_angle


@kernel
def _sample_rect(
    m: Floats, width: float, height: float, px: float, py: float, pz: float, u1: float, u2: float
) -> Floats:
    ex, ey, x0, y0, depth, b0, b1, k, solid_angle = _rect_frame(m, width, height, px, py, pz)
    if depth <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    x = u1
    y = u2
    if solid_angle > 0.0:
        xu, yv = _sample_spherical_rectangle(b0, b1, k, solid_angle, x0, y0, -depth, x0 + ex, y0 + ey, u1, u2)
        x = (xu - x0) / ex
        y = (yv - y0) / ey
    sx = (x - 0.5) * width
    sy = (y - 0.5) * height
    dx = m[3] - px + m[0] * sx + m[1] * sy
    dy = m[7] - py + m[4] * sx + m[5] * sy
    dz = m[11] - pz + m[8] * sx + m[9] * sy
    distance = math.sqrt(_dot(dx, dy, dz, dx, dy, dz))
    pdf = (
        1.0 / solid_angle
        if solid_angle > 0.0
        else _to_solid_angle(1.0 / (_plane_axes(m)[9] * width * height), distance, depth / distance)
    )
    return dx / distance, dy / distance, dz / distance, distance, pdf, x, y


@kernel
def _sample_disk(m: Floats, radius: float, px: float, py: float, pz: float, u1: float, u2: float) -> Floats:
    ax, ay, az, bx, by, bz, nx, ny, nz, scale = _plane_axes(m)
    area = scale * math.pi * radius * radius
    qx, qy, qz = m[3] - px, m[7] - py, m[11] - pz
    depth = -_dot(qx, qy, qz, nx, ny, nz)
    if area == 0.0 or depth <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    x, y = _unit_disk(u1, u2)
    x *= radius
    y *= radius
    dx, dy, dz = qx + ax * x + bx * y, qy + ay * x + by * y, qz + az * x + bz * y
    distance = math.sqrt(_dot(dx, dy, dz, dx, dy, dz))
    pdf = _to_solid_angle(1.0 / area, distance, depth / distance)
    return dx / distance, dy / distance, dz / distance, distance, pdf, 0.0, 0.0


@kernel
def _direction_scale(m: Floats, determinant: float, x: float, y: float, z: float) -> float:
    """World solid angle pdf over local one, for the unit local direction (x, y, z)."""
    wx, wy, wz = linear_map(m, x, y, z)
    length = math.sqrt(_dot(wx, wy, wz, wx, wy, wz))
    return length * length * length / determinant


@kernel
def _sample_sphere(
    m: Floats, inverse: Floats, determinant: float, radius: float, px: float, py: float, pz: float, u1: float, u2: float
) -> Floats:
    """Cone that the sphere fills, in the space where it is the unit sphere; emits outwards only."""
    if radius <= 0.0 or determinant == 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    qx, qy, qz = linear_map(inverse, m[3] - px, m[7] - py, m[11] - pz)
    qx, qy, qz = qx / radius, qy / radius, qz / radius
    d2 = _dot(qx, qy, qz, qx, qy, qz)
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
    pdf = _direction_scale(m, determinant, dx, dy, dz) / (2.0 * math.pi * one_minus_cos)
    wx, wy, wz = linear_map(m, dx * radius * t, dy * radius * t, dz * radius * t)
    distance = math.sqrt(_dot(wx, wy, wz, wx, wy, wz))
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
    nx, ny, nz = _cross(ax, ay, az, bx, by, bz)
    jacobian = math.sqrt(_dot(nx, ny, nz, nx, ny, nz))
    dx, dy, dz = wx - ox, wy - oy, wz - oz
    distance = math.sqrt(_dot(dx, dy, dz, dx, dy, dz))
    if jacobian == 0.0 or distance == 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    cosine = abs(_dot(nx, ny, nz, dx, dy, dz)) / (jacobian * distance)
    if cosine < 1e-9:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    pdf = _to_solid_angle(1.0 / (2.0 * half * length * jacobian), distance, cosine)
    return dx / distance, dy / distance, dz / distance, distance, pdf, 0.0, 0.0


@kernel
def _sample_distant(m: Floats, angle: float, u1: float, u2: float) -> Floats:
    """Cone about local +Z; a half-angle of zero is one direction whose `radiance` is an irradiance (pdf 1)."""
    zx, zy, zz = normalized(m[2], m[6], m[10])
    if angle <= 0.0:
        return zx, zy, zz, _FAR, 1.0, 0.0, 0.0
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
        _FAR,
        1.0 / (2.0 * math.pi * one_minus_cos),
        0.0,
        0.0,
    )


@kernel
def _sample_plain_dome(nx: float, ny: float, nz: float, u1: float, u2: float) -> Floats:
    x, y = _unit_disk(u1, u2)
    z = math.sqrt(max(0.0, 1.0 - x * x - y * y))
    sx, sy, sz, tx, ty, tz = orthonormal_basis(nx, ny, nz)
    return (
        x * sx + y * tx + z * nx,
        x * sy + y * ty + z * ny,
        x * sz + y * tz + z * nz,
        _FAR,
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
    if kind == _DOME and image[0] >= 0:
        begin, width, height, rows_begin, columns_begin = image
        x, y, z, pdf = sample_dome_image(rows_cdf, rows_begin, columns_cdf, columns_begin, width, height, u1, u2)
        if pdf <= 0.0 or determinant == 0.0:
            return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        s, t = latlong_coordinates(x, y, z)
        red, green, blue = image_bilinear(texels, begin, width, height, s, t, True)
        pdf *= _direction_scale(m, determinant, x, y, z)
        wx, wy, wz = linear_map(m, x, y, z)
        wx, wy, wz = normalized(wx, wy, wz)
        return wx, wy, wz, _FAR, pdf, red, green, blue
    if kind == _SPHERE:
        wx, wy, wz, distance, pdf, x, y = _sample_sphere(m, inverse, determinant, a, px, py, pz, u1, u2)
    elif kind == _DISK:
        wx, wy, wz, distance, pdf, x, y = _sample_disk(m, a, px, py, pz, u1, u2)
    elif kind == _RECT:
        wx, wy, wz, distance, pdf, x, y = _sample_rect(m, a, b, px, py, pz, u1, u2)
    elif kind == _CYLINDER:
        wx, wy, wz, distance, pdf, x, y = _sample_cylinder(m, inverse, determinant, a, b, px, py, pz, u1, u2)
    elif kind == _DISTANT:
        wx, wy, wz, distance, pdf, x, y = _sample_distant(m, a, u1, u2)
    else:
        wx, wy, wz, distance, pdf, x, y = _sample_plain_dome(nx, ny, nz, u1, u2)
    if kind != _RECT or image[0] < 0 or pdf <= 0.0:
        return wx, wy, wz, distance, pdf, 1.0, 1.0, 1.0
    red, green, blue = _rect_image(texels, image, x, y)
    return wx, wy, wz, distance, pdf, red, green, blue


@kernel
def _rect_image(texels: F32, image: Any, x: float, y: float) -> Floats:
    """Image at (x, y) in [0, 1]^2 of a rect's plane: upright for who looks at its lit side."""
    return image_bilinear(texels, image[0], image[1], image[2], 1.0 - x, 1.0 - y, False)


#: Triangles that fill more steradians than this are sampled by solid angle: by area, one that touches the point
#: has a 1 / r^2 without bound. Below it the two hardly differ, and the spherical formulas lose their digits.
_LARGE_SOLID_ANGLE = 1e-3


@kernel
def _angle(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> float:
    """Angle between two unit vectors, exact also near 0 and pi."""
    cx, cy, cz = _cross(ax, ay, az, bx, by, bz)
    return math.atan2(math.sqrt(_dot(cx, cy, cz, cx, cy, cz)), _dot(ax, ay, az, bx, by, bz))


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
    nx, ny, nz = _cross(bx, by, bz, cx, cy, cz)
    triple = abs(_dot(ax, ay, az, nx, ny, nz))
    below = 1.0 + _dot(ax, ay, az, bx, by, bz) + _dot(bx, by, bz, cx, cy, cz) + _dot(cx, cy, cz, ax, ay, az)
    return 2.0 * math.atan2(triple, below)


@kernel
def _towards(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> Floats:
    """Unit part of a that is perpendicular to the unit vector b."""
    along = _dot(ax, ay, az, bx, by, bz)
    return normalized(ax - along * bx, ay - along * by, az - along * bz)


@kernel
def _sample_spherical_triangle(p: F64, px: float, py: float, pz: float, u1: float, u2: float) -> Floats:
    """Barycentric (2) of a point uniform in the solid angle of a triangle (Arvo 1995); -1 where the formulas fail."""
    ax, ay, az, bx, by, bz, cx, cy, cz = _corner_directions(p, px, py, pz)
    abx, aby, abz = _cross(ax, ay, az, bx, by, bz)
    bcx, bcy, bcz = _cross(bx, by, bz, cx, cy, cz)
    cax, cay, caz = _cross(cx, cy, cz, ax, ay, az)
    shortest = min(
        _dot(abx, aby, abz, abx, aby, abz), _dot(bcx, bcy, bcz, bcx, bcy, bcz), _dot(cax, cay, caz, cax, cay, caz)
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
    k2 = sin_phi - sin_alpha * _dot(ax, ay, az, bx, by, bz)
    below = (k2 * sin_phi + k1 * cos_phi) * sin_alpha
    if below == 0.0:
        return -1.0, -1.0
    cos_b = min(max((k2 + (k2 * cos_phi - k1 * sin_phi) * cos_alpha) / below, -1.0), 1.0)
    sin_b = math.sqrt(1.0 - cos_b * cos_b)
    ex, ey, ez = _towards(cx, cy, cz, ax, ay, az)
    dx, dy, dz = cos_b * ax + sin_b * ex, cos_b * ay + sin_b * ey, cos_b * az + sin_b * ez
    cos_theta = 1.0 - u2 * (1.0 - _dot(dx, dy, dz, bx, by, bz))
    sin_theta = math.sqrt(max(0.0, 1.0 - cos_theta * cos_theta))
    fx, fy, fz = _towards(dx, dy, dz, bx, by, bz)
    wx, wy, wz = cos_theta * bx + sin_theta * fx, cos_theta * by + sin_theta * fy, cos_theta * bz + sin_theta * fz
    # Where that direction meets the triangle's plane (Moller & Trumbore 1997).
    ex, ey, ez = p[1, 0] - p[0, 0], p[1, 1] - p[0, 1], p[1, 2] - p[0, 2]
    fx, fy, fz = p[2, 0] - p[0, 0], p[2, 1] - p[0, 1], p[2, 2] - p[0, 2]
    qx, qy, qz = _cross(wx, wy, wz, fx, fy, fz)
    determinant = _dot(ex, ey, ez, qx, qy, qz)
    if determinant == 0.0:
        return -1.0, -1.0
    sx, sy, sz = px - p[0, 0], py - p[0, 1], pz - p[0, 2]
    b1 = min(max(_dot(sx, sy, sz, qx, qy, qz) / determinant, 0.0), 1.0)
    rx, ry, rz = _cross(sx, sy, sz, ex, ey, ez)
    b2 = min(max(_dot(wx, wy, wz, rx, ry, rz) / determinant, 0.0), 1.0 - b1)
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
    nx, ny, nz = _cross(
        p[1, 0] - p[0, 0], p[1, 1] - p[0, 1], p[1, 2] - p[0, 2], p[2, 0] - p[0, 0], p[2, 1] - p[0, 1], p[2, 2] - p[0, 2]
    )
    double_area = math.sqrt(_dot(nx, ny, nz, nx, ny, nz))
    dx, dy, dz = hx - px, hy - py, hz - pz
    distance = math.sqrt(_dot(dx, dy, dz, dx, dy, dz))
    if double_area == 0.0 or distance == 0.0:
        return 0.0
    cosine = abs(_dot(dx, dy, dz, nx, ny, nz)) / (distance * double_area)
    if cosine < 1e-9:
        return 0.0
    return _to_solid_angle(2.0 * probability / double_area, distance, cosine)


# Where rays meet lights ---------------------------------------------------------------------------
# Each answers (distance, probability per solid angle with which the sampler above returns this
# direction, place on the image (2)); probability 0 where the ray misses.


@kernel
def _hit_plane(
    kind: int, m: Floats, a: float, b: float, px: float, py: float, pz: float, wx: float, wy: float, wz: float
) -> Floats:
    ax, ay, az, bx, by, bz, nx, ny, nz, scale = _plane_axes(m)
    cosine = -_dot(wx, wy, wz, nx, ny, nz)
    qx, qy, qz = m[3] - px, m[7] - py, m[11] - pz
    depth = -_dot(qx, qy, qz, nx, ny, nz)
    if scale == 0.0 or cosine <= 0.0 or depth <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    t = depth / cosine
    hx, hy, hz = t * wx - qx, t * wy - qy, t * wz - qz
    aa = _dot(ax, ay, az, ax, ay, az)
    ab = _dot(ax, ay, az, bx, by, bz)
    bb = _dot(bx, by, bz, bx, by, bz)
    ha = _dot(hx, hy, hz, ax, ay, az)
    hb = _dot(hx, hy, hz, bx, by, bz)
    x = (ha * bb - hb * ab) / (scale * scale)
    y = (hb * aa - ha * ab) / (scale * scale)
    if kind == _DISK:
        if x * x + y * y > a * a:
            return 0.0, 0.0, 0.0, 0.0
        return t, _to_solid_angle(1.0 / (scale * math.pi * a * a), t, cosine), 0.0, 0.0
    if abs(x) > 0.5 * a or abs(y) > 0.5 * b:
        return 0.0, 0.0, 0.0, 0.0
    solid_angle = _rect_frame(m, a, b, px, py, pz)[8]
    pdf = 1.0 / solid_angle if solid_angle > 0.0 else _to_solid_angle(1.0 / (scale * a * b), t, cosine)
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
    length = math.sqrt(_dot(dx, dy, dz, dx, dy, dz))
    dx, dy, dz = dx / length, dy / length, dz / length
    d2 = _dot(qx, qy, qz, qx, qy, qz)
    along = _dot(qx, qy, qz, dx, dy, dz)
    if d2 <= 1.0 or along <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    # distance of the centre from the ray, by the cross product: d2 - along^2 would cancel from afar
    cx, cy, cz = _cross(qx, qy, qz, dx, dy, dz)
    inside = 1.0 - _dot(cx, cy, cz, cx, cy, cz)
    if inside < 0.0:
        return 0.0, 0.0, 0.0, 0.0
    t = (along - math.sqrt(inside)) * radius / length
    one_minus_cos = (1.0 / d2) / (1.0 + math.sqrt(1.0 - 1.0 / d2))
    pdf = _direction_scale(m, determinant, dx, dy, dz) / (2.0 * math.pi * one_minus_cos)
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
    nx, ny, nz = _cross(m[0], m[4], m[8], bx, by, bz)
    jacobian = math.sqrt(_dot(nx, ny, nz, nx, ny, nz))
    cosine = abs(_dot(nx, ny, nz, wx, wy, wz)) / jacobian
    if cosine < 1e-9:
        return 0.0, 0.0, 0.0, 0.0
    half = math.acos(radius / rho)
    return t, _to_solid_angle(1.0 / (2.0 * half * length * jacobian), t, cosine), 0.0, 0.0


@kernel
def _hit_distant(m: Floats, angle: float, wx: float, wy: float, wz: float) -> Floats:
    zx, zy, zz = normalized(m[2], m[6], m[10])
    half_sine = math.sin(0.5 * angle)
    chord2 = (wx - zx) * (wx - zx) + (wy - zy) * (wy - zy) + (wz - zz) * (wz - zz)
    if half_sine <= 0.0 or chord2 > 4.0 * half_sine * half_sine:
        return 0.0, 0.0, 0.0, 0.0
    return _FAR, 1.0 / (4.0 * math.pi * half_sine * half_sine), 0.0, 0.0


@kernel
def hit_shape(
    kind: int, m: Floats, inverse: Floats, size: Floats, image: Any, texels: F32, rows_cdf: F64, columns_cdf: F32,
    px: float, py: float, pz: float, nx: float, ny: float, nz: float, wx: float, wy: float, wz: float,
) -> Floats:  # fmt: skip
    """Where a ray from a point meets a light that is no mesh: distance, pdf of `sample_shape`, radiance (3)."""
    determinant, a, b = size
    if kind == _DOME and image[0] < 0:
        return _FAR, max(0.0, _dot(nx, ny, nz, wx, wy, wz)) / math.pi, 1.0, 1.0, 1.0
    if kind == _DOME:
        if determinant == 0.0:
            return 0.0, 0.0, 0.0, 0.0, 0.0
        begin, width, height, rows_begin, columns_begin = image
        x, y, z = linear_map(inverse, wx, wy, wz)
        x, y, z = normalized(x, y, z)
        pdf = dome_image_pdf(rows_cdf, rows_begin, columns_cdf, columns_begin, width, height, x, y, z)
        s, t = latlong_coordinates(x, y, z)
        red, green, blue = image_bilinear(texels, begin, width, height, s, t, True)
        return _FAR, pdf * _direction_scale(m, determinant, x, y, z), red, green, blue
    if kind == _SPHERE:
        distance, pdf, x, y = _hit_sphere(m, inverse, determinant, a, px, py, pz, wx, wy, wz)
    elif kind == _CYLINDER:
        distance, pdf, x, y = _hit_cylinder(m, inverse, determinant, a, b, px, py, pz, wx, wy, wz)
    elif kind == _DISTANT:
        distance, pdf, x, y = _hit_distant(m, a, wx, wy, wz)
    else:
        distance, pdf, x, y = _hit_plane(kind, m, a, b, px, py, pz, wx, wy, wz)
    if pdf <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    if kind != _RECT or image[0] < 0:
        return distance, pdf, 1.0, 1.0, 1.0
    red, green, blue = _rect_image(texels, image, x, y)
    return distance, pdf, red, green, blue


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
