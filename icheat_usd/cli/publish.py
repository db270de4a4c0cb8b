"""Verify every payload of a stage and pack them into one read-only file.

Every edit counts, muted ones too, at every key. Anything missing, damaged,
stale or wrong is listed, and nothing is written (exit 1). A manifest beside
the file lists what it holds; `icheat gc` never collects published files.
"""

from __future__ import annotations

import argparse

from icheat_usd.cli.options import add_json, add_stage, add_why, finding_as_json, finding_as_text, print_json, why


def setup_parser(parser: argparse.ArgumentParser) -> None:
    add_stage(parser)
    parser.add_argument(
        "-o", "--out", metavar="FILE", help="the .icheat.h5 to make; else STAGE.published.v001.icheat.h5 or the next"
    )
    parser.add_argument(
        "--layer", action="append", default=[], metavar="LAYER", help="layer file to make name it; may be repeated"
    )
    add_why(parser)
    add_json(parser)


def command(options: argparse.Namespace) -> int:
    from icheat_usd.session import inspection, publishing

    stage = inspection.open_stage(options.stage)
    published = publishing.publish(stage, options.out, layers=options.layer, why=why(options))
    if options.json:
        print_json(
            {
                "file": published.file or None,
                "manifest": published.manifest or None,
                "payloads": list(published.payloads),
                "keys": [
                    {"edit": key.edit, "time": key.time, "payload": key.digest, "source": key.file}
                    for key in published.keys
                ],
                "repointed": published.repointed,
                "findings": [finding_as_json(finding) for finding in published.findings],
            }
        )
    elif published.findings:
        for finding in published.findings:
            print(finding_as_text(finding))
        print(f"not published: {len(published.findings)} findings")
    else:
        n_keys, n_payloads = len(published.keys), len(published.payloads)
        print(f"{published.file}: {n_payloads} payloads of {n_keys} keys, verified; listed in {published.manifest}")
        for layer, count in published.repointed.items():
            print(f"{layer}: {count} values name it now")
    return 1 if published.findings else 0
