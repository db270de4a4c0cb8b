"""The frames of `icheat render`, one after the other, each in files that appear whole."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from icheat_usd.cli.compiling import compile_first
from icheat_usd.cli.imaging import output_path, report
from icheat_usd.cli.progress import ProgressLine
from icheat_usd.errors import IcheatError, ImageError
from icheat_usd.final_gather import GatherSettings
from icheat_usd.image.colour import check_view
from icheat_usd.session import Quality, Session, layer_names
from icheat_usd.session.products import product_output
from icheat_usd.session.rendering import Output, write_outputs
from icheat_usd.stage import open_stage
from icheat_usd.stage.render_products import RenderProduct, read_render_products


@dataclass(frozen=True)
class _View:
    """Files of one frame that show the same."""

    product: str | None  #: RenderProduct that says what the image is like
    camera: str | None  #: that it names itself: it decides which edit stack is meant
    outputs: tuple[Output, ...]


def render_frames(options: argparse.Namespace, settings: GatherSettings, quality: Quality) -> int:
    """Write every output of every frame.

    Parameters
    ----------
    quality : Quality
        Of the gather samples; their seed and bounces are those of the settings.

    Raises
    ------
    IcheatError
        An output or a layer cannot be named, which is found before anything is computed; or a frame cannot be
        rendered, and the message names it. Frames that were finished stay.
    """
    frames: tuple[float | None, ...] = options.frames or (options.frame,)
    stage = open_stage(options.stage)
    found: dict[Any, None] = {}
    views = {frame: _views(options, stage, frame, len(frames), found) for frame in frames}
    _refuse_shared_files(views)
    if any(
        output.path.suffix.lower() == ".png" for frame in frames for view in views[frame] for output in view.outputs
    ):
        check_view(options.view)

    images: list[dict[str, Any]] = []
    with ProgressLine() as progress:
        compile_first("render", progress)
        for frame in frames:
            name = f"frame {frame:g}" if frame is not None else ""
            progress.prefix = f"{name}: " if name and len(frames) > 1 else ""
            for view in views[frame]:
                try:
                    images.append(_render(options, settings, quality, stage, frame, view, progress, found))
                except IcheatError as error:
                    if not name or len(frames) == 1:
                        raise
                    raise type(error)(f"{name}: {error}") from error
    return report(options, images, found)


def _render(
    options: argparse.Namespace,
    settings: GatherSettings,
    quality: Quality,
    stage: Any,
    frame: float | None,
    view: _View,
    progress: ProgressLine,
    found: dict[Any, None],
) -> dict[str, Any]:
    """One view of one frame. All that was computed for it goes when this returns, so that memory stays bounded."""
    began = time.perf_counter()
    session = Session.open(
        stage,
        camera=options.camera or view.camera,
        frame=frame,
        stack=options.stack,
        width=options.width,
        height=options.height,
        quality=replace(quality, seed=options.seed, n_bounces=settings.n_bounces),
        progress=progress,
        product=view.product,
    )
    written = write_outputs(session, settings, view.outputs, force=options.force)
    found |= dict.fromkeys(session.findings)
    for path in written.kept:
        print(f"kept {path}: made of the same before; --force renders it again", file=sys.stderr)
    if not options.json:
        for output in view.outputs:
            print(output.path, flush=True)
    return {
        "frame": frame,
        "files": [str(output.path) for output in view.outputs],
        "kept": [str(path) for path in written.kept],
        "width": written.width,
        "height": written.height,
        "seconds": round(time.perf_counter() - began, 3),
        "metadata": written.metadata,
    }


def _views(
    options: argparse.Namespace, stage: Any, frame: float | None, n_frames: int, found: dict[Any, None]
) -> tuple[_View, ...]:
    if options.out and options.product is None:
        if options.aov and all(name.lower().endswith(".png") for name in options.out):
            raise ImageError("--aov is for .exr files; choose what a .png shows with --show")
        layers = _layers(options.aov or layer_names.DEFAULT, "--aov")
        files = tuple(_output(options, pattern, layers, frame, n_frames) for pattern in options.out)
        return (_View(None, None, files + _map_of_records(options, frame, n_frames)),)
    if options.records is not None:
        raise ImageError("--records goes with -o FILE")
    if options.aov:
        raise ImageError("--aov goes with -o FILE; products name their layers in orderedVars")
    products, findings = read_render_products(stage, frame, options.product)
    found |= dict.fromkeys(findings)
    # Those that differ in nothing that decides the camera's rays are rendered at once.
    grouped: dict[tuple[object, ...], list[tuple[RenderProduct, Output]]] = {}
    for product in products:
        made, more = product_output(product)
        found |= dict.fromkeys(more)
        patterns = options.out or [product.file]
        for pattern in patterns:
            where = "--out" if options.out else f"{product.path} productName"
            # A name with time samples need not hold a place for the frame.
            path = output_path(pattern, frame, n_frames if options.out else 1, where)
            output = replace(made, path=path, view=options.view, exposure=options.exposure)
            output = replace(output, multipart=not options.single_part)
            grouped.setdefault(product.views, []).append((product, output))
    return tuple(
        _View(group[0][0].path, group[0][0].camera, tuple(output for _, output in group)) for group in grouped.values()
    )


def _map_of_records(options: argparse.Namespace, frame: float | None, n_frames: int) -> tuple[Output, ...]:
    if options.records is None:
        return ()
    path = output_path(options.records, frame, n_frames, "--records")
    if path.suffix.lower() != ".png":
        raise ImageError(f"--records {options.records}: the name must end in .png; --aov records is for .exr files")
    shown = tuple(layer_names.Layer(name, name) for name in ("records", "indirect"))
    return (Output(path, shown, is_map=True),)


def _output(
    options: argparse.Namespace, pattern: str, layers: tuple[layer_names.Layer, ...], frame: float | None, n_frames: int
) -> Output:
    path = output_path(pattern, frame, n_frames)
    if path.suffix.lower() == ".png":
        (shown,) = _layers([options.show], "--show")
        if shown.source in layer_names.FAMILIES or not layer_names.n_channels(shown.source):
            raise ImageError(f"--show {options.show}: is no image; write an .exr for it")
        return Output(path, (shown,), view=options.view, exposure=options.exposure)
    return Output(path, layers, multipart=not options.single_part)


def _layers(names: Sequence[str], where: str) -> tuple[layer_names.Layer, ...]:
    sources = dict.fromkeys(layer_names.canonical(name, where=where) for name in names)
    return tuple(layer_names.Layer(source, layer_names.layer_name(source)) for source in sources)


def _refuse_shared_files(views: Mapping[float | None, tuple[_View, ...]]) -> None:
    """No file may be written twice."""
    owners: dict[str, str] = {}
    for frame, of_frame in views.items():
        for view in of_frame:
            for output in view.outputs:
                owner = f"{output.product or '--out'}" + (f" at frame {frame:g}" if frame is not None else "")
                other = owners.setdefault(str(output.path.absolute()), owner)
                if other != owner or sum(o.path == output.path for o in view.outputs) > 1:
                    raise ImageError(
                        f"{output.path}: {other} and {owner} would write the same file; write #### for the frame in the"
                        " name, give productName time samples, or name another file"
                    )
