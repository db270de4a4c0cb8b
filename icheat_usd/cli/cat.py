"""List what is in a sidecar file: payloads, elements, sizes and history."""

from __future__ import annotations

import argparse
from dataclasses import asdict

from icheat_usd.cli.options import add_json, print_json


def setup_parser(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("sidecar", metavar="SIDECAR", help="a .icheat.h5 file")
    parser.add_argument("--verify", action="store_true", help="also read every payload and compare it with its name")
    parser.add_argument("--history", action="store_true", help="only which payload came when, from whom and why")
    add_json(parser)


def command(options: argparse.Namespace) -> int:
    from icheat_usd.sidecar import reader

    if options.verify:
        for digest in reader.list_payloads(options.sidecar):
            reader.read_payload(options.sidecar, digest, anchor="/")
    if options.history and not options.json:
        from icheat_usd.cli.history import as_text
        from icheat_usd.session.payload_history import file_history

        print(as_text(file_history(options.sidecar)))
    elif options.json:
        elements = [asdict(info) for info in reader.list_elements(options.sidecar)]
        history = [asdict(entry) for entry in reader.read_history(options.sidecar)]
        payloads = list(reader.list_payloads(options.sidecar))
        print_json({"file": options.sidecar, "payloads": payloads, "elements": elements, "history": history})
    else:
        print(reader.describe(options.sidecar))
    return 0
