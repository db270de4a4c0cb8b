"""Sampled rows in files: the same bits come back, and no malformed array reaches a kernel."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from icheat_usd.edits.binding import bind
from icheat_usd.edits.encodings.bake import at_full_amount, bake_field
from icheat_usd.edits.encodings.rows import bind_rows
from icheat_usd.edits.encodings.sampled import SampledRows
from icheat_usd.edits.model import Edit, Payload, Selection
from icheat_usd.errors import SidecarError
from icheat_usd.sidecar import Element, list_elements, read_payload, write_payloads
from icheat_usd.sidecar.elements import decode_payload, encode_payload
from tests.pipeline import Pipeline
from tests.scenes import cornell


@cache
def pipeline() -> Pipeline:
    return Pipeline(cornell(24, 24), n_gather=256, rays=64)


@cache
def payload(operation: str = "falloff") -> Payload:
    pipe = pipeline()
    parameters = {"exponent": 1.0, "pivot": 1.5} if operation == "falloff" else {"color": (0.1, 0.2, 0.3)}
    edit = Edit(
        "/e", operation, parameters, Selection(frozenset(["/floor", "/low"])), Selection(frozenset(["/red", "/tall"]))
    )
    field = bind(at_full_amount(edit), pipe.snapshot)
    rows = bake_field(field, pipe.view, pipe.gather, pipe.snapshot, where="/e", epsilon=0.1).rows
    return Payload(operation, parameters, rows=rows)


def elements(operation: str = "falloff") -> dict[str, Element]:
    return encode_payload(payload(operation), anchor="/")


def evaluated(rows: SampledRows) -> np.ndarray:
    pipe = pipeline()
    bound = bind_rows(rows, pipe.snapshot, "/e")
    mixture = bound.locate_receivers(pipe.view.points)
    leaves = bound.locate_casters(pipe.gather.points)
    n = len(mixture.rows)
    return np.asarray(bound.evaluate(mixture, np.resize(leaves, n)).scale)


@pytest.mark.parametrize("operation", ["falloff", "scale", "paint", "emit"])
def test_what_is_read_evaluates_to_the_same_bits(operation: str, tmp_path: Path):
    file, (digest,) = write_payloads(tmp_path, [payload(operation)], anchor="/")
    read = read_payload(file, digest, anchor="/").rows
    assert read is not None
    written = payload(operation).rows
    assert written is not None
    for name in SampledRows.__dataclass_fields__:
        a, b = getattr(written, name), getattr(read, name)
        if isinstance(a, np.ndarray):
            assert a.dtype == b.dtype and np.array_equal(a, b), name
        elif isinstance(a, tuple) and a and isinstance(a[0], np.ndarray):
            assert all(np.array_equal(x, y) for x, y in zip(a, b, strict=True)), name
        else:
            assert a == b, name
    assert read.samples_digest == written.samples_digest
    assert np.array_equal(evaluated(read), evaluated(written))
    assert write_payloads(tmp_path, [replace(payload(operation), rows=read)], anchor="/")[1] == [digest]


def test_surfaces_are_named_relative_to_the_anchor(tmp_path: Path):
    rows = payload("scale").rows
    assert rows is not None
    below = replace(rows, surfaces=tuple(replace(s, path="/World" + s.path) for s in rows.surfaces))
    file, (digest,) = write_payloads(tmp_path, [Payload("scale", {}, rows=below)], anchor="/World")
    read = read_payload(file, digest, anchor="/Shot/Set").rows
    assert read is not None
    assert {s.path for s in read.surfaces} == {"/Shot/Set" + s.path for s in rows.surfaces}
    with pytest.raises(SidecarError, match="outside the anchor"):
        write_payloads(tmp_path, [Payload("scale", {}, rows=rows)], anchor="/World")


def value_by_the_book(data: dict[str, np.ndarray], row: int, leaf: int, column: int) -> float:
    """What SPEC.md says about decoding, with plain NumPy and nothing of the package."""
    pattern = int(np.cumsum(data["row-pattern"], dtype=int)[row])
    ends = np.cumsum(data["pattern-size"], dtype=int)
    begin, end = int(ends[pattern] - data["pattern-size"][pattern]), int(ends[pattern])
    index = np.cumsum(data["index"][begin:end], dtype=int)
    numbers = data["number"][begin:end, data["number-column"][column]] * float(data["row-step"][row, column])
    coefficient = dict(zip(index.tolist(), numbers.tolist(), strict=True))
    area = data["leaf-area"].astype(float)
    value, first, last, node = coefficient.get(0, 0.0), 0, len(area), 0
    while last - first > 1:
        middle = first + int(data["split-size"][node])
        a, b = area[first:middle].sum(), area[middle:last].sum()
        difference = coefficient.get(1 + node, 0.0)
        if leaf < middle:
            value, last, node = value + b / (a + b) * difference, middle, node + 1
        else:
            value, first, node = value - a / (a + b) * difference, middle, node + middle - first
    return value


def test_the_specification_alone_is_enough_to_decode_rows():
    data = dict(elements()["rows"].datasets)
    rows = payload().rows
    assert rows is not None
    bound = bind_rows(rows, pipeline().snapshot, "/e")
    assert bound.table is not None
    rng = np.random.default_rng(5)
    for row, leaf in zip(rng.integers(0, len(rows.row_pattern), 40), rng.integers(0, rows.n_leaves, 40), strict=True):
        expected = [value_by_the_book(data, int(row), int(leaf), c) for c in range(3)]
        assert np.allclose(bound.table[row, bound.cell[leaf]], expected, atol=1e-6)
    site_row = np.cumsum(data["site-row"], dtype=int)
    assert site_row.min() >= -1 and site_row.max() == len(data["row-pattern"]) - 1


def test_an_object_edit_is_a_few_kilobytes(tmp_path: Path):
    file, _ = write_payloads(tmp_path, [payload("scale")], anchor="/")
    assert sum(info.stored_bytes for info in list_elements(file)) < 6000


def decoded(element: Element) -> SampledRows | None:
    return decode_payload({**elements(), "rows": element}, anchor="/", where="file").rows


@pytest.mark.parametrize("dataset", sorted(elements()["rows"].datasets))
def test_an_element_that_lacks_an_array_is_refused(dataset: str):
    element = elements()["rows"]
    kept = {path: array for path, array in element.datasets.items() if path != dataset}
    with pytest.raises(SidecarError, match=f"lacks '{dataset}'"):
        decoded(Element(element.type, element.version, kept))


NASTY = (
    lambda a: a[:-1],
    lambda a: np.concatenate([a, a]),
    lambda a: a[None],
    lambda a: a.astype(np.float64),
    lambda a: a.astype(np.int64),
    lambda a: np.zeros((0,) + a.shape[1:], a.dtype),
    lambda a: np.array(a.reshape(-1)[0]),
    lambda a: np.full_like(a, np.iinfo(a.dtype).max if a.dtype.kind in "iu" else np.inf),
    lambda a: np.full_like(a, np.iinfo(a.dtype).min if a.dtype.kind in "iu" else -1),
    lambda a: np.zeros_like(a),
    lambda a: a[::-1].copy(),
    lambda a: np.full(a.shape, b"\xff"),
)


def is_used_safely(element: Element) -> bool:
    """True if the element is read and bound and evaluated; False if it is refused with a reason."""
    try:
        rows = decoded(element)
    except SidecarError as problem:
        assert str(problem).startswith("file: element 'rows'")
        return False
    assert rows is not None
    evaluated(rows)
    return True


@pytest.mark.parametrize("dataset", sorted(elements()["rows"].datasets))
def test_arrays_of_another_form_are_refused_or_harmless(dataset: str):
    element = elements()["rows"]
    for change in NASTY:
        array = element.datasets[dataset]
        try:
            changed = np.asarray(change(array if array.ndim else array.reshape(1)))
        except (ValueError, IndexError, TypeError):
            continue  # there is no such form of this array
        is_used_safely(Element(element.type, element.version, {**element.datasets, dataset: changed}))


@settings(max_examples=300, deadline=None)
@given(data=st.data())
def test_no_changed_value_makes_a_kernel_read_outside_its_arrays(data: st.DataObject):
    """What passes the checks is bound and evaluated: an index that is out of range would crash or raise here."""
    element = elements()["rows"]
    dataset = data.draw(
        st.sampled_from(sorted(k for k, a in element.datasets.items() if a.dtype.kind in "iuf" and a.size))
    )
    array = element.datasets[dataset].copy()
    flat = array.reshape(-1)
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, flat.size - 1))
        if array.dtype.kind == "f":
            flat[at] = data.draw(st.sampled_from([0.0, -1.0, 1e30, np.inf, 1e-30]))
        else:
            limits = np.iinfo(array.dtype)
            flat[at] = data.draw(st.integers(limits.min, limits.max) | st.integers(max(-3, limits.min), 3))
    is_used_safely(Element(element.type, element.version, {**element.datasets, dataset: flat.reshape(array.shape)}))


def test_a_chain_as_deep_as_it_is_long_is_refused():
    element = elements()["rows"]
    n = 3000
    chain = {
        "leaf-surface": np.zeros(n, np.int8),
        "leaf-side": np.zeros(n, np.uint8),
        "leaf-face": np.zeros(n, np.int8),
        "leaf-face-uv": np.zeros((n, 2), np.uint16),
        "leaf-position": np.zeros((n, 3), np.uint16),
        "leaf-area": np.ones(n, np.float32),
        "split-size": np.ones(n - 1, np.uint8),
    }
    with pytest.raises(SidecarError, match="levels"):
        decoded(Element(element.type, element.version, {**element.datasets, **chain}))


def test_newer_rows_ask_for_an_update():
    element = elements()["rows"]
    with pytest.raises(SidecarError, match="update icheat_usd"):
        decoded(Element(element.type, element.version + 1, element.datasets))
