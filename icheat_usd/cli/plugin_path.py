"""Print the folders of the USD plug-ins with schemas and validators, for PXR_PLUGINPATH_NAME.

export PXR_PLUGINPATH_NAME="$(icheat plugin-path)${PXR_PLUGINPATH_NAME:+:$PXR_PLUGINPATH_NAME}"
"""

from __future__ import annotations

import argparse

from icheat_usd.cli.options import add_json, print_json


def setup_parser(parser: argparse.ArgumentParser) -> None:
    add_json(parser)


def command(options: argparse.Namespace) -> int:
    from icheat_usd.plugin_path import plugin_directories, search_path

    if options.json:
        print_json({"path": search_path(), "folders": [str(folder) for folder in plugin_directories()]})
    else:
        print(search_path())
    return 0
