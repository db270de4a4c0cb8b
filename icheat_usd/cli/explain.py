"""Say which edits touch a pixel, by how much, from which casters, and which layer says so.

What an edit does is the light with the whole stack less the light without that
edit. --image writes this for all pixels: an .exr with a layer edit.<name> for
each edit, a .png with one picture after another (grey: nothing, lighter: light
added, darker: light taken away), the finished image first.

icheat explain shot.usda --pixel 320 240
icheat explain shot.usda --image edits.exr --image edits.png
"""

from __future__ import annotations

import argparse
import os
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from icheat_usd.cli.options import add_frame, add_json, add_stack, add_stage, positive, print_json, seed
from icheat_usd.errors import EditError, ImageError


def setup_parser(parser: argparse.ArgumentParser) -> None:
    add_stage(parser)
    parser.add_argument("--pixel", nargs=2, type=int, metavar=("X", "Y"), help="pixel from the top left, 0 0 first")
    parser.add_argument("--image", action="append", metavar="FILE", help=".exr or .png of what each edit does")
    add_frame(parser)
    parser.add_argument("--camera", metavar="PRIM", help="camera; as for relight")
    add_stack(parser)
    parser.add_argument("--width", type=positive, metavar="PIXELS", help="else the render settings' resolution")
    parser.add_argument("--height", type=positive, metavar="PIXELS")
    parser.add_argument("--casters", type=positive, default=5, metavar="N", help="most casters to name; default 5")
    parser.add_argument("--gather", type=positive, metavar="N", help="gather samples; default 8192")
    parser.add_argument("--rays", type=positive, metavar="N", help="gather rays a row; images 128, pixels 1024")
    parser.add_argument("--seed", type=seed, default=0, help="of all random numbers; default 0")
    add_json(parser)


def command(options: argparse.Namespace) -> int:
    if options.pixel is None and not options.image:
        raise EditError("explain needs --pixel X Y or --image FILE")
    for name in options.image or ():
        if Path(name).suffix.lower() not in (".exr", ".png"):
            raise ImageError(f"--image {name}: the name must end in .exr or .png")
        if not Path(name).parent.is_dir():
            raise ImageError(f"--image {name}: there is no folder '{Path(name).parent}'; make it first")

    from icheat_usd.cli.compiling import compile_first
    from icheat_usd.cli.progress import ProgressLine
    from icheat_usd.session import DRAFT, Session

    rays, gather = options.rays or 128, options.gather or DRAFT.n_gather
    quality = replace(DRAFT, seed=options.seed, n_gather=gather, rays_per_row=rays, row_spacing=2)
    content: dict[str, Any] = {"stage": options.stage}
    lines: list[str] = []
    with ProgressLine() as progress:
        compile_first("relight", progress)
        session = Session.open(
            options.stage,
            camera=options.camera,
            frame=options.frame,
            stack=options.stack,
            width=options.width,
            height=options.height,
            quality=quality,
            progress=progress,
        )
        if options.pixel is not None:
            from icheat_usd.session.explain import PIXEL_RAYS, explain_pixel

            found = explain_pixel(session, *options.pixel, n_casters=options.casters, rays=options.rays or PIXEL_RAYS)
            content["pixel"] = _as_json(found)
            lines += _lines(found)
        if options.image:
            layers = _write_images(session, options.image)
            content |= {"files": options.image, "layers": layers}
            lines += [*options.image, *(["order: beauty, " + ", ".join(layers)] if layers else [])]
    if options.json:
        print_json(content)
    else:
        print("\n".join(lines))
    return 0


def _write_images(session: Any, names: list[str]) -> list[str]:
    from icheat_usd.image.contact import contact_sheet, signed_image
    from icheat_usd.image.exr import write_exr
    from icheat_usd.image.film import Film
    from icheat_usd.image.png import write_png
    from icheat_usd.session.explain import contribution_film

    film = contribution_film(session)
    maps = [name for name in film.layers if name.startswith("edit.")]
    for name in names:
        if Path(name).suffix.lower() == ".exr":
            write_exr(film, name)
        else:
            sheet = contact_sheet([film.layer("beauty"), *(signed_image(film.layer(layer)) for layer in maps)])
            text = {**film.metadata, "images": ", ".join(["beauty", *maps])}
            write_png(Film(sheet.shape[1], sheet.shape[0], {"beauty": sheet}, text), name)
    return maps


def _as_json(found: Any) -> dict[str, Any]:
    content = asdict(found)
    edits = []
    for edit in content.pop("edits"):
        layers = {name: {"value": value, "layer": layer} for name, (value, layer) in edit.pop("layers").items()}
        edits.append({**edit, "values": layers})
    content["indirectEdited"] = content.pop("indirect_edited")
    return content | {"edits": edits}


def _lines(found: Any) -> list[str]:
    where = f"pixel {found.x} {found.y} of {found.width} x {found.height}, {found.camera}"
    lines = [where, "shows: " + (" ".join(found.surfaces[:4]) or "nothing")]
    lines.append(f"indirect light {_color(found.indirect)}, edited {_color(found.indirect_edited)}")
    for share in found.edits:
        name = share.edit.rpartition("/")[2]
        if share.note:
            lines.append(f"{name}  {share.operation}: {share.note}{_who(share, 'enabled', 'amount')}")
            continue
        if not any(share.change):
            why = "its receivers are elsewhere" if share.mask == 0 else "no light of its casters comes here"
            lines.append(f"{name}  {share.operation}: nothing ({why})")
            continue
        total = _luminance(share.change)
        percent = f" ({100 * total / _luminance(found.indirect):+.0f} %)" if _luminance(found.indirect) > 0 else ""
        lines.append(f"{name}  {share.operation}: {_color(share.change, sign='+')}{percent}, mask {share.mask:.2g}")
        for caster in share.casters:
            part = f"{100 * _luminance(caster.change) / total:.0f} %" if total else _color(caster.change, sign="+")
            lines.append(f"    from {caster.path}  {part}")
        by_layer: dict[str, list[str]] = {}
        for key, (value, layer) in share.layers.items():
            by_layer.setdefault(os.path.basename(layer), []).append(f"{key}={_text(value)}")
        lines += [f"    {layer}: {', '.join(values)}" for layer, values in by_layer.items()]
    if not found.edits:
        lines.append("the stage has no edits")
    return lines


def _who(share: Any, *names: str) -> str:
    layers = [os.path.basename(share.layers[name][1]) for name in names if name in share.layers]
    return f" ({layers[0]})" if layers else ""


def _luminance(color: Any) -> float:
    return float(0.2126 * color[0] + 0.7152 * color[1] + 0.0722 * color[2])


def _color(color: Any, sign: str = "") -> str:
    return "(" + ", ".join(f"{float(value):{sign}.3g}" for value in color) + ")"


def _text(value: Any) -> str:
    if isinstance(value, (tuple, list)):
        return "(" + ", ".join(f"{number:g}" for number in value) + ")"
    return f"{value:g}" if isinstance(value, float) else str(value)
