"""Print the folder of the USD plug-in with the schemas, for PXR_PLUGINPATH_NAME.

export PXR_PLUGINPATH_NAME="$(icheat plugin-path)${PXR_PLUGINPATH_NAME:+:$PXR_PLUGINPATH_NAME}"
"""

from __future__ import annotations

import argparse

from icheat_usd.cli.options import add_json, print_json


def setup_parser(parser: argparse.ArgumentParser) -> None:
    add_json(parser)


def command(options: argparse.Namespace) -> int:
    from icheat_usd.plugin_path import plugin_directory

    path = str(plugin_directory())
    if options.json:
        print_json({"path": path})
    else:
        print(path)
    return 0
