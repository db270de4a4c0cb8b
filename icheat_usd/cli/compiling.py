"""What a command is about to compute with is compiled by all cores first, where it has not been compiled yet."""

from __future__ import annotations

import sys

from icheat_usd.progress import Progress


def compile_first(purpose: str, progress: Progress) -> None:
    """As `session.first_use.compile_first`; it is imported when it is needed, as the compiler takes long to load."""
    from icheat_usd.session import first_use

    first_use.compile_first(purpose, progress, lambda text: print(f"icheat: warning: {text}", file=sys.stderr))
