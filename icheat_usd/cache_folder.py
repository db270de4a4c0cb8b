"""Where the user's caches lie; imports nothing but the standard library."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def cache_folder(name: str) -> Path:
    """Folder for one kind of what can be made again: below ``$ICHEAT_CACHE_DIR``, else the user's cache folder.

    It need not exist.
    """
    if configured := os.environ.get("ICHEAT_CACHE_DIR"):
        return Path(configured) / name
    if sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    elif sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home()))
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "icheat_usd" / name
