"""Counter-based random numbers: a value depends on its counters alone, never on what ran before."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels._jit import kernel

_TO_UNIT = np.float32(1.0 / 16777216.0)


@kernel
def hash_u32(x: int) -> int:
    """PCG output hash of a 32-bit word (Jarzynski & Olano 2020, JCGT 9(3))."""
    state = np.uint32(np.uint32(x) * np.uint32(747796405) + np.uint32(2891336453))
    word = np.uint32(
        np.uint32(np.uint32(state >> np.uint32((state >> np.uint32(28)) + np.uint32(4))) ^ state) * np.uint32(277803737)
    )
    return np.uint32(np.uint32(word >> np.uint32(22)) ^ word)


@kernel
def hash_combine(seed: int, value: int) -> int:
    """Hash of `value` under `seed`; chain calls to hash several counters."""
    return hash_u32(np.uint32(np.uint32(seed) ^ hash_u32(np.uint32(value) + np.uint32(0x9E3779B9))))


@kernel
def to_unit(x: int) -> float:
    """Float32 in [0, 1) from the top 24 bits."""
    return np.float32(np.uint32(x) >> np.uint32(8)) * _TO_UNIT


@kernel
def uniform(seed: int, index: int, dimension: int) -> float:
    """Independent uniform float32 in [0, 1) for (seed, index, dimension)."""
    return to_unit(hash_combine(hash_combine(seed, index), dimension))


@kernel
def _reverse_bits(x: int) -> int:
    x = np.uint32(x)
    x = np.uint32(((x & np.uint32(0x55555555)) << np.uint32(1)) | ((x >> np.uint32(1)) & np.uint32(0x55555555)))
    x = np.uint32(((x & np.uint32(0x33333333)) << np.uint32(2)) | ((x >> np.uint32(2)) & np.uint32(0x33333333)))
    x = np.uint32(((x & np.uint32(0x0F0F0F0F)) << np.uint32(4)) | ((x >> np.uint32(4)) & np.uint32(0x0F0F0F0F)))
    x = np.uint32(((x & np.uint32(0x00FF00FF)) << np.uint32(8)) | ((x >> np.uint32(8)) & np.uint32(0x00FF00FF)))
    return np.uint32((x << np.uint32(16)) | (x >> np.uint32(16)))


@kernel
def _owen_scramble_reversed(x: int, seed: int) -> int:
    x = np.uint32(x)
    seed = np.uint32(seed)
    x = np.uint32(x ^ np.uint32(x * np.uint32(0x3D20ADEA)))
    x = np.uint32(x + seed)
    x = np.uint32(x * np.uint32(np.uint32(seed >> np.uint32(16)) | np.uint32(1)))
    x = np.uint32(x ^ np.uint32(x * np.uint32(0x05526C56)))
    x = np.uint32(x ^ np.uint32(x * np.uint32(0x53A22864)))
    return x


@kernel
def _taylor_shift(index: int) -> int:
    """Polynomial over GF(2) with these coefficients, at x + 1 instead of x.

    With the bits reversed, this is the second dimension of the Sobol sequence:
    its generator matrix is Pascal's triangle modulo 2.
    """
    r = np.uint32(index)
    r = np.uint32(r ^ np.uint32((r & np.uint32(0xAAAAAAAA)) >> np.uint32(1)))
    r = np.uint32(r ^ np.uint32((r & np.uint32(0xCCCCCCCC)) >> np.uint32(2)))
    r = np.uint32(r ^ np.uint32((r & np.uint32(0xF0F0F0F0)) >> np.uint32(4)))
    r = np.uint32(r ^ np.uint32((r & np.uint32(0xFF00FF00)) >> np.uint32(8)))
    return np.uint32(r ^ np.uint32((r & np.uint32(0xFFFF0000)) >> np.uint32(16)))


@kernel
def sobol_pair(index: int, seed: int) -> tuple[float, float]:
    """Point `index` of an Owen-scrambled, index-shuffled 2-D Sobol sequence under `seed`.

    Different seeds give independent sequences, so pairs of dimensions are
    padded by giving each pair its own seed (Burley 2020, JCGT 9(4)).
    Stratified best when the number of points is a power of two.
    """
    shuffled = _reverse_bits(_owen_scramble_reversed(_reverse_bits(np.uint32(index)), hash_combine(seed, 0)))
    first = _reverse_bits(_owen_scramble_reversed(shuffled, hash_combine(seed, 1)))
    second = _reverse_bits(_owen_scramble_reversed(_taylor_shift(shuffled), hash_combine(seed, 2)))
    return to_unit(first), to_unit(second)
