"""Writing sidecar files once: complete and flushed before they get a name, never changed afterwards."""

from __future__ import annotations

import os
import re
import secrets
import socket
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np

from icheat_usd import __version__
from icheat_usd.edits.model import Payload
from icheat_usd.errors import SidecarError
from icheat_usd.sidecar.canonical import Array, Element, alias_check, digest_of
from icheat_usd.sidecar.elements import encode_payload
from icheat_usd.sidecar.guarded import FORMAT, FORMAT_VERSION
from icheat_usd.sidecar.reader import History

SUFFIX = ".icheat.h5"

# Large enough for gzip to find repeats, small enough to read a part; SPEC.md allows up to 64 MiB.
_CHUNK_BYTES = 1 << 20
_FILTER_FROM_BYTES = 1 << 12
_ABANDONED_AFTER_SECONDS = 24 * 3600.0


def write_payloads(
    beside: str | os.PathLike[str],
    payloads: Iterable[Payload],
    *,
    anchor: str,
    history: History | None = None,
) -> tuple[Path, list[str]]:
    """Write payloads into one new file beside a layer.

    Parameters
    ----------
    beside : path
        The layer that will name the file (`shot.usda` gets
        ``shot.v001.icheat.h5``, then ``.v002`` ...); or a folder; or, ending
        in ``.icheat.h5``, the very file to make, which must not exist.
    payloads : iterable of Payload
        Equal ones are stored once.
    anchor : str
        Absolute prim path above every surface that a mask names; the file
        holds paths relative to it.
    history : History, optional
        Who and why. Nothing else of the moment is stored: the same payloads
        give the same bytes.

    Returns
    -------
    (Path, list of str)
        The file, and the digest of each payload in the order given: the
        values of `icheat:filePath` and `icheat:payload`.

    Raises
    ------
    SidecarError
        There is nothing to write, a payload cannot be stored, the file
        exists, or the folder is missing, full or not writable. Nothing is
        left behind then, nor after an interruption.
    """
    encoded = [encode_payload(payload, anchor=anchor) for payload in payloads]
    if not encoded:
        raise SidecarError(f"{os.fspath(beside)}: there are no payloads to write; give at least one")
    digests = [digest_of(elements) for elements in encoded]
    contents = dict(zip(digests, encoded, strict=True))
    entries = [replace(history, payloads=tuple(dict.fromkeys(digests)))] if history else []
    return make_file(Path(beside), lambda root: fill_root(root, contents, entries)), digests


# Contents -------------------------------------------------------------------------------------------------------------


def fill_root(
    root: h5py.Group,
    contents: Mapping[str, Mapping[str, Element]],
    entries: Sequence[History],
    aliases: Mapping[str, str] = MappingProxyType({}),
    *,
    published: bool = False,
) -> None:
    """Everything of a file; `write_payload` may add payloads to it."""
    root.attrs["format"] = _fixed(FORMAT)
    root.attrs["format-version"] = np.int64(FORMAT_VERSION)
    root.attrs["creator"] = _fixed(f"icheat_usd {__version__}")
    if published:
        root.attrs["published"] = np.int64(1)
    group = root.require_group("payloads")
    for digest in sorted(contents):
        write_payload(group, digest, contents[digest])
    history = root.create_group("history")
    for number, entry in enumerate(entries):
        place = history.create_group(f"{number:06d}")
        for key in ("who", "why", "when"):
            _write_dataset(place, key, np.asarray(_fixed(getattr(entry, key))))
        if entry.edit:
            _write_dataset(place, "edit", np.asarray(_fixed(entry.edit)))
        _write_dataset(place, "payloads", np.array([digest.encode() for digest in entry.payloads], dtype="S64"))

    if aliases:
        group = root.create_group("aliases")
        for old, new in sorted(aliases.items()):
            place = group.create_group(old)
            _write_dataset(place, "payload", np.asarray(_fixed(new)))
            _write_dataset(place, "check", np.asarray(_fixed(alias_check(old, new))))


def write_payload(group: h5py.Group, digest: str, elements: Mapping[str, Element]) -> None:
    """One payload under `/payloads`."""
    payload = group.create_group(digest)
    for name, element in sorted(elements.items(), key=lambda item: item[0].encode()):
        place = payload.create_group(name)
        place.attrs["element-type"] = _fixed(element.type)
        place.attrs["element-version"] = np.int64(element.version)
        for path, array in sorted(element.datasets.items(), key=lambda item: item[0].encode()):
            _write_dataset(place, path, array)


def _write_dataset(group: h5py.Group, path: str, array: Array) -> None:
    if array.dtype.kind == "S":
        # HDF5 converts no ASCII to UTF-8 strings: the array itself has to say that it is UTF-8.
        array = array.astype(h5py.string_dtype("utf-8", max(1, array.dtype.itemsize)))
    options: dict[str, Any] = {}
    if array.ndim and array.nbytes >= _FILTER_FROM_BYTES:
        options = {"chunks": _chunks(array), "compression": "gzip", "compression_opts": 1}
        options |= {"shuffle": True, "fletcher32": True}
    group.create_dataset(path, data=np.ascontiguousarray(array) if array.ndim else array, **options)


def _chunks(array: Array) -> tuple[int, ...]:
    """Whole rows, as many as fit; where one row is too large, it is split along the following axes."""
    room, chunks = max(1, _CHUNK_BYTES // array.dtype.itemsize), []
    for size in reversed(array.shape):
        step = max(1, min(size, room))
        chunks.append(step)
        room = max(1, room // step)
    return tuple(reversed(chunks))


def _fixed(value: str) -> Any:
    encoded = value.replace("\0", "").encode("utf-8", "replace")
    return np.array(encoded, dtype=h5py.string_dtype("utf-8", max(1, len(encoded))))[()]


# Files ----------------------------------------------------------------------------------------------------------------


def make_file(beside: Path, fill: Callable[[h5py.Group], None], *, mode: int | None = None) -> Path:
    """Make a file complete under a temporary name, then give it a name that no file has.

    `mode` is its permissions; by default the umask decides.
    """
    exact = beside.name.endswith(SUFFIX)
    folder = beside if beside.is_dir() else beside.parent
    stem = beside.name[: -len(SUFFIX)] if exact else ("edits" if beside.is_dir() else beside.stem)
    if not folder.is_dir():
        raise SidecarError(f"{beside}: there is no folder '{folder}'; make it first")
    if exact and beside.exists():
        raise SidecarError(f"{beside}: exists, and sidecars are never overwritten; choose an unused name")
    _remove_abandoned(folder, stem)
    temporary = _temporary(folder, stem)
    try:
        # Created by name with the usual mode, not by mkstemp, so that the umask decides who may read the file.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        # v108 to v110: every HDF5 since 1.10 reads it, and object headers carry no times.
        with h5py.File(temporary, "w", libver=("v108", "v110"), locking=False) as root:
            fill(root)
        _flush(temporary)
        if mode is not None:
            os.chmod(temporary, mode)
        if exact:
            if not _give_name(temporary, beside):
                raise SidecarError(f"{beside}: exists, and sidecars are never overwritten; choose an unused name")
            final = beside
        else:
            final = _give_unused_name(temporary, folder, stem)
        _flush(folder)
        return final
    except SidecarError:
        raise
    except (OSError, RuntimeError, ValueError) as problem:
        reason = getattr(problem, "strerror", None) or str(problem).splitlines()[0]
        raise SidecarError(
            f"{beside}: cannot write a sidecar in '{folder}' ({reason}); free space, change permissions or choose "
            "another place"
        ) from problem
    finally:
        with suppress(OSError):
            temporary.unlink()


def write_text_beside(sidecar: Path, suffix: str, content: str) -> Path:
    """Write a read-only text file called as a sidecar but for its suffix, complete or not at all.

    Raises
    ------
    SidecarError
        It exists or cannot be written.
    """
    final = sidecar.with_name(sidecar.name.removesuffix(SUFFIX) + suffix)
    # Called as those of the sidecar's own versions, so that their next writer removes what a killed one left.
    temporary = _temporary(final.parent, re.sub(r"\.v\d+$", "", sidecar.name.removesuffix(SUFFIX)))
    try:
        with temporary.open("x", encoding="utf-8") as opened:
            opened.write(content)
        _flush(temporary)
        os.chmod(temporary, 0o444)
        if not _give_name(temporary, final):
            raise SidecarError(f"{final} exists, and is never overwritten; choose an unused name")
        _flush(final.parent)
        return final
    except OSError as problem:
        raise SidecarError(f"{final} cannot be written ({problem.strerror}); check permissions and space") from problem
    finally:
        with suppress(OSError):
            temporary.unlink()


def _temporary(folder: Path, stem: str) -> Path:
    return folder / f".{stem}.{socket.gethostname()}.{os.getpid()}.{secrets.token_hex(4)}.icheat-tmp"


def _give_unused_name(temporary: Path, folder: Path, stem: str) -> Path:
    pattern = re.compile(re.escape(stem) + r"\.v(\d+)" + re.escape(SUFFIX))
    taken = [int(match[1]) for name in os.listdir(folder) if (match := pattern.fullmatch(name))]
    version = max(taken, default=0) + 1
    while True:
        final = folder / f"{stem}.v{version:03d}{SUFFIX}"
        if _give_name(temporary, final):
            return final
        version += 1  # another writer was faster


def _give_name(temporary: Path, final: Path) -> bool:
    """Name a finished file; False where the name is taken. It never shows an incomplete file under that name."""
    try:
        os.link(temporary, final)
        return True
    except FileExistsError:
        return False
    except OSError:
        pass  # no hard links on this file system
    # Claim the name with an empty file, then put the finished one in its place: both steps are atomic. A crash in
    # between leaves the empty file, which no layer names yet.
    try:
        os.close(os.open(final, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    except FileExistsError:
        return False
    try:
        os.replace(temporary, final)
    except BaseException:
        with suppress(OSError):
            final.unlink()
        raise
    return True


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError:
        # Some file systems cannot flush a folder; the file itself must be on the disk.
        if not path.is_dir():
            raise
    finally:
        os.close(descriptor)


def _remove_abandoned(folder: Path, stem: str) -> None:
    """Remove temporary files of writers that were killed: dead on this machine, or a day old on another."""
    pattern = re.compile(rf"\.{re.escape(stem)}\.(.+)\.(\d+)\.[0-9a-f]{{8}}\.icheat-tmp")
    with suppress(OSError):
        for name in os.listdir(folder):
            if (match := pattern.fullmatch(name)) is None:
                continue
            if match[1] == socket.gethostname():
                abandoned = not _is_running(int(match[2]))
            else:
                abandoned = time.time() - (folder / name).stat().st_mtime > _ABANDONED_AFTER_SECONDS
            if abandoned:
                (folder / name).unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
