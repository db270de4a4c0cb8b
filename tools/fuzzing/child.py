"""Reads mutated files one after the other and says how each went; killed by the first that crashes or hangs it.

    python -m tools.fuzzing.child KIND BEGIN END FOLDER

Writes one line per case to FOLDER/outcomes: number and outcome. A case that has no line killed the process.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import signal
import struct
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

#: Seconds that one case may take; the operating system then kills the process, whatever library it hangs in.
CASE_SECONDS = 20

#: Address space beyond what the process has after the first cases.
_ADDRESS_SPACE = 2 << 30


def main(kind: str, begin: int, end: int, folder: Path) -> None:
    case, read = _makers(kind, folder)
    watch = _OpenWatch(folder / "secret")
    # The first reads load libraries; memory is measured from there.
    for number in (0, 1):
        _outcome(lambda number=number: read(case(number)))  # type: ignore[misc]
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + _ADDRESS_SPACE, used + _ADDRESS_SPACE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    watch.events()
    with open(folder / "outcomes", "a", encoding="utf-8") as outcomes:
        for number in range(begin, end):
            path = case(number)
            watch.events()  # making a case may look at the secret
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            signal.alarm(CASE_SECONDS)
            outcome = _outcome(lambda path=path: read(path))  # type: ignore[misc]
            signal.alarm(0)
            after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            if watch.events():
                outcome = f"a file outside was opened, {outcome}"
            outcomes.write(json.dumps([number, outcome, (after - before) * 1024]) + "\n")
            outcomes.flush()


def _makers(kind: str, folder: Path) -> tuple[Callable[[int], Path], Callable[[Path], str]]:
    if kind == "sidecar":
        from tools.fuzzing import sidecars

        secret = sidecars.make_secret(folder / "secret")
        return lambda number: sidecars.case(number, folder, secret), sidecars.read
    from tools.fuzzing import layers

    (folder / "secret").mkdir(exist_ok=True)
    return lambda number: layers.case(number, folder), layers.read


def _outcome(read: Callable[[], str]) -> str:
    try:
        return read()
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        own = [frame for frame in traceback.extract_tb(error.__traceback__) if "/icheat_usd/" in frame.filename]
        where = own[-1] if own else place
        return f"wrong: {type(error).__name__}: {str(error)[:300]} ({os.path.basename(where.filename)}:{where.lineno})"


class _OpenWatch:
    """Tells when a file in a folder is opened, through inotify."""

    _IN_OPEN = 0x20

    def __init__(self, folder: Path) -> None:
        libc = ctypes.CDLL(None, use_errno=True)
        self._descriptor = libc.inotify_init1(os.O_NONBLOCK)
        if self._descriptor < 0 or libc.inotify_add_watch(self._descriptor, os.fsencode(folder), self._IN_OPEN) < 0:
            raise OSError(ctypes.get_errno(), "inotify is needed to see what is opened")

    def events(self) -> int:
        try:
            content = os.read(self._descriptor, 1 << 16)
        except BlockingIOError:
            return 0
        count = offset = 0
        while offset < len(content):
            mask, length = struct.unpack_from("iIII", content, offset)[1::2]
            count += mask == self._IN_OPEN  # not folders that are listed
            offset += 16 + length
        return count


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]))
