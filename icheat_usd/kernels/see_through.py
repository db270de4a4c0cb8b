"""How much light crosses surfaces that let some of it straight through, one ray after another in compiled code."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.bsdf import dielectric_reflectance
from icheat_usd.kernels.embree import call_1
from icheat_usd.kernels.place_columns import ORIGIN
from icheat_usd.kernels.surface import OPACITY, corner, corner_pair, mixed, rescaled, texel_sum, unit
from icheat_usd.kernels.vector import dot, normalized, transform_normal

_BLOCK = 64
_RUNS = 16  # of places, whose rays are looked at together
_MAX_LAYERS = 256  # more count as opaque
_INVALID = np.uint32(0xFFFFFFFF)
# A surface is left behind by 2^-17 of its largest coordinate, twice what other rays start off it.
_STEP = 2.0**-17
_BEFORE_POINT = 1.0 - 1e-4  # as for other shadow rays: lights may lie in the plane of a pane


@kernel
def _opacity(
    m: int, triangle: int, weights: tuple[float, float, float], st: np.ndarray, opacities: np.ndarray,
    texture: np.ndarray, transform: np.ndarray, channel: np.ndarray, scale: np.ndarray, bias: np.ndarray,
    texels: np.ndarray, begin: np.ndarray, width: np.ndarray, height: np.ndarray, wrap: np.ndarray,
) -> float:  # fmt: skip
    image = np.int64(texture[m, OPACITY])
    if image < 0:
        return unit(np.float64(opacities[m]))
    s, t = corner_pair(st, triangle, weights)
    s2 = transform[m, OPACITY, 0, 0] * s + transform[m, OPACITY, 0, 1] * t + transform[m, OPACITY, 0, 2]
    t2 = transform[m, OPACITY, 1, 0] * s + transform[m, OPACITY, 1, 1] * t + transform[m, OPACITY, 1, 2]
    texel = texel_sum(texels, begin, width, height, wrap, image, s2, t2)
    return unit(np.float64(rescaled(texel, channel, scale, bias, m, OPACITY)[0]))


@kernel
def _cross_block(
    function: int, scene: int, mesh_begin: np.ndarray, instance_mesh: np.ndarray, geometry: tuple, materials: tuple,
    textures: tuple, origin: np.ndarray, direction: np.ndarray, limit: float, out: np.ndarray,
) -> None:  # fmt: skip
    """`cross_layers` by one thread."""
    material, st, normals = geometry.material, geometry.st, geometry.normals
    to_object = geometry.instance_to_object
    opacities, thresholds, iors = materials.opacity, materials.opacity_threshold, materials.ior
    texture, transform = materials.texture, materials.texture_transform
    channel, scale, bias = materials.texture_channel, materials.texture_scale, materials.texture_bias
    texels, begin, width, height, wrap = (
        textures.texels,
        textures.begin,
        textures.width,
        textures.height,
        textures.wrap,
    )
    storage = np.empty(64, np.float32)
    shift = np.int64((-storage.ctypes.data % 64) // 4)
    ray = storage[shift : shift + 24]
    words = ray.view(np.uint32)
    for i in range(len(origin)):
        near = 0.0
        left = 1.0
        layer = 0
        d = np.float64(direction[i, 0]), np.float64(direction[i, 1]), np.float64(direction[i, 2])
        length = math.sqrt(dot(d, d))
        while left > 0.0 and length > 0.0:
            for c in range(3):
                ray[c] = origin[i, c]
                ray[4 + c] = direction[i, c]
            ray[3] = near
            ray[7] = 0.0
            ray[8] = limit
            words[9] = _INVALID
            words[10] = 0
            words[11] = 0
            words[17] = _INVALID
            words[18] = _INVALID
            words[19] = _INVALID
            call_1(function, scene, ray.ctypes.data)
            if words[18] == _INVALID:
                break
            instance = np.int64(words[18] if words[19] == _INVALID else words[19])
            triangle = np.int64(mesh_begin[instance_mesh[instance]]) + np.int64(words[17])
            u, v = np.float64(ray[15]), np.float64(ray[16])
            weights = (1.0 - u - v, u, v)
            m = np.int64(material[triangle])
            opacity = _opacity(
                m, triangle, weights, st, opacities, texture, transform, channel, scale, bias, texels, begin,
                width, height, wrap,
            )  # fmt: skip
            ior = np.float64(iors[m])
            if thresholds[m] > 0.0:
                left *= 0.0 if opacity >= thresholds[m] else 1.0
            elif opacity > 0.0:
                left *= 1.0 - opacity
            elif ior != 1.0 and ior > 0.0:
                mean = mixed(
                    corner(normals, triangle, 0),
                    corner(normals, triangle, 1),
                    corner(normals, triangle, 2),
                    weights,
                )
                normal = normalized(transform_normal(to_object, instance, mean))
                left *= 1.0 - dielectric_reflectance(abs(dot(normal, d)) / length, 1.0 / ior)[0]
            largest = 0.0
            for c in range(3):
                largest = max(largest, abs(np.float64(origin[i, c]) + ray[8] * d[c]), abs(np.float64(origin[i, c])))
            near = np.float64(ray[8]) + _STEP * largest / length
            layer += 1
            if layer >= _MAX_LAYERS:
                left = 0.0
            if near >= limit:
                break
        out[i] = left


@parallel_kernel
def cross_layers(
    function: int,
    scene: int,
    mesh_begin: np.ndarray,
    instance_mesh: np.ndarray,
    geometry: tuple,
    materials: tuple,
    textures: tuple,
    origin: np.ndarray,
    direction: np.ndarray,
    limit: float,
    out: np.ndarray,
) -> None:
    """Share of light that crosses each segment, as `tracing.transmittance`.

    `function` is the address of rtcIntersect1, `scene` that of the triangles that may let light through.
    """
    n = len(origin)
    for block in prange((n + _BLOCK - 1) // _BLOCK):
        some = slice(block * _BLOCK, (block + 1) * _BLOCK)
        _cross_block(
            function, scene, mesh_begin, instance_mesh, geometry, materials, textures, origin[some], direction[some],
            limit, out[some],
        )  # fmt: skip


@kernel
def _find_crossed(runs: np.ndarray, size: int, through: np.ndarray, found: np.ndarray) -> tuple[int, int]:
    """Those of some runs behind see-through surfaces, to `found`; how many, and from how many places a ray was sent."""
    n = n_sent = 0
    for run in runs:
        first = np.int64(run) * size
        any_of, sent = np.int32(0), 0
        for value in through[first : first + size]:
            any_of |= value
            sent += 1 if value > 0 else 0
        found[n] = first
        n += 1 if any_of != 0 else 0
        n_sent += sent
    return n, n_sent


@kernel
def _find_ways(
    first: np.ndarray, points: np.ndarray, distant: bool, columns: np.ndarray, column: np.ndarray, through: np.ndarray,
    origin: np.ndarray, direction: np.ndarray,
) -> None:  # fmt: skip
    """Rays that were sent from places of runs, of which the `first` ones are given, into `origin` and `direction`."""
    size, n = columns.shape[1], 0
    for begin in first:
        for k, value in enumerate(through[begin : begin + size]):
            if value > 0:
                for c in range(3):
                    origin[n, c] = columns[column[begin // size, ORIGIN + c], k]
                    end = points[value - 1, c]
                    direction[n, c] = end if distant else end - origin[n, c]
                n += 1


@kernel
def _dim(
    first: np.ndarray, size: int, share: np.ndarray, row: np.ndarray, through: np.ndarray, crossing: np.ndarray,
    out: np.ndarray,
) -> None:  # fmt: skip
    """Dim the places of runs, of which the `first` ones are given; `share` (n_sent,) is what the rays found."""
    n = 0
    for begin in first:
        for k, value in enumerate(through[begin : begin + size]):
            if value == 0:
                continue
            if value > 0:
                crossing[begin + k] = share[n]
                n += 1
            for c in range(3):
                out[row[begin + k], c] *= crossing[begin + k]


@parallel_kernel
def dim_places(
    function: int,
    scene: int,
    mesh_begin: np.ndarray,
    instance_mesh: np.ndarray,
    geometry: tuple,
    materials: tuple,
    textures: tuple,
    points: np.ndarray,
    distant: bool,
    columns: np.ndarray,
    column: np.ndarray,
    row: np.ndarray,
    runs: np.ndarray,
    through: np.ndarray,
    crossing: np.ndarray,
    out: np.ndarray,
) -> None:
    """Dim what places get through see-through surfaces, after `kernels.shadow.light_places`.

    Parameters
    ----------
    function, scene
        As for `cross_layers`.
    points : (n_points, at least 3) float32
        Where the light's points are; of distant ones the direction.
    distant, columns, column, row, through, out
        As `light_places` has them; `out` is changed.
    runs : (n_runs,) int32
        Runs of places that are meant.
    crossing : (n,) float32
        Share of light that crosses. Set where a ray was sent, taken as it is where none was.
    """
    size, limit = columns.shape[1], np.inf if distant else _BEFORE_POINT
    for block in prange((len(runs) + _RUNS - 1) // _RUNS):
        first = np.empty(_RUNS, np.int64)
        n_runs, n = _find_crossed(runs[block * _RUNS : (block + 1) * _RUNS], size, through, first)
        if n_runs == 0:
            continue
        origin, direction, share = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32), np.empty(n, np.float32)
        _find_ways(first[:n_runs], points, distant, columns, column, through, origin, direction)
        _cross_block(
            function, scene, mesh_begin, instance_mesh, geometry, materials, textures, origin, direction, limit, share
        )
        _dim(first[:n_runs], size, share, row, through, crossing, out)
