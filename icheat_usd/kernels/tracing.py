"""Steps of paths that mirrors, glass and holes carry on, and ray origins clear of the surface they leave."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.bsdf import dielectric_reflectance, interface, mirror_share, reflected
from icheat_usd.kernels.random import hash_combine, uniform
from icheat_usd.kernels.vector import Vector, dot, normalized, plus_scaled, row3, store3, transform_point

CHUNK = 512
# Offsets are 2^-18 of the largest coordinate involved, 32 units in the last place of float32; 2 were seen to be enough
# (spheres and planes, sheared, far out, copied and instanced).
RELATIVE_OFFSET = 2.0**-18

STOPPED, FOLLOWED, ABSORBED = 0, 1, 2


@kernel
def triangle_magnitude(geometry: tuple, instance: int, triangle: int) -> float:
    """Largest world coordinate of a triangle's corners: what the rounding of its position is relative to."""
    largest = 0.0
    for k in range(3):
        p = transform_point(geometry.instance_to_world, instance, row3(geometry.points[triangle], k))
        largest = max(largest, abs(p[0]), abs(p[1]), abs(p[2]))
    for r in range(3):
        largest = max(largest, abs(np.float64(geometry.instance_to_world[instance, r, 3])))
    return largest


@parallel_kernel
def point_magnitudes(geometry: tuple, instance: np.ndarray, triangle: np.ndarray, out: np.ndarray) -> None:
    """`triangle_magnitude` of n places."""
    n = instance.shape[0]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            out[i] = 0.0
            if instance[i] >= 0:
                out[i] = triangle_magnitude(geometry, np.int64(instance[i]), np.int64(triangle[i]))


@kernel
def offset_origin(position: Vector, normal: Vector, direction: Vector, magnitude: float) -> Vector:
    """A position moved along the normal to the side that `direction` leaves on."""
    size = max(abs(position[0]), abs(position[1]), abs(position[2]), magnitude)
    sign = 1.0 if dot(normal, direction) >= 0.0 else -1.0
    return plus_scaled(position, normal, sign * RELATIVE_OFFSET * size)


@parallel_kernel
def offset_origins(
    positions: np.ndarray, normals: np.ndarray, directions: np.ndarray, magnitude: np.ndarray, out: np.ndarray
) -> None:
    """Positions moved along the normal to the side that `directions` leave on."""
    n = positions.shape[0]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            size = np.float64(magnitude[min(i, magnitude.shape[0] - 1)])
            store3(out, i, offset_origin(row3(positions, i), row3(normals, i), row3(directions, i), size))


@parallel_kernel
def step_paths(
    points: tuple,
    directions: np.ndarray,
    path: np.ndarray,
    seed: int,
    depth: int,
    throughput: np.ndarray,
    state: np.ndarray,
) -> None:
    """What each path does at its point: stops there, or goes on with new `directions` and `throughput` (in place).

    `path` are the counters of the random numbers; `throughput` has a row per point.
    """
    n = points.instance.shape[0]
    stream = hash_combine(hash_combine(seed, 0x7061), depth)
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            state[i] = STOPPED
            if points.instance[i] < 0:
                continue
            kind = points.delta[i]
            direction = row3(directions, i)
            choice = np.float64(uniform(stream, path[i], 0))
            if kind == 3:
                state[i] = FOLLOWED
            elif kind == 2:
                reflectance, back, bent = interface(points, i, direction)
                store3(directions, i, back if choice < reflectance else bent)
                state[i] = FOLLOWED
            elif choice >= points.opacity[i]:
                state[i] = FOLLOWED
            elif kind == 1:
                share = mirror_share(points, i, direction)
                normal, geometric = row3(points.shading_normal, i), row3(points.normal, i)
                store3(directions, i, reflected(direction, normal, geometric))
                largest = 0.0
                for c in range(3):
                    f0 = points.specular[i, c]
                    throughput[i, c] *= f0 + (points.specular_edge[i, c] - f0) * share
                    largest = max(largest, throughput[i, c])
                state[i] = FOLLOWED if largest > 0.0 else ABSORBED


@parallel_kernel
def straight_transmittance(points: tuple, directions: np.ndarray, out: np.ndarray) -> None:
    """Share of light that goes straight on at each point: holes all, glass ``1 - F``, others ``1 - opacity``."""
    n = points.instance.shape[0]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            if points.instance[i] < 0:
                out[i] = 1.0
            elif points.delta[i] == 3:
                out[i] = 1.0
            elif points.delta[i] == 2:
                cosine = abs(dot(normalized(row3(directions, i)), row3(points.shading_normal, i)))
                # The straight ray has the angle of the OUTER side at both faces of a solid or pane, so that it is
                # never totally reflected and both faces agree.
                out[i] = 1.0 - dielectric_reflectance(cosine, 1.0 / np.float64(points.ior[i]))[0]
            else:
                out[i] = 1.0 - points.opacity[i]
