"""Edit a sample stage, preview and render it, and say where the images are.

Copies the furnished room into the output folder, adds a layer with one edit
(more and warmer light from rug and floor on the person), and writes the image
before and after as .exr and .png, from the preview and from the final gather.
"""

from __future__ import annotations

import argparse
import shutil
import time
from pathlib import Path

from icheat_usd.cli.options import add_json, positive, print_json

_LAYER = """#usda 1.0
(
    "The demo's own layer: one edit over the sequence's and the shot's."
    defaultPrim = "World"
    metersPerUnit = 1
    renderSettingsPrimPath = "/Render/Settings"
    subLayers = [@./shot.usda@]
    upAxis = "Y"
)
"""


def setup_parser(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--out", default="demo_output", metavar="FOLDER", help="default demo_output")
    parser.add_argument("--width", type=positive, default=400, metavar="PIXELS", help="default 400; height follows")
    parser.add_argument("--preview-only", action="store_true", help="leave out the final gather")
    add_json(parser)


def command(options: argparse.Namespace) -> int:
    from icheat_usd.cli.compiling import compile_first
    from icheat_usd.cli.imaging import write_film
    from icheat_usd.cli.progress import ProgressLine
    from icheat_usd.image.metrics import mean_ratio
    from icheat_usd.resources import resource_path
    from icheat_usd.session import GatherSettings, Quality, Session, soft_sphere

    out = Path(options.out)
    folder = out / "furnished_room"
    shutil.copytree(resource_path("sample_stages/furnished_room"), folder, dirs_exist_ok=True)
    for old in folder.glob("demo.*.icheat.h5"):
        old.unlink()
    layer = folder / "demo.usda"
    layer.write_text(_LAYER, encoding="utf-8")

    def say(text: str) -> None:
        if not options.json:
            print(text, flush=True)

    images: list[str] = []
    seconds: dict[str, float] = {}
    with ProgressLine() as progress:
        compile_first("relight", progress)
        quality = Quality(n_gather=32_768, rays_per_row=256, rays_per_bounce_row=128)
        height = round(options.width * 3 / 4)
        session = Session.open(layer, width=options.width, height=height, quality=quality, progress=progress)

        def save(film: object, name: str) -> None:
            for suffix in (".exr", ".png"):
                path = out / f"{name}{suffix}"
                write_film(film, path)  # type: ignore[arg-type]
                images.append(str(path))

        say(f"opened {layer}")
        began = time.perf_counter()
        before = session.relight()
        seconds["first preview"] = time.perf_counter() - began
        save(before, "preview_before")
        say(f"first preview, with transport: {seconds['first preview']:.1f} s")

        centre = session.snapshot.centre
        chest = (0.95 - float(centre[0]), 1.35 - float(centre[1]), -0.62 - float(centre[2]))
        edit = session.add_edit(
            "warmPerson",
            layer=str(layer),
            operation="scale",
            parameters={"color": (3.0, 2.0, 1.2)},
            receivers=["Geometry/Person"],
            casters=["Geometry/Rug", "Geometry/Room/Floor"],
            receiver_brush=soft_sphere(chest, inner=0.45, outer=1.0),
        )
        began = time.perf_counter()
        after = session.relight()
        seconds["preview after the edit"] = time.perf_counter() - began
        save(after, "preview_after")
        say(f"added {edit}; preview again: {seconds['preview after the edit']:.2f} s")

        ratio = None
        if not options.preview_only:
            compile_first("render", progress)
            began = time.perf_counter()
            final = session.render(GatherSettings(samples_per_pixel=4, gather_rays=48))
            seconds["final gather"] = time.perf_counter() - began
            save(final, "final_after")
            ratio = float(mean_ratio(after.layers["beauty"], final.layers["beauty"]))
            say(f"final gather: {seconds['final gather']:.1f} s; preview / final in the mean: {ratio:.4f}")
    if options.json:
        print_json(
            {
                "stage": str(layer),
                "edit": edit,
                "images": images,
                "seconds": {name: round(value, 3) for name, value in seconds.items()},
                "previewOverFinal": ratio,
            }
        )
    else:
        say("images:")
        for image in images:
            say(f"  {image}")
    return 0
