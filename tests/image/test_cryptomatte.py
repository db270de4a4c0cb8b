"""Hashes, ids and ranks as the Cryptomatte specification has them."""

from __future__ import annotations

import json

import numpy as np
import pytest

from icheat_usd.image.cryptomatte import (
    Cryptomatte,
    coverage,
    hex_id,
    manifest,
    murmur3,
    name_id,
    rank,
    weighted_sum,
)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        # Published with the specification's own plug-in.
        ("hello", 6.0705627102400005616e-17),
        ("cube", -4.08461912519e15),
        ("sphere", 2.79018604383e15),
        ("plane", 3.66557617593e-11),
        ("равнина", -1.3192631212399999468e-25),
        ("mädchen", 6.2361298211599995797e25),
    ],
)
def test_names_have_the_published_ids(name: str, value: float) -> None:
    assert np.uint32(name_id(name)).view(np.float32) == np.float32(value)


def test_names_of_the_specification_have_its_hashes() -> None:
    assert (hex_id(name_id("bunny")), hex_id(name_id("default"))) == ("13851a76", "42c9679f")
    assert murmur3(b"") == 0 and murmur3(b"", 1) == 0x514E28B7 and murmur3(b"test", 0x9747B28C) == 0x704B81DC


def test_ids_are_normal_numbers() -> None:
    names = [f"/World/Prop_{index}" for index in range(3000)]
    exponents = [(murmur3(name.encode()) >> 23) & 0xFF for name in names]
    assert 0 in exponents and 255 in exponents  # so that the rule below has something to do
    ids = np.array([name_id(name) for name in names], np.uint32).view(np.float32)
    assert np.isfinite(ids).all() and (np.abs(ids) >= np.finfo(np.float32).tiny).all()


def test_ids_are_ranked_by_what_they_cover() -> None:
    pixel = np.array([2, 0, 0, 2, 0, 2, 0], np.int64)
    ids = np.array([7, 5, 9, 8, 5, 6, 4], np.uint32)
    share = np.array([0.25, 0.2, 0.3, 0.5, 0.2, 0.25, 0.0])
    ranks = rank(coverage(pixel, ids, share), 3, n_ranks=2)
    assert ranks[..., 0].view(np.uint32).tolist() == [[5, 9], [0, 0], [8, 6]]
    np.testing.assert_allclose(ranks[..., 1], [[0.4, 0.3], [0, 0], [0.5, 0.25]])


def test_images_laid_over_each_other_share_by_weight() -> None:
    one = coverage(np.array([0, 1]), np.array([3, 3], np.uint32), np.array([1.0, 0.5]))
    two = coverage(np.array([0, 1]), np.array([4, 3], np.uint32), np.array([1.0, 1.0]))
    both = weighted_sum([(0.25, one), (0.75, two)])
    assert both.pixel.tolist() == [0, 0, 1] and both.id.tolist() == [3, 4, 3]
    np.testing.assert_allclose(both.share, [0.25, 0.75, 0.875])
    assert len(weighted_sum([]).pixel) == 0


def test_channels_and_header_are_those_of_the_specification() -> None:
    ranks = np.arange(12, dtype=np.float32).reshape(1, 1, 6, 2)
    shown = np.array([name_id("bunny")], np.uint32)
    matte = Cryptomatte("CryptoAsset", ranks, manifest(["default", "bunny"], shown))
    assert list(matte.planes) == [f"CryptoAsset0{layer}.{c}" for layer in range(3) for c in "RGBA"]
    assert matte.planes["CryptoAsset01.B"][0, 0] == 6
    prefix = "cryptomatte/" + hex_id(name_id("CryptoAsset"))[:7]
    assert matte.metadata[f"{prefix}/name"] == "CryptoAsset"
    assert matte.metadata[f"{prefix}/hash"] == "MurmurHash3_32"
    assert matte.metadata[f"{prefix}/conversion"] == "uint32_to_float32"
    assert json.loads(matte.metadata[f"{prefix}/manifest"]) == {"bunny": "13851a76"}
