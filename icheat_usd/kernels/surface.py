"""Surfaces at points: interpolation over triangles, textures, and the mapping of UsdPreviewSurface inputs.

Helpers take the few arrays that they read, never a whole table or a slice of an
array: both cost reference counting at every point (measured: 1 instead of 10
million points per second). Outputs are arguments of their own: Numba removes
stores to an array that it finds in a tuple as dead code.
"""

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
def texel_sum(
    texels: np.ndarray,
    begin: np.ndarray,
    width: np.ndarray,
    height: np.ndarray,
    wrap: np.ndarray,
    image: int,
    s: float,
    t: float,
) -> tuple[float, float, float, float]:
    """Bilinear lookup, texel centres at (k + 1/2) / size, v up."""
    columns, rows = np.int64(width[image]), np.int64(height[image])
    x = s * columns - 0.5
    y = (1.0 - t) * rows - 0.5
    if not (abs(x) < 1e9 and abs(y) < 1e9):
        return 0.0, 0.0, 0.0, 0.0
    x0, y0 = np.int64(math.floor(x)), np.int64(math.floor(y))
    fx, fy = x - x0, y - y0
    r, g, b, a = 0.0, 0.0, 0.0, 0.0
    for dy in range(2):
        row = wrapped(y0 + dy, rows, wrap[image, 1])
        wy = fy if dy == 1 else 1.0 - fy
        for dx in range(2):
            column = wrapped(x0 + dx, columns, wrap[image, 0])
            if row >= 0 and column >= 0:
                w = wy * (fx if dx == 1 else 1.0 - fx)
                texel = begin[image] + row * columns + column
                r += w * texels[texel, 0]
                g += w * texels[texel, 1]
                b += w * texels[texel, 2]
                a += w * texels[texel, 3]
    return r, g, b, a


@kernel
def rescaled(
    value: tuple[float, float, float, float],
    channels: np.ndarray,
    scale: np.ndarray,
    bias: np.ndarray,
    m: int,
    slot: int,
) -> tuple[float, float, float, float]:
    """A texel after scale and bias; one channel, where one is chosen, is repeated in all."""
    r = value[0] * scale[m, slot, 0] + bias[m, slot, 0]
    g = value[1] * scale[m, slot, 1] + bias[m, slot, 1]
    b = value[2] * scale[m, slot, 2] + bias[m, slot, 2]
    a = value[3] * scale[m, slot, 3] + bias[m, slot, 3]
    channel = channels[m, slot]
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
def corner(array: np.ndarray, triangle: int, k: int) -> Vector:
    """``array[triangle, k]`` of (n, 3, 3) in double precision."""
    return (
        np.float64(array[triangle, k, 0]),
        np.float64(array[triangle, k, 1]),
        np.float64(array[triangle, k, 2]),
    )


@kernel
def corner_pair(array: np.ndarray, triangle: int, w: Vector) -> tuple[float, float]:
    """Barycentric mix of an (n, 3, 2) array."""
    return (
        w[0] * array[triangle, 0, 0] + w[1] * array[triangle, 1, 0] + w[2] * array[triangle, 2, 0],
        w[0] * array[triangle, 0, 1] + w[1] * array[triangle, 1, 1] + w[2] * array[triangle, 2, 1],
    )


@kernel
def mixed(a: Vector, b: Vector, c: Vector, w: Vector) -> Vector:
    """Barycentric mix of three corners."""
    return plus_scaled(plus_scaled(scaled(a, w[0]), b, w[1]), c, w[2])


@kernel
def geometric_normal(points: np.ndarray, to_object: np.ndarray, instance: int, triangle: int) -> Vector:
    """Unit world-space normal of the front side; zero for a triangle without area."""
    a = corner(points, triangle, 0)
    edge_1 = plus_scaled(corner(points, triangle, 1), a, -1.0)
    edge_2 = plus_scaled(corner(points, triangle, 2), a, -1.0)
    return normalized(transform_normal(to_object, instance, normalized(cross(edge_1, edge_2))))


@kernel
def bent_above(shading: Vector, normal: Vector) -> Vector:
    """The shading normal, or the nearest one that keeps `LEAST_NORMAL_COSINE` to the geometric normal."""
    cosine = dot(shading, normal)
    if cosine >= LEAST_NORMAL_COSINE:
        return shading
    along = normalized(plus_scaled(shading, normal, -cosine))
    if dot(along, along) <= 0.0:
        return normal
    sine = math.sqrt(1.0 - LEAST_NORMAL_COSINE * LEAST_NORMAL_COSINE)
    return normalized(plus_scaled(scaled(along, sine), normal, LEAST_NORMAL_COSINE))


@kernel
def unit(x: float) -> float:
    """`x` kept in [0, 1]."""
    return min(max(x, 0.0), 1.0)


@parallel_kernel
def sides_seen(
    points: np.ndarray,
    to_object: np.ndarray,
    instance: np.ndarray,
    triangle: np.ndarray,
    directions: np.ndarray,
    side: np.ndarray,
) -> None:
    """0 where a ray meets the front, 1 the back."""
    n = instance.shape[0]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            side[i] = 0
            if instance[i] >= 0:
                normal = geometric_normal(points, to_object, np.int64(instance[i]), np.int64(triangle[i]))
                along = normal[0] * directions[i, 0] + normal[1] * directions[i, 1] + normal[2] * directions[i, 2]
                side[i] = 0 if along <= 0.0 else 1


@parallel_kernel
def place_points(
    geometry: tuple,
    instances: np.ndarray,
    triangles: np.ndarray,
    us: np.ndarray,
    vs: np.ndarray,
    sides: np.ndarray,
    st: np.ndarray,
    color: np.ndarray,
    out_position: np.ndarray,
    out_normal: np.ndarray,
    out_shading_normal: np.ndarray,
    out_instance: np.ndarray,
    out_triangle: np.ndarray,
    out_barycentric: np.ndarray,
    out_side: np.ndarray,
    out_face: np.ndarray,
    out_face_uv: np.ndarray,
) -> None:
    """The geometry of n places (zeros where the instance is -1), their texture coordinates and displayColor."""
    points, normals, to_world, to_object = (
        geometry.points,
        geometry.normals,
        geometry.instance_to_world,
        geometry.instance_to_object,
    )
    corner_st, corner_color, face, face_uv = geometry.st, geometry.color, geometry.face, geometry.face_uv
    n = instances.shape[0]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            instance, triangle = np.int64(instances[i]), np.int64(triangles[i])
            zero = (0.0, 0.0, 0.0)
            if instance < 0:
                store3(out_position, i, zero)
                store3(out_normal, i, zero)
                store3(out_shading_normal, i, zero)
                for c in range(2):
                    out_barycentric[i, c] = 0.0
                    out_face_uv[i, c] = 0.0
                    st[i, c] = 0.0
                store3(color, i, zero)
                out_instance[i] = -1
                out_triangle[i] = -1
                out_side[i] = 0
                out_face[i] = 0
                continue
            u, v = np.float64(us[i]), np.float64(vs[i])
            w = (1.0 - u - v, u, v)
            sign = 1.0 if sides[i] == 0 else -1.0
            position = mixed(
                transform_point(to_world, instance, corner(points, triangle, 0)),
                transform_point(to_world, instance, corner(points, triangle, 1)),
                transform_point(to_world, instance, corner(points, triangle, 2)),
                w,
            )
            normal = geometric_normal(points, to_object, instance, triangle)
            n0, n1, n2 = corner(normals, triangle, 0), corner(normals, triangle, 1), corner(normals, triangle, 2)
            shading = normalized(transform_normal(to_object, instance, mixed(n0, n1, n2, w)))
            if dot(transform_normal(to_object, instance, mixed(n0, n1, n2, (1.0, 1.0, 1.0))), normal) < 0.0:
                shading = scaled(shading, -1.0)  # authored for the other winding
            shading = bent_above(shading, normal)

            out_instance[i] = instance
            out_triangle[i] = triangle
            out_barycentric[i, 0] = us[i]
            out_barycentric[i, 1] = vs[i]
            out_side[i] = sides[i]
            out_face[i] = face[triangle]
            store3(out_position, i, position)
            store3(out_normal, i, scaled(normal, sign))
            store3(out_shading_normal, i, scaled(shading, sign))
            a, b = corner_pair(face_uv, triangle, w)
            out_face_uv[i, 0] = a
            out_face_uv[i, 1] = b
            a, b = corner_pair(corner_st, triangle, w)
            st[i, 0] = a
            st[i, 1] = b
            tint = mixed(
                corner(corner_color, triangle, 0),
                corner(corner_color, triangle, 1),
                corner(corner_color, triangle, 2),
                w,
            )
            store3(color, i, tint)


@parallel_kernel
def sample_inputs(
    materials: tuple,
    textures: tuple,
    material: np.ndarray,
    instance: np.ndarray,
    triangle: np.ndarray,
    st: np.ndarray,
    inputs: np.ndarray,
) -> None:
    """Replace `inputs` (n, 6, 3), by `scene.Texture`, where a texture drives them."""
    texture, transform = materials.texture, materials.texture_transform
    channel, scale, bias = materials.texture_channel, materials.texture_scale, materials.texture_bias
    texels, begin, width, height, wrap = (
        textures.texels,
        textures.begin,
        textures.width,
        textures.height,
        textures.wrap,
    )
    n = instance.shape[0]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            if instance[i] < 0:
                continue
            m = np.int64(material[triangle[i]])
            for slot in range(6):
                image = np.int64(texture[m, slot])
                if image < 0:
                    continue
                s, t = np.float64(st[i, 0]), np.float64(st[i, 1])
                s2 = transform[m, slot, 0, 0] * s + transform[m, slot, 0, 1] * t + transform[m, slot, 0, 2]
                t2 = transform[m, slot, 1, 0] * s + transform[m, slot, 1, 1] * t + transform[m, slot, 1, 2]
                texel = texel_sum(texels, begin, width, height, wrap, image, s2, t2)
                r, g, b, _ = rescaled(texel, channel, scale, bias, m, slot)
                inputs[i, slot, 0] = r
                inputs[i, slot, 1] = g
                inputs[i, slot, 2] = b


@parallel_kernel
def constant_inputs(
    materials: tuple,
    material: np.ndarray,
    instance: np.ndarray,
    triangle: np.ndarray,
    color: np.ndarray,
    inputs: np.ndarray,
) -> None:
    """Fill `inputs` (n, 6, 3), by `scene.Texture`, with the constants of the materials."""
    diffuse, emission, specular = materials.diffuse, materials.emission, materials.specular
    metallic, roughness, opacity = materials.metallic, materials.roughness, materials.opacity
    display = materials.use_display_color
    n = instance.shape[0]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            if instance[i] < 0:
                continue
            m = np.int64(material[triangle[i]])
            for c in range(3):
                inputs[i, DIFFUSE, c] = color[i, c] if display[m] != 0 else diffuse[m, c]
                inputs[i, EMISSION, c] = emission[m, c]
                inputs[i, SPECULAR, c] = specular[m, c]
            inputs[i, METALLIC, 0] = metallic[m]
            inputs[i, ROUGHNESS, 0] = roughness[m]
            inputs[i, OPACITY, 0] = opacity[m]


@parallel_kernel
def reflectances(
    materials: tuple,
    material: np.ndarray,
    instance: np.ndarray,
    triangle: np.ndarray,
    inputs: np.ndarray,
    out_albedo: np.ndarray,
    out_specular: np.ndarray,
    out_specular_edge: np.ndarray,
    out_roughness: np.ndarray,
    out_emission: np.ndarray,
    out_delta: np.ndarray,
    out_opacity: np.ndarray,
    out_ior: np.ndarray,
) -> None:
    """From UsdPreviewSurface inputs to the columns of `SurfacePoints` that describe reflection."""
    use_specular, iors, thresholds = materials.use_specular, materials.ior, materials.opacity_threshold
    n = instance.shape[0]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            if instance[i] < 0:
                for c in range(3):
                    out_albedo[i, c] = 0.0
                    out_specular[i, c] = 0.0
                    out_specular_edge[i, c] = 0.0
                    out_emission[i, c] = 0.0
                out_roughness[i] = 0.0
                out_delta[i] = NONE
                out_opacity[i] = 0.0
                out_ior[i] = 0.0
                continue
            m = np.int64(material[triangle[i]])
            roughness, opacity = unit(inputs[i, ROUGHNESS, 0]), unit(inputs[i, OPACITY, 0])
            metallic = unit(inputs[i, METALLIC, 0])
            ior = np.float64(iors[m])
            ratio = (ior - 1.0) / (ior + 1.0) if ior > 0.0 else 0.0
            dielectric = ratio * ratio * (1.0 - metallic)

            delta = NONE
            keep_emission = True
            threshold = thresholds[m]
            if threshold > 0.0:
                keep_emission = opacity >= threshold
                delta = NONE if keep_emission else PASS
                opacity = 1.0 if keep_emission else 0.0
            elif opacity <= 0.0:
                delta = PASS if ior == 1.0 or ior <= 0.0 else GLASS

            largest_albedo = 0.0
            largest_specular = 0.0
            for c in range(3):
                diffuse = unit(inputs[i, DIFFUSE, c])
                albedo = diffuse * (1.0 - metallic)
                specular = dielectric + metallic * diffuse
                edge = metallic * diffuse + (0.0 if ior == 1.0 else 1.0 - metallic)
                if use_specular[m] != 0:
                    albedo = diffuse
                    specular = unit(inputs[i, SPECULAR, c])
                    edge = 1.0 if ior != 1.0 or specular > 0.0 else 0.0
                # What the interface reflects does not reach the diffuse base.
                albedo *= 1.0 - specular
                if delta != NONE:
                    albedo = 0.0
                if delta == PASS:
                    specular = 0.0
                    edge = 0.0
                largest_albedo = max(largest_albedo, albedo)
                largest_specular = max(largest_specular, specular)
                out_albedo[i, c] = albedo
                out_specular[i, c] = specular
                out_specular_edge[i, c] = edge
                out_emission[i, c] = max(inputs[i, EMISSION, c], np.float32(0.0)) if keep_emission else np.float32(0.0)
            if delta == NONE and roughness <= MIRROR_ROUGHNESS and largest_albedo <= 0.0 and largest_specular > 0.0:
                delta = MIRROR
            out_roughness[i] = roughness
            out_delta[i] = delta
            out_opacity[i] = opacity
            out_ior[i] = ior
