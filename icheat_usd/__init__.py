"""Artistic control of indirect light, in USD."""

from __future__ import annotations

import importlib
import os
import sys

from icheat_usd.errors import IcheatError
from icheat_usd.resources import resource_path

__version__ = "0.1.0"


def _announce_schemas() -> None:
    """Let USD find schemas and validators: through the environment before it loads, at once where it has.

    USD itself is never loaded here. A host that composed a stage before this
    ignores both ways; reading works there, authoring says what to do.
    """
    try:
        # One plug-in a directory: USD registers only one of two that share it.
        directories = [str(resource_path(f"schemas/{name}")) for name in ("usd", "validation")]
    except IcheatError:
        return  # Incomplete installation: what needs the schemas says so; --help and the rest still work.
    paths = [path for path in os.environ.get("PXR_PLUGINPATH_NAME", "").split(os.pathsep) if path]
    missing = [directory for directory in directories if directory not in paths]
    if missing:
        os.environ["PXR_PLUGINPATH_NAME"] = os.pathsep.join([*missing, *paths])
    if "pxr" in sys.modules:
        importlib.import_module("pxr.Plug").Registry().RegisterPlugins(directories)


_announce_schemas()
