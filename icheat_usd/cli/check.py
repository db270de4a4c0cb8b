"""Say what is wrong with a stage's edits: exit 0 if nothing, 1 if something.

Composition, schemas, selections, keys and payloads; every sidecar is read.
"""

from __future__ import annotations

import argparse

from icheat_usd.cli.options import add_frame, add_json, add_stage, finding_as_json, finding_as_text, print_json


def setup_parser(parser: argparse.ArgumentParser) -> None:
    add_stage(parser)
    add_frame(parser)
    add_json(parser)


def command(options: argparse.Namespace) -> int:
    from icheat_usd.session import inspection

    findings = inspection.check(inspection.open_stage(options.stage), options.frame)
    if options.json:
        print_json({"stage": options.stage, "findings": [finding_as_json(finding) for finding in findings]})
    else:
        for finding in findings:
            print(finding_as_text(finding))
    return 1 if findings else 0
