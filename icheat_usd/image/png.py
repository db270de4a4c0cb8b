"""Films to PNG, as a screen shows them."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from icheat_usd.errors import ImageError
from icheat_usd.image.colour import default_display, to_display
from icheat_usd.image.exr import METADATA_PREFIX
from icheat_usd.image.film import Film
from icheat_usd.image.replacing import replacing

_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def write_png(
    film: Film,
    path: str | os.PathLike[str],
    *,
    layer: str = "beauty",
    view: str | None = None,
    display: str | None = None,
    exposure: float = 0.0,
    dither: bool = False,
) -> Path:
    """Write one layer as an 8-bit RGB PNG through a display view.

    Parameters
    ----------
    film : Film
    path : path
        An existing file is replaced only once the new one is complete.
    layer : str
    view, display : str or None
        Names in the active OpenColorIO configuration; None takes its defaults.
    exposure : float, stops
    dither : bool
        See `icheat_usd.image.colour.to_display`.

    Returns
    -------
    Path
        The file written. It carries the film's metadata as text, and an sRGB chunk where the display is sRGB.

    Raises
    ------
    ImageError
        There is no such layer, display or view, or the file cannot be written.
    """
    pixels = to_display(film.layer(layer), display=display, view=view, exposure=exposure, dither=dither)
    srgb = (display or default_display()).startswith("sRGB")
    return write_pixels(pixels, path, srgb=srgb, metadata=film.metadata)


def write_pixels(
    pixels: NDArray[np.uint8], path: str | os.PathLike[str], *, srgb: bool, metadata: Mapping[str, str]
) -> Path:
    """Write (height, width, 3) display-encoded bytes as an 8-bit RGB PNG, which says so if they are sRGB.

    Raises
    ------
    ImageError
        The file cannot be written.
    """
    target = Path(path)
    encoded = encode_png(pixels, srgb=srgb, text={METADATA_PREFIX + key: text for key, text in metadata.items()})
    with replacing(target) as temporary:
        temporary.write_bytes(encoded)
    return target


def read_text(path: str | os.PathLike[str]) -> dict[str, str]:
    """The metadata of a PNG that `write_png` wrote.

    Raises
    ------
    ImageError
        The file cannot be read, is no PNG, or is damaged or cut short.
    """
    source = Path(path)
    try:
        content = source.read_bytes()
    except OSError as problem:
        raise ImageError(f"{source}: cannot read the image ({problem.strerror}); check the path") from problem
    found: dict[str, str] = {}
    at, kind = len(_SIGNATURE), b""
    while kind != b"IEND":
        length = int.from_bytes(content[at : at + 4], "big")
        kind, body = content[at + 4 : at + 8], content[at + 8 : at + 8 + length]
        if not content.startswith(_SIGNATURE) or content[at : at + 12 + length] != _chunk(kind, body):
            raise ImageError(f"{source}: not a PNG file, or damaged; write it again")
        if kind == b"iTXt":
            key, _, value = body.partition(b"\0")
            found[key.decode("latin-1").removeprefix(METADATA_PREFIX)] = value[4:].decode("utf-8", "replace")
        at += 12 + length
    return found


def encode_png(pixels: NDArray[np.uint8], *, srgb: bool, text: dict[str, str]) -> bytes:
    """An 8-bit RGB image as the bytes of a PNG file.

    Parameters
    ----------
    pixels : (height, width, 3) uint8, display-encoded
    srgb : bool
        State with an sRGB chunk that the values are sRGB.
    text : dict of str to str
        International text; a keyword is cut to the 79 Latin-1 bytes that PNG allows.

    References
    ----------
    .. [1] Portable Network Graphics (PNG) Specification, third edition, W3C 2025: chunks 11, filter "Up" 9.2.
    """
    # Written here because image libraries differ in which of these chunks they write, and from release to release.
    height, width, _ = pixels.shape
    chunks = [_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))]
    if srgb:
        chunks.append(_chunk(b"sRGB", b"\0"))  # rendering intent: perceptual
    for key, value in sorted(text.items()):
        keyword = key.encode("latin-1", "replace")[:79]
        chunks.append(_chunk(b"iTXt", keyword + b"\0\0\0\0\0" + value.encode("utf-8", "replace")))
    chunks.append(_chunk(b"IDAT", _packed(pixels)))
    chunks.append(_chunk(b"IEND", b""))
    return _SIGNATURE + b"".join(chunks)


def encode_animation(frames: NDArray[np.uint8], *, per_second: int = 24) -> bytes:
    """Frames as the bytes of an animated PNG file [1]_, which repeats; it says that the values are sRGB.

    Parameters
    ----------
    frames : (n, height, width, 3) uint8, display-encoded

    References
    ----------
    .. [1] Portable Network Graphics (PNG) Specification, third edition, W3C 2025: chunks 11.3.6.
    """
    n, height, width, _ = frames.shape
    chunks = [
        _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)),
        _chunk(b"acTL", struct.pack(">II", n, 0)),
        _chunk(b"sRGB", b"\0"),
    ]
    for number, frame in enumerate(frames):
        # Control and data chunks are counted together; the data of the first frame is the still image.
        place = struct.pack(">IIIIIHHBB", max(2 * number - 1, 0), width, height, 0, 0, 1, per_second, 0, 0)
        chunks.append(_chunk(b"fcTL", place))
        data = _packed(frame)
        chunks.append(_chunk(b"fdAT", struct.pack(">I", 2 * number) + data) if number else _chunk(b"IDAT", data))
    chunks.append(_chunk(b"IEND", b""))
    return _SIGNATURE + b"".join(chunks)


def _packed(pixels: NDArray[np.uint8]) -> bytes:
    """Rows of (height, width, 3) pixels, filtered and compressed."""
    height, width, _ = pixels.shape
    rows = pixels.reshape(height, width * 3)
    filtered = np.full((height, 1 + width * 3), 2, dtype=np.uint8)  # column 0: the filter type of the row, "Up"
    filtered[0, 1:] = rows[0]
    filtered[1:, 1:] = rows[1:] - rows[:-1]
    return zlib.compress(filtered.tobytes(), 6)


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
