"""Where the USD plug-ins with schemas and validators lie, for hosts that must know before USD starts.

    export PXR_PLUGINPATH_NAME="$(python -m icheat_usd.plugin_path)${PXR_PLUGINPATH_NAME:+:$PXR_PLUGINPATH_NAME}"

Imports no USD, so that it can run before a host does.
"""

from __future__ import annotations

import os
from pathlib import Path

from icheat_usd.resources import resource_path


def plugin_directory() -> Path:
    """Absolute path of the directory that holds plugInfo.json and generatedSchema.usda.

    Raises
    ------
    IcheatError
        The installation lacks them.
    """
    return resource_path("schemas/usd")


def plugin_directories() -> tuple[Path, ...]:
    """All plug-ins: that with the schemas, and that with the validators. USD takes one plug-in of a directory.

    Raises
    ------
    IcheatError
        The installation lacks them.
    """
    return plugin_directory(), resource_path("schemas/validation")


def search_path() -> str:
    """All plug-ins, as PXR_PLUGINPATH_NAME takes them."""
    return os.pathsep.join(str(directory) for directory in plugin_directories())


def main() -> int:
    """Print the directories."""
    print(search_path())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
