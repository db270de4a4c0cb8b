"""Preview the edited stage through precomputed transport.

icheat relight shot.usda -o preview.exr -o preview.png
icheat relight shot.usda --draft --frames 1:48x4 -o preview.####.png
"""

from __future__ import annotations

import argparse
from dataclasses import replace

from icheat_usd.cli.options import add_image, positive


def setup_parser(parser: argparse.ArgumentParser) -> None:
    add_image(parser)
    parser.add_argument("--draft", action="store_true", help="a quick, coarse preview")
    parser.add_argument("--gather", type=positive, metavar="N", help="gather samples")
    parser.add_argument("--rays", type=positive, metavar="N", help="gather rays of a transport row")
    parser.add_argument("--samples", type=positive, metavar="N", help="camera samples a pixel")
    parser.add_argument("--bounces", type=positive, metavar="N", help="diffuse reflections before the last one")


def command(options: argparse.Namespace) -> int:
    from icheat_usd.cli.imaging import make_images
    from icheat_usd.session import DRAFT, Quality

    given = {
        "n_gather": options.gather,
        "rays_per_row": options.rays,
        "samples_per_pixel": options.samples,
        "n_bounces": options.bounces,
    }
    quality = replace(
        DRAFT if options.draft else Quality(),
        seed=options.seed,
        **{name: value for name, value in given.items() if value is not None},
    )
    return make_images(options, quality, lambda session: session.relight())
