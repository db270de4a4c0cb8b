"""SPEC.md by itself is enough: its vectors hold, and its code reads our files without our package."""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from icheat_usd.edits.model import MaskedSurface, Payload, SurfaceMask
from icheat_usd.sidecar import (
    History,
    list_aliases,
    list_payloads,
    pack,
    payload_digest,
    read_history,
    read_payload,
    upgrade,
    write_payloads,
)
from icheat_usd.sidecar.canonical import alias_check, canonical_bytes
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


def test_the_digests_of_the_newer_elements_are_those_printed() -> None:
    emit = Payload("emit", {}, emission=(1.0, 2.0, 3.0), offset=(0.0, 0.5, 0.0))
    assert f"\n`{payload_digest(emit, anchor='/')}`" in SPEC
    rest = np.array([[[[0, 0, 0], [1, 0, 0]], [[0, 2, 0], [0.25, 2, 0]]]], np.float32)
    mask = SurfaceMask((MaskedSurface("/Room/Floor", 1),), np.ones((1, 1, 1), np.float32), rest)
    with_rest = Payload("scale", {"gain": 2.0}, mask)
    datasets = encode_payload(with_rest, anchor="/Room")["receiver-mask"].datasets
    assert datasets["rest"].tolist() == [[[[0, 0, 0], [65535, 0, 0]], [[0, 65535, 0], [16384, 65535, 0]]]]
    assert datasets["rest-box"].tolist() == [[[0, 0, 0], [1, 2, 0]]]
    digest = payload_digest(with_rest, anchor="/Room")
    assert f"\n`{digest}`" in SPEC
    first = payload_digest(Payload("scale", {"amount": 2.0}), anchor="/")
    assert f"\n`{alias_check(first, digest)}`" in SPEC


#: Run by a stranger's interpreter, after the code of SPEC.md; it has our package out of reach.
STRANGER = """
import json, sys

assert "icheat_usd" not in sys.modules
golden, ours, out = sys.argv[1:4]
found = {name: {"golden": golden, "ours": ours}[name] for name in ("golden", "ours")}
contents = {name: read(path) for name, path in found.items()}

n, r = 3, 2
payloads = [
    {
        "recipe": ("recipe", 1, {"operation": "hsv", "parameters/hue": 0.25, "parameters/on": True,
                                 "parameters/tint": np.array([1.0, 0.5, 0.25]), "parameters/a%2Fb": "wärmer"}),
        "receiver-mask": ("surface-mask", 2, {
            "surface-path": np.array(["Floor", "."]), "surface-part": np.array(["", "leaves"]),
            "surface-instance-id": np.array([-1, 17]), "surface-n-faces": np.array([n - 1, 1]),
            "surface-topology-digest": np.array(["", "ab"]),
            "texels": np.arange(n * r * r, dtype=np.uint16).reshape(n, r, r),
            "rest": np.linspace(0, 1, n * 12, dtype=np.float32).reshape(n, 2, 2, 3),
        }),
        "scale-delta": ("scale-delta", 1, {"rgb": np.array([0.5, 0.0, -0.5])}),
        "emission": ("emission", 1, {"rgb": np.array([1.0, 2.0, 3.0])}),
        "made-against": ("made-against", 1, {"camera": "/World/Camera", "width": 640}),
        "from-elsewhere": ("theirs", 4, {"deep/er": np.arange(4, dtype=">i2")}),
    },
    {"recipe": ("recipe", 1, {"operation": "scale", "parameters/amount": 2.0})},
]
names = write(out, payloads, who="a stranger", why="to see", when="2026-11-21T19:30:00Z")
assert set(read(out)) == set(names)
assert not [name for name in sys.modules if name.startswith(("icheat_usd", "pxr"))]
print(json.dumps({
    "names": names,
    "golden": sorted(contents["golden"]),
    "ours": sorted(contents["ours"]),
    "texels": contents["ours"][sys.argv[4]]["receiver-mask"][b"texels"].tolist(),
}))
"""


def test_a_stranger_with_nothing_but_h5py_reads_and_writes_what_we_do(tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", SPEC, re.DOTALL)
    golden = ROOT / "tests" / "golden" / "v0.1.0" / "every-element.icheat.h5"
    ours, renamed = upgrade([golden], tmp_path / "ours.icheat.h5")
    old = next(before for before, after in renamed.items() if before != after)
    # -I: no current folder, no user packages; and our package cannot be imported even where it is installed.
    block = (
        "import sys\n"
        "class Blocked:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.partition('.')[0] in ('icheat_usd', 'pxr'):\n"
        "            raise ImportError(name + ' is not for strangers')\n"
        "sys.meta_path.insert(0, Blocked())\n"
    )
    out = tmp_path / "theirs.icheat.h5"
    done = subprocess.run(
        [sys.executable, "-I", "-c", block + code + STRANGER, str(golden), str(ours), str(out), old],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    # What it reads: every payload, and the old digest by its alias.
    assert said["golden"] == sorted(renamed) and said["ours"] == sorted({*renamed, *renamed.values()})
    mask = read_payload(ours, old, anchor="/").receiver_mask
    assert mask is not None
    np.testing.assert_array_equal(np.float32(said["texels"]) / np.float32(255), mask.texels)

    # What it writes: the same digests as ours, and the values it stated.
    assert list_payloads(out) == tuple(sorted(said["names"]))
    assert said["names"][1] == payload_digest(Payload("scale", {"amount": 2.0}), anchor="/")
    theirs = read_payload(out, said["names"][0], anchor="/World")
    assert dict(theirs.parameters) == {"hue": 0.25, "on": True, "tint": (1.0, 0.5, 0.25), "a/b": "wärmer"}
    assert theirs.receiver_mask is not None and theirs.receiver_mask.rest is not None
    assert theirs.receiver_mask.surfaces == (
        MaskedSurface("/World/Floor", 2),
        MaskedSurface("/World", 1, 17, "leaves", "ab"),
    )
    expected = np.arange(12, dtype=np.float32).reshape(3, 2, 2) / np.float32(65535)
    np.testing.assert_array_equal(theirs.receiver_mask.texels, expected)
    np.testing.assert_array_equal(theirs.receiver_mask.rest.reshape(-1), np.linspace(0, 1, 36, dtype=np.float32))
    assert (theirs.scale_delta, theirs.emission) == ((0.5, 0.0, -0.5), (1.0, 2.0, 3.0))
    assert dict(theirs.made_against) == {"camera": "/World/Camera", "width": 640}
    assert theirs.unknown["from-elsewhere"].datasets["deep/er"].tolist() == [0, 1, 2, 3]
    assert read_history(out) == (History("a stranger", "to see", "2026-11-21T19:30:00Z", tuple(said["names"])),)
    packed, digests = pack([out], tmp_path / "packed.icheat.h5")
    assert digests == sorted(said["names"])


def test_a_stranger_verifies_every_golden_file(stranger: dict[str, Any]) -> None:
    files = sorted((ROOT / "tests" / "golden").rglob("*.icheat.h5"))
    assert len(files) >= 4
    for file in files:
        assert set(stranger["read"](file)) == {*list_payloads(file), *list_aliases(file)}


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
