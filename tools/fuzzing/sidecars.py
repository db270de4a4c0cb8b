"""Mutated sidecars: half of them damaged bytes, half well-formed files whose payloads have valid digests.

`case` makes one from its number alone. `read` has every public reader look at
it, and checks that what they accept is what payloads are allowed to be.
"""

from __future__ import annotations

import random
import zlib
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from icheat_usd.edits.encodings.sampled import Places, SampledRows
from icheat_usd.edits.model import MaskedSurface, Payload, SurfaceMask
from icheat_usd.errors import IcheatError
from icheat_usd.sidecar import (
    Element,
    History,
    describe,
    is_published,
    list_payloads,
    read_payload,
    writer,
)
from icheat_usd.sidecar.canonical import Array, digest_of
from icheat_usd.sidecar.elements import encode_payload

ANCHOR = "/World"

#: What one payload may declare here; the readers' memory stays below twice this, two chunks, and what libraries need.
LIMIT_BYTES = 8 << 20

Elements = dict[str, Element]

_WORDS = (b"", b".", b"..", b"../../etc", b"/", b"/World/Wall", b"a//b", b"\xff\xfe", b"\xed\xa0\x80", b"x" * 5000)
_WORDS += (b"scale", b"nan", b"\x1b[2J", "ö/ü".encode(), b"%2F%00%", b"Wall\nWall", b"{variant=a}", b"</World>")
_NUMBERS = (0.0, -1.0, 1e308, -1e308, np.inf, -np.inf, 5e-324, 2.0**63, 1.0000001, 255.0, 65536.0)
_SIZES = (0, 1, 2**31, 2**32, 2**63, 2**64 - 1)
_DTYPES = ("u1", "<u2", "<u4", "<u8", "i1", "<i2", "<i4", "<i8", "<f4", "<f8", ">f4", ">i8", ">u2", "?", "S1", "S7")


# Something to start from ----------------------------------------------------------------------------------------------


def payloads() -> list[Payload]:
    """Small payloads that use every element of the format between them."""
    surfaces = (MaskedSurface("/World/Wall", 3, topology_digest="a1"), MaskedSurface("/World/Tree", 2, 5, "leaves"))
    texels = (np.arange(5 * 16, dtype=np.float32) / np.float32(255)).reshape(5, 4, 4)
    rest = np.linspace(-3, 7, 5 * 12, dtype=np.float32).reshape(5, 2, 2, 3)
    far = SurfaceMask(
        surfaces[:1], np.full((3, 60, 60), 1 / 3, np.float32), rest[:3] * np.float32(1e-6) + np.float32(9)
    )
    return [
        Payload("hsv", {"hue": 0.25, "on": True}, receiver_mask=SurfaceMask(surfaces, texels, rest)),
        Payload("scale", {"tint": (1.0, 0.5, 0.125)}, caster_mask=far, scale_delta=(0.5, 0.25, -0.125)),
        Payload("emit", {"a/b": "text"}, emission=(1.0, 2.0, 3.0), offset=(0.0, 0.5, 0.0)),
        Payload(
            "scale",
            {"gain": 2.0},
            made_against={"camera": "/World/Camera", "width": 640, "time": 12.5},
            unknown={"later": Element("later", 3, {"a/b": np.arange(5, dtype=np.uint16)})},
        ),
        Payload("baked", {}, rows=small_rows()),
    ]


def small_rows() -> SampledRows:
    """Two rows on a tree of four leaves, for three sites."""

    def places(surface: list[int], face: list[int]) -> Places:
        n = len(surface)
        uv = np.arange(2 * n, dtype=np.uint16).reshape(n, 2)
        position = np.arange(3 * n, dtype=np.uint16).reshape(n, 3)
        return Places(np.array(surface, np.int32), np.zeros(n, np.uint8), np.array(face, np.int32), uv, position)

    return SampledRows(
        surfaces=(MaskedSurface("/World/Wall", 3, -1, "", "a1"), MaskedSurface("/World/Tree", 2, 5, "leaves")),
        bounds=np.array([[[0, 0, 0], [1, 2, 3]], [[-1, -1, -1], [1, 1, 1]]], np.float32),
        leaves=places([0, 0, 1, 1], [0, 1, 0, 1]),
        leaf_area=np.array([0.5, 1.0, 0.25, 2.0], np.float32),
        split_size=np.array([2, 1, 1], np.int32),
        side_surface=np.array([0, 1], np.int32),
        side=np.zeros(2, np.uint8),
        side_leaves=np.array([[0, 2], [2, 4]], np.int32),
        sites=places([0, 1, 1], [2, 0, 1]),
        site_reach=np.array([0.5, 0.25, 1.0], np.float32),
        site_row=np.array([0, 1, -1], np.int32),
        row_pattern=np.array([0, 1], np.int32),
        row_step=np.full((2, 3), 0.01, np.float32),
        indptr=np.array([0, 2, 5], np.int64),
        indices=np.array([0, 2, 0, 1, 3], np.int32),
        numbers=np.arange(15, dtype=np.int8).reshape(5, 3),
        kinds=("delta",),
        epsilon_scale=0.005,
    )


@cache
def _elements() -> tuple[Elements, ...]:
    return tuple(encode_payload(payload, anchor=ANCHOR) for payload in payloads())


@cache
def _images(folder: Path) -> tuple[bytes, ...]:
    """Files of one payload each, as the writer makes them."""
    contents = []
    for payload in payloads():
        entry = History("ann", "why", "2026-01-01T00:00:00Z")
        file, _ = writer.write_payloads(folder / "base.icheat.h5", [payload], anchor=ANCHOR, history=entry)
        contents.append(file.read_bytes())
        file.unlink()
    return tuple(contents)


# One case -------------------------------------------------------------------------------------------------------------


def case(number: int, folder: Path, secret: Path) -> Path:
    """Write mutated sidecar `number` into a folder; nothing decides what it is but the number.

    `secret` is a folder with files that no reader of a sidecar may open.
    """
    choose = random.Random(number)
    path = folder / "case.icheat.h5"
    path.unlink(missing_ok=True)
    if number % 2:
        path.write_bytes(_damaged_bytes(choose, bytearray(choose.choice(_images(folder)))))
        return path
    elements = dict(choose.choice(_elements()))
    for _ in range(choose.choice((1, 1, 1, 2, 4))):
        choose.choice(_ELEMENT_CHANGES)(choose, elements)
    storage = choose.choice(_STORAGES) if choose.random() < 0.3 else None
    _write(path, elements, choose, storage, secret)
    return path


def read(path: Path) -> str:
    """Let every reader look at a file: ``"accepted"`` or ``"refused"``.

    Raises
    ------
    Exception
        A reader raised what is no `IcheatError`, or accepted what a payload must not be.
    """
    outcome = "accepted"
    digests: tuple[str, ...] = ()
    # `describe` lists elements, aliases and history.
    looks: tuple[Callable[[Path], Any], ...] = (is_published, describe)
    for look in (*looks, list_payloads):
        try:
            found = look(path)
            digests = found if look is list_payloads else digests
        except IcheatError as error:
            _check_message(error, path)
            outcome = "refused"
    for digest in digests:
        try:
            payload = read_payload(path, digest, anchor=ANCHOR, limit_bytes=LIMIT_BYTES)
        except IcheatError as error:
            _check_message(error, path)
            outcome = "refused"
        else:
            check_payload(payload)
    return outcome


def _check_message(error: IcheatError, path: Path) -> None:
    text = str(error)
    if path.name not in text or "\n" in text or not text.isprintable() or ";" not in text or len(text) > 2000:
        raise AssertionError(f"not one clear sentence: {text!r}")


def check_payload(payload: Payload) -> None:
    """Hold a payload that was read to what payloads are allowed to be."""
    assert isinstance(payload.operation, str)
    for value in payload.parameters.values():
        assert isinstance(value, (bool, str)) or np.isfinite(np.asarray(value, dtype=np.float64)).all(), value
    for mask in (payload.receiver_mask, payload.caster_mask):
        if mask is not None:
            n_faces = sum(surface.n_faces for surface in mask.surfaces)
            assert mask.texels.dtype == np.float32 and mask.texels.shape == (n_faces, mask.resolution, mask.resolution)
            assert ((mask.texels >= 0) & (mask.texels <= 1)).all()
            assert all(surface.n_faces >= 0 for surface in mask.surfaces)
            assert all(surface.path.startswith(ANCHOR) for surface in mask.surfaces)
            assert not any(".." in surface.path.split("/") for surface in mask.surfaces)
            assert mask.rest is None or (mask.rest.shape == (n_faces, 2, 2, 3) and np.isfinite(mask.rest).all())
    if payload.rows is not None:
        check_rows(payload.rows)
    for rgb in (payload.scale_delta, payload.emission, payload.offset):
        assert rgb is None or (len(rgb) == 3 and np.isfinite(rgb).all())


def check_rows(rows: SampledRows) -> None:
    """Every index of rows that were read stays within what it points to, because kernels follow them."""
    n_faces = np.array([surface.n_faces for surface in rows.surfaces])
    for places in (rows.leaves, rows.sites):
        assert ((places.surface >= 0) & (places.surface < len(rows.surfaces))).all()
        assert ((places.face >= 0) & (places.face < n_faces[places.surface])).all() if len(places.face) else True
    assert len(rows.split_size) == rows.n_leaves - 1 and (rows.leaf_area > 0).all()
    assert (rows.side_leaves >= 0).all() and (rows.side_leaves <= rows.n_leaves).all()
    assert ((rows.site_row >= -1) & (rows.site_row < len(rows.row_pattern))).all()
    assert ((rows.row_pattern >= 0) & (rows.row_pattern < len(rows.indptr) - 1)).all()
    assert rows.indptr[0] == 0 and rows.indptr[-1] == len(rows.indices) == len(rows.numbers)
    assert (np.diff(rows.indptr) >= 0).all()
    assert ((rows.indices >= 0) & (rows.indices < rows.n_leaves)).all()
    assert np.isfinite(rows.row_step).all() and rows.numbers.shape[1] == rows.n_columns == rows.row_step.shape[1]
    assert len(rows.tree.node_weight) > 0 and rows.samples_digest


# Damaged bytes --------------------------------------------------------------------------------------------------------


def _damaged_bytes(choose: random.Random, content: bytearray) -> bytes:
    for _ in range(choose.choice((1, 1, 2, 8))):
        place = choose.randrange(len(content))
        kind = choose.randrange(7)
        if kind == 0:
            content[place] ^= 1 << choose.randrange(8)
        elif kind == 1:
            content[place] = choose.choice((0, 1, 0x7F, 0x80, 0xFF))
        elif kind == 2:
            del content[choose.choice((place, max(place, len(content) - 64))) :]
        elif kind == 3:
            content[place : place + 8] = choose.choice((*_SIZES, place)).to_bytes(8, "little")
        elif kind == 4:
            other = choose.randrange(len(content))
            length = choose.choice((1, 8, 64, 512))
            content[place : place + length] = content[other : other + length]
        elif kind == 5:
            content[place : place + choose.choice((4, 32, 256))] = bytes(choose.choice((4, 32, 256)))
        else:
            content[place:place] = choose.randbytes(choose.choice((1, 8, 100)))
        if not content:
            return b""
    return bytes(content)


# Payloads that are wrong in themselves --------------------------------------------------------------------------------


def _some_dataset(choose: random.Random, elements: Elements) -> tuple[str, str] | None:
    places = [(name, path) for name, element in elements.items() for path in element.datasets]
    return choose.choice(sorted(places)) if places else None


def _change_dataset(choose: random.Random, elements: Elements, change: Callable[[Array], Array | None]) -> None:
    place = _some_dataset(choose, elements)
    if place is not None:
        name, path = place
        element = elements[name]
        datasets = dict(element.datasets)
        after = change(np.asarray(datasets.pop(path)))
        if after is not None:
            datasets[path] = after
        elements[name] = Element(element.type, element.version, datasets)


def _drop(choose: random.Random, elements: Elements) -> None:
    _change_dataset(choose, elements, lambda array: None)


def _retype(choose: random.Random, elements: Elements) -> None:
    dtype = np.dtype(choose.choice(_DTYPES))

    def change(array: Array) -> Array:
        if dtype.kind == "S" or array.dtype.kind == "S":
            return np.zeros(array.shape, dtype)
        with np.errstate(all="ignore"):
            return np.nan_to_num(array.astype(dtype)) if dtype.kind == "f" else array.astype(dtype)

    _change_dataset(choose, elements, change)


def _reshape(choose: random.Random, elements: Elements) -> None:
    kind = choose.randrange(7)

    def change(array: Array) -> Array:
        if kind == 0:
            return array.reshape(-1)
        if kind == 1:
            return array[None]
        if kind == 2:
            return np.repeat(np.atleast_1d(array), choose.choice((2, 3, 300)), axis=0)
        if kind == 3:
            return np.atleast_1d(array)[:0]
        if kind == 4:
            return np.atleast_1d(array)[:-1]
        if kind == 5:
            return np.moveaxis(array, 0, -1) if array.ndim > 1 else array.reshape(1, -1)
        return np.zeros((choose.choice((0, 1, 2, 70_000)), *array.shape[1:]), array.dtype)

    _change_dataset(choose, elements, change)


def _set_value(choose: random.Random, elements: Elements) -> None:
    word, number = choose.choice(_WORDS), choose.choice(_NUMBERS)

    def change(array: Array) -> Array:
        flat = array.reshape(-1).copy()
        if not flat.size:
            return array
        if flat.dtype.kind == "S":
            flat = flat.astype(f"S{max(1, len(word), flat.dtype.itemsize)}")
            flat[choose.randrange(flat.size)] = word
        elif flat.dtype.kind == "f":
            with np.errstate(all="ignore"):
                flat[choose.randrange(flat.size)] = number
        elif flat.dtype.kind in "iu":
            limits = np.iinfo(flat.dtype)
            flat[choose.randrange(flat.size)] = choose.choice((limits.min, limits.max, 0, 1, limits.max // 2 + 1))
        return flat.reshape(array.shape)

    _change_dataset(choose, elements, change)


def _rename(choose: random.Random, elements: Elements) -> None:
    place = _some_dataset(choose, elements)
    if place is not None:
        name, path = place
        datasets = dict(elements[name].datasets)
        new = choose.choice(("x", f"{path}2", "parameters/%", "a%Z", "a/b/c/d/e/f/g/h/i/j", "rest", "ü\x01"))
        datasets[new] = datasets.pop(path)
        elements[name] = Element(elements[name].type, elements[name].version, datasets)


def _mark(choose: random.Random, elements: Elements) -> None:
    name = choose.choice(sorted(elements))
    element = elements[name]
    type_ = choose.choice((element.type, element.type, "recipe", "surface-mask", "haar-rows", "x\x1b[2J"))
    version = choose.choice((1, 2, 3, 2**31, 2**62, element.version))
    elements[name] = Element(type_, version, element.datasets)


def _move(choose: random.Random, elements: Elements) -> None:
    name = choose.choice(sorted(elements))
    new = choose.choice(("recipe", "receiver-mask", "caster-mask", "offset", "emission", "rows", "made-against", "new"))
    elements[new] = elements[name]
    if choose.random() < 0.5 and new != name and len(elements) > 1:
        del elements[name]


def _remove(choose: random.Random, elements: Elements) -> None:
    if len(elements) > 1:
        del elements[choose.choice(sorted(elements))]


def _grow(choose: random.Random, elements: Elements) -> None:
    """Consistent columns of many surfaces, whose sums and products overflow or are large."""
    count = choose.choice((0, 1, 1000))
    faces = np.full(count, choose.choice((0, 1, 2**31, 2**62, -1, -(2**62))), np.int64)
    shape = choose.choice(((0, 1, 1), (count, 1, 1), (1, 700, 700), (0, 2**20, 2**20), (2**20, 1, 1)))
    datasets: dict[str, Array] = {
        "surface-path": np.full(count, b"Wall", "S4"),
        "surface-part": np.zeros(count, "S1"),
        "surface-topology-digest": np.zeros(count, "S1"),
        "surface-instance-id": np.full(count, -1, np.int64),
        "surface-n-faces": faces,
        "texels": np.zeros(shape, np.uint8),
    }
    if choose.random() < 0.5:
        datasets["rest"] = np.zeros((shape[0], 2, 2, 3), choose.choice((np.uint16, np.float32)))
        datasets["rest-box"] = np.full((count, 2, 3), choose.choice((0.0, 3e38, np.inf)), np.float32)
    elements[choose.choice(("receiver-mask", "caster-mask"))] = Element("surface-mask", 2, datasets)


_ELEMENT_CHANGES: tuple[Callable[[random.Random, Elements], None], ...]
_ELEMENT_CHANGES = (_drop, _retype, _reshape, _set_value, _set_value, _rename, _mark, _move, _remove, _grow)


# Files with valid digests ---------------------------------------------------------------------------------------------

_STORAGES = ("soft", "external-link", "external-storage", "virtual", "plug-in", "lzf", "bomb", "holes", "huge", "ring")
_STORAGES += ("alias", "alias-ring", "vlen", "compound", "user-block", "many", "reference")


def _write(path: Path, elements: Elements, choose: random.Random, storage: str | None, secret: Path) -> None:
    try:
        digest = digest_of(elements)
    except IcheatError:
        digest = "0" * 64
    block = 512 if storage == "user-block" else 0
    with h5py.File(path, "w", libver=("v108", "v110"), userblock_size=block, locking=False) as root:
        old = {"a" * 64: digest} if storage == "alias" else {}
        writer.fill_root(root, {}, [History("ann", choose.choice(("why", "\x1b]0;x\x07", "")), "")], old)
        writer.write_payload(root["payloads"], digest, _writable(elements))
        if storage == "alias-ring":
            for one, two in (("b" * 64, "c" * 64), ("c" * 64, "b" * 64)):
                place = root.require_group(f"aliases/{one}")
                place["payload"] = np.bytes_(two)
        place = _some_dataset(choose, elements)
        if storage is not None and place is not None:
            _hostile(root, f"payloads/{digest}/{place[0]}/{place[1]}", storage, secret, choose)


def _writable(elements: Mapping[str, Element]) -> Mapping[str, Element]:
    """Without datasets that lie where another's group does, which no file can hold."""
    kept: dict[str, Element] = {}
    for name, element in elements.items():
        paths = set(element.datasets)
        datasets = {
            path: array
            for path, array in element.datasets.items()
            if not any(other != path and other.startswith(path + "/") for other in paths)
        }
        kept[name] = Element(element.type, element.version, datasets)
    return kept


def _hostile(root: h5py.Group, path: str, storage: str, secret: Path, choose: random.Random) -> None:
    if path not in root:
        return
    values = np.asarray(root[path])
    if storage in ("alias", "alias-ring", "user-block"):
        return
    if storage == "ring":
        parent = root[path].parent
        for name in ("ring", "rang", "rung"):
            parent[name] = parent
        return
    del root[path]
    if storage == "soft":
        root[path] = h5py.SoftLink(choose.choice(("/payloads", "/nowhere", path)))
    elif storage == "external-link":
        root[path] = h5py.ExternalLink(str(secret / choose.choice(("file.h5", "raw.bin"))), "/x")
    elif storage == "external-storage":
        root.create_dataset(path, shape=(8,), dtype="u1", external=[(str(secret / "raw.bin"), 0, h5py.h5f.UNLIMITED)])
    elif storage == "virtual":
        layout = h5py.VirtualLayout(shape=(4,), dtype="f8")
        layout[:] = h5py.VirtualSource(str(secret / "file.h5"), "x", shape=(4,))
        root.create_virtual_dataset(path, layout)
    elif storage == "plug-in":
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk((8,))
        plist.set_filter(choose.choice((32001, 32015, 32099, 307, 1000)), h5py.h5z.FLAG_OPTIONAL, (1, 2))
        parent, _, name = path.rpartition("/")
        space = h5py.h5s.create_simple((8,))
        made = h5py.h5d.create(root.require_group(parent).id, name.encode(), h5py.h5t.IEEE_F64LE, space, plist)
        made.write_direct_chunk((0,), bytes(64))
    elif storage == "lzf":
        root.create_dataset(path, data=np.zeros(100), compression="lzf")
    elif storage == "bomb":
        root.create_dataset(path, shape=(1 << 16,), dtype="u1", chunks=(1 << 16,), compression=1)
        root[path].id.write_direct_chunk((0,), _bomb())
    elif storage == "holes":
        root.create_dataset(path, shape=(100,), dtype="f8", chunks=(10,))[:50] = 1.0
    elif storage == "huge":
        shape = choose.choice(((1 << 40,), (1 << 20, 1 << 20), (1 << 31, 1 << 31), (5 << 20,)))
        root.create_dataset(path, shape=shape, dtype="f8", chunks=(1024,) * len(shape) if len(shape) < 2 else (32, 32))
    elif storage == "vlen":
        root.create_dataset(path, data=["scale"] * 4, dtype=h5py.string_dtype())
    elif storage == "compound":
        root.create_dataset(path, data=np.zeros(3, [("a", "f4"), ("b", "i4")]))
    elif storage == "reference":
        root.create_dataset(path, data=root["payloads"].ref, dtype=h5py.ref_dtype)
    elif storage == "many":
        group = root.require_group(path)
        for number in range(300):
            group.create_dataset(f"{number}", data=values)


@cache
def _bomb() -> bytes:
    packer = zlib.compressobj(9)
    return b"".join(packer.compress(bytes(1 << 20)) for _ in range(64)) + packer.flush()


def make_secret(folder: Path) -> Path:
    """A folder with files that mutated sidecars point to."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "raw.bin").write_bytes(bytes(range(64)))
    with h5py.File(folder / "file.h5", "w") as file:
        file["x"] = np.arange(4.0)
    return folder
