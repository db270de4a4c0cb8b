"""Files of released versions still read to the values they were written from, stated here by hand."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from icheat_usd.edits.model import MaskedSurface
from icheat_usd.sidecar import Element, History, list_aliases, list_payloads, pack, read_history, read_payload, upgrade

FOLDER = Path(__file__).parents[1] / "golden"
GOLDEN = [FOLDER / "v0.1.0" / "every-element.icheat.h5"]
NEWER = FOLDER / "v0.2.0"
SCALE = "e9e96689efb3cc041e93f5601e009346dd57a93b05bd8be32bcdda6ec4c6e3aa"
FULL = "3351bd16fb1a60144477abc51c4903b0c98505eb8c32861b65c5e26c20144934"


#: Of every file that was ever written: never rewritten, so never to be changed here either.
SHA256 = {
    "v0.1.0/every-element.icheat.h5": "fc9d7dbb22db2f738a9d5a0bde3efdd319bff1095aadb3340fa966e1ab8f6b58",
    "v0.2.0/every-element.icheat.h5": "c654bd5bb9276c6f0b5a3e41e76c9ecd562765164c529a11c0410f0e02eaa151",
    "v0.2.0/rows.icheat.h5": "a9b2cae40796b2314552003ce8360b80d96d7853144afc2b913f92c3a1aadaac",
    "v0.2.0/upgraded.icheat.h5": "0cc09b83fceaeb66f249dd9a31b6060307668113133d83af345c4e4687f15b85",
}


def test_golden_files_are_what_they_were() -> None:
    files = {str(file.relative_to(FOLDER)): file for file in FOLDER.rglob("*.icheat.h5")}
    assert {name: hashlib.sha256(file.read_bytes()).hexdigest() for name, file in files.items()} == SHA256


@pytest.mark.parametrize("file", GOLDEN, ids=lambda file: str(file.parent.name))
def test_a_golden_file_reads_to_the_values_it_was_written_from(file: Path) -> None:
    assert list_payloads(file) == (FULL, SCALE)
    scale = read_payload(file, SCALE, anchor="/World")
    assert (scale.operation, dict(scale.parameters)) == ("scale", {"amount": 2.0})
    assert scale.receiver_mask is None and scale.caster_mask is None and scale.scale_delta is None

    full = read_payload(file, FULL, anchor="/Shot/Set")
    assert full.operation == "hsv"
    assert dict(full.parameters) == {
        "hue": 0.25,
        "tint": (1.0, 0.5, 0.125),
        "preserve": True,
        "label": "wärmer",
        "a/b": 0.0,
    }
    assert full.receiver_mask is not None and full.caster_mask is not None
    assert full.receiver_mask.surfaces == (
        MaskedSurface("/Shot/Set/Room/Floor", 2, -1, "", "f100"),
        MaskedSurface("/Shot/Set/Trees", 4, 17, "leaves", ""),
    )
    expected = np.float32(np.arange(96).reshape(6, 4, 4)) / np.float32(255)
    np.testing.assert_array_equal(full.receiver_mask.texels, expected)
    assert full.caster_mask.surfaces == (MaskedSurface("/Shot/Set", 400),)
    np.testing.assert_array_equal(full.caster_mask.texels[:, 1, 0], np.float32(np.arange(400)) / np.float32(1000))
    assert full.scale_delta == (0.5, 0.25, -0.125)
    assert dict(full.made_against) == {"camera": "/World/Camera", "width": 640, "time": 12.5}
    later = full.unknown["later-idea"]
    assert isinstance(later, Element) and (later.type, later.version) == ("haar-rows", 3)
    np.testing.assert_array_equal(later.datasets["rows/index"], np.arange(5, dtype=np.uint16))
    assert read_history(file) == (History("write_golden", "every element of format 1", "2026-11-21", (SCALE, FULL)),)


@pytest.mark.parametrize("file", GOLDEN, ids=lambda file: str(file.parent.name))
def test_packing_a_golden_file_loses_nothing(file: Path, tmp_path: Path) -> None:
    packed, digests = pack([file], tmp_path / "all.icheat.h5")
    assert digests == sorted([SCALE, FULL])
    assert read_history(packed) == read_history(file)
    for digest in digests:
        before, after = (read_payload(f, digest, anchor="/World") for f in (file, packed))
        assert before.parameters == after.parameters and set(before.unknown) == set(after.unknown)


def test_version_0_2_0_reads_to_the_values_it_was_written_from() -> None:
    file = NEWER / "every-element.icheat.h5"
    newest = "5317f2c4089a2f49cbde3efc75268fe4fc752d08bb79e881216ff80ca5f9e169"
    assert list_payloads(file) == (newest, SCALE)
    full = read_payload(file, newest, anchor="/World")
    old = read_payload(GOLDEN[0], FULL, anchor="/World")
    assert (full.operation, dict(full.parameters)) == (old.operation, dict(old.parameters))
    assert (full.scale_delta, full.emission, full.offset) == ((0.5, 0.25, -0.125), (1.0, 2.0, 4.0), (0.0, 0.5, -0.25))
    assert full.receiver_mask is not None and old.receiver_mask is not None and full.caster_mask is not None
    assert full.receiver_mask.surfaces == old.receiver_mask.surfaces
    np.testing.assert_array_equal(full.receiver_mask.texels, old.receiver_mask.texels)
    assert full.receiver_mask.rest is not None and full.caster_mask.rest is None
    expected = (np.arange(72, dtype=np.float32) / np.float32(4)).reshape(6, 2, 2, 3)
    # The larger surface spans 11.25, so that positions are kept to half of 1/65,535 of that.
    np.testing.assert_allclose(full.receiver_mask.rest, expected, atol=11.25 / 131070, rtol=0)
    later = full.unknown["later-idea"]
    assert isinstance(later, Element) and (later.type, later.version) == ("later-idea", 3)
    (entry,) = read_history(file)
    assert entry == History(
        "write_golden", "every element of format 1", "2026-11-21T19:30:00Z", (SCALE, newest), "/World/Edits/golden"
    )


def test_the_rows_of_version_0_2_0_read_to_the_values_they_were_written_from() -> None:
    digest = "64a08dcf48ac7d521c0ccfd26397db6a52e67a59161bd878d41b0615ce9fe088"
    rows = read_payload(NEWER / "rows.icheat.h5", digest, anchor="/World").rows
    assert rows is not None
    assert [surface.path for surface in rows.surfaces] == ["/World/Wall", "/World/Tree"]
    assert rows.leaf_area.tolist() == [0.5, 1.0, 0.25, 2.0] and rows.split_size.tolist() == [2, 1, 1]
    assert rows.site_row.tolist() == [0, 1, -1] and rows.indices.tolist() == [0, 2, 0, 1, 3]
    assert rows.indptr.tolist() == [0, 2, 5] and rows.kinds == ("delta",) and rows.epsilon_scale == 0.005
    assert rows.numbers.tolist() == np.arange(15).reshape(5, 3).tolist()
    assert rows.leaves.face.tolist() == [0, 1, 0, 1] and rows.sites.face.tolist() == [2, 0, 1]


def test_the_oldest_file_upgrades_to_the_bytes_it_did_in_version_0_2_0(tmp_path: Path) -> None:
    kept = NEWER / "upgraded.icheat.h5"
    assert list_aliases(kept) == {FULL: "5944c670bb78f967eab73d2e4b21603cce72e9839b393e0e32560c52cada36df"}
    for digest in (FULL, SCALE):
        a, b = (read_payload(file, digest, anchor="/World") for file in (kept, GOLDEN[0]))
        assert (a.operation, a.parameters, a.scale_delta, a.made_against) == (
            b.operation,
            b.parameters,
            b.scale_delta,
            b.made_against,
        )
    again, _ = upgrade(GOLDEN, tmp_path / "again.icheat.h5")
    assert list_payloads(again) == list_payloads(kept)
