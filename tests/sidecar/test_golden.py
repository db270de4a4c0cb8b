"""Files of released versions still read to the values they were written from, stated here by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from icheat_usd.edits.model import MaskedSurface
from icheat_usd.sidecar import Element, History, list_payloads, pack, read_history, read_payload

GOLDEN = sorted((Path(__file__).parents[1] / "golden").glob("v*/every-element.icheat.h5"))
SCALE = "e9e96689efb3cc041e93f5601e009346dd57a93b05bd8be32bcdda6ec4c6e3aa"
FULL = "3351bd16fb1a60144477abc51c4903b0c98505eb8c32861b65c5e26c20144934"


def test_there_is_a_golden_file() -> None:
    assert GOLDEN


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
