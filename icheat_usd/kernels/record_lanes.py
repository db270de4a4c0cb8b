"""Light of a record as 16 floats next to each other: one cache line, and one register where these are long.

For red, green and blue the irradiance, and its change with two turns of the normal and with two moves, about the
tangents of the record (`samples.basis`); then a pad.
"""

from __future__ import annotations

from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.samples import basis
from icheat_usd.kernels.simd import add_in_fives, load, load_color, multiply_add, spread_in_fives, store

LANES = 16


@kernel
def add_ray(to, light, share, weights_0, ray):  # type: ignore[no-untyped-def]
    """Add a ray's light to lanes at an address: times its share, and times its four of `ray_weights` at another."""
    store(to, add_in_fives(share, load_color(weights_0 + 16 * ray), light, load(to)))


@kernel
def add_change(to, change, at):  # type: ignore[no-untyped-def]
    """Add lanes at an address, each channel times that of a colour, to others."""
    store(to, multiply_add(spread_in_fives(change), load(at), load(to)))


@parallel_kernel
def frames_of(at, facing, shrink, out):  # type: ignore[no-untyped-def]
    """Where records are and how they are turned, each in a line of its own: tangents take long to find.

    Parameters
    ----------
    at, facing : (n, 3) float32
        Where they are, and their normals.
    shrink : (n,) float32
        Factor on what changes with place.
    out : (n, 16) float32
        Place, normal, tangent, other tangent, factor.
    """
    for r in prange(len(out)):
        frame = out[r]
        frame[0], frame[1], frame[2] = at[r, 0], at[r, 1], at[r, 2]
        frame[3], frame[4], frame[5] = facing[r, 0], facing[r, 1], facing[r, 2]
        frame[6], frame[7], frame[8], frame[9], frame[10], frame[11] = basis(facing[r, 0], facing[r, 1], facing[r, 2])
        frame[12] = shrink[r]
