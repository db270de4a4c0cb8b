"""What is expensive to compute, kept on disk by content: transports, and what belongs to them.

    <cache folder>/transport/<kind>-<key>/<part>-<digest>.npz

A *shelf* (a folder) holds the parts of one product; its key is a digest of
everything the product depends on (see `content_keys`), so nothing here ever
goes stale: it is only forgotten. A part is written to a temporary file, flushed
and renamed, so that it is there whole or not at all, and carries a digest of
its bytes in its name, so that a damaged one is noticed and dropped. A build
that is stopped goes on from the parts that are there. Whole products are
written by a thread of their own: nobody waits for the disk but who looks there.

Folders that were used last longest ago are removed when all together exceed
``$ICHEAT_CACHE_SIZE`` (such as ``20G``; 0 keeps nothing).
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any
from uuid import uuid4

from icheat_usd.cache_folder import cache_folder
from icheat_usd.errors import IcheatError
from icheat_usd.session import parts

#: Bytes that the cache may take if ``$ICHEAT_CACHE_SIZE`` says nothing: a dozen uncompressed previews.
DEFAULT_SIZE = 10 * 10**9
_ABOUT = "about.json"
_DIGITS = 24
_UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}
#: A temporary file older than this was left by a process that was killed.
_ABANDONED_SECONDS = 24 * 3600.0


def size_limit() -> int:
    """Bytes that the cache may take: ``$ICHEAT_CACHE_SIZE``, else `DEFAULT_SIZE`.

    Raises
    ------
    IcheatError
        The variable holds no size.
    """
    text = os.environ.get("ICHEAT_CACHE_SIZE", "").strip()
    return parse_size(text, "ICHEAT_CACHE_SIZE") if text else DEFAULT_SIZE


def parse_size(text: str, where: str) -> int:
    """Bytes, as people write them.

    Raises
    ------
    IcheatError
        It is no size; the message begins with `where`.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?)I?B?", text.strip().upper())
    if match is None:
        raise IcheatError(f"{where} is '{text}', which is no size such as 20G or 500M; 0 keeps nothing")
    return int(float(match[1]) * _UNITS[match[2]])


@dataclass(frozen=True)
class ShelfInfo:
    """One product in the cache."""

    kind: str  #: "transport", "view", …
    key: str
    folder: Path
    bytes: int
    used: float  #: seconds since the epoch
    about: Mapping[str, Any]  #: what it was made for, for people


class _Writing:
    """Work for the disk that goes on behind its caller's back, one piece after another; the program ends after it."""

    def __init__(self) -> None:
        self._lock, self._own = threading.Lock(), threading.local()
        self._last: dict[Path, threading.Thread] = {}  # that works on each folder
        self._error: Exception | None = None

    def start(self, folder: Path, work: Callable[[], None]) -> None:
        """Do something in a folder once all that was asked for before is done."""
        with self._lock:
            before = list(self._last.values())
            thread = threading.Thread(target=self._run, args=(before, work), name="icheat disk")
            self._last = {other: one for other, one in self._last.items() if one.is_alive()} | {folder: thread}
            thread.start()

    def _run(self, before: list[threading.Thread], work: Callable[[], None]) -> None:
        self._own.works = True
        for thread in before:
            thread.join()
        try:
            work()
        except Exception as error:
            self._error = error

    def wait(self, folder: Path | None = None) -> None:
        """Until nothing is under way in a folder, by default in any; raises what went wrong."""
        if getattr(self._own, "works", False):
            return  # the work itself looks
        with self._lock:
            threads = [one for other, one in self._last.items() if folder in (None, other)]
        for thread in threads:
            thread.join()
        if (error := self._error) is not None:
            self._error = None
            raise error


_WRITING = _Writing()


class Shelf:
    """The parts of one product. All methods may be called from several threads and processes."""

    def __init__(self, cache: DiskCache, folder: Path, about: Mapping[str, Any]) -> None:
        self._cache, self.folder, self._about = cache, folder, about

    def load(self, name: str) -> Any | None:
        """A part, or None where it is missing or damaged; a damaged one is removed."""
        _WRITING.wait(self.folder)
        for path in sorted(self.folder.glob(f"{_checked(name)}-{'?' * _DIGITS}.npz")):
            try:
                with open(path, "rb") as file:
                    if _digest(file) != path.stem[-_DIGITS:]:
                        raise ValueError("its bytes are not those that were written")
                    value = parts.read(file)
            except (OSError, ValueError):
                with suppress(OSError):
                    path.unlink()
                continue
            with suppress(OSError):
                os.utime(self.folder)
            return value
        return None

    def save(self, name: str, value: Any) -> None:
        """Keep a part. What does not fit on the disk is not kept: the cache only saves time."""
        if not self._cache.is_on:
            return
        with suppress(OSError):
            self.folder.mkdir(parents=True, exist_ok=True)
            if not (self.folder / _ABOUT).exists():
                about = json.dumps(dict(self._about), indent=1).encode()
                _write(self.folder, lambda file: file.write(about), lambda _: _ABOUT)
            path = _write(
                self.folder,
                lambda file: parts.write(file, value),
                lambda file: f"{_checked(name)}-{_digest(file)}.npz",
            )
            for other in self.folder.glob(f"{name}-{'?' * _DIGITS}.npz"):
                if other != path:
                    other.unlink(missing_ok=True)
        self._cache.trim(keep=self.folder)

    def keep_whole(self, value: Any) -> None:
        """Keep the product as one part, `whole`, instead of its pieces; goes on while the caller does."""

        def keep() -> None:
            self.save("whole", value)
            self.drop(*(name for name in self.names() if name != "whole"))

        _WRITING.start(self.folder, keep)

    def drop(self, *names: str) -> None:
        """Forget parts, such as the pieces of a whole that is kept now."""
        for name in names:
            for path in self.folder.glob(f"{_checked(name)}-{'?' * _DIGITS}.npz"):
                with suppress(OSError):
                    path.unlink()

    def names(self) -> tuple[str, ...]:
        """Parts that are there, checked or not."""
        _WRITING.wait(self.folder)
        return tuple(sorted(path.stem[: -_DIGITS - 1] for path in self.folder.glob("*.npz") if path.stem[0] != "."))


class DiskCache:
    """All shelves below one folder.

    Parameters
    ----------
    folder : path, optional
        Below the user's cache folder by default.
    limit : bytes, optional
        `size_limit` by default; 0 keeps nothing and finds nothing.
    """

    def __init__(self, folder: Path | None = None, limit: int | None = None) -> None:
        self.folder = cache_folder("transport") if folder is None else folder
        self.limit = size_limit() if limit is None else limit

    @property
    def is_on(self) -> bool:
        return self.limit > 0

    def shelf(self, kind: str, key: str, about: Mapping[str, Any] | None = None) -> Shelf:
        """The shelf of a product; nothing is made on disk before something is kept."""
        return Shelf(self, self.folder / f"{_checked(kind)}-{_checked(key)}", about or {})

    def list(self) -> tuple[ShelfInfo, ...]:
        """All products, the one used last first."""
        _WRITING.wait()
        return tuple(sorted(self._read(), key=lambda info: -info.used))

    def _read(self) -> Iterator[ShelfInfo]:
        for folder in self.folder.iterdir() if self.folder.is_dir() else ():
            if not folder.is_dir() or "-" not in folder.name:
                continue
            kind, _, key = folder.name.rpartition("-")
            try:
                about = json.loads((folder / _ABOUT).read_text())
            except (OSError, ValueError):
                about = {}
            with suppress(OSError):  # another process may be removing it
                size = sum(file.stat().st_size for file in folder.iterdir())
                yield ShelfInfo(kind, key, folder, size, folder.stat().st_mtime, about)

    def trim(self, keep: Path | None = None) -> int:
        """Remove what was used last longest ago until the limit holds; how many bytes that freed."""
        found = tuple(sorted(self._read(), key=lambda info: -info.used))
        total = sum(info.bytes for info in found)
        freed = 0
        for info in reversed(found):
            freed += _remove_abandoned(info.folder)
            if total - freed > self.limit and info.folder != keep:
                shutil.rmtree(info.folder, ignore_errors=True)
                freed += info.bytes
        return freed

    def clear(self) -> int:
        """Remove everything; how many bytes that freed."""
        found = self.list()
        for info in found:
            shutil.rmtree(info.folder, ignore_errors=True)
        return sum(info.bytes for info in found)


def _checked(name: str) -> str:
    """Names come from this program; one that leaves the folder would be a mistake in it."""
    if not re.fullmatch(r"[A-Za-z0-9_.+-]*[A-Za-z0-9_]", name):
        raise ValueError(f"'{name}' cannot name a part of the cache")
    return name


def _digest(file: IO[bytes]) -> str:
    file.seek(0)
    found = hashlib.file_digest(file, "sha256").hexdigest()[:_DIGITS]  # type: ignore[arg-type]
    file.seek(0)
    return found


def _write(folder: Path, content: Callable[[IO[bytes]], Any], name: Callable[[IO[bytes]], str]) -> Path:
    """All of a file or nothing of it, also if the machine stops; named when its content is known."""
    temporary = folder / f".{uuid4().hex}.tmp"
    try:
        with open(temporary, "w+b") as file:
            content(file)
            file.flush()
            os.fsync(file.fileno())
            path = folder / name(file)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    with suppress(OSError):  # some file systems cannot flush a folder
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    return path


def _remove_abandoned(folder: Path) -> int:
    freed = 0
    for file in folder.glob(".*.tmp"):
        with suppress(OSError):
            if time.time() - file.stat().st_mtime > _ABANDONED_SECONDS:
                size = file.stat().st_size
                file.unlink()
                freed += size
    return freed
