"""Light of one light at many points: shadow rays are made, weighed, traced and summed without arrays in between."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.bsdf import ggx_density, lobe_alpha, lobe_cosines, smith_lambda, specular_terms
from icheat_usd.kernels.dome_rays import DISTANCE, PDF, RADIANCE
from icheat_usd.kernels.embree import PACKET, call_1, call_packet
from icheat_usd.kernels.light_rays import ask_rays, find_rays, make_asked
from icheat_usd.kernels.lights import light_shape
from icheat_usd.kernels.simd import address_of
from icheat_usd.kernels.vector import dot, normalized, plus_scaled, row3

_CHUNK = 256  # points that share buffers
_INVALID = np.uint32(0xFFFFFFFF)


class Weights(NamedTuple):
    """How rays of one light count."""

    n_shadow: float  #: shadow rays of a point in all, against which rays of its specular lobe are weighed
    n_specular: float  #: of these; 0 where they cannot find the light
    diffuse: float  #: factors of the light
    specular: float
    stop_short: float  #: share of the way to the light that is looked along


@parallel_kernel
def add_shadowed(  # type: ignore[no-untyped-def]
    trace, lights, textures, tables, guide, light, points, instance, start, to_eye, draws, n_samples, seed, weights,
    out, extremes,
):  # fmt: skip
    """Add what one light, which is no mesh, brings to n points, where anything that is in the way blocks it.

    Parameters
    ----------
    trace : TraceTable
        With a function that tells whether there is anything, rtcOccluded16 or rtcOccluded1.
    points : SurfacePoints
    instance : (n,) int32
        -1 for points that the light does not shine on.
    start : (n, 3) float32
        Where rays leave, off the surface.
    to_eye : (n, 3) float32
        Radiance towards there is added; irradiance where it has no rows.
    draws : (n, 2) int64
        Sequence of random numbers of each point, and the number in it of its first ray.
    out : (n, 3) float32
    extremes : (n, 2) float32
        Lowered and raised to the least and the largest irradiance that a ray brings; not where it has no rows.
    """
    n = len(instance)
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        _add_to_chunk(
            chunk * _CHUNK, min(n, (chunk + 1) * _CHUNK), trace, lights, textures, tables, guide, light, points,
            instance, start, to_eye, draws, n_samples, seed, weights, out, extremes,
        )  # fmt: skip


@kernel
def _add_to_chunk(  # type: ignore[no-untyped-def]
    first, end, trace, lights, textures, tables, guide, light, points, instance, start, to_eye, draws, n_samples, seed,
    weights, out, extremes,
):  # fmt: skip
    storage = np.zeros(PACKET + 48, np.float32)
    shift = (-address_of(storage) % 64) // 4
    valid = storage[shift : shift + 16].view(np.int32)
    rays = storage[shift + 16 : shift + 16 + PACKET].reshape(22, 16)
    single = storage[shift + 16 + PACKET : shift + 32 + PACKET]
    owner, value, brought = np.empty(16, np.int64), np.empty((16, 3), np.float32), np.empty(16, np.float32)
    total = np.zeros((end - first, 3), np.float64)
    shape = light_shape(lights, textures, tables, light)
    texels, rows_cdf, columns_cdf = textures.texels, tables.rows_cdf, tables.columns_cdf
    axis, split, child, rows, bands, columns = guide
    position, normal, shading_normal, delta = points.position, points.normal, points.shading_normal, points.delta
    albedo, roughness, specular, specular_edge = points.albedo, points.roughness, points.specular, points.specular_edge
    red, green, blue = lights.radiance[light, 0], lights.radiance[light, 1], lights.radiance[light, 2]
    function, scene, arguments, packets = trace.function, trace.scene, trace.arguments, trace.packets
    has_eye = len(to_eye) > 0
    asked = make_asked()
    ray = asked.ray
    n, i, k = 0, first, 0
    while i < end:
        n_asked, i, k = ask_rays(
            asked, i, k, end, instance, draws, n_samples, seed, light, shape[0], axis, split, child, rows, position,
            shading_normal,
        )  # fmt: skip
        find_rays(
            n_asked, asked, shape, texels, rows_cdf, columns_cdf, bands, columns, position, normal, shading_normal
        )
        for a in range(n_asked):
            p = ray[a, PDF]
            if p <= 0.0:
                continue
            at = asked.point[a]
            wx, wy, wz = ray[a, 0], ray[a, 1], ray[a, 2]
            about = row3(shading_normal, at)
            cosine = about[0] * wx + about[1] * wy + about[2] * wz
            share = 1.0 / (p * n_samples)
            if not has_eye:
                share *= cosine
            r = np.float32(ray[a, RADIANCE] * share * red)
            g = np.float32(ray[a, RADIANCE + 1] * share * green)
            b = np.float32(ray[a, RADIANCE + 2] * share * blue)
            if has_eye:
                upwards, eye, to_light = row3(normal, at), normalized(row3(to_eye, at)), normalized((wx, wy, wz))
                tint, lobe, edge_of_lobe = row3(albedo, at), row3(specular, at), row3(specular_edge, at)
                diffuse = lobe_cosines(about, upwards, eye, to_light)[1] / math.pi * weights.diffuse
                x, y, z = tint[0] * diffuse, tint[1] * diffuse, tint[2] * diffuse
                if delta[at] == 0 and max(max(lobe), max(edge_of_lobe)) > 0.0:
                    base, edge = _lobe_factors(about, upwards, eye, to_light, lobe_alpha(roughness[at]), p, weights)
                    x += lobe[0] * base + edge_of_lobe[0] * edge
                    y += lobe[1] * base + edge_of_lobe[1] * edge
                    z += lobe[2] * base + edge_of_lobe[2] * edge
            else:
                x = y = z = weights.diffuse
            value[n, 0], value[n, 1], value[n, 2] = r * x, g * y, b * z
            if value[n, 0] == 0.0 and value[n, 1] == 0.0 and value[n, 2] == 0.0:
                continue
            owner[n] = at - first
            brought[n] = max(r, g, b) * cosine if has_eye else max(r, g, b)
            rays[0, n], rays[1, n], rays[2, n] = start[at, 0], start[at, 1], start[at, 2]
            rays[4, n], rays[5, n], rays[6, n] = wx, wy, wz
            rays[8, n] = np.float32(ray[a, DISTANCE]) * np.float32(weights.stop_short)
            n += 1
            if n == 16:
                _trace_and_add(
                    function, scene, arguments, packets, n, rays, valid, single, owner, value, brought, total, first,
                    extremes,
                )  # fmt: skip
                n = 0
    _trace_and_add(
        function, scene, arguments, packets, n, rays, valid, single, owner, value, brought, total, first, extremes
    )
    for i in range(first, end):
        for c in range(3):
            out[i, c] += np.float32(total[i - first, c])


@kernel
def _lobe_factors(normal, geometric, eye, to_light, alpha, pdf, weights):  # type: ignore[no-untyped-def]
    """Factors of `specular` and `specular_edge`, weighed against rays of the lobe (Veach 1997, eq. 9.13)."""
    base, edge = specular_terms(normal, geometric, eye, to_light, alpha)
    share = weights.specular
    if weights.n_specular > 0.0:
        ours, other = weights.n_shadow * pdf, weights.n_specular * _lobe_pdf(normal, eye, to_light, alpha)
        share *= ours * ours / (ours * ours + other * other)
    return base * share, edge * share


@kernel
def _lobe_pdf(normal, eye, to_light, alpha):  # type: ignore[no-untyped-def]
    """Density with which `bsdf.sample_specular` picks a direction (Heitz 2018, eq. 17)."""
    h = normalized(plus_scaled(eye, to_light, 1.0))
    if not dot(eye, h) > 0.0:
        return 0.0
    cosine = max(dot(normal, eye), 1e-4)
    return ggx_density(normal, h, alpha) / (4.0 * cosine * (1.0 + smith_lambda(cosine, alpha)))


@kernel
def _trace_and_add(  # type: ignore[no-untyped-def]
    function, scene, arguments, packets, n, rays, valid, single, owner, value, brought, total, first, extremes
):
    """Trace the first n rays of a packet, and add what those bring that nothing blocks."""
    if n == 0:
        return
    words, single_words = rays.view(np.uint32), single.view(np.uint32)
    for k in range(16):
        finite = np.float32(0.0)
        for c in range(3):
            finite += rays[c, k] * np.float32(0.0) + rays[4 + c, k] * np.float32(0.0)
        # What cannot be traced is not blocked, as for other rays.
        valid[k] = -1 if k < n and finite == 0.0 and rays[8, k] > 0.0 else 0
    rays[3, :] = 0.0
    rays[7, :] = 0.0
    words[9, :] = _INVALID
    words[10:12, :] = 0
    if packets:
        call_packet(function, address_of(valid), scene, address_of(rays), arguments)
    else:
        for k in range(n):
            if valid[k] != 0:
                for c in range(12):
                    single_words[c] = words[c, k]
                call_1(function, scene, address_of(single))
                rays[8, k] = single[8]
    for k in range(n):
        i = owner[k]
        clear = valid[k] == 0 or rays[8, k] >= 0.0
        if clear:
            for c in range(3):
                total[i, c] += value[k, c]
        if len(extremes) > 0:
            light = brought[k] if clear else np.float32(0.0)
            extremes[first + i, 0] = min(extremes[first + i, 0], light)
            extremes[first + i, 1] = max(extremes[first + i, 1], light)
