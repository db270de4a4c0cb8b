"""What the verbs that make images have in common: frames in, files out."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from icheat_usd.cli.compiling import compile_first
from icheat_usd.cli.frames import frame_path, has_frame
from icheat_usd.cli.options import finding_as_json, finding_as_text, print_json
from icheat_usd.cli.progress import ProgressLine
from icheat_usd.errors import ImageError

if TYPE_CHECKING:
    from icheat_usd.image.film import Film
    from icheat_usd.session import Quality, Session

_SUFFIXES = (".exr", ".png")


def make_images(options: argparse.Namespace, quality: Quality, make: Callable[[Session], Film]) -> int:
    """Open the stage at each frame, make its film and write every --out of it.

    Raises
    ------
    ImageError
        An output cannot be named, its folder does not exist, or there is no such view; found before anything is
        computed.
    """
    frames: tuple[float | None, ...] = options.frames or (options.frame,)
    files = {frame: [output_path(pattern, frame, len(frames)) for pattern in options.out] for frame in frames}

    from icheat_usd.session import Session
    from icheat_usd.stage import open_stage

    if any(path.suffix.lower() == ".png" for paths in files.values() for path in paths):
        from icheat_usd.image.colour import check_view

        check_view(options.view)

    images: list[dict[str, Any]] = []
    found: dict[Any, None] = {}
    stage = open_stage(options.stage)
    with ProgressLine() as progress:
        compile_first("relight", progress)
        for frame in frames:
            began = time.perf_counter()
            progress.prefix = f"frame {frame:g}: " if frame is not None and len(frames) > 1 else ""
            session = Session.open(
                stage,
                camera=options.camera,
                frame=frame,
                stack=options.stack,
                width=options.width,
                height=options.height,
                quality=quality,
                progress=progress,
            )
            film = make(session)
            for path in files[frame]:
                write_film(film, path, layer=options.show, view=options.view, exposure=options.exposure)
            found |= dict.fromkeys(session.findings)
            seconds = time.perf_counter() - began
            images.append(
                {
                    "frame": frame,
                    "files": [str(path) for path in files[frame]],
                    "width": film.width,
                    "height": film.height,
                    "seconds": round(seconds, 3),
                    "metadata": dict(film.metadata),
                }
            )
            if not options.json:
                for path in files[frame]:
                    print(path, flush=True)
    return report(options, images, found)


def report(options: argparse.Namespace, images: list[dict[str, Any]], found: Iterable[Any]) -> int:
    """Say what was made and found; the exit status."""
    findings = list(found)
    if options.json:
        print_json({"stage": options.stage, "images": images, "findings": list(map(finding_as_json, findings))})
    else:
        for finding in findings:
            print(finding_as_text(finding), file=sys.stderr)
    return 1 if findings and options.strict else 0


def write_film(
    film: Film, path: Path, *, layer: str = "beauty", view: str | None = None, exposure: float = 0.0
) -> None:
    """Write a film as its suffix says."""
    from icheat_usd.image.exr import write_exr
    from icheat_usd.image.png import write_png

    if path.suffix.lower() == ".exr":
        write_exr(film, path)
    else:
        write_png(film, path, layer=layer, view=view, exposure=exposure)


def output_path(pattern: str, frame: float | None, n_frames: int, where: str = "--out") -> Path:
    """The file of a frame.

    Parameters
    ----------
    where : str
        What to call the pattern in errors.

    Raises
    ------
    ImageError
        It has another suffix than .exr or .png, no place for the frame, or no folder.
    """
    if Path(pattern).suffix.lower() not in _SUFFIXES:
        raise ImageError(f"{where} {pattern}: the name must end in .exr or .png")
    if n_frames > 1 and not has_frame(pattern):
        raise ImageError(f"{where} {pattern}: {n_frames} frames would share one file; write #### for the frame")
    try:
        path = frame_path(pattern, frame)
    except ValueError as error:
        raise ImageError(f"{where}: {error}") from error
    if not path.parent.is_dir():
        raise ImageError(f"{where} {path}: there is no folder '{path.parent}'; make it first or choose another path")
    return path
