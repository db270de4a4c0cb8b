"""SPEC.md by itself is enough: its vectors hold, and its code reads our files without our package."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from icheat_usd.edits.model import MaskedSurface, Payload, SurfaceMask
from icheat_usd.sidecar import payload_digest, read_payload, write_payloads
from icheat_usd.sidecar.canonical import canonical_bytes
from icheat_usd.sidecar.elements import encode_payload

ROOT = Path(__file__).parents[2]
SPEC = (ROOT / "schemas" / "sidecar" / "SPEC.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def stranger() -> dict[str, Any]:
    """The names that the Python of SPEC.md defines; it imports h5py and the standard library alone."""
    (code,) = re.findall(r"```python\n(.*?)```", SPEC, re.DOTALL)
    assert "icheat_usd" not in code
    names: dict[str, Any] = {}
    exec(compile(code, "SPEC.md", "exec"), names)
    return names


def test_the_bytes_printed_in_the_spec_are_the_canonical_bytes() -> None:
    (block,) = re.findall(r"```\n((?:[0-9a-f]{2}[ \n])+)```", SPEC)
    printed = bytes.fromhex(block)
    assert len(printed) == 175
    elements = encode_payload(Payload("scale", {"amount": 2.0}), anchor="/World")
    assert b"".join(canonical_bytes(elements)) == printed
    assert f"digest `{hashlib.sha256(printed).hexdigest()}`" in SPEC


def test_the_digest_of_the_second_vector_is_the_one_printed() -> None:
    texels = np.array([[[0.0, 1.0], [0.2, 1.0]]], np.float32)
    payload = Payload("hsv", {"tint": (1.0, -0.0), "on": True}, SurfaceMask((MaskedSurface("/Room/Floor", 1),), texels))
    assert f"\n`{payload_digest(payload, anchor='/Room')}`" in SPEC


def test_a_stranger_reads_the_golden_files_with_plain_h5py(stranger: dict[str, Any]) -> None:
    (file,) = (ROOT / "tests" / "golden").glob("v0.1.0/*.h5")
    contents = stranger["read"](file)
    assert len(contents) == 2
    (full,) = (payload for payload in contents.values() if "receiver-mask" in payload)
    assert full["recipe"][b"operation"] == b"hsv"
    np.testing.assert_array_equal(full["recipe"][b"parameters/tint"], (1.0, 0.5, 0.125))
    assert full["receiver-mask"][b"surface-path"].tolist() == [b"Room/Floor", b"Trees"]
    assert full["receiver-mask"][b"texels"].dtype == np.uint8


def test_a_stranger_reads_what_we_write_and_finds_the_same_digest(stranger: dict[str, Any], tmp_path: Path) -> None:
    texels = np.random.default_rng(0).random((900, 3, 3)).astype(np.float32)
    mask = SurfaceMask(tuple(MaskedSurface(f"/W/ä{i}", 9, i) for i in range(100)), texels)
    payload = Payload("hsv", {"x/y": 1.5, "%": "é", ".": False}, caster_mask=mask, made_against={"n": -3})
    file, (digest,) = write_payloads(tmp_path / "shot.usda", [payload], anchor="/W")
    ((name, contents),) = stranger["read"](file).items()
    assert name == digest
    np.testing.assert_array_equal(contents["caster-mask"][b"texels"], texels)
    assert read_payload(file, digest, anchor="/W").parameters == payload.parameters
