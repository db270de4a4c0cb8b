"""Where the data files that travel with the package lie; imports nothing but the standard library.

A wheel carries `schemas` and `sample_stages` inside the package; in a source
checkout (and so in an editable install) they lie beside it.
"""

from __future__ import annotations

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
