"""What is written is what is read, whatever it is; what cannot be written says why."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from icheat_usd.edits.model import MaskedSurface, Payload, SurfaceMask
from icheat_usd.errors import SidecarError
from icheat_usd.sidecar import Element, elements, pack, payload_digest, read_payload, registry, write_payloads
from icheat_usd.sidecar.canonical import digest_of

_text = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=12)
_name = _text.filter(bool)
_number = st.floats(allow_nan=False, allow_infinity=False)
_value = st.one_of(_number, st.booleans(), _text, st.lists(_number, max_size=4).map(tuple))
_component = st.text(st.characters(categories=["L", "Nd"], include_characters="_"), min_size=1, max_size=6)


@st.composite
def _masks(draw: st.DrawFn) -> SurfaceMask:
    surfaces = tuple(
        MaskedSurface(
            "/".join(["/World", *draw(st.lists(_component, max_size=3))]),
            draw(st.integers(0, 4)),
            draw(st.integers(-1, 2**40)),
            draw(_text),
            draw(_text),
        )
        for _ in range(draw(st.integers(0, 4)))
    )
    resolution = draw(st.integers(1, 5))
    shape = (sum(surface.n_faces for surface in surfaces), resolution, resolution)
    eighths = st.integers(0, 255).map(lambda k: np.float32(k) / np.float32(255))
    weights = draw(st.sampled_from([st.floats(0, 1, width=32), eighths]))
    finite = st.floats(width=32, allow_nan=False, allow_infinity=False)
    positions = draw(st.sampled_from([finite, st.floats(999, 1001, width=32), st.just(0.0)]))
    rest = draw(st.none() | npst.arrays(np.float32, (shape[0], 2, 2, 3), elements=positions))
    return SurfaceMask(surfaces, draw(npst.arrays(np.float32, shape, elements=weights)), rest)


_payloads = st.builds(
    Payload,
    operation=_text,
    parameters=st.dictionaries(_name, _value, max_size=4),
    receiver_mask=st.none() | _masks(),
    caster_mask=st.none() | _masks(),
    scale_delta=st.none() | st.tuples(_number, _number, _number),
    emission=st.none() | st.tuples(_number, _number, _number),
    offset=st.none() | st.tuples(_number, _number, _number),
    made_against=st.dictionaries(_name, _number | _text | st.integers(-(2**63), 2**63 - 1), max_size=3),
    unknown=st.dictionaries(
        st.sampled_from(["later-rows", "ünknown", "z-later"]),
        st.builds(
            Element,
            type=_name,
            version=st.integers(1, 9),
            datasets=st.dictionaries(
                st.sampled_from(["a", "b", "b2/c"]),
                npst.arrays(
                    st.sampled_from([np.dtype(t) for t in ("u1", "<i8", ">u2", "<f8", ">f4", "?", "S3")]),
                    npst.array_shapes(min_dims=0, max_dims=3, max_side=3),
                    elements={"allow_nan": False},
                ),
                max_size=3,
            ),
        ),
        max_size=2,
    ),
)


def assert_rest_within_the_stated_error(mine: SurfaceMask, other: SurfaceMask) -> None:
    assert (mine.rest is None) == (other.rest is None)
    if mine.rest is None or other.rest is None:
        return
    begin = 0
    for surface in mine.surfaces:
        one, two = (rest[begin : begin + surface.n_faces].astype(np.float64) for rest in (mine.rest, other.rest))
        if one.size:
            size = one.max((0, 1, 2)) - one.min((0, 1, 2))
            rounding = np.abs(one).max() * 2.0**-23 + 1e-44
            assert (np.abs(one - two) <= size / 131070 * (1 + 1e-9) + rounding).all()
        begin += surface.n_faces


def assert_same(a: Payload, b: Payload) -> None:
    assert (a.operation, dict(a.parameters), a.scale_delta) == (b.operation, dict(b.parameters), b.scale_delta)
    assert (a.emission, a.offset) == (b.emission, b.offset)
    assert dict(a.made_against) == dict(b.made_against)
    assert {k: type(v) for k, v in a.made_against.items()} == {k: type(v) for k, v in b.made_against.items()}
    for mine, other in ((a.receiver_mask, b.receiver_mask), (a.caster_mask, b.caster_mask)):
        assert (mine is None) == (other is None)
        if mine is not None and other is not None:
            assert mine.surfaces == other.surfaces
            assert other.texels.dtype == np.float32 and other.texels.flags.c_contiguous and other.texels.flags.writeable
            np.testing.assert_array_equal(mine.texels, other.texels)
            assert_rest_within_the_stated_error(mine, other)
    assert set(a.unknown) == set(b.unknown)
    for name, element in a.unknown.items():
        assert (element.type, element.version) == (b.unknown[name].type, b.unknown[name].version)
        assert set(element.datasets) == set(b.unknown[name].datasets)
        for path, values in element.datasets.items():
            np.testing.assert_array_equal(values, b.unknown[name].datasets[path])


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(payloads=st.lists(_payloads, min_size=1, max_size=2))
def test_any_payloads_come_back_exactly_and_under_the_digest_they_had(payloads: list[Payload], tmp_path: Path) -> None:
    file, digests = write_payloads(tmp_path, payloads, anchor="/World")
    for payload, digest in zip(payloads, digests, strict=True):
        assert digest == payload_digest(payload, anchor="/World")
        again = read_payload(file, digest, anchor="/World")
        assert_same(payload, again)
        assert payload_digest(again, anchor="/World") == digest
    packed, _ = pack([file], tmp_path)
    assert_same(payloads[0], read_payload(packed, digests[0], anchor="/World"))
    file.unlink()
    packed.unlink()


def _mask(texels: Any, path: str = "/World/Wall") -> SurfaceMask:
    return SurfaceMask((MaskedSurface(path, len(texels)),), np.asarray(texels, np.float32))


def test_a_file_is_read_from_bytes_and_from_an_open_file_as_from_a_path(tmp_path: Path) -> None:
    payload = Payload("scale", {"amount": 2.0}, receiver_mask=_mask(np.full((40, 16, 16), 0.25)))
    file, (digest,) = write_payloads(tmp_path / "shot.usda", [payload], anchor="/World")
    data = file.read_bytes()
    for source in (file, str(file), data, memoryview(data), io.BytesIO(data)):
        assert_same(payload, read_payload(source, digest, anchor="/World"))


def test_masks_follow_the_anchor_they_are_read_with(tmp_path: Path) -> None:
    payload = Payload("scale", {}, receiver_mask=_mask([[[1.0]]], "/Sequence/Set/Wall"))
    file, (digest,) = write_payloads(tmp_path / "a.usda", [payload], anchor="/Sequence/Set")
    mask = read_payload(file, digest, anchor="/Shot").receiver_mask
    assert mask is not None and mask.surfaces[0].path == "/Shot/Wall"
    mask = read_payload(file, digest, anchor="/").receiver_mask
    assert mask is not None and mask.surfaces[0].path == "/Wall"
    assert payload_digest(payload, anchor="/Sequence") != digest


@pytest.mark.parametrize(("steps", "dtype"), [(255, "u1"), (65535, "u2"), (1000, "f4")])
def test_texels_are_stored_in_the_smallest_type_that_is_exact(steps: int, dtype: str) -> None:
    texels = (np.arange(200, dtype=np.float32) / np.float32(steps)).reshape(-1, 1, 1)
    encoded = elements.encode_payload(Payload("scale", {}, receiver_mask=_mask(texels)), anchor="/World")
    assert encoded["receiver-mask"].datasets["texels"].dtype == np.dtype(dtype)


@pytest.mark.parametrize(
    ("payload", "message"),
    [
        (Payload("scale", {}, _mask([[[1.0]]], "/Other/Wall")), "/Other/Wall outside the anchor /World;"),
        (Payload("scale", {}, _mask([[[1.0]]], "/WorldWide/Wall")), "/WorldWide/Wall outside the anchor /World;"),
        (Payload("scale", {}, _mask([[[1.5]]])), r"outside \[0, 1\]"),
        (Payload("scale", {}, _mask([[[np.nan]]])), r"outside \[0, 1\] or NaN"),
        (Payload("scale", {}, SurfaceMask((MaskedSurface("/World/W", 2),), np.zeros((1, 1, 1), "f4"))), "do not fit 2"),
        (Payload("scale", {"amount": float("nan")}), "parameter 'amount' is nan"),
        (Payload("scale", {"amount": float("inf")}), "parameter 'amount' is inf"),
        (Payload("scale", {"amount": None}), "parameter 'amount' is None"),  # type: ignore[dict-item]
        (Payload("scale", {"": 1.0}), "cannot name a value"),
        (Payload("sc\0ale", {}), "null character"),
        (Payload("scale", {"t": "\ud800"}), "not valid text"),
        (Payload("scale", {}, scale_delta=(1.0, 2.0)), "2 components"),  # type: ignore[arg-type]
        (Payload("scale", {}, made_against={"n": 2**70}), "beyond 64 bits"),
        (Payload("scale", {}, unknown={"later": 3}), "not one that a sidecar reader kept"),
    ],
)
def test_what_cannot_be_stored_is_refused_by_name_and_leaves_no_file(
    payload: Payload, message: str, tmp_path: Path
) -> None:
    with pytest.raises(SidecarError, match=message):
        write_payloads(tmp_path / "shot.usda", [payload], anchor="/World")
    assert list(tmp_path.iterdir()) == []


def test_minus_zero_is_zero_in_names_and_in_files() -> None:
    payloads = [
        Payload("scale", {"amount": zero}, _mask([[[zero]], [[0.001]]]), None, (zero, 1.0, 2.0)) for zero in (0.0, -0.0)
    ]
    plus, minus = (elements.encode_payload(payload, anchor="/World") for payload in payloads)
    for element in minus.values():
        for path, values in element.datasets.items():
            assert values.dtype.kind != "f" or not np.signbit(values).any(), path
    assert digest_of(plus) == digest_of(minus)
    # Also in an element that another writer made and we only copy.
    foreign = [digest_of({"later": Element("later", 1, {"a": np.array([zero, 1.0])})}) for zero in (0.0, -0.0)]
    assert foreign[0] == foreign[1]


def test_an_anchor_that_is_no_prim_path_is_refused(tmp_path: Path) -> None:
    for anchor in ("World", "", "/World/"):
        with pytest.raises(SidecarError, match="not an absolute prim path"):
            write_payloads(tmp_path / "shot.usda", [Payload("scale", {})], anchor=anchor)


def test_older_elements_are_stepped_up_and_newer_ones_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, (digest,) = write_payloads(tmp_path / "a.usda", [Payload("scale", {"amount": 2.0})], anchor="/World")
    # A later release: the recipe is at version 3, with a step from 1 to 2 and one from 2 to 3.
    monkeypatch.setattr(registry, "_READERS", dict(registry._READERS))
    monkeypatch.setattr(registry, "_STEPS", {})
    reader = registry._READERS.pop(("recipe", 1))

    @registry.upgrades("recipe", 1)
    def rename(element: Element) -> Element:
        return Element("recipe", 2, {**element.datasets, "operation": np.array(b"gain")})

    @registry.upgrades("recipe", 2)
    def add(element: Element) -> Element:
        return Element("recipe", 3, {**element.datasets, "parameters/new": np.array(7.0)})

    registry.reads("recipe", 3)(reader)
    payload = read_payload(file, digest, anchor="/World")
    assert (payload.operation, dict(payload.parameters)) == ("gain", {"amount": 2.0, "new": 7.0})
    assert registry.newest_version("recipe") == 3
