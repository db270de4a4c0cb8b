"""Artistic control of indirect light, in USD."""

from __future__ import annotations

import importlib
import os
import sys

from icheat_usd.errors import IcheatError
from icheat_usd.resources import resource_path

__version__ = "0.1.0"


def _announce_schemas() -> None:
    """Let USD find the schemas: through the environment before it loads, at once where it has.

    USD itself is never loaded here. A host that composed a stage before this
    ignores both ways; reading works there, authoring says what to do.
    """
    try:
        directory = str(resource_path("schemas/usd"))
    except IcheatError:
        return  # Incomplete installation: what needs the schemas says so; --help and the rest still work.
    paths = [path for path in os.environ.get("PXR_PLUGINPATH_NAME", "").split(os.pathsep) if path]
    if directory not in paths:
        os.environ["PXR_PLUGINPATH_NAME"] = os.pathsep.join([directory, *paths])
    if "pxr" in sys.modules:
        importlib.import_module("pxr.Plug").Registry().RegisterPlugins(directory)


_announce_schemas()
