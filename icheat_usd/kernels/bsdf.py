"""The reflectance model: Lambert plus an isotropic GGX lobe with Schlick's Fresnel term, and exact dielectrics.

Roughness-based quantities use alpha = max(roughness^2, `LEAST_ALPHA`).
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.vector import Vector, cross, dot, frame, normalized, plus_scaled, row3, scaled, store3

CHUNK = 512
# Below this a lobe is narrower than float32 normals are precise (roughness 0.032).
LEAST_ALPHA = 1e-3


@kernel
def lobe_alpha(roughness: float) -> float:
    """GGX width of UsdPreviewSurface's roughness."""
    return max(np.float64(roughness) * np.float64(roughness), LEAST_ALPHA)


@kernel
def schlick_weight(cosine: float) -> float:
    """Share of the grazing reflectance, ``(1 - cosine)^5`` (Schlick 1994)."""
    x = 1.0 - min(max(cosine, 0.0), 1.0)
    return x * x * x * x * x


@kernel
def ggx_density(n: Vector, h: Vector, alpha: float) -> float:
    """Microfacet density D(h) per solid angle (Walter et al. 2007, eq. 33).

    The sine comes from the cross product: from ``1 - cos^2`` it would lose all
    digits where a narrow lobe has its peak.
    """
    cosine = dot(n, h)
    if cosine <= 0.0:
        return 0.0
    sine = cross(n, h)
    x = alpha * alpha * cosine * cosine + dot(sine, sine)
    return alpha * alpha / (math.pi * x * x)


@kernel
def smith_lambda(cosine: float, alpha: float) -> float:
    """Smith's Lambda for GGX (Heitz 2014, eq. 72)."""
    c2 = min(cosine * cosine, 1.0)
    return 0.5 * (math.sqrt(1.0 + alpha * alpha * (1.0 - c2) / c2) - 1.0)


@kernel
def lobe_cosines(n: Vector, geometric: Vector, to_eye: Vector, to_light: Vector) -> tuple[float, float]:
    """Cosines of eye and light to the shading normal; (0, 0) where the light is below either horizon.

    A shading normal can turn away from an eye that sees the surface: that
    cosine is kept positive, else such pixels would be black.
    """
    light = dot(n, to_light)
    if light <= 0.0 or dot(geometric, to_light) <= 0.0:
        return 0.0, 0.0
    return max(dot(n, to_eye), 1e-4), light


@kernel
def specular_terms(n: Vector, geometric: Vector, to_eye: Vector, to_light: Vector, alpha: float) -> tuple[float, float]:
    """GGX reflectance times the light's cosine, for `specular` 1 and for `specular_edge` 1."""
    eye, light = lobe_cosines(n, geometric, to_eye, to_light)
    if light <= 0.0:
        return 0.0, 0.0
    h = normalized(plus_scaled(to_eye, to_light, 1.0))
    shadowing = 1.0 / (1.0 + smith_lambda(eye, alpha) + smith_lambda(light, alpha))
    value = ggx_density(n, h, alpha) * shadowing / (4.0 * eye)
    edge = schlick_weight(dot(h, to_light))
    return value * (1.0 - edge), value * edge


@kernel
def has_lobe(points: tuple, i: int) -> bool:
    """Whether the point scatters light into a specular lobe."""
    if points.delta[i] != 0:
        return False
    for c in range(3):
        if points.specular[i, c] > 0.0 or points.specular_edge[i, c] > 0.0:
            return True
    return False


@parallel_kernel
def evaluate(points: tuple, to_eye: np.ndarray, to_light: np.ndarray, out: np.ndarray) -> None:
    """BRDF times the light's cosine."""
    n = points.instance.shape[0]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            normal, geometric = row3(points.shading_normal, i), row3(points.normal, i)
            eye, light = normalized(row3(to_eye, i)), normalized(row3(to_light, i))
            cosine = lobe_cosines(normal, geometric, eye, light)[1]
            base, edge = 0.0, 0.0
            if has_lobe(points, i):
                base, edge = specular_terms(normal, geometric, eye, light, lobe_alpha(points.roughness[i]))
            for c in range(3):
                out[i, c] = (
                    points.albedo[i, c] * (cosine / math.pi)
                    + points.specular[i, c] * base
                    + points.specular_edge[i, c] * edge
                )


@parallel_kernel
def evaluate_specular(
    points: tuple, to_eye: np.ndarray, to_light: np.ndarray, base: np.ndarray, edge: np.ndarray, pdf: np.ndarray
) -> None:
    """Factors of `specular` and `specular_edge`, and the density with which `sample_specular` picks `to_light`."""
    n = points.instance.shape[0]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            base[i] = 0.0
            edge[i] = 0.0
            pdf[i] = 0.0
            if has_lobe(points, i):
                normal, geometric = row3(points.shading_normal, i), row3(points.normal, i)
                eye, light = normalized(row3(to_eye, i)), normalized(row3(to_light, i))
                alpha = lobe_alpha(points.roughness[i])
                base[i], edge[i] = specular_terms(normal, geometric, eye, light, alpha)
                eye_cosine = max(dot(normal, eye), 1e-4)
                h = normalized(plus_scaled(eye, light, 1.0))
                if dot(eye, h) > 0.0:
                    pdf[i] = ggx_density(normal, h, alpha) / (
                        4.0 * eye_cosine * (1.0 + smith_lambda(eye_cosine, alpha))
                    )


@kernel
def visible_normal(to_eye: Vector, alpha: float, u: float, v: float) -> Vector:
    """Microfacet normal seen from `to_eye` in the frame whose z is the surface normal (Heitz 2018, JCGT 7(4))."""
    stretched = normalized((alpha * to_eye[0], alpha * to_eye[1], to_eye[2]))
    length = math.sqrt(stretched[0] * stretched[0] + stretched[1] * stretched[1])
    t1 = (1.0, 0.0, 0.0)
    if length > 1e-9:
        t1 = (-stretched[1] / length, stretched[0] / length, 0.0)
    t2 = cross(stretched, t1)
    r = math.sqrt(u)
    phi = 2.0 * math.pi * v
    a = r * math.cos(phi)
    b = r * math.sin(phi)
    s = 0.5 * (1.0 + stretched[2])
    b = (1.0 - s) * math.sqrt(max(0.0, 1.0 - a * a)) + s * b
    c = math.sqrt(max(0.0, 1.0 - a * a - b * b))
    h = plus_scaled(plus_scaled(scaled(t1, a), t2, b), stretched, c)
    return normalized((alpha * h[0], alpha * h[1], max(0.0, h[2])))


@kernel
def sample_lobe(points: tuple, i: int, eye: Vector, u: float, v: float) -> tuple[Vector, float, float]:
    """A direction of the GGX lobe of point i, seen from the unit vector `eye`; weights as of `sample_specular`."""
    normal = row3(points.shading_normal, i)
    if points.instance[i] < 0 or not has_lobe(points, i):
        return normal, 0.0, 0.0
    alpha = lobe_alpha(points.roughness[i])
    tangent, bitangent = frame(normal)
    local = normalized((dot(eye, tangent), dot(eye, bitangent), max(dot(eye, normal), 1e-4)))
    h = visible_normal(local, alpha, u, v)
    cosine = dot(local, h)
    light = plus_scaled(scaled(h, 2.0 * cosine), local, -1.0)
    world = normalized(plus_scaled(plus_scaled(scaled(tangent, light[0]), bitangent, light[1]), normal, light[2]))
    if light[2] <= 0.0 or dot(row3(points.normal, i), world) <= 0.0:
        return world, 0.0, 0.0
    eye_lambda = smith_lambda(local[2], alpha)
    weight = (1.0 + eye_lambda) / (1.0 + eye_lambda + smith_lambda(light[2], alpha))
    share = schlick_weight(cosine)
    return world, weight * (1.0 - share), weight * share


@parallel_kernel
def sample_specular(
    points: tuple, to_eye: np.ndarray, u: np.ndarray, directions: np.ndarray, base: np.ndarray, edge: np.ndarray
) -> None:
    """Directions of the GGX lobe and what `specular` and `specular_edge` are to be multiplied by."""
    n = points.instance.shape[0]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            world, base[i], edge[i] = sample_lobe(points, i, normalized(row3(to_eye, i)), u[i, 0], u[i, 1])
            store3(directions, i, world)


@kernel
def dielectric_reflectance(cosine: float, eta: float) -> tuple[float, float]:
    """Unpolarised Fresnel reflectance and the cosine of the refracted ray; (1, 0) is total internal reflection.

    `cosine` to the normal on the incoming side, `eta` = index there / index beyond
    (Born & Wolf, Principles of Optics, 1.5.2).
    """
    cosine = min(max(cosine, 0.0), 1.0)
    sine2 = eta * eta * (1.0 - cosine * cosine)
    if sine2 >= 1.0:
        return 1.0, 0.0
    beyond = math.sqrt(1.0 - sine2)
    parallel = (cosine - eta * beyond) / (cosine + eta * beyond)
    perpendicular = (eta * cosine - beyond) / (eta * cosine + beyond)
    return 0.5 * (parallel * parallel + perpendicular * perpendicular), beyond


@kernel
def reflected(direction: Vector, normal: Vector, geometric: Vector) -> Vector:
    """Mirror direction about the shading normal; about the geometric one where that would go through the surface."""
    result = plus_scaled(direction, normal, -2.0 * dot(direction, normal))
    if dot(result, geometric) <= 0.0:
        result = plus_scaled(direction, geometric, -2.0 * dot(direction, geometric))
    return normalized(result)


@kernel
def interface(points: tuple, i: int, direction: Vector) -> tuple[float, Vector, Vector]:
    """Reflectance, reflected and refracted unit direction at the dielectric of point `i`, seen along `direction`."""
    normal, geometric = row3(points.shading_normal, i), row3(points.normal, i)
    ior = np.float64(points.ior[i])
    eta = 1.0 / ior if points.side[i] == 0 else ior
    cosine = -dot(direction, normal)
    if cosine <= 0.0:
        normal, cosine = geometric, -dot(direction, geometric)
    reflectance, beyond = dielectric_reflectance(cosine, eta)
    bent = normalized(plus_scaled(scaled(direction, eta), normal, eta * cosine - beyond))
    if reflectance < 1.0 and dot(bent, geometric) >= 0.0:
        reflectance_flat, beyond = dielectric_reflectance(-dot(direction, geometric), eta)
        bent = normalized(plus_scaled(scaled(direction, eta), geometric, -eta * dot(direction, geometric) - beyond))
        reflectance = reflectance_flat
    return reflectance, reflected(direction, normal, geometric), bent


@kernel
def mirror_share(points: tuple, i: int, direction: Vector) -> float:
    """Share of the grazing reflectance at a mirror."""
    return schlick_weight(-dot(direction, row3(points.shading_normal, i)))


@parallel_kernel
def split_delta(
    points: tuple,
    directions: np.ndarray,
    mirrored: np.ndarray,
    passed: np.ndarray,
    weight_mirrored: np.ndarray,
    weight_passed: np.ndarray,
) -> None:
    """Both continuations of a path at points that do not scatter it, with their weights."""
    n = points.instance.shape[0]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            direction = normalized(row3(directions, i))
            normal, geometric = row3(points.shading_normal, i), row3(points.normal, i)
            there = points.instance[i] >= 0
            kind = points.delta[i] if there else 0
            back, bent = reflected(direction, normal, geometric), direction
            reflectance = 0.0
            transmitted = 1.0 - points.opacity[i] if there else 0.0
            if kind == 2:
                reflectance, back, bent = interface(points, i, direction)
                transmitted = 1.0 - reflectance
            elif kind == 3:
                transmitted = 1.0
            share = mirror_share(points, i, direction)
            store3(mirrored, i, back)
            store3(passed, i, bent)
            for c in range(3):
                weight_passed[i, c] = transmitted
                weight_mirrored[i, c] = reflectance
                if kind == 1:
                    f0 = points.specular[i, c]
                    weight_mirrored[i, c] = points.opacity[i] * (f0 + (points.specular_edge[i, c] - f0) * share)
