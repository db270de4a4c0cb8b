"""ID mattes for compositing: which names a pixel shows, and how much of it each covers.

A pixel keeps the ids that cover most of it, by falling coverage, as pairs of
float channels; ids are hashes of names, so that files of any shot and any
renderer agree on them. As of Cryptomatte specification 1.2.0 [1]_.

References
----------
.. [1] Friedman and Jones (Psyop), Cryptomatte Specification, version 1.2.0.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U32 = NDArray[np.uint32]

#: (id, coverage) pairs that a pixel keeps: what the specification suggests, three layers of four channels.
N_RANKS = 6


class Coverage(NamedTuple):
    """Share of n (pixel, id) pairs, ascending by pixel and id, each pair once."""

    pixel: I64  #: (n,) row-major from the top left
    id: U32  #: (n,) bits of the id
    share: F64  #: (n,) of the pixel, 0..1


@dataclass(frozen=True, eq=False)
class Cryptomatte:
    """The ranked ids of an image."""

    name: str  #: type name, such as CryptoObject: names the channels
    ranks: F32  #: (height, width, n_ranks, 2) id and coverage; both 0 where a pixel has no more
    manifest: Mapping[str, str]  #: id as eight hexadecimal digits by name

    @property
    def planes(self) -> dict[str, F32]:
        """Channels by name: ``<name>00.R`` is the first id, ``.G`` its coverage, ``.B`` and ``.A`` the second pair."""
        height, width, n_ranks, _ = self.ranks.shape
        flat = self.ranks.reshape(height, width, 2 * n_ranks)
        return {f"{self.name}{i // 4:02d}.{'RGBA'[i % 4]}": flat[..., i] for i in range(2 * n_ranks)}

    @property
    def metadata(self) -> dict[str, str]:
        """What a file's header must say."""
        # A key stays the same from shot to shot, has at most seven characters and is best a hash of the type name.
        prefix = f"cryptomatte/{hex_id(name_id(self.name))[:7]}/"
        return {
            prefix + "name": self.name,
            prefix + "hash": "MurmurHash3_32",
            prefix + "conversion": "uint32_to_float32",
            prefix + "manifest": json.dumps(dict(self.manifest), ensure_ascii=False, separators=(",", ":")),
        }


def coverage(pixel: I64, ids: U32, share: F64) -> Coverage:
    """Add up what each id covers of each pixel."""
    key = (pixel.astype(np.uint64) << np.uint64(32)) | ids
    pairs, place = np.unique(key, return_inverse=True)
    total = np.bincount(place.reshape(-1), share, len(pairs)).astype(np.float64)
    return Coverage((pairs >> np.uint64(32)).astype(np.int64), (pairs & np.uint64(0xFFFFFFFF)).astype(np.uint32), total)


def weighted_sum(parts: Iterable[tuple[float, Coverage]]) -> Coverage:
    """Coverage of several images of one size laid over each other: those of moments while the shutter is open."""
    weighted = [(part, weight * part.share) for weight, part in parts]
    return coverage(
        np.concatenate([np.empty(0, np.int64), *(part.pixel for part, _ in weighted)]),
        np.concatenate([np.empty(0, np.uint32), *(part.id for part, _ in weighted)]),
        np.concatenate([np.empty(0, np.float64), *(share for _, share in weighted)]),
    )


def rank(covered: Coverage, n_pixels: int, n_ranks: int = N_RANKS) -> F32:
    """The ids that cover most of each pixel, (n_pixels, n_ranks, 2); of equal shares, the smaller id first."""
    order = np.lexsort((covered.id, -covered.share, covered.pixel))
    pixel = covered.pixel[order]
    first = np.searchsorted(pixel, np.arange(n_pixels))
    place = np.arange(len(pixel)) - first[pixel]
    kept = (place < n_ranks) & (covered.share[order] > 0)
    ranks = np.zeros((n_pixels, n_ranks, 2), np.float32)
    ranks[pixel[kept], place[kept], 0] = covered.id[order][kept].view(np.float32)
    ranks[pixel[kept], place[kept], 1] = covered.share[order][kept]
    return ranks


def manifest(names: Iterable[str], shown: U32) -> dict[str, str]:
    """Names of the ids that an image shows, with their ids as text."""
    there = set(shown.tolist())
    found = ((name, name_id(name)) for name in sorted(names))
    return {name: hex_id(bits) for name, bits in found if bits in there}


def hex_id(bits: int) -> str:
    return f"{bits:08x}"


def name_id(name: str) -> int:
    """Bits of the float32 that stands for a name: its hash, never a denormal, infinite or no number."""
    bits = murmur3(name.encode("utf-8"))
    if (bits >> 23) & 0xFF in (0, 0xFF):
        bits ^= 1 << 23
    return bits


def murmur3(data: bytes, seed: int = 0) -> int:
    """MurmurHash3_x86_32 [1]_.

    References
    ----------
    .. [1] Appleby, MurmurHash3, 2011; public domain.
    """
    mask = 0xFFFFFFFF

    def mixed(block: int) -> int:
        block = (block * 0xCC9E2D51) & mask
        block = ((block << 15) | (block >> 17)) & mask
        return (block * 0x1B873593) & mask

    found = seed
    whole = len(data) & ~3
    for at in range(0, whole, 4):
        found ^= mixed(int.from_bytes(data[at : at + 4], "little"))
        found = ((found << 13) | (found >> 19)) & mask
        found = (found * 5 + 0xE6546B64) & mask
    if whole < len(data):
        found ^= mixed(int.from_bytes(data[whole:], "little"))
    found ^= len(data)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35), (16, 1)):
        found ^= found >> shift
        found = (found * factor) & mask
    return found
