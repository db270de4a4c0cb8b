"""Suite `sequence`: frames of an animated stage with keyed edits, and whether they flicker.

Flicker is what a pixel does beside moving evenly: the root mean square of its second difference over frames, of the
logarithm of the light, with edits and without, from the same renders. What moves in the picture is in both. To look
at there are a sheet of the frames, and a slice: one row of pixels of every frame, in which flicker is stripes.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from icheat_usd.image.contact import contact_sheet
from icheat_usd.image.png import encode_animation
from icheat_usd.scene import F32, F64
from icheat_usd.session import Session
from icheat_usd.stage import open_stage
from tools.benchmarking.goals import Goal, at_most
from tools.benchmarking.parts import Effort
from tools.benchmarking.render_efforts import lesser
from tools.benchmarking.render_images import as_bytes, write_png
from tools.benchmarking.runner import ROOT

STAGE = "sample_stages/animated_room/sequence.usda"
ONE_SEED, SEED_A_FRAME = "one seed", "a seed a frame"  #: the first is what `icheat render` does
_FRAMES, _QUICK_FRAMES = 48, 4
_DIRECT = {"samples_per_pixel": 4, "light_samples": 8}  #: so that penumbrae in the sheet have no noise
_FIRST, _QUICK_FIRST = 1, 26
_FEWER = 12  #: frames, where every frame has a seed of its own
_SLICE = 6  #: rows of a slice for one frame
_SIZE, _QUICK_SIZE = (160, 120), (16, 12)


def cases(stages: list[str], quick: bool) -> list[dict[str, Any]]:
    """The animated sample stage, whatever stages are named."""
    return [{"stage": str(ROOT / STAGE), "seeds": seeds} for seeds in (ONE_SEED, SEED_A_FRAME)]


def measure(case: dict[str, Any], effort: Effort, quick: bool, folder: Path) -> dict[str, Any]:
    """Second differences of the indirect light with edits and without, and a contact sheet of all frames."""
    width, height = _QUICK_SIZE if quick else _SIZE
    n = _QUICK_FRAMES if quick else (_FRAMES if case["seeds"] == ONE_SEED else _FEWER)
    chosen = lesser(quick)
    chosen = chosen if quick else chosen._replace(settings=replace(chosen.settings, **_DIRECT))
    stage = open_stage(case["stage"])
    frames: list[dict[str, F32]] = []
    start = time.perf_counter()
    first = _QUICK_FIRST if quick else _FIRST
    for frame in range(first, first + n):
        seed = frame if case["seeds"] == SEED_A_FRAME else 0
        quality, settings = replace(chosen.quality, seed=seed), replace(chosen.settings, seed=seed)
        session = Session.open(stage, frame=float(frame), width=width, height=height, quality=quality)
        film = session.render(settings)
        frames.append({name: film.layers[name] for name in ("indirect", "indirect_edited", "beauty")})
    seconds = time.perf_counter() - start
    edited, unedited = (np.stack([one[name] for one in frames]) for name in ("indirect_edited", "indirect"))
    name = case["seeds"].replace(" ", "_")
    shown = [one["beauty"] for one in frames]
    found: dict[str, Any] = {
        "frames": n,
        "width": width,
        "height": height,
        "seconds_a_frame": seconds / n,
        "flicker_edited": flicker(edited),
        "flicker_unedited": flicker(unedited),
        "median_edited": flicker_of_median(edited),
        "median_unedited": flicker_of_median(unedited),
        "touched_share": float((edited != unedited).any(axis=(0, 3)).mean()),
        "sheet": write_png(folder / "sequence" / f"sheet_{name}.png", as_bytes(contact_sheet(shown))),
    }
    touched = (edited != unedited).any(axis=(0, 3))
    row = int(touched.sum(axis=1).argmax())
    found["slice"] = write_png(folder / "sequence" / f"slice_{name}.png", as_bytes(_slice(unedited, edited, row)))
    if touched.any():
        found["flicker_edited_where_touched"] = flicker(edited[:, touched])
        found["flicker_unedited_where_touched"] = flicker(unedited[:, touched])
    found["video"] = _video(shown, folder / "sequence" / f"{name}_moving.png")
    return found


def flicker(images: F32 | F64) -> float:
    """Root mean square second difference over frames of the logarithm of the light.

    Parameters
    ----------
    images : (n_frames, ..., 3) scene-linear
        Light below a hundredth of the mean counts as that.
    """
    return float(np.sqrt((_second_differences(images) ** 2).mean()))


def flicker_of_median(images: F32 | F64) -> float:
    """The same of every pixel by itself, and the median of these: what moves covers few pixels."""
    return float(np.median(np.sqrt((_second_differences(images) ** 2).mean(axis=0))))


def _second_differences(images: F32 | F64) -> F64:
    light = np.asarray(images, np.float64).mean(axis=-1)
    logarithm = np.log(np.maximum(light, 0.01 * light.mean() + 1e-12))
    return np.asarray(np.diff(logarithm, 2, axis=0))


def _slice(unedited: F32, edited: F32, row: int) -> F32:
    """One row of pixels, frame below frame, without edits on the left and with them on the right; twice as wide."""
    white = 1 / max(float(np.quantile(edited[:, row], 0.98)), 1e-12)
    sides = [np.repeat(np.repeat(images[:, row] * white, _SLICE, axis=0), 2, axis=1) for images in (unedited, edited)]
    return np.asarray(np.concatenate(sides, axis=1), np.float32)


def _video(images: list[F32], path: Path) -> str:
    """The frames as an animated PNG, which browsers play."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode_animation(np.stack([as_bytes(image) for image in images])))
    return path.name


def markdown(results: list[dict[str, Any]]) -> list[str]:
    """Table for README."""
    lines = [
        "| frames | seeds | time a frame | flicker unedited | edited | where edits act: unedited | edited |"
        " median pixel: unedited | edited |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for one in (one for one in results if "result" in one):
        found = one["result"]
        touched = [found.get(f"flicker_{name}_where_touched") for name in ("unedited", "edited")]
        cells = ["" if value is None else f"{value:.4f}" for value in touched]
        lines.append(
            f"| {found['frames']} of {found['width']}x{found['height']} | {one['case']['seeds']} |"
            f" {found['seconds_a_frame']:.2f} s | {found['flicker_unedited']:.4f} | {found['flicker_edited']:.4f} |"
            f" {' | '.join(cells)} | {found['median_unedited']:.4f} | {found['median_edited']:.4f} |"
        )
    return [*lines, "", *_goals([one for one in results if "result" in one])]


def _goals(done: list[dict[str, Any]]) -> list[str]:
    """Flicker with edits over that without, of the same pixels."""
    ratios = [
        Goal(
            one["case"]["seeds"], found["flicker_edited_where_touched"] / found["flicker_unedited_where_touched"], 1.05
        )
        for one in done
        for found in [one["result"]]
        if found.get("flicker_unedited_where_touched")
    ]
    return [at_most("flicker where edits act over that without edits,", ratios)] if ratios else []
