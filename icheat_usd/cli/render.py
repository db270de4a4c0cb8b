"""Render the edited stage with the final gather.

icheat render shot.usda -o final.exr -o final.png
icheat render shot.usda --frames 1:48 -o final.####.exr
icheat render shot.usda --aov beauty --aov edit_ratio --aov crypto_object -o comp.exr
icheat render shot.usda --frames 1:48

Without -o, the products of the stage's render settings are written: their
productName, relative to the stage, with their orderedVars as layers.

Frames whose files are there, whole and made of the same scene, edits,
settings and program, are kept; so a sequence that was stopped goes on where it
was, and one whose edits changed is rendered where they did. An .exr has a part
for each layer.

Layers (--aov, or sourceName of a RenderVar):
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

from icheat_usd.cli.options import add_image, fraction, positive
from icheat_usd.session.layer_names import DEFAULT, FAMILIES, LAYERS

_WIDTH = max(map(len, (*LAYERS, *FAMILIES)))
__doc__ += "\n" + "\n".join(f"  {name:{_WIDTH}}  {what}" for name, what in {**LAYERS, **FAMILIES}.items())


def setup_parser(parser: argparse.ArgumentParser) -> None:
    add_image(parser, without_out="without it, the products of the stage's render settings are written")
    parser.add_argument("--product", metavar="PRIM", help="write this RenderProduct alone; with -o, to that file")
    parser.add_argument(
        "--aov",
        action="append",
        metavar="NAME",
        help=f"layer of .exr files, see above; may be given several times; default {', '.join(DEFAULT)}",
    )
    parser.add_argument(
        "--records", metavar="FILE", help=".png that maps the records of cached light: their reach, and their rounds"
    )
    parser.add_argument("--single-part", action="store_true", help="all layers in one part of an .exr")
    parser.add_argument("--force", action="store_true", help="render frames again that are there already")
    parser.add_argument("--samples", type=positive, metavar="N", help="camera samples a pixel; default 4 (quick: 1)")
    parser.add_argument(
        "--edge-samples", type=at_least_0, metavar="N", help="more of them in pixels with edges; default 12 (quick: 1)"
    )
    parser.add_argument("--filter", metavar="NAME", help="box, triangle, gaussian or blackman-harris; default box")
    parser.add_argument("--filter-width", type=float, metavar="PIXELS", help="of its support; default the usual one")
    parser.add_argument(
        "--quick",
        action="store_true",
        help="a frame in seconds, to look at: denoised from few rays of every camera sample and few gather samples; "
        "needs pip install 'icheat-usd[denoise]'",
    )
    parser.add_argument(
        "--method",
        choices=("cached", "gathered", "brute"),
        help="cached: irradiance is interpolated where it is smooth; gathered: every camera sample sends rays of its "
        "own to the gather samples, noisy and for --denoise; brute: it follows paths, slow and unbiased",
    )
    parser.add_argument(
        "--noise",
        type=fraction,
        metavar="SHARE",
        help="relative error by chance of cached light that reaches 10 pixels, from which more rays are traced; "
        "default 0.0125",
    )
    parser.add_argument(
        "--photons", action="store_true", help="earlier bounces by a photon map instead of the gather samples"
    )
    parser.add_argument(
        "--denoise", action="store_true", help="with Open Image Denoise: pip install 'icheat-usd[denoise]'"
    )
    parser.add_argument(
        "--rays", type=positive, metavar="N", help="gather rays where no light is cached; default 64 (quick: 8)"
    )
    parser.add_argument(
        "--bounces", type=positive, metavar="N", help="diffuse reflections before the last one; default 16"
    )


def at_least_0(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{value} is less than 0")
    return value


def command(options: argparse.Namespace) -> int:
    from icheat_usd.cli.sequence import render_frames
    from icheat_usd.errors import SettingsError
    from icheat_usd.freed_memory import keep_freed_memory
    from icheat_usd.session.quality import FINAL, PREVIEW, QUICK, QUICK_CELLS

    start, quality = (QUICK, QUICK_CELLS) if options.quick else (FINAL, PREVIEW)
    method = options.method or start.method
    unused = {"--noise": options.noise if method != "cached" else None}
    if method == "brute":
        unused["--edge-samples"] = options.edge_samples
    wrong = [name for name, value in unused.items() if value is not None]
    if wrong:
        raise SettingsError(f"the {method} method has no use for {', '.join(wrong)}; leave that out, or the method")
    given = {
        "samples_per_pixel": options.samples,
        "gather_rays": options.rays,
        "n_bounces": options.bounces,
        "edge_samples": options.edge_samples,
        "pixel_filter": options.filter,
        "filter_width": options.filter_width,
        "method": options.method,
        "bounces": "photons" if options.photons else None,
        "denoise": options.denoise or None,
    }
    chosen: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    settings = replace(start, seed=options.seed, **chosen)
    if options.noise is not None:
        settings = replace(settings, cache=replace(settings.cache, noise=options.noise))
    keep_freed_memory()
    return render_frames(options, settings, quality)
