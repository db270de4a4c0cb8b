"""What a payload is apart from its file: named elements of arrays, and the digest of their canonical bytes.

The bytes are defined in schemas/sidecar/SPEC.md, "Canonical serialisation".
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from icheat_usd.errors import SidecarError

Array = NDArray[Any]

#: Kinds of values a dataset may hold, by NumPy kind and size; text is null-padded UTF-8 (NumPy kind S).
_KINDS = {
    ("u", 1): "uint8",
    ("u", 2): "uint16",
    ("u", 4): "uint32",
    ("u", 8): "uint64",
    ("i", 1): "int8",
    ("i", 2): "int16",
    ("i", 4): "int32",
    ("i", 8): "int64",
    ("f", 4): "float32",
    ("f", 8): "float64",
}
_BLOCK = 1 << 20


@dataclass(frozen=True, eq=False)
class Element:
    """One element of a payload as it lies in a file: nothing decoded, so that what is unknown can be kept.

    `datasets` maps the path below the element's group to an array: numbers,
    booleans, or NumPy bytes (kind S) for text.
    """

    type: str
    version: int
    datasets: Mapping[str, Array]


def kind_of(dtype: np.dtype[Any]) -> str | None:
    """Name of a value kind in the canonical bytes; None for what a payload must not hold."""
    if dtype.kind == "S":
        return "text"
    if dtype.kind == "b":
        return "bool"
    return _KINDS.get((dtype.kind, dtype.itemsize))


def digest_of(elements: Mapping[str, Element]) -> str:
    """SHA-256, in 64 hexadecimal digits, of the canonical bytes of a payload.

    Raises
    ------
    SidecarError
        A dataset holds NaN or a type that payloads do not have.
    """
    state = hashlib.sha256()
    for block in canonical_bytes(elements):
        state.update(block)
    return state.hexdigest()


def alias_check(old: str, new: str) -> str:
    """What an alias holds beside the digest it stands for, so that damage does not lead to another payload."""
    return hashlib.sha256(b"icheat-alias 1\n" + _text(old.encode()) + _text(new.encode())).hexdigest()


def canonical_bytes(elements: Mapping[str, Element]) -> Iterator[bytes]:
    """The canonical bytes in blocks of bounded size; equal payloads give equal bytes whatever file holds them."""
    yield b"icheat-payload 1\n"
    yield _count(len(elements))
    for name, element in sorted(elements.items(), key=lambda item: item[0].encode()):
        yield _text(name.encode())
        yield _text(element.type.encode())
        yield _count(element.version)
        yield _count(len(element.datasets))
        for path, array in sorted(element.datasets.items(), key=lambda item: item[0].encode()):
            kind = kind_of(array.dtype)
            if kind is None:
                raise SidecarError(
                    f"element '{name}': dataset '{path}' holds {array.dtype}, which payloads do not have"
                )
            yield _text(path.encode())
            yield _text(kind.encode())
            yield _count(array.ndim)
            yield b"".join(_count(size) for size in array.shape)
            yield from _values(name, path, array)


def _values(name: str, path: str, array: Array) -> Iterator[bytes]:
    flat = np.ascontiguousarray(array).reshape(-1)
    for begin in range(0, flat.size, _BLOCK):
        block = flat[begin : begin + _BLOCK]
        if block.dtype.kind == "S":
            yield b"".join(_text(item) for item in block.tolist())
        elif block.dtype.kind == "b":
            yield (block.view(np.uint8) != 0).astype(np.uint8).tobytes()
        elif block.dtype.kind == "f":
            if np.isnan(block).any():
                raise SidecarError(f"element '{name}': dataset '{path}' holds NaN; replace it by a number")
            # Adding zero turns -0.0 into +0.0, so that equal payloads have one name.
            yield (block + block.dtype.type(0)).astype(block.dtype.newbyteorder("<"), copy=False).tobytes()
        else:
            yield block.astype(block.dtype.newbyteorder("<"), copy=False).tobytes()


def _count(value: int) -> bytes:
    return struct.pack("<Q", value)


def _text(encoded: bytes) -> bytes:
    return _count(len(encoded)) + encoded
