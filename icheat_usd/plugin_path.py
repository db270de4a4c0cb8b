"""Where the USD plug-ins with schemas and validators lie, for hosts that must know before USD starts.

    export PXR_PLUGINPATH_NAME="$(python -m icheat_usd.plugin_path)${PXR_PLUGINPATH_NAME:+:$PXR_PLUGINPATH_NAME}"

Imports no USD, so that it can run before a host does.
"""

from __future__ import annotations

import os
import sys
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
    """All plug-ins: that with the schemas, that with the validators, and those of other packages.

    USD takes one plug-in of a directory.

    Raises
    ------
    IcheatError
        The installation lacks them.
    """
    return plugin_directory(), resource_path("schemas/validation"), *package_directories()


def package_directories() -> tuple[Path, ...]:
    """Directories of the plug-ins with which other packages describe their operations to USD.

    They are named by entry points of the group ``icheat_usd.schemas``, whose
    value is the Python package that has plugInfo.json beside its code. A
    package that cannot be found has none; who asks for its operation hears so.
    """
    # Here, because they take as long to load as the rest of a short command.
    from importlib.metadata import entry_points
    from importlib.util import find_spec

    found = []
    for entry in entry_points(group="icheat_usd.schemas"):
        try:
            spec = find_spec(entry.value)
        except (ImportError, ValueError):
            continue
        for place in (spec.submodule_search_locations or ()) if spec else ():
            if (Path(place) / "plugInfo.json").is_file():
                found.append(Path(place).resolve())
    return tuple(dict.fromkeys(found))


def announce_packages() -> None:
    """Let USD find the plug-ins of other packages: through the environment before it loads, at once where it has."""
    directories = [str(directory) for directory in package_directories()]
    if "pxr" in sys.modules:
        from importlib import import_module

        if directories:
            import_module("pxr.Plug").Registry().RegisterPlugins(directories)
        return
    paths = [path for path in os.environ.get("PXR_PLUGINPATH_NAME", "").split(os.pathsep) if path]
    missing = [directory for directory in directories if directory not in paths]
    if missing:
        os.environ["PXR_PLUGINPATH_NAME"] = os.pathsep.join([*paths, *missing])


def search_path() -> str:
    """All plug-ins, as PXR_PLUGINPATH_NAME takes them."""
    return os.pathsep.join(str(directory) for directory in plugin_directories())


def main() -> int:
    """Print the directories."""
    print(search_path())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
