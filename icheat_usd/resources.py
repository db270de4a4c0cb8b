"""Where the package's data files and the user's caches lie; imports nothing but the standard library.

A wheel carries `schemas` and `sample_stages` inside the package; in a source
checkout (and so in an editable install) they lie beside it.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from icheat_usd.errors import IcheatError

_PACKAGE = Path(__file__).resolve().parent


def resource_path(name: str) -> Path:
    """Absolute path of a packaged file or folder.

    Parameters
    ----------
    name
        Path below the data root with forward slashes, such as ``"schemas/usd"``.

    Raises
    ------
    IcheatError
        Neither the installed package nor a source checkout holds it.
    """
    for root in (_PACKAGE, _PACKAGE.parent):
        path = root / name
        if path.exists():
            return path
    raise IcheatError(f"{_PACKAGE}: the installation lacks its data file {name}; reinstall icheat-usd")


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
