"""Options that several verbs share."""

from __future__ import annotations

import argparse
import json
import math
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from icheat_usd.cli.frames import parse_frames

#: Version of everything that --json prints; raised when a key changes its meaning or goes.
JSON_VERSION = 1


def add_stage(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("stage", metavar="STAGE", help="USD file to open")


def add_stack(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--stack", metavar="PRIM", help="edit stack; else the render settings', else the camera's only one"
    )


def add_layer(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--layer", metavar="LAYER", help="layer of the stage to write to: path or file name; default STAGE itself"
    )


def add_variant(parser: argparse.ArgumentParser, what: str = "write into") -> None:
    """For verbs that write, and for those that look at a variant as if it were selected."""
    parser.add_argument(
        "--variant",
        type=variant,
        metavar="SET=VARIANT",
        help=f"{what} this variant of the stack's prim, or of the edit's own, such as grade=dusk",
    )


def variant(text: str) -> tuple[str, str]:
    """`set=variant` of --variant."""
    name, _, chosen = text.partition("=")
    if not name or not chosen:
        raise argparse.ArgumentTypeError(f"'{text}' is no SET=VARIANT, such as grade=dusk")
    return name, chosen


def add_why(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--why", metavar="TEXT", help="kept in the payload's history; default the command line")


def why(options: argparse.Namespace) -> str:
    """What the history of a payload shall say: --why, else the command line."""
    return options.why if options.why is not None else shlex.join(["icheat", *options.given])[:500]


def add_frame(parser: argparse.ArgumentParser, help: str = "time code; default the stage's first") -> None:
    parser.add_argument("--frame", type=time_code, metavar="T", help=help)


def time_code(text: str) -> float:
    """A number; "nan", which USD takes for its default time, is none."""
    try:
        time = float(text)
    except ValueError:
        time = math.nan
    if not math.isfinite(time):
        raise argparse.ArgumentTypeError(f"'{text}' is no time code, such as 24 or 12.5")
    return time


def number(text: str) -> float:
    """A number that is one: no "nan", and none without end."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"'{text}' is no number, such as 1 or -0.5")
    return value


def seed(text: str) -> int:
    """A seed that random numbers are made of."""
    if not re.fullmatch(r"\d{1,9}", text.strip()):
        raise argparse.ArgumentTypeError(f"'{text}' is no seed: a whole number from 0 to 999999999")
    return int(text)


def add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print one JSON object for programs")


def add_image(parser: argparse.ArgumentParser, without_out: str = "") -> None:
    """Options of the verbs that make images; `without_out` says what happens where no file need be named."""
    add_stage(parser)
    parser.add_argument(
        "-o",
        "--out",
        action="append",
        required=not without_out,
        metavar="FILE",
        help=".exr (all layers) or .png (as displayed); may be given several times; #### stands for the frame"
        + (f"; {without_out}" if without_out else ""),
    )
    parser.add_argument(
        "--camera", metavar="PRIM", help="camera; else the render settings', else the only one; 'auto' frames the scene"
    )
    times = parser.add_mutually_exclusive_group()
    add_frame(times)  # type: ignore[arg-type]
    times.add_argument("--frames", type=parse_frames, metavar="SPEC", help="several frames: 1:10x2 or 1,5,9")
    add_stack(parser)
    parser.add_argument("--width", type=positive, metavar="PIXELS", help="else the render settings' resolution")
    parser.add_argument("--height", type=positive, metavar="PIXELS")
    parser.add_argument("--view", metavar="NAME", help="OCIO view of .png files; default the display's own")
    parser.add_argument("--exposure", type=number, default=0.0, metavar="STOPS", help="for .png files; default 0")
    parser.add_argument("--show", default="beauty", metavar="LAYER", help="film layer in .png files; default beauty")
    parser.add_argument("--seed", type=seed, default=0, help="of all random numbers; default 0")
    parser.add_argument("--strict", action="store_true", help="exit with 1 if the stage has findings")
    add_json(parser)


def positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is not at least 1")
    return value


def read_value(text: str) -> float | bool | str | tuple[float, ...]:
    """A parameter value as typed: `true`, `1.5`, `1.2,0.9,0.7`, else a word."""
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        return text
    return numbers[0] if len(numbers) == 1 else numbers


def assignment(text: str) -> tuple[str, float | bool | str | tuple[float, ...]]:
    """`name=value` of --set."""
    name, equals, value = text.partition("=")
    if not equals or not name.strip() or not value.strip():
        raise argparse.ArgumentTypeError(f"'{text}' is no NAME=VALUE, such as gain=0.5 or color=1.2,1,0.8")
    return name.strip(), read_value(value.strip())


def print_json(content: Mapping[str, Any]) -> None:
    print(json.dumps({"version": JSON_VERSION, **content}, indent=2))


def finding_as_json(finding: Any) -> dict[str, Any]:
    return {key: str(value) for key, value in asdict(finding).items()} | {"severity": severity(finding)}


def severity(finding: Any) -> str:
    """What only some kinds of finding say; the others are warnings."""
    return str(getattr(finding, "severity", "warning"))


def finding_as_text(finding: Any) -> str:
    place = " ".join(part for part in (finding.prim, finding.feature) if part)
    return f"{severity(finding)}: {place}: {finding.message}"


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows of cells as lines with columns; nothing follows the last cell of a row."""
    if not rows:
        return []
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def file_size(n: int) -> str:
    """Bytes as people read them."""
    if n < 999_500:
        return f"{n} B" if n < 1000 else f"{n / 1000:.3g} kB"
    return f"{n / 1e6:.3g} MB" if n < 999_500_000 else f"{n / 1e9:.3g} GB"


def fraction(text: str) -> float:
    """A share of something: above 0, at most 1."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value <= 1:
        raise argparse.ArgumentTypeError(f"'{text}' is no share between 0 and 1, such as 0.02")
    return value
