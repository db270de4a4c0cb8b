"""Surfaces at points: interpolation over triangles, textures, and the mapping of UsdPreviewSurface inputs."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.vector import (
    Vector,
    cross,
    dot,
    normalized,
    plus_scaled,
    row3,
    scaled,
    store3,
    transform_normal,
    transform_point,
)

CHUNK = 512

# Columns of Materials.texture (scene.Texture) and values of SurfacePoints.delta (scene.DeltaKind).
DIFFUSE, EMISSION, SPECULAR, METALLIC, ROUGHNESS, OPACITY = 0, 1, 2, 3, 4, 5
NONE, MIRROR, GLASS, PASS = 0, 1, 2, 3

MIRROR_ROUGHNESS = 0.01
# Shading normals keep at least this cosine to the geometric one, so that a mirror seen at them reflects outward.
LEAST_NORMAL_COSINE = 0.01


@kernel
def wrapped(i: int, n: int, mode: int) -> int:
    """Texel index under a wrap mode (0 repeat, 1 clamp, 2 mirror, 3 black); -1 is black."""
    if mode == 0:
        return i % n
    if mode == 1:
        return min(max(i, 0), n - 1)
    if mode == 2:
        j = i % (2 * n)
        return j if j < n else 2 * n - 1 - j
    return i if 0 <= i < n else -1


@kernel
def texel_sum(textures: tuple, image: int, s: float, t: float) -> tuple[float, float, float, float]:
    """Bilinear lookup, texel centres at (k + 1/2) / size, v up."""
    width, height = np.int64(textures.width[image]), np.int64(textures.height[image])
    x = s * width - 0.5
    y = (1.0 - t) * height - 0.5
    if not (abs(x) < 1e9 and abs(y) < 1e9):
        return 0.0, 0.0, 0.0, 0.0
    x0, y0 = np.int64(math.floor(x)), np.int64(math.floor(y))
    fx, fy = x - x0, y - y0
    r, g, b, a = 0.0, 0.0, 0.0, 0.0
    for dy in range(2):
        row = wrapped(y0 + dy, height, textures.wrap[image, 1])
        wy = fy if dy == 1 else 1.0 - fy
        for dx in range(2):
            column = wrapped(x0 + dx, width, textures.wrap[image, 0])
            if row >= 0 and column >= 0:
                w = wy * (fx if dx == 1 else 1.0 - fx)
                texel = textures.begin[image] + row * width + column
                r += w * textures.texels[texel, 0]
                g += w * textures.texels[texel, 1]
                b += w * textures.texels[texel, 2]
                a += w * textures.texels[texel, 3]
    return r, g, b, a


@kernel
def sampled(
    materials: tuple, textures: tuple, m: int, slot: int, s: float, t: float
) -> tuple[float, float, float, float]:
    """The texture of an input after its transform, scale and bias; one channel is repeated in all."""
    matrix = materials.texture_transform
    s2 = matrix[m, slot, 0, 0] * s + matrix[m, slot, 0, 1] * t + matrix[m, slot, 0, 2]
    t2 = matrix[m, slot, 1, 0] * s + matrix[m, slot, 1, 1] * t + matrix[m, slot, 1, 2]
    r, g, b, a = texel_sum(textures, materials.texture[m, slot], s2, t2)
    r = r * materials.texture_scale[m, slot, 0] + materials.texture_bias[m, slot, 0]
    g = g * materials.texture_scale[m, slot, 1] + materials.texture_bias[m, slot, 1]
    b = b * materials.texture_scale[m, slot, 2] + materials.texture_bias[m, slot, 2]
    a = a * materials.texture_scale[m, slot, 3] + materials.texture_bias[m, slot, 3]
    channel = materials.texture_channel[m, slot]
    if channel == 0:
        return r, r, r, r
    if channel == 1:
        return g, g, g, g
    if channel == 2:
        return b, b, b, b
    if channel == 3:
        return a, a, a, a
    return r, g, b, a


@kernel
def scalar_input(
    constant: np.ndarray, materials: tuple, textures: tuple, m: int, slot: int, s: float, t: float
) -> float:
    """Value of a scalar input, kept in [0, 1]."""
    value = np.float64(constant[m])
    if materials.texture[m, slot] >= 0:
        value = sampled(materials, textures, m, slot, s, t)[0]
    return min(max(value, 0.0), 1.0)


@kernel
def color_input(
    constant: np.ndarray, materials: tuple, textures: tuple, m: int, slot: int, s: float, t: float
) -> Vector:
    """Value of a colour input, not negative."""
    r, g, b = row3(constant, m)
    if materials.texture[m, slot] >= 0:
        r, g, b, _ = sampled(materials, textures, m, slot, s, t)
    return max(r, 0.0), max(g, 0.0), max(b, 0.0)


@kernel
def mixed(a: Vector, b: Vector, c: Vector, w: Vector) -> Vector:
    """Barycentric mix of three corners."""
    return plus_scaled(plus_scaled(scaled(a, w[0]), b, w[1]), c, w[2])


@kernel
def geometric_normal(geometry: tuple, instance: int, triangle: int) -> Vector:
    """Unit world-space normal of the front side; zero for a triangle without area."""
    p = geometry.points[triangle]
    a = row3(p, 0)
    edge_1 = plus_scaled(row3(p, 1), a, -1.0)
    edge_2 = plus_scaled(row3(p, 2), a, -1.0)
    return normalized(transform_normal(geometry.instance_to_object, instance, normalized(cross(edge_1, edge_2))))


@kernel
def write_point(
    geometry: tuple,
    materials: tuple,
    textures: tuple,
    i: int,
    instance: int,
    triangle: int,
    u: float,
    v: float,
    side: int,
    out: tuple,
) -> None:
    """Fill row `i` of the `SurfacePoints` `out` for one place on one side of a surface."""
    w = (1.0 - u - v, np.float64(u), np.float64(v))
    sign = 1.0 if side == 0 else -1.0

    # Place
    corners = geometry.points[triangle]
    to_world = geometry.instance_to_world
    position = mixed(
        transform_point(to_world, instance, row3(corners, 0)),
        transform_point(to_world, instance, row3(corners, 1)),
        transform_point(to_world, instance, row3(corners, 2)),
        w,
    )
    normal = geometric_normal(geometry, instance, triangle)

    # Shading normal
    corner_normals = geometry.normals[triangle]
    n0, n1, n2 = row3(corner_normals, 0), row3(corner_normals, 1), row3(corner_normals, 2)
    to_object = geometry.instance_to_object
    shading = normalized(transform_normal(to_object, instance, mixed(n0, n1, n2, w)))
    whole = transform_normal(to_object, instance, mixed(n0, n1, n2, (1.0, 1.0, 1.0)))
    if dot(whole, normal) < 0.0:  # authored for the other winding
        shading = scaled(shading, -1.0)
    cosine = dot(shading, normal)
    if cosine < LEAST_NORMAL_COSINE:
        along = normalized(plus_scaled(shading, normal, -cosine))
        if dot(along, along) > 0.0:
            shading = normalized(
                plus_scaled(
                    scaled(along, math.sqrt(1.0 - LEAST_NORMAL_COSINE * LEAST_NORMAL_COSINE)),
                    normal,
                    LEAST_NORMAL_COSINE,
                )
            )
        else:
            shading = normal

    out.instance[i] = instance
    out.triangle[i] = triangle
    out.barycentric[i, 0] = u
    out.barycentric[i, 1] = v
    out.side[i] = side
    out.face[i] = geometry.face[triangle]
    store3(out.position, i, position)
    store3(out.normal, i, scaled(normal, sign))
    store3(out.shading_normal, i, scaled(shading, sign))
    for c in range(2):
        uv = geometry.face_uv[triangle]
        out.face_uv[i, c] = w[0] * uv[0, c] + w[1] * uv[1, c] + w[2] * uv[2, c]

    # Material
    m = np.int64(geometry.material[triangle])
    st = geometry.st[triangle]
    s = w[0] * st[0, 0] + w[1] * st[1, 0] + w[2] * st[2, 0]
    t = w[0] * st[0, 1] + w[1] * st[1, 1] + w[2] * st[2, 1]
    if materials.use_display_color[m] != 0 and materials.texture[m, DIFFUSE] < 0:
        color = geometry.color[triangle]
        diffuse = mixed(row3(color, 0), row3(color, 1), row3(color, 2), w)
    else:
        diffuse = color_input(materials.diffuse, materials, textures, m, DIFFUSE, s, t)
    diffuse = (min(max(diffuse[0], 0.0), 1.0), min(max(diffuse[1], 0.0), 1.0), min(max(diffuse[2], 0.0), 1.0))
    emission = color_input(materials.emission, materials, textures, m, EMISSION, s, t)
    roughness = scalar_input(materials.roughness, materials, textures, m, ROUGHNESS, s, t)
    opacity = scalar_input(materials.opacity, materials, textures, m, OPACITY, s, t)
    ior = np.float64(materials.ior[m])

    specular = (0.0, 0.0, 0.0)
    edge = 0.0
    albedo = diffuse
    if materials.use_specular[m] != 0:
        specular = color_input(materials.specular, materials, textures, m, SPECULAR, s, t)
        specular = (min(specular[0], 1.0), min(specular[1], 1.0), min(specular[2], 1.0))
        if ior != 1.0 or max(specular[0], specular[1], specular[2]) > 0.0:
            edge = 1.0
    else:
        metallic = scalar_input(materials.metallic, materials, textures, m, METALLIC, s, t)
        ratio = (ior - 1.0) / (ior + 1.0) if ior > 0.0 else 0.0
        f0 = ratio * ratio * (1.0 - metallic)
        specular = (f0 + metallic * diffuse[0], f0 + metallic * diffuse[1], f0 + metallic * diffuse[2])
        albedo = scaled(diffuse, 1.0 - metallic)
        edge = metallic if ior == 1.0 else 1.0

    delta = NONE
    threshold = materials.opacity_threshold[m]
    if threshold > 0.0:
        if opacity < threshold:
            delta = PASS
            opacity = 0.0
            emission = (0.0, 0.0, 0.0)
        else:
            opacity = 1.0
    elif opacity <= 0.0:
        delta = PASS if ior == 1.0 or ior <= 0.0 else GLASS
    if delta == PASS:
        specular, edge = (0.0, 0.0, 0.0), 0.0
    if delta != NONE:
        albedo = (0.0, 0.0, 0.0)
    elif (
        roughness <= MIRROR_ROUGHNESS
        and max(albedo[0], albedo[1], albedo[2]) <= 0.0
        and max(specular[0], specular[1], specular[2]) > 0.0
    ):
        delta = MIRROR

    store3(out.albedo, i, albedo)
    store3(out.specular, i, specular)
    store3(out.emission, i, emission)
    out.specular_edge[i] = edge
    out.roughness[i] = roughness
    out.delta[i] = delta
    out.opacity[i] = opacity
    out.ior[i] = ior


@kernel
def clear_point(i: int, out: tuple) -> None:
    """Make row `i` of `out` the point of a ray that hit nothing."""
    zero = (0.0, 0.0, 0.0)
    store3(out.position, i, zero)
    store3(out.normal, i, zero)
    store3(out.shading_normal, i, zero)
    store3(out.albedo, i, zero)
    store3(out.specular, i, zero)
    store3(out.emission, i, zero)
    for c in range(2):
        out.barycentric[i, c] = 0.0
        out.face_uv[i, c] = 0.0
    out.instance[i] = -1
    out.triangle[i] = -1
    out.side[i] = 0
    out.face[i] = 0
    out.specular_edge[i] = 0.0
    out.roughness[i] = 0.0
    out.delta[i] = 0
    out.opacity[i] = 0.0
    out.ior[i] = 0.0


@parallel_kernel
def shade_hits(
    geometry: tuple, materials: tuple, textures: tuple, hits: tuple, directions: np.ndarray, out: tuple
) -> None:
    """Surface points of hits, each seen from the side that its ray comes from."""
    n = hits.instance.shape[0]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            instance, triangle = np.int64(hits.instance[i]), np.int64(hits.triangle[i])
            if instance < 0:
                clear_point(i, out)
                continue
            side = 0 if dot(geometric_normal(geometry, instance, triangle), row3(directions, i)) <= 0.0 else 1
            write_point(geometry, materials, textures, i, instance, triangle, hits.u[i], hits.v[i], side, out)


@parallel_kernel
def points_on_surface(
    geometry: tuple,
    materials: tuple,
    textures: tuple,
    instance: np.ndarray,
    triangle: np.ndarray,
    barycentric: np.ndarray,
    side: np.ndarray,
    out: tuple,
) -> None:
    """Surface points of given places on given sides."""
    n = instance.shape[0]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            if instance[i] < 0:
                clear_point(i, out)
                continue
            write_point(
                geometry,
                materials,
                textures,
                i,
                np.int64(instance[i]),
                np.int64(triangle[i]),
                barycentric[i, 0],
                barycentric[i, 1],
                np.int64(side[i]),
                out,
            )
