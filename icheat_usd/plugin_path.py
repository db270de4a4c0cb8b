"""Where the USD plug-in with the schemas lies, for hosts that must know before USD starts.

    export PXR_PLUGINPATH_NAME="$(python -m icheat_usd.plugin_path)${PXR_PLUGINPATH_NAME:+:$PXR_PLUGINPATH_NAME}"

Imports no USD, so that it can run before a host does.
"""

from __future__ import annotations

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


def main() -> int:
    """Print the directory."""
    print(plugin_directory())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
