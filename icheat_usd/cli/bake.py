"""Bake edits as sampled rows, for readers that know matrices and no operations.

icheat bake shot.usda warmFace --layer shot.usda --epsilon 0.01
icheat bake shot.usda --coefficients 100 --as baked
icheat bake shot.usda --flatten --frames 1:24
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

from icheat_usd.cli.frames import parse_frames
from icheat_usd.cli.options import (
    add_frame,
    add_json,
    add_layer,
    add_stack,
    add_stage,
    finding_as_json,
    finding_as_text,
    positive,
    print_json,
    seed,
)

if TYPE_CHECKING:
    from icheat_usd.session.baking import Baked, BakedKey


def setup_parser(parser: argparse.ArgumentParser) -> None:
    add_stage(parser)
    parser.add_argument("edits", metavar="EDIT", nargs="*", help="names or prim paths; default every edit of the stack")
    add_stack(parser)
    parser.add_argument("--camera", metavar="PRIM", help="camera that the rows are sampled for")
    add_layer(parser)
    times = parser.add_mutually_exclusive_group()
    add_frame(times)  # type: ignore[arg-type]
    times.add_argument("--frames", type=parse_frames, metavar="SPEC", help="bake keys at these frames: 1:10x2 or 1,5,9")
    bound = parser.add_mutually_exclusive_group()
    bound.add_argument(
        "--epsilon",
        type=_share,
        default=0.02,
        metavar="E",
        help="largest error of the scale: of the image, at most E of the unedited indirect light; default 0.02",
    )
    bound.add_argument("--coefficients", type=positive, metavar="K", help="keep K wavelet coefficients a row instead")
    parser.add_argument(
        "--as",
        dest="form",
        choices=("both", "baked"),
        default="both",
        help="'baked' evaluates the rows from now on; 'both' (default) keeps the operation and stores rows beside it",
    )
    parser.add_argument(
        "--forget-recipe", dest="form", action="store_const", const="baked", help="the same as --as baked"
    )
    parser.add_argument(
        "--flatten", action="store_true", help="freeze the whole stack into one edit, and mute its edits"
    )
    parser.add_argument("--name", default="Flattened", help="of the edit that --flatten makes; default Flattened")
    parser.add_argument("--width", type=positive, metavar="PIXELS", help="else the render settings' resolution")
    parser.add_argument("--height", type=positive, metavar="PIXELS")
    parser.add_argument("--gather", type=positive, metavar="N", help="gather samples; default 65536")
    parser.add_argument("--seed", type=seed, default=0, help="of all random numbers; default 0")
    parser.add_argument(
        "--sidecar", metavar="FILE", help="folder or .icheat.h5 file for the rows; default by the layer"
    )
    parser.add_argument("--why", default="", metavar="TEXT", help="kept with the payloads' history")
    add_json(parser)


def command(options: argparse.Namespace) -> int:
    from icheat_usd.cli.authoring import named_edit, open_for_writing
    from icheat_usd.cli.compiling import compile_first
    from icheat_usd.cli.progress import ProgressLine
    from icheat_usd.errors import EditError
    from icheat_usd.session import baking, flattening, inspection
    from icheat_usd.session.quality import PREVIEW

    stage, layer = open_for_writing(options)
    quality = replace(PREVIEW, n_gather=options.gather or PREVIEW.n_gather, seed=options.seed)
    stack = inspection.find_stack(stage, options.stack, options.camera)
    if stack is None:
        raise EditError(f"{options.stage} has no edit stack, so there is nothing to bake; add an edit first")
    frames = options.frames or ((options.frame,) if options.frame is not None else None)
    shot = baking.Shot(options.camera, stack, options.width, options.height, quality)
    with ProgressLine() as progress:
        compile_first("relight", progress)
        if options.flatten:
            if options.edits:
                raise EditError("--flatten freezes the whole stack; mute the edits that should not be in it instead")
            done = flattening.flatten_stack(
                stage,
                options.name,
                layer=layer,
                shot=shot,
                frames=frames,
                epsilon=options.epsilon,
                coefficients=options.coefficients,
                sidecar=options.sidecar,
                why=options.why,
                progress=progress,
            )
        else:
            paths = []
            for name in options.edits:
                options.edit = name
                paths.append(named_edit(stage, options)[1])
            done = baking.bake_edits(
                stage,
                paths or baking.bakeable_edits(stage, stack),
                layer=layer,
                shot=shot,
                frames=frames,
                epsilon=options.epsilon,
                coefficients=options.coefficients,
                forget_recipe=options.form == "baked",
                sidecar=options.sidecar,
                why=options.why,
                progress=progress,
            )
    return _report(options, layer, done)


def _report(options: argparse.Namespace, layer: str, done: Baked) -> int:
    if options.json:
        findings = [finding_as_json(finding) for finding in done.findings]
        print_json({"layer": layer, "keys": [asdict(key) for key in done.keys], "findings": findings})
        return 1 if done.findings else 0
    for key in done.keys:
        print(_line(key))
    for finding in done.findings:
        print(finding_as_text(finding), file=sys.stderr)
    return 1 if done.findings else 0


def _line(key: BakedKey) -> str:
    when = "" if key.time is None else f" @ {key.time:g}"
    bounds = [f"scale within {key.epsilon_scale:.2g}"]
    if key.epsilon_emission:
        bounds.append(f"emission within {key.epsilon_emission:.2g}")
    if key.epsilon_offset:
        bounds.append(f"offset within {key.epsilon_offset:.2g} / m^2")
    lines = [
        f"{key.edit}{when}  {key.stored_bytes / 1e6:.3f} MB  ({', '.join(bounds)};"
        f" measured between samples {key.measured_error:.2g})",
        f"    {key.rows:,} rows of {key.gather_samples:,} gather samples at {key.sites:,} places,"
        f" {key.coefficients:,} coefficients; cheapest exact form: {key.cheapest}",
    ]
    if key.lost_radiance:
        lines.append(
            f"    rows do not hold up to {key.lost_radiance:.2g} of radiance added where there is none to scale"
        )
    return "\n".join(lines)


def _share(text: str) -> float:
    value = float(text)
    if not 0 < value <= 1:
        raise argparse.ArgumentTypeError(f"{value:g} is not above 0 and at most 1")
    return value
