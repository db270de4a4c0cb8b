"""Text, numbers and names of payloads to and from the arrays of elements, each checked."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from icheat_usd.edits.model import Value
from icheat_usd.errors import SidecarError
from icheat_usd.sidecar.canonical import Array, Element


def shown(text: str, limit: int = 200) -> str:
    """Text from a file as one line of a message or a terminal may show it: no control characters."""
    return "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in text[:limit])


def floats(value: Any, what: str) -> NDArray[np.float64]:
    """One number or several, finite, as a list."""
    try:
        numbers = np.array([float(v) for v in (value if isinstance(value, (tuple, list)) else (value,))], np.float64)
    except (TypeError, ValueError, OverflowError) as problem:
        raise SidecarError(f"{what} is {value!r}; expected a number, a flag, text or a tuple of numbers") from problem
    if not np.isfinite(numbers).all():
        raise SidecarError(f"{what} is {value!r}; expected finite numbers")
    return numbers + 0.0  # -0.0 becomes 0.0


def text(value: str, what: str) -> Array:
    """Text as a NumPy bytes scalar array."""
    return texts([value], what)[0:1].reshape(())


def texts(values: list[str], what: str) -> Array:
    """Texts as a NumPy bytes array."""
    try:
        encoded = [value.encode() for value in values]
    except UnicodeEncodeError as problem:
        raise SidecarError(f"{what} is not valid text ({problem.reason}); use Unicode without surrogates") from problem
    if any(b"\0" in item for item in encoded):
        raise SidecarError(f"{what} contains a null character; remove it")
    return np.array(encoded, dtype=f"S{max([1, *map(len, encoded)])}")


def escaped(key: str) -> str:
    """A parameter's or fact's name as an HDF5 link name: '%', '/' and a lone '.' are percent-encoded."""
    if not key or "\0" in key:
        raise SidecarError(f"{key!r} cannot name a value; use at least one character and no null")
    try:
        key.encode()
    except UnicodeEncodeError as problem:
        raise SidecarError(f"{key!r} is not valid text; use Unicode without surrogates") from problem
    name = key.replace("%", "%25").replace("/", "%2F")
    return "%2E" if name == "." else name


def unescaped(name: str) -> str:
    """The free text that `escaped` made a link name of."""
    return name.replace("%2E", ".").replace("%2F", "/").replace("%25", "%")


def read_value(path: str, array: Array) -> Value:
    """A number, a flag, a text or a list of numbers."""
    if array.dtype.kind == "S" and array.ndim == 0:
        return _utf8(array.tobytes().rstrip(b"\0"), path)
    if array.dtype.kind == "b" and array.ndim == 0:
        return bool(array)
    if array.dtype.kind in "iu" and array.ndim == 0:
        return int(array)
    if array.dtype.kind == "f" and array.ndim <= 1 and np.isfinite(array).all():
        return float(array) if array.ndim == 0 else tuple(float(v) for v in array)
    raise SidecarError(f"'{path}' is {array.dtype} {array.shape}; expected a finite number, a flag, text or a list")


def read_text(element: Element, path: str) -> str:
    """One text of an element."""
    values = read_texts(element, path)
    if element.datasets[path].ndim != 0:
        raise SidecarError(f"'{path}' is a list; expected one text")
    return values[0]


def read_texts(element: Element, path: str) -> list[str]:
    """The texts of a list, or the one text."""
    array = element.datasets[path]
    if array.dtype.kind != "S" or array.ndim > 1:
        raise SidecarError(f"'{path}' is {array.dtype} {array.shape}; expected text")
    return [_utf8(item, path) for item in array.reshape(-1).tolist()]


def _utf8(encoded: bytes, path: str) -> str:
    try:
        return encoded.decode()
    except UnicodeDecodeError as problem:
        raise SidecarError(f"'{path}' is not valid UTF-8; restore the file from a copy") from problem
