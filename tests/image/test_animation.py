"""Frames as one animated PNG."""

from __future__ import annotations

import struct
import zlib

import numpy as np

from icheat_usd.image.png import encode_animation, encode_png


def chunks(content: bytes) -> list[tuple[bytes, bytes]]:
    found, at = [], 8
    while at < len(content):
        (length,) = struct.unpack(">I", content[at : at + 4])
        kind, body = content[at + 4 : at + 8], content[at + 8 : at + 8 + length]
        assert struct.unpack(">I", content[at + 8 + length : at + 12 + length])[0] == zlib.crc32(kind + body)
        found.append((kind, body))
        at += 12 + length
    return found


def test_an_animation_holds_every_frame_and_is_its_first_one_where_none_can_be_played() -> None:
    frames = np.random.default_rng(1).integers(0, 256, (3, 5, 4, 3), dtype=np.uint8)
    found = chunks(encode_animation(frames, per_second=12))
    assert [kind for kind, _ in found] == [
        b"IHDR", b"acTL", b"sRGB", b"fcTL", b"IDAT", b"fcTL", b"fdAT", b"fcTL", b"fdAT", b"IEND"
    ]  # fmt: skip
    assert dict(found)[b"acTL"] == struct.pack(">II", 3, 0)
    counted = [struct.unpack(">I", body[:4])[0] for kind, body in found if kind in (b"fcTL", b"fdAT")]
    assert counted == [0, 1, 2, 3, 4]
    delays = [struct.unpack(">HH", body[20:24]) for kind, body in found if kind == b"fcTL"]
    assert delays == [(1, 12)] * 3
    data = [body[4:] if kind == b"fdAT" else body for kind, body in found if kind in (b"IDAT", b"fdAT")]
    for frame, packed in zip(frames, data, strict=True):
        assert packed == dict(chunks(encode_png(frame, srgb=True, text={})))[b"IDAT"]
