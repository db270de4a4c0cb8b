"""What is known of the noise of one look at a light taken from a later one: a control variate for every run of places.

A light that moves is looked at with few rays, whose numbers are the same from one look to the next: near where it was
at rest, its noise is nearly what it was there, which is known. How nearly is found by least squares, run by run.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.place_columns import RUN
from icheat_usd.kernels.simd import address_of, load, multiply_add, positive, product, spread, store, zeros

_GROUPS = 16  # of places, for the jackknife
_JACKKNIFE = (_GROUPS - 1) / _GROUPS  # of the squared changes that leaving out one group makes: the variance
_PIECE = 16  # runs that a worker takes at a time
_DISTRUST = 4  # power of the squared cosine between two looks, for what is believed of their common noise
_LEAST_ANGLE = 1e-3  # squared sine between light and noise below which they are not told apart


@kernel
def _add_products(look, rest, noise, sums):  # type: ignore[no-untyped-def]
    """Products of look, light at rest and its noise, addresses of 192 numbers each, by groups: `sums` of (6, 16)."""
    ff = aa = ab = bb = fa = fb = zeros()
    for first in range(0, 12 * RUN, 4 * _GROUPS):
        f, a, b = load(look + first), load(rest + first), load(noise + first)
        aa, ab, bb = multiply_add(a, a, aa), multiply_add(a, b, ab), multiply_add(b, b, bb)
        fa, fb, ff = multiply_add(f, a, fa), multiply_add(f, b, fb), multiply_add(f, f, ff)
    of_group = 4 * _GROUPS
    store(sums, aa)
    store(sums + of_group, ab)
    store(sums + 2 * of_group, bb)
    store(sums + 3 * of_group, fa)
    store(sums + 4 * of_group, fb)
    store(sums + 5 * of_group, ff)


@kernel
def _least_squares(aa, ab, bb, fa, fb):  # type: ignore[no-untyped-def]
    """How often the light at rest and its noise are in a look, by sums of their products."""
    determinant = aa * bb - ab * ab
    if determinant <= _LEAST_ANGLE * aa * bb:
        return 0.0, (fb / bb if bb > 0.0 else 0.0)
    return (fa * bb - fb * ab) / determinant, (fb * aa - fa * ab) / determinant


@kernel
def _sure(found, expected, variance):  # type: ignore[no-untyped-def]
    """What is sure of a difference from what is expected (James and Stein 1961)."""
    off = found - expected
    return expected + off * max(0.0, 1.0 - variance / (off * off)) if off != 0.0 else expected


@kernel
def _fit(sums, usual):  # type: ignore[no-untyped-def]
    """What is sure of the light at rest and of its noise in a look, and how much of the remainder is more than noise.

    From `_add_products`; `usual` is how often the light at rest is in other looks. Groups of places are left out one
    by one: by how much that changes what is found is how unsure it is (the jackknife).
    """
    aa = ab = bb = fa = fb = ff = 0.0
    for g in range(_GROUPS):
        aa += np.float64(sums[0, g])
        ab += np.float64(sums[1, g])
        bb += np.float64(sums[2, g])
        fa += np.float64(sums[3, g])
        fb += np.float64(sums[4, g])
        ff += np.float64(sums[5, g])
    light, share = _least_squares(aa, ab, bb, fa, fb)
    of_light = of_share = 0.0
    for g in range(_GROUPS):
        other_light, other_share = _least_squares(
            aa - sums[0, g], ab - sums[1, g], bb - sums[2, g], fa - sums[3, g], fb - sums[4, g]
        )
        of_light += (other_light - light) ** 2
        of_share += (other_share - share) ** 2
    # Noise grows as the light does; more than that is chance.
    most = max(0.0, light)
    before = aa + 2.0 * ab + bb  # of the look at rest
    alike = (fa + fb) ** 2 / (ff * before) if ff * before > 0.0 else 0.0
    # A pool of light that has gone elsewhere leaves what looks like its noise.
    taken = min(max(_sure(share, 0.0, of_share * _JACKKNIFE), 0.0), most) * alike**_DISTRUST
    left = bb * max(most * most - 2.0 * taken * share + taken * taken, 0.0)
    light = max(_sure(light, usual, of_light * _JACKKNIFE), 0.0)
    remainder = ff + light * light * aa + taken * taken * bb + 2.0 * (light * taken * ab - light * fa - taken * fb)
    return light, taken, max(0.0, 1.0 - left / remainder) if remainder > 0.0 else 1.0


@kernel
def _take(look, rest, noise, light, share, kept):  # type: ignore[no-untyped-def]
    """``known + kept * (look - known - share * noise)`` with ``known = light * rest``, where above 0, to `look`."""
    kept_look, of_rest, of_noise = spread(kept), spread(light * (np.float32(1.0) - kept)), spread(-kept * share)
    for first in range(0, 12 * RUN, 4 * _GROUPS):
        known = multiply_add(of_noise, load(noise + first), product(of_rest, load(rest + first)))
        store(look + first, positive(multiply_add(kept_look, load(look + first), known)))


@kernel
def _take_run(row, first, rest, noise, usual, smooths, flat, sums, look):  # type: ignore[no-untyped-def]
    n = min(RUN, len(row) - first)
    if n < RUN:
        flat[:] = np.float32(0.0)
    for k in range(n):
        at = row[first + k]
        flat[k], flat[RUN + k], flat[2 * RUN + k] = look[at, 0], look[at, 1], look[at, 2]
    tables = address_of(flat), address_of(rest), address_of(noise)
    _add_products(*tables, address_of(sums))
    light, share, kept = _fit(sums, usual)
    if not smooths:
        kept = 1.0
    _take(*tables, np.float32(light), np.float32(share), np.float32(kept))
    for k in range(n):
        at = row[first + k]
        look[at, 0], look[at, 1], look[at, 2] = flat[k], flat[RUN + k], flat[2 * RUN + k]


@parallel_kernel
def take_noise(row, runs, rest, noise, usual, smooths, look):  # type: ignore[no-untyped-def]
    """Take known noise from a look, as far as it is there again.

    Parameters
    ----------
    row : (n,) int32
        Points of the places, in runs of `RUN`.
    runs : (n_runs,) int32
        Those that are meant.
    rest, noise : (n_runs, 3 * RUN) float32
        Light at rest and the noise that was known, of these runs, channel after channel; 0 behind the last place.
    usual : float
        How often the light at rest is in the look, by all places together.
    smooths : bool
        Whether noise that is new is held down, too: less noise in each place, but errors that all places share.
    look : (n, 3) float32, changed
        By point; nowhere below 0.

    Notes
    -----
    In a run, ``look = a * rest + b * noise + remainder`` by least squares over places and channels, and as much of
    ``b * noise`` is taken away as is sure by the jackknife over 16 groups of places (Efron 1982; shrunk as by James and
    Stein 1961), times the eighth power of the cosine between this look and that at rest. Where new noise is held down,
    it is taken for as strong, beside the light, as noise was at rest, and of the remainder as much is kept as there is
    more than that (Wiener's filter), beside what is sure of ``a``.
    """
    for piece in prange((len(runs) + _PIECE - 1) // _PIECE):
        flat, sums = np.empty(3 * RUN, np.float32), np.empty((6, _GROUPS), np.float32)
        for k in range(piece * _PIECE, min((piece + 1) * _PIECE, len(runs))):
            _take_run(row, np.int64(runs[k]) * RUN, rest[k], noise[k], usual, smooths, flat, sums, look)


@kernel
def sum_of_some(values: np.ndarray, step: int) -> float:
    """Sum of every `step`-th of some colours, all channels together."""
    total = 0.0
    for i in range(0, len(values), step):
        total += np.float64(values[i, 0]) + np.float64(values[i, 1]) + np.float64(values[i, 2])
    return total
