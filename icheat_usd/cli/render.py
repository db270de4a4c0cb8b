"""Render the edited stage with the final gather.

icheat render shot.usda -o final.exr -o final.png
icheat render shot.usda --frames 1:48 -o final.####.exr
"""

from __future__ import annotations

import argparse
from dataclasses import replace

from icheat_usd.cli.options import add_image, positive


def setup_parser(parser: argparse.ArgumentParser) -> None:
    add_image(parser)
    parser.add_argument("--samples", type=positive, metavar="N", help="camera samples a pixel")
    parser.add_argument("--rays", type=positive, metavar="N", help="gather rays a camera sample")
    parser.add_argument("--bounces", type=positive, metavar="N", help="diffuse reflections before the last one")


def command(options: argparse.Namespace) -> int:
    from icheat_usd.cli.imaging import make_images
    from icheat_usd.session import GatherSettings, Quality

    given = {
        "samples_per_pixel": options.samples,
        "gather_rays": options.rays,
        "n_bounces": options.bounces,
    }
    settings = replace(
        GatherSettings(seed=options.seed), **{name: value for name, value in given.items() if value is not None}
    )
    return make_images(options, Quality(seed=options.seed), lambda session: session.render(settings))
