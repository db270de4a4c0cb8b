"""Find sidecars that no layer names; move them to a trash folder with --move.

Every layer below the ROOTs is read, and every layer that these refer to:
variants that are not selected, muted layers and inactive prims count. A ROOT
that is a layer stands for its folder. Only sidecars below the ROOTs are
collected: give every place whose layers name them. If a layer cannot be read,
nothing is moved. What is moved lies in `.icheat-trash/<time>/` beside where it
was; moving it back restores it. Published files are spared.
"""

from __future__ import annotations

import argparse

from icheat_usd.cli.options import add_json, print_json


def setup_parser(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("roots", nargs="+", metavar="ROOT", help="folders, or layers")
    parser.add_argument("--move", action="store_true", help="move to the trash; else only say what would be moved")
    parser.add_argument("--min-age", type=float, default=24.0, metavar="HOURS", help="spare younger files; default 24")
    parser.add_argument(
        "--ignore",
        action="append",
        default=[],
        metavar="PATTERN",
        help="layers that may be missing or broken, as '/show/assets/*'; say so only if they name no sidecar",
    )
    add_json(parser)


def command(options: argparse.Namespace) -> int:
    from icheat_usd.session import housekeeping

    found = housekeeping.collect(options.roots, move=options.move, min_age_hours=options.min_age, ignore=options.ignore)
    if options.json:
        print_json(
            {
                "layers": found.layers,
                "sidecars": found.sidecars,
                "unnamed": [_as_json(item) for item in found.unnamed],
                "partlyNamed": [_as_json(item) for item in found.partly_named],
                "spared": dict(found.spared),
                "bytes": found.n_bytes,
                "moved": options.move and not found.problems,
                "problems": list(found.problems),
            }
        )
        return 1 if found.problems else 0
    for problem in found.problems:
        print(f"problem: {problem}")
    for item in found.unnamed:
        moved = f" -> {item.moved_to}" if item.moved_to else ""
        print(f"unnamed: {item.file}, {item.n_bytes:,} bytes, {len(item.payloads)} payloads{moved}")
    for item in found.partly_named:
        print(f"partly named: {item.file}: {len(item.payloads)} payloads that no layer names; `icheat pack` drops them")
    for file, reason in found.spared.items():
        print(f"spared: {file}: {reason}")
    did = "moved" if options.move and not found.problems else "to move"
    if found.problems:
        did = "not moved, because of the problems above"
    print(
        f"{found.layers} layers read, {found.sidecars} sidecars found; "
        f"{len(found.unnamed)} that none names, {found.n_bytes:,} bytes: {did}"
    )
    return 1 if found.problems else 0


def _as_json(item: object) -> dict[str, object]:
    from dataclasses import asdict

    content = asdict(item)  # type: ignore[call-overload]
    return {"file": content["file"], "bytes": content["n_bytes"], "payloads": list(content["payloads"])} | (
        {"movedTo": content["moved_to"]} if content["moved_to"] else {}
    )
