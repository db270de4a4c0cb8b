"""Procedural textures: small PNG files (sRGB) and one lat-long EXR sky, with nothing but NumPy and zlib."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


def smooth_noise(height: int, width: int, cells: tuple[int, int], seed: int) -> F64:
    """Periodic value noise in [0, 1] with `cells` = (rows, columns) knots."""
    knots = np.random.default_rng(seed).random(cells)
    y = np.arange(height) / height * cells[0]
    x = np.arange(width) / width * cells[1]
    iy, ix = y.astype(int), x.astype(int)
    fy, fx = (y - iy)[:, None], (x - ix)[None, :]
    fy, fx = fy * fy * (3 - 2 * fy), fx * fx * (3 - 2 * fx)
    a = knots[iy % cells[0]][:, ix % cells[1]]
    b = knots[iy % cells[0]][:, (ix + 1) % cells[1]]
    c = knots[(iy + 1) % cells[0]][:, ix % cells[1]]
    d = knots[(iy + 1) % cells[0]][:, (ix + 1) % cells[1]]
    return (a * (1 - fx) + b * fx) * (1 - fy) + (c * (1 - fx) + d * fx) * fy


def mix(a: tuple[float, float, float], b: tuple[float, float, float], t: F64) -> F64:
    return np.asarray(a) * (1 - t[..., None]) + np.asarray(b) * t[..., None]


def wood_planks(size: int = 256, planks: int = 6) -> F64:
    """Floor boards that run along s; reflectance (linear)."""
    row = np.arange(size) * planks // size
    tone = np.random.default_rng(7).random(planks)[row]
    shift = np.random.default_rng(8).integers(0, size, planks)[row]
    grain = smooth_noise(size, size, (96, 5), 1) * 0.6 + smooth_noise(size, size, (32, 3), 2) * 0.4
    grain = np.stack([np.roll(grain[y], shift[y]) for y in range(size)])
    image = mix((0.30, 0.175, 0.09), (0.56, 0.37, 0.21), np.clip(0.55 * grain + 0.45 * tone[:, None], 0, 1))
    image[(np.arange(size) * planks) % size < planks] *= 0.55
    for y in range(size):
        image[y, (np.arange(size) + shift[y]) % size < 2] *= 0.6
    return image


def wood(size: int = 128) -> F64:
    grain = smooth_noise(size, size, (40, 3), 3) * 0.6 + smooth_noise(size, size, (12, 2), 4) * 0.4
    return mix((0.16, 0.08, 0.04), (0.38, 0.21, 0.11), grain)


def rug(size: int = 256) -> F64:
    """A woven rug: border, field and a lozenge grid."""
    y, x = np.mgrid[0:size, 0:size] / size
    edge = np.minimum(np.minimum(x, 1 - x), np.minimum(y, 1 - y))
    lozenge = np.abs((x * 6) % 1 - 0.5) + np.abs((y * 4) % 1 - 0.5)
    image = np.empty((size, size, 3))
    image[:] = (0.62, 0.12, 0.07)
    image[lozenge < 0.30] = (0.74, 0.62, 0.42)
    image[lozenge < 0.13] = (0.62, 0.12, 0.07)
    image[edge < 0.10] = (0.74, 0.62, 0.42)
    image[(edge < 0.075) & (edge > 0.055)] = (0.10, 0.11, 0.22)
    image[edge < 0.025] = (0.52, 0.075, 0.05)
    return image * (0.88 + 0.24 * smooth_noise(size, size, (64, 64), 5))[..., None]


def painting(height: int = 128, width: int = 192) -> F64:
    """Hills under an evening sky."""
    y, x = np.mgrid[0:height, 0:width] / np.array([height, width])[:, None, None]
    image = mix((0.10, 0.24, 0.50), (0.85, 0.52, 0.24), np.clip(y / 0.62, 0, 1))
    disc = (x - 0.68) ** 2 * 2.25 + (y - 0.40) ** 2 < 0.0052
    image[disc] = (0.95, 0.80, 0.45)
    layers: tuple[tuple[float, float, float, tuple[float, float, float]], ...] = (
        (0.52, 0.10, 3.0, (0.22, 0.20, 0.34)),
        (0.64, 0.07, 5.0, (0.12, 0.22, 0.20)),
        (0.78, 0.06, 2.0, (0.16, 0.24, 0.07)),
    )
    for level, swing, waves, color in layers:
        hill = y > level + swing * np.sin(waves * np.pi * x + 9 * level)
        image[hill] = color
    return image * (0.9 + 0.2 * smooth_noise(height, width, (48, 24), 6))[..., None]


def checker(size: int = 64, cells: int = 2) -> F64:
    y, x = np.mgrid[0:size, 0:size] * cells // size
    return np.where(((x + y) % 2 == 0)[..., None], (0.62, 0.60, 0.56), (0.20, 0.21, 0.24))


def sky(height: int = 32, width: int = 64) -> F64:
    """Lat-long sky radiance, top row up: a clear gradient, a bright haze about the sun's azimuth, dim ground."""
    elevation = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    azimuth = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    e, a = np.meshgrid(elevation, azimuth, indexing="ij")
    up = np.clip(np.sin(e), 0, 1)
    image = mix((1.0, 1.05, 1.1), (0.28, 0.50, 1.0), up**0.5)
    towards = np.clip(np.cos(e) * np.cos(a) * np.cos(0.6) + np.sin(e) * np.sin(0.6), 0, 1)
    image += (towards**24 * 6)[..., None] * np.array([1.0, 0.86, 0.66])
    image[e < 0] = (0.10, 0.09, 0.08)
    return image


def encode_srgb(linear: F64) -> NDArray[np.uint8]:
    x = np.clip(linear, 0, 1)
    curve = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    return np.round(curve * 255).astype(np.uint8)


def write_png(path: Path, linear: F64) -> None:
    """8-bit sRGB PNG, every row with filter Up (2): small for textures that vary slowly."""
    pixels = encode_srgb(linear)
    height, width = pixels.shape[:2]
    rows = pixels.reshape(height, -1)
    above = np.vstack([np.zeros_like(rows[:1]), rows[:-1]])
    filtered = np.hstack([np.full((height, 1), 2, np.uint8), rows - above])

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
        + chunk(b"sRGB", b"\0")
        + chunk(b"IDAT", zlib.compress(filtered.tobytes(), 9))
        + chunk(b"IEND", b"")
    )


def png_content(data: bytes) -> bytes:
    """What a PNG written here says, whichever zlib packed it."""
    content, at = b"", 8
    while at < len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        kind, body = data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        content += kind + (zlib.decompress(body) if kind == b"IDAT" else body)
        at += 12 + length
    return content


def write_exr(path: Path, linear: F64) -> None:
    """Uncompressed half-float RGB scanlines: the plainest OpenEXR file, the same bytes with any library version."""
    height, width = linear.shape[:2]

    def attribute(name: str, kind: str, data: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(data)) + data

    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    channels = b"".join(name + b"\0" + struct.pack("<iiii", 1, 0, 1, 1) for name in (b"B", b"G", b"R")) + b"\0"
    header = (
        struct.pack("<ii", 20000630, 2)
        + attribute("channels", "chlist", channels)
        + attribute("compression", "compression", b"\0")
        + attribute("dataWindow", "box2i", window)
        + attribute("displayWindow", "box2i", window)
        + attribute("lineOrder", "lineOrder", b"\0")
        + attribute("pixelAspectRatio", "float", struct.pack("<f", 1.0))
        + attribute("screenWindowCenter", "v2f", struct.pack("<ff", 0.0, 0.0))
        + attribute("screenWindowWidth", "float", struct.pack("<f", 1.0))
        + b"\0"
    )
    line = 8 + 3 * 2 * width
    first = len(header) + 8 * height
    offsets = b"".join(struct.pack("<Q", first + y * line) for y in range(height))
    half = linear.astype("<f2")
    lines = b"".join(
        struct.pack("<ii", y, 3 * 2 * width) + b"".join(half[y, :, c].tobytes() for c in (2, 1, 0))
        for y in range(height)
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(header + offsets + lines)
