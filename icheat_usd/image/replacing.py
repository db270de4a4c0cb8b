"""Files that appear whole or not at all."""

from __future__ import annotations

import fcntl
import os
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from icheat_usd.errors import ImageError

#: A temporary file younger than this may be one that its writer has not locked yet.
_SETTLED_SECONDS = 1.0


@contextmanager
def replacing(target: Path) -> Iterator[Path]:
    """A temporary file beside `target` that takes its place when the block ends well and vanishes otherwise.

    What an earlier writer of the same file left when it was killed is removed.

    Raises
    ------
    ImageError
        The folder is missing or cannot be written.
    """
    temporary, held = _temporary(target)
    try:
        # The lock goes with the process, however it ends: it tells others that this file is being written.
        with suppress(OSError):
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield temporary
        # A name must not survive a power cut that its content does not.
        _flush(temporary)
        os.replace(temporary, target)
    except OSError as problem:
        raise ImageError(f"{target}: cannot write the image ({problem.strerror or problem})") from problem
    finally:
        os.close(held)
        temporary.unlink(missing_ok=True)


def check_writable(target: Path) -> None:
    """Find out whether a file can be made, which is better known before hours of work.

    Raises
    ------
    ImageError
        The folder is missing or cannot be written.
    """
    temporary, held = _temporary(target)
    os.close(held)
    temporary.unlink(missing_ok=True)


def _temporary(target: Path) -> tuple[Path, int]:
    """A new file beside `target`, open."""
    if not target.parent.is_dir():
        raise ImageError(f"{target}: there is no folder '{target.parent}'; make it first or choose another path")
    if target.is_dir():
        raise ImageError(f"{target}: is a folder; name a file in it")
    remove_abandoned(target)
    try:
        # Opened by name with the usual mode, not by mkstemp, so that the umask decides who may read the image.
        temporary = target.parent / f".{target.name}.{secrets.token_hex(4)}.tmp"
        return temporary, os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
    except OSError as problem:
        raise ImageError(
            f"{target}: cannot write in this folder ({problem.strerror}); choose another path"
        ) from problem


def remove_abandoned(target: Path) -> None:
    """Remove temporary files of `target` whose writers are gone."""
    for left in target.parent.glob(f".{_literal(target.name)}.????????.tmp"):
        with suppress(OSError):
            if time.time() - left.stat().st_mtime < _SETTLED_SECONDS:
                continue
            held = os.open(left, os.O_RDWR)
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
                left.unlink()
            finally:
                os.close(held)


def _literal(name: str) -> str:
    return "".join(f"[{letter}]" if letter in "*?[" else letter for letter in name)


def _flush(path: Path) -> None:
    held = os.open(path, os.O_RDONLY)
    try:
        os.fsync(held)
    finally:
        os.close(held)
