"""`pack` and `upgrade`: new files in which everything old is found, under the digests that stages name."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import h5py
import numpy as np
import pytest

from icheat_usd.edits.model import MaskedSurface, Payload, SurfaceMask
from icheat_usd.errors import SidecarError
from icheat_usd.sidecar import (
    Element,
    History,
    describe,
    is_published,
    list_aliases,
    list_elements,
    list_payloads,
    pack,
    payload_digest,
    read_history,
    read_payload,
    registry,
    upgrade,
    write_payloads,
    writer,
)
from icheat_usd.sidecar.canonical import alias_check, digest_of
from icheat_usd.sidecar.elements import encode_payload

GOLDEN = Path(__file__).parents[1] / "golden" / "v0.1.0" / "every-element.icheat.h5"
SCALE = "e9e96689efb3cc041e93f5601e009346dd57a93b05bd8be32bcdda6ec4c6e3aa"
FULL = "3351bd16fb1a60144477abc51c4903b0c98505eb8c32861b65c5e26c20144934"


def test_an_old_file_is_upgraded_and_still_answers_to_its_old_digests(tmp_path: Path) -> None:
    before = GOLDEN.read_bytes()
    who = History("ann@host", "newest versions", "2026-12-01T00:00:00Z")
    file, renamed = upgrade([GOLDEN], tmp_path / "new.icheat.h5", history=who)
    assert GOLDEN.read_bytes() == before
    # The recipe alone is as it was; the masks have moved from version 1 to 2.
    assert renamed[SCALE] == SCALE and renamed[FULL] != FULL
    assert list_payloads(file) == tuple(sorted(renamed.values()))
    assert list_aliases(file) == {FULL: renamed[FULL]}
    versions = {info.element: info.version for info in list_elements(file) if info.payload == renamed[FULL]}
    assert versions["receiver-mask"] == versions["caster-mask"] == 2 and versions["recipe"] == 1
    assert versions["later-idea"] == 3  # unknown here, and kept as it is

    old = read_payload(GOLDEN, FULL, anchor="/World")
    for digest in (FULL, renamed[FULL]):
        new = read_payload(file, digest, anchor="/World")
        assert (new.operation, new.parameters, new.made_against) == (old.operation, old.parameters, old.made_against)
        assert new.receiver_mask is not None and old.receiver_mask is not None
        assert new.receiver_mask.surfaces == old.receiver_mask.surfaces
        np.testing.assert_array_equal(new.receiver_mask.texels, old.receiver_mask.texels)
        later = new.unknown["later-idea"]
        np.testing.assert_array_equal(later.datasets["rows/index"], np.arange(5, dtype=np.uint16))
        # What is read now is written under the new name.
        assert payload_digest(new, anchor="/World") == renamed[FULL]
    assert read_history(file)[-1] == dataclasses.replace(who, payloads=tuple(sorted([SCALE, FULL])))
    assert f"alias {FULL} of {renamed[FULL]}" in describe(file)


def test_an_upgraded_file_is_packed_and_upgraded_again_with_its_old_digests(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, renamed = upgrade([GOLDEN], tmp_path / "1.icheat.h5")
    packed, _ = pack([first], tmp_path / "2.icheat.h5", only={FULL})
    assert list_payloads(packed) == (renamed[FULL],) and list_aliases(packed) == {FULL: renamed[FULL]}
    assert not pack([first], tmp_path / "3.icheat.h5", only={renamed[FULL]})[0].samefile(first)
    assert list_aliases(tmp_path / "3.icheat.h5") == {}
    # A file that has the payload itself needs no alias for it.
    both, digests = pack([GOLDEN, first], tmp_path / "4.icheat.h5")
    assert set(digests) == {SCALE, FULL, renamed[FULL]} and list_aliases(both) == {}

    # A later release, with version 3 of masks: both earlier digests lead to the newest payload.
    monkeypatch.setattr(registry, "_READERS", dict(registry._READERS))
    monkeypatch.setattr(registry, "_STEPS", dict(registry._STEPS))
    registry.reads("surface-mask", 3)(registry._READERS["surface-mask", 2])
    registry.upgrades("surface-mask", 2)(lambda element: Element("surface-mask", 3, element.datasets))
    again, newest = upgrade([first], tmp_path / "5.icheat.h5")
    assert list_aliases(again) == {FULL: newest[renamed[FULL]], renamed[FULL]: newest[renamed[FULL]]}
    assert read_payload(again, FULL, anchor="/World").operation == "hsv"


def test_upgrade_refuses_what_is_newer_or_cannot_be_decoded(tmp_path: Path) -> None:
    for element, message in (
        (Element("recipe", 9, {"operation": np.array(b"x")}), "recipe version 9.*; update icheat_usd"),
        (Element("recipe", 1, {}), "lacks 'operation'"),
    ):
        payload = encode_payload(Payload("scale", {}), anchor="/World") | {"recipe": element}
        digest = digest_of(payload)
        path = tmp_path / f"{element.version}.icheat.h5"
        with h5py.File(path, "w") as file:
            writer.fill_root(file, {digest: payload}, [])
        with pytest.raises(SidecarError, match=message):
            upgrade([path], tmp_path / "out.icheat.h5")
        assert not (tmp_path / "out.icheat.h5").exists()


def test_a_damaged_alias_leads_nowhere(tmp_path: Path) -> None:
    file, renamed = upgrade([GOLDEN], tmp_path / "new.icheat.h5")
    with h5py.File(file, "r+") as root:
        # As damage or a mistaken tool would: another payload's digest, the old check.
        root[f"aliases/{FULL}/payload"][...] = SCALE.encode()
    with pytest.raises(SidecarError, match=f"alias {FULL[:12]} is damaged"):
        read_payload(file, FULL, anchor="/World")
    with pytest.raises(SidecarError, match="is damaged"):
        pack([file], tmp_path / "packed.icheat.h5")
    assert read_payload(file, renamed[FULL], anchor="/World").operation == "hsv"


def test_an_alias_of_a_payload_that_is_not_there_is_an_error_and_not_a_loop(tmp_path: Path) -> None:
    one, two = "a" * 64, "b" * 64
    path = tmp_path / "x.icheat.h5"
    payload = encode_payload(Payload("scale", {}), anchor="/World")
    with h5py.File(path, "w") as root:
        writer.fill_root(root, {digest_of(payload): payload}, [], {one: two, two: one})
    assert alias_check(one, two) != alias_check(two, one)
    with pytest.raises(SidecarError, match=f"no payload '{one}'"):
        read_payload(path, one, anchor="/World")


def test_packing_some_payloads_keeps_their_history_alone(tmp_path: Path) -> None:
    payloads = [Payload("scale", {"gain": gain}) for gain in (1.0, 2.0)]
    file, (a, b) = write_payloads(
        tmp_path / "a.usda", payloads, anchor="/World", history=History("ann", "both", "2026-01-01", edit="/World/E/a")
    )
    packed, digests = pack([file], tmp_path / "b.icheat.h5", only={b}, history=History("bob", "one", "2026-01-02"))
    assert digests == [b]
    assert read_history(packed) == (
        History("ann", "both", "2026-01-01", (b,), "/World/E/a"),
        History("bob", "one", "2026-01-02", (b,)),
    )
    with pytest.raises(SidecarError, match="no file has the payload"):
        pack([file], tmp_path / "c.icheat.h5", only={a, "0" * 64})


def test_a_published_file_is_read_only_and_says_so(tmp_path: Path) -> None:
    file, _ = pack([GOLDEN], tmp_path / "p.icheat.h5", published=True)
    assert file.stat().st_mode & 0o777 == 0o444 and is_published(file) and not is_published(GOLDEN)


def test_rest_positions_are_kept_within_the_stated_error(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    surfaces = (MaskedSurface("/World/A", 40), MaskedSurface("/World/B", 0), MaskedSurface("/World/C", 3))
    rest = rng.uniform(-20, 30, (43, 2, 2, 3)).astype(np.float32)
    rest[40:] = rest[40:] * np.float32(1e-3) + np.float32(1e3)  # small, far from its origin
    payload = Payload("scale", {}, SurfaceMask(surfaces, np.ones((43, 2, 2), np.float32), rest))
    file, (digest,) = write_payloads(tmp_path, [payload], anchor="/World")
    mask = read_payload(file, digest, anchor="/World").receiver_mask
    assert mask is not None and mask.rest is not None
    assert payload_digest(Payload("scale", {}, mask), anchor="/World") == digest
    # Half a 65,535th of the surface's box, and the rounding of float32.
    for part, size, largest in ((slice(0, 40), 50, 30), (slice(40, 43), 0.05, 1000)):
        difference = np.abs(mask.rest[part].astype(np.float64) - rest[part])
        assert difference.max() <= size / 131070 + largest * 2.0**-24
    (info,) = [i for i in list_elements(file) if i.dataset == "rest"]
    assert info.dtype == "uint16"

    # Another writer may store them as they are.
    elements = encode_payload(payload, anchor="/World")
    datasets = {path: array for path, array in elements["receiver-mask"].datasets.items() if path != "rest-box"}
    elements["receiver-mask"] = Element("surface-mask", 2, datasets | {"rest": rest})
    digest = digest_of(elements)
    with h5py.File(tmp_path / "whole.icheat.h5", "w") as root:
        writer.fill_root(root, {digest: elements}, [])
    mask = read_payload(tmp_path / "whole.icheat.h5", digest, anchor="/World").receiver_mask
    assert mask is not None
    np.testing.assert_array_equal(mask.rest, rest)


def test_rank_1_emission_and_offset_come_back(tmp_path: Path) -> None:
    payload = Payload("emit", {}, emission=(1.5, 0.0, -0.0), offset=(0.25, 1e-9, 3.0))
    file, (digest,) = write_payloads(tmp_path, [payload], anchor="/World")
    again = read_payload(file, digest, anchor="/World")
    assert (again.emission, again.offset, again.scale_delta) == ((1.5, 0.0, 0.0), (0.25, 1e-9, 3.0), None)
    with pytest.raises(SidecarError, match="emission has 2 components"):
        write_payloads(tmp_path, [Payload("emit", {}, emission=(1.0, 2.0))], anchor="/World")  # type: ignore[arg-type]


def test_a_long_text_is_stored(tmp_path: Path) -> None:
    payload = Payload("scale", {"note": "long " * 2000})
    file, (digest,) = write_payloads(
        tmp_path, [payload], anchor="/World", history=History("ann", "because " * 900, "2026-01-01")
    )
    assert read_payload(file, digest, anchor="/World").parameters == payload.parameters
    assert read_history(file)[0].why == "because " * 900
