"""Preview the edited stage through precomputed transport.

icheat relight shot.usda -o preview.exr -o preview.png
icheat relight shot.usda --draft --frames 1:48x4 -o preview.####.png

Transport rows are kept at few view samples, with many rays each, where the
light changes; the others are interpolated from them, within a stated error.
--exact keeps a row at every view sample. What takes long is kept on disk for
the next time (`icheat cache`).
"""

from __future__ import annotations

import argparse
from dataclasses import replace

from icheat_usd.cli.options import add_image, positive


def setup_parser(parser: argparse.ArgumentParser) -> None:
    add_image(parser)
    parser.add_argument("--draft", action="store_true", help="a quick, coarse preview")
    rows = parser.add_mutually_exclusive_group()
    rows.add_argument("--exact", action="store_true", help="a transport row at every view sample; slower, noisier")
    rows.add_argument(
        "--record-error", type=error_share, metavar="SHARE", help="relative error of interpolated rows; default 0.01"
    )
    parser.add_argument("--gather", type=positive, metavar="N", help="gather samples")
    parser.add_argument("--rays", type=positive, metavar="N", help="gather rays of a transport row")
    parser.add_argument("--samples", type=positive, metavar="N", help="camera samples a pixel")
    parser.add_argument("--bounces", type=positive, metavar="N", help="diffuse reflections before the last one")


def error_share(text: str) -> float:
    """A share that an error may have, above 0 and below 1."""
    share = float(text)
    if not 0 < share < 1:
        raise argparse.ArgumentTypeError(f"{text} is no share between 0 and 1, such as 0.01")
    return share


def command(options: argparse.Namespace) -> int:
    from icheat_usd.cli.imaging import make_images
    from icheat_usd.session import DRAFT
    from icheat_usd.session.quality import PREVIEW, RECORDS

    base = DRAFT if options.draft else PREVIEW if options.exact else RECORDS
    at_records = options.record_error is not None or base.record_error is not None
    given = {
        "n_gather": options.gather,
        "record_error": options.record_error,
        "record_rays" if at_records else "rays_per_row": options.rays,
        "samples_per_pixel": options.samples,
        "n_bounces": options.bounces,
    }
    quality = replace(
        base,
        seed=options.seed,
        **{name: value for name, value in given.items() if value is not None},
    )
    return make_images(options, quality, lambda session: session.relight())
