"""What a command is about to compute with is compiled by all cores first, where it has not been compiled yet."""

from __future__ import annotations

import sys

from icheat_usd.errors import IcheatError
from icheat_usd.progress import Progress


def compile_first(purpose: str, progress: Progress) -> None:
    """Compile what one of `session.warming.PURPOSES` needs; a failure is told, and left to whoever calls the kernel."""
    from icheat_usd.session.warming import compile_ahead, may_help

    if not may_help():  # Kernels are then compiled as they are called, and no others.
        return
    try:
        compile_ahead((purpose,), progress=progress)
    except IcheatError as error:
        print(f"icheat: warning: {error}; it is compiled when it is called", file=sys.stderr)
