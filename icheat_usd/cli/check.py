"""Say what is wrong with a stage's edits: exit 0 if nothing, 1 if something.

Composition, schemas, selections, keys and payloads; every sidecar is read, and
what is baked is compared with the scene as it is now. Tools built on
UsdValidation find the same rules under the keyword 'icheat'.
"""

from __future__ import annotations

import argparse

from icheat_usd.cli.options import add_frame, add_json, finding_as_json, finding_as_text, print_json, severity
from icheat_usd.errors import EditError


def setup_parser(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("stage", metavar="STAGE", nargs="?", help="USD file to open")
    parser.add_argument("--list", action="store_true", help="list all rules instead")
    parser.add_argument("--errors", action="store_true", help="exit with 1 for errors only; warnings are still printed")
    add_frame(parser)
    add_json(parser)


def command(options: argparse.Namespace) -> int:
    if options.list:
        return _list_rules(options.json)
    if options.stage is None:
        raise EditError("check needs a STAGE, or --list for all rules")
    from icheat_usd.session import inspection

    findings = inspection.check(inspection.open_stage(options.stage), options.frame)
    if options.json:
        print_json({"stage": options.stage, "findings": [finding_as_json(finding) for finding in findings]})
    else:
        for finding in findings:
            print(finding_as_text(finding))
    counted = [f for f in findings if not options.errors or severity(f) == "error"]
    return 1 if counted else 0


def _list_rules(as_json: bool) -> int:
    from icheat_usd.session import inspection

    rules = inspection.check_rules()
    if as_json:
        print_json({"rules": [rule._asdict() for rule in rules]})
    else:
        width = max(len(rule.name) for rule in rules)
        for rule in rules:
            print(f"{rule.name:<{width}}  {rule.severity:<7}  {rule.doc}")
    return 0
