"""Opening and reading HDF5 files that nobody vouches for.

Nothing is taken at its word: links are looked at before they are followed,
sizes before anything is read, and chunks are decompressed here with a known
upper bound, never by HDF5's filter pipeline, so that a file can neither load
a plug-in nor unfold into more memory than it declares.
"""

from __future__ import annotations

import io
import math
import os
import re
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, BinaryIO

import h5py
import numpy as np

from icheat_usd.errors import SidecarError
from icheat_usd.sidecar.canonical import Array, Element, alias_check, digest_of, kind_of
from icheat_usd.sidecar.registry import check_known
from icheat_usd.sidecar.values import shown

FORMAT = "icheat-sidecar"
FORMAT_VERSION = 1

#: A payload that declares more than this is refused unless the caller raises the limit.
MAX_PAYLOAD_BYTES = 1 << 30
#: Larger chunks than the format allows are refused; one chunk and its compressed form are in memory at a time.
MAX_CHUNK_BYTES = 1 << 26

_MAX_OBJECTS = 1 << 16
_MAX_DEPTH = 8
_MAX_NAME = 1024
_DIGEST = re.compile(r"[0-9a-f]{64}")
_SHUFFLE, _DEFLATE, _FLETCHER32 = h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_FLETCHER32
_RESTORE = "restore the file from a copy"

#: What a sidecar is read from: a path, the bytes of a file (as `Ar.OpenAsset` gives them), or an open binary file.
Source = str | os.PathLike[str] | bytes | bytearray | memoryview | BinaryIO

# What h5py is seen to raise for damaged files.
_DAMAGE = (OSError, RuntimeError, ValueError, TypeError, KeyError, OverflowError, MemoryError, UnicodeError)


@contextmanager
def open_sidecar(file: Source, where: str) -> Iterator[h5py.Group]:
    """The root group of a file that says it is a sidecar of a version this package reads."""
    source: Any = io.BytesIO(file) if isinstance(file, (bytes, bytearray, memoryview)) else file
    if isinstance(source, (str, os.PathLike)):
        source = os.fspath(source)
        if not os.path.isfile(source):
            raise SidecarError(f"{where}: there is no such sidecar file; check icheat:filePath or copy the file there")
    try:
        # Written once, so there is nothing to lock; locking fails on some network file systems.
        opened = h5py.File(source, "r", locking=False) if isinstance(source, str) else h5py.File(source, "r")
    except PermissionError as problem:
        raise SidecarError(f"{where}: the sidecar file may not be read; change its permissions") from problem
    except _DAMAGE as problem:
        raise SidecarError(f"{where}: not an HDF5 file, or cut short ({_brief(problem)}); {_RESTORE}") from problem
    with opened:
        with naming_damage(where):
            root = opened["/"]
            if attribute(root, "format", where) != FORMAT:
                raise SidecarError(f"{where}: an HDF5 file, but no icheat sidecar; check icheat:filePath")
            version = attribute(root, "format-version", where)
            if not isinstance(version, int) or version < 1:
                raise SidecarError(f"{where}: 'format-version' is {version!r}; {_RESTORE}")
            if version > FORMAT_VERSION:
                raise SidecarError(
                    f"{where}: sidecar format {version}, and this icheat_usd reads up to {FORMAT_VERSION}; "
                    "update icheat_usd"
                )
        yield root


def read_elements(
    root: h5py.Group, digest: str, where: str, limit_bytes: int, *, refuse_newer: bool = False
) -> dict[str, Element]:
    """All elements of a payload as they are stored, their digest verified; newer ones may be kept for copying.

    A digest that the file has as an alias gives the payload that the alias names, verified under that payload's digest.
    """
    with naming_damage(where):
        payloads = child_group(root, "payloads", where)
        asked = digest
        if not is_digest(digest) or not payloads.id.links.exists(digest.encode()):
            digest = _alias_target(root, asked, where) or asked
        if not is_digest(digest) or not payloads.id.links.exists(digest.encode()):
            names = payload_names(root, where)
            held = ", ".join(name[:12] for name in names[:5]) + (", ..." if len(names) > 5 else "")
            raise SidecarError(
                f"{where}: there is no payload '{shown(asked[:64])}'; the file holds {held or 'none'}: "
                "point icheat:filePath to the file that was written with it"
            )
        payload = child_group(payloads, digest, where)
        elements: dict[str, Element] = {}
        budget, count, seen = [limit_bytes], [0], set[int]()
        for name in link_names(payload, where):
            place = f"{where}: payload {digest[:12]}: element '{shown(name)}'"
            group = child_group(payload, name, f"{where}: payload {digest[:12]}")
            type_, version = element_mark(group, place)
            if refuse_newer:
                # Before the values: those of a newer element may look like damage.
                check_known(name, type_, version, f"{where}: payload {digest[:12]}")
            check_first_sight(group, seen, place)
            datasets: dict[str, Array] = {}
            for path, dataset in datasets_below(group, place, count):
                check_first_sight(dataset, seen, place)
                datasets[path] = read_dataset(dataset, f"{place}: '{shown(path)}'", budget)
            elements[name] = Element(type_, version, datasets)
        try:
            found = digest_of(elements)
        except SidecarError as problem:
            raise SidecarError(f"{where}: payload {digest[:12]}: {problem}") from problem
    if found != digest:
        raise SidecarError(
            f"{where}: payload {digest[:12]} is damaged: its contents have digest {found[:12]}; {_RESTORE}"
        )
    return elements


@contextmanager
def naming_damage(where: str) -> Iterator[None]:
    try:
        yield
    except SidecarError:
        raise
    except _DAMAGE as problem:
        raise SidecarError(f"{where}: the file is damaged ({_brief(problem)}); {_RESTORE}") from problem


def payload_names(root: h5py.Group, where: str) -> list[str]:
    with naming_damage(where):
        names = link_names(child_group(root, "payloads", where), where)
    for name in names:
        if not is_digest(name):
            raise SidecarError(f"{where}: '/payloads/{shown(name)}' is not named by a digest; {_RESTORE}")
    return names


def is_digest(name: str) -> bool:
    """Whether a text can name a payload."""
    return _DIGEST.fullmatch(name) is not None


def aliases_of(root: h5py.Group, where: str) -> dict[str, str]:
    """Digests that payloads of this file had before they were stored anew, and those they have now."""
    with naming_damage(where):
        if not root.id.links.exists(b"aliases"):
            return {}
        names = link_names(child_group(root, "aliases", where), where)
        return {name: target for name in names if (target := _alias_target(root, name, where)) is not None}


def _alias_target(root: h5py.Group, digest: str, where: str) -> str | None:
    if not is_digest(digest) or not root.id.links.exists(b"aliases"):
        return None
    aliases = child_group(root, "aliases", where)
    if not aliases.id.links.exists(digest.encode()):
        return None
    place = f"{where}: alias {digest[:12]}"
    texts: dict[str, str] = {}
    for path, dataset in datasets_below(child_group(aliases, digest, where), place, [0]):
        values = read_dataset(dataset, f"{place}: '{shown(path)}'", [1 << 16])
        if values.dtype.kind == "S" and values.ndim == 0:
            texts[path] = values.tobytes().rstrip(b"\0").decode()
    target = texts.get("payload", "")
    if not is_digest(target) or texts.get("check") != alias_check(digest, target):
        raise SidecarError(f"{place} is damaged; {_RESTORE}")
    return target


def link_names(group: h5py.Group, where: str) -> list[str]:
    names: list[str] = []
    for name in group:
        if not isinstance(name, str) or len(name) > _MAX_NAME or len(names) >= _MAX_OBJECTS:
            raise SidecarError(
                f"{where}: group '{shown(str(group.name))}' has too many or impossible names; {_RESTORE}"
            )
        name.encode()
        names.append(name)
    return sorted(names, key=str.encode)


def _child(group: h5py.Group, name: str, where: str) -> Any:
    # Looked at before it is followed: opening an external link opens another file.
    if group.id.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
        raise SidecarError(
            f"{where}: '{shown(name)}' is a soft or external link, which sidecars must not have; {_RESTORE}"
        )
    return group[name]


def child_group(group: h5py.Group, name: str, where: str) -> h5py.Group:
    if not group.id.links.exists(name.encode()):
        raise SidecarError(f"{where}: there is no group '{shown(name)}'; {_RESTORE}")
    child = _child(group, name, where)
    if not isinstance(child, h5py.Group):
        raise SidecarError(f"{where}: '{shown(name)}' is not a group; {_RESTORE}")
    return child


def datasets_below(
    group: h5py.Group, where: str, count: list[int], prefix: str = ""
) -> Iterator[tuple[str, h5py.Dataset]]:
    """Datasets below an element, by path; bounded, because hard links may form rings."""
    for name in link_names(group, where):
        count[0] += 1
        if count[0] > _MAX_OBJECTS or prefix.count("/") >= _MAX_DEPTH:
            raise SidecarError(f"{where}: more than {_MAX_OBJECTS} objects or {_MAX_DEPTH} levels; {_RESTORE}")
        child = _child(group, name, where)
        if isinstance(child, h5py.Dataset):
            yield prefix + name, child
        elif isinstance(child, h5py.Group):
            yield from datasets_below(child, where, count, f"{prefix}{name}/")
        else:
            raise SidecarError(f"{where}: '{shown(prefix + name)}' is neither group nor dataset; {_RESTORE}")


def check_first_sight(thing: h5py.Group | h5py.Dataset, seen: set[int], where: str) -> None:
    """Refuse an object that has been seen under another name: a small file could list one as billions."""
    address = int(h5py.h5o.get_info(thing.id).addr)
    if address in seen:
        raise SidecarError(f"{where}: '{shown(str(thing.name))}' has more than one name; {_RESTORE}")
    seen.add(address)


def element_mark(group: h5py.Group, where: str) -> tuple[str, int]:
    type_, version = attribute(group, "element-type", where), attribute(group, "element-version", where)
    if not isinstance(type_, str) or not isinstance(version, int) or version < 1:
        raise SidecarError(f"{where}: 'element-type' or 'element-version' is missing or no text and number; {_RESTORE}")
    return type_, version


def attribute(group: h5py.Group, name: str, where: str) -> str | int | None:
    """A scalar attribute, text of fixed length or integer; None where it is absent."""
    if not h5py.h5a.exists(group.id, name.encode()):
        return None
    opened = h5py.h5a.open(group.id, name.encode())
    dtype = opened.dtype
    if opened.shape != () or dtype.kind not in "Siu" or not 0 < dtype.itemsize <= _MAX_NAME:
        raise SidecarError(f"{where}: attribute '{name}' is no short text or integer; {_RESTORE}")
    value = np.zeros((), dtype=dtype)
    opened.read(value)
    return value.tobytes().rstrip(b"\0").decode() if dtype.kind == "S" else int(value)


def read_dataset(dataset: h5py.Dataset, where: str, budget: list[int]) -> Array:
    """A dataset's values, after everything it declares was checked."""
    plist = dataset.id.get_create_plist()
    layout = plist.get_layout()
    if layout == h5py.h5d.VIRTUAL or (layout == h5py.h5d.CONTIGUOUS and plist.get_external_count() > 0):
        raise SidecarError(f"{where} takes its values from other files, which sidecars must not do; {_RESTORE}")
    if dataset.shape is None:
        raise SidecarError(f"{where} has no values; {_RESTORE}")
    dtype, shape = dataset.dtype, tuple(int(size) for size in dataset.shape)
    if kind_of(dtype) is None or dtype.itemsize < 1:
        raise SidecarError(f"{where} holds {dtype}, which sidecars must not; {_RESTORE}")
    declared = math.prod(shape) * dtype.itemsize
    if declared > budget[0]:
        raise SidecarError(
            f"{where} declares {declared:,} bytes, more than the {budget[0]:,} left of the limit for a payload; "
            "raise limit_bytes if you trust the file"
        )
    budget[0] -= declared
    if layout == h5py.h5d.CHUNKED:
        return _read_chunks(dataset, plist, dtype, shape, where)
    if int(dataset.id.get_storage_size()) not in (0, declared):
        raise SidecarError(f"{where} stores another number of bytes than it declares; {_RESTORE}")
    values = np.zeros(shape, dtype=dtype)
    if declared:
        dataset.read_direct(values)
    return values.astype(dtype.newbyteorder("="), copy=False)


def _read_chunks(dataset: h5py.Dataset, plist: Any, dtype: np.dtype[Any], shape: tuple[int, ...], where: str) -> Array:
    filters = [plist.get_filter(index)[0] for index in range(plist.get_nfilters())]
    if set(filters) - {_SHUFFLE, _DEFLATE, _FLETCHER32} or len(set(filters)) != len(filters):
        raise SidecarError(f"{where} uses HDF5 filters {filters}; only shuffle, deflate and fletcher32 are allowed")
    chunk_shape = tuple(int(size) for size in dataset.chunks)
    chunk_bytes = math.prod(chunk_shape) * dtype.itemsize
    if chunk_bytes > MAX_CHUNK_BYTES:
        raise SidecarError(f"{where} has chunks of {chunk_bytes:,} bytes; at most {MAX_CHUNK_BYTES:,} are allowed")
    if dataset.fillvalue != np.zeros((), dtype=dtype)[()]:
        raise SidecarError(f"{where} has a fill value; sidecars store every value")
    n_chunks = math.prod(-(-size // step) for size, step in zip(shape, chunk_shape, strict=True))
    if n_chunks != int(dataset.id.get_num_chunks()):
        raise SidecarError(f"{where} stores {dataset.id.get_num_chunks()} of {n_chunks} chunks; {_RESTORE}")
    values = np.zeros(shape, dtype=dtype)
    for selection in dataset.iter_chunks() if values.size else ():
        corner = tuple(axis.start for axis in selection)
        stored = int(dataset.id.get_chunk_info_by_coord(corner).size)
        # Deflate never grows data by more than 0.1 % and a few bytes; more is not a chunk of ours.
        if stored > chunk_bytes + chunk_bytes // 100 + 64:
            raise SidecarError(f"{where}: a chunk of {chunk_bytes:,} bytes claims {stored:,} stored; {_RESTORE}")
        mask, raw = dataset.id.read_direct_chunk(corner)
        unfolded = _unfiltered(raw, mask, filters, dtype.itemsize, chunk_bytes, where)
        inside = tuple(slice(0, axis.stop - axis.start) for axis in selection)
        values[selection] = np.frombuffer(unfolded, dtype=dtype).reshape(chunk_shape)[inside]
    return values.astype(dtype.newbyteorder("="), copy=False)


def _unfiltered(raw: bytes, mask: int, filters: list[int], itemsize: int, size: int, where: str) -> bytes:
    """One chunk through its filters backwards, never growing beyond `size` bytes."""
    for index in reversed(range(len(filters))):
        if mask >> index & 1:
            continue
        if filters[index] == _FLETCHER32:
            # The checksum needs no check of its own: the payload's digest covers every value.
            raw = raw[:-4]
        elif filters[index] == _DEFLATE:
            inflater = zlib.decompressobj()
            try:
                # The four bytes more leave room for a checksum that was appended before compression.
                raw = inflater.decompress(raw, size + 4)
            except zlib.error as problem:
                raise SidecarError(f"{where} has a damaged chunk ({problem}); {_RESTORE}") from problem
            if inflater.unconsumed_tail or not inflater.eof:
                raise SidecarError(f"{where} has a chunk that unfolds to more than it declares; {_RESTORE}")
        elif itemsize > 1:
            whole = len(raw) // itemsize * itemsize
            planes = np.frombuffer(raw, np.uint8, whole).reshape(itemsize, -1)
            raw = planes.T.tobytes() + raw[whole:]
    if len(raw) != size:
        raise SidecarError(f"{where} has a chunk of {len(raw):,} bytes instead of {size:,}; {_RESTORE}")
    return raw


def file_name(file: Source, name: str | None) -> str:
    if name is not None:
        return name
    return os.fspath(file) if isinstance(file, (str, os.PathLike)) else "sidecar in memory"


def _brief(problem: BaseException) -> str:
    return (str(problem).splitlines() or [""])[0][:120] or type(problem).__name__
