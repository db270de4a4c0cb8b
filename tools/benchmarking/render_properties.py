"""Suite `properties`: what must hold of edits in the final gather, measured.

- A hard edge of a mask: error of the change that an edit makes in the pixels about the edge, against brute force.
- An offset from casters half of which are hidden: all of it must arrive.
- The same bits from 1, 2 and 8 threads, with the edits of the stage.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from icheat_usd.edits.model import Edit, EditStack, Region, Selection, Shape
from icheat_usd.final_gather import GatherSettings
from icheat_usd.samples import ViewSamples, view_samples
from icheat_usd.samples.develop import average
from icheat_usd.scene import F32, F64, Bool, Camera, SceneSnapshot
from icheat_usd.stage import open_stage, take_snapshot
from tools.benchmarking.generated import WALL_ALBEDO, WALL_AREA, WALL_COSINE, write_screened
from tools.benchmarking.goals import Goal, at_most
from tools.benchmarking.parts import Effort
from tools.benchmarking.render_edits import shares_of
from tools.benchmarking.render_efforts import RenderEffort, usual
from tools.benchmarking.render_frame import Frame
from tools.benchmarking.render_images import write_sheet
from tools.benchmarking.runner import ROOT
from tools.benchmarking.statistics import relative_error
from tools.peers.mitsuba_peer import as_diffuse

_THREADS = (1, 2, 8)
_QUICK_SIZE = (24, 18)
#: Pixels about the middle of the edge that brute force makes: of a whole picture they would take hours.
_CROP, _QUICK_CROP = (128, 96), (16, 12)
_BAND = 8  #: pixels to either side of the edge
_WITHIN = 256  #: samples of a pixel that find whether the edge crosses it: a corner of it will do
_GAIN = 3.0  #: inside the mask
_REFERENCE = GatherSettings(method="brute", samples_per_pixel=4, gather_rays=512)
_QUICK_REFERENCE = replace(_REFERENCE, gather_rays=8)

#: Of the offset, which arrives from a wall whose lower half is hidden.
_OFFSET = 0.70


def cases(stages: list[str], quick: bool) -> list[dict[str, Any]]:
    """Edge and bits on the first stage; the offset has one of its own."""
    return [{"stage": stages[0], "property": name} for name in ("edge", "offset", "bits")]


def measure(case: dict[str, Any], effort: Effort, quick: bool, folder: Path) -> dict[str, Any]:
    """Figures of one property."""
    if case["property"] == "edge":
        return _edge(case["stage"], _QUICK_SIZE if quick else (effort.width, effort.height), quick, folder)
    if case["property"] == "offset":
        return _offset(usual(quick))
    return _bits(case["stage"], _QUICK_SIZE if quick else (effort.width // 2, effort.height // 2), quick)


def _edge(stage: str, size: tuple[int, int], quick: bool, folder: Path) -> dict[str, Any]:
    """A hard-edged region on the surface that is seen most, for light from all and from the first caster."""
    snapshot = as_diffuse(take_snapshot(open_stage(stage), width=size[0], height=size[1]))
    frame = Frame(snapshot, usual(quick))
    shares = shares_of(frame)
    receiver = max(shares.seen, key=lambda path: shares.seen[path])
    caster = max((p for p in shares.hit if p != receiver), key=lambda path: shares.hit[path])
    region = _half(frame, receiver)
    rows, columns = _crop(frame, receiver, region, _QUICK_CROP if quick else _CROP)
    cropped = replace(snapshot, camera=_camera_of(snapshot.camera, rows, columns))
    band, crossed = _band(Frame(cropped, usual(quick)), receiver, region)
    found: dict[str, Any] = {"receiver": receiver, "caster": caster, "width": size[0], "height": size[1]}
    found |= {"pixels": int(band.sum()), "crossed": int(crossed.sum())}
    for name, casters in (("from all", frozenset(shares.hit)), ("from one caster", frozenset([caster]))):
        edit = Edit("/edge", "scale", {"gain": _GAIN}, Selection(frozenset([receiver]), (region,)), Selection(casters))
        stack = EditStack("/Edge", (edit,))
        image, _ = frame.render(frame.field(stack))
        ours, ours_unedited = image.indirect_edited[rows, columns], image.indirect[rows, columns]
        halves = [_reference(cropped, stack, seed, quick) for seed in (1, 2)]
        edited, across = (
            relative_error(ours[some], *(half.indirect_edited[some] for half in halves)) for some in (band, crossed)
        )
        unedited = relative_error(ours_unedited[band], *(half.indirect[band] for half in halves))
        mean = (halves[0].indirect_edited + halves[1].indirect_edited) / 2
        found[name] = {
            "edited": edited.as_dict(),
            "unedited": unedited.as_dict(),
            "crossed": across.as_dict(),
            "image": write_sheet(folder / "properties" / f"edge {name}.png", ours, mean),
        }
    return found


def _crop(frame: Frame, path: str, region: Region, size: tuple[int, int]) -> tuple[slice, slice]:
    """Rows and columns of a part of the picture, about the middle of where the region ends on a surface."""
    camera = frame.snapshot.camera
    inside, on = _inside(frame, frame.view, path, region)
    values = np.stack([inside & on, on & ~inside], axis=1).astype(np.float32)
    within, beyond = (column.reshape(camera.height, camera.width) > 0 for column in average(frame.view, values).T)
    places = np.argwhere(_grown(within, 1) & _grown(beyond, 1)).astype(float)
    centre = places[np.argmin(np.square(places - places.mean(axis=0)).sum(axis=1))]
    parts = []
    for middle, n, most in zip(centre, size[::-1], (camera.height, camera.width), strict=True):
        first = min(max(int(middle) - n // 2, 0), most - n)
        parts.append(slice(first, first + n))
    return parts[0], parts[1]


def _camera_of(camera: Camera, rows: slice, columns: slice) -> Camera:
    """The camera of some pixels, which look where they did."""
    left, right, bottom, top = camera.window
    across, down = (right - left) / camera.width, (top - bottom) / camera.height
    window = (
        left + across * columns.start,
        left + across * columns.stop,
        top - down * rows.stop,
        top - down * rows.start,
    )
    return replace(camera, window=window, width=columns.stop - columns.start, height=rows.stop - rows.start)


def _reference(snapshot: SceneSnapshot, stack: EditStack, seed: int, quick: bool) -> Any:
    effort = usual(quick)
    settings = replace(_QUICK_REFERENCE if quick else _REFERENCE, seed=seed)
    frame = Frame(snapshot, RenderEffort(settings, effort.quality))
    return frame.render(frame.field(stack))[0]


def _half(frame: Frame, path: str) -> Region:
    """A box, one side of which cuts what is seen of a surface in two, askew."""
    points = frame.view.points
    rows = [i for i, surface in enumerate(frame.snapshot.surfaces) if surface.path == path]
    on = np.isin(frame.snapshot.geometry.instance_surface[points.instance], rows)
    places = points.position[on].astype(float) + frame.snapshot.centre
    middle = np.median(places, axis=0)
    _, _, axes = np.linalg.svd(places - places.mean(axis=0), full_matrices=False)
    turn = np.radians(25)
    across = np.cos(turn) * axes[0] + np.sin(turn) * axes[1]
    along = np.cos(turn) * axes[1] - np.sin(turn) * axes[0]
    half = 10 * frame.snapshot.radius
    matrix = np.stack([across, along, np.cross(across, along)]) / half
    offset = -matrix @ (middle - half * across)
    rows_of_matrix = np.concatenate([matrix, offset[:, None]], axis=1)
    return Region(Shape.BOX, tuple(float(x) for x in rows_of_matrix.ravel()))


def _band(frame: Frame, path: str, region: Region) -> tuple[Bool, Bool]:
    """Pixels that show nothing but the surface: those near where the region ends, and those that its end crosses.

    What is shown of the latter depends on where in the pixel camera samples fall, whatever the light is.
    """
    camera = frame.snapshot.camera
    view = view_samples(frame.snapshot, frame.tracer, samples_per_pixel=_WITHIN, max_splits=0)
    inside, on = _inside(frame, view, path, region)
    shape = (camera.height, camera.width)
    values = np.stack([inside, on], axis=1).astype(np.float32)
    share, surface = (column.reshape(shape) for column in average(view, values).T)
    near = _grown((share > 0) & (surface == 1), _BAND) & _grown((share < 1) & (surface == 1), _BAND)
    crossed = (share > 0) & (share < 1) & (surface == 1)
    return np.asarray(near & (surface == 1) & ~crossed), np.asarray(crossed)


def _inside(frame: Frame, view: ViewSamples, path: str, region: Region) -> tuple[Bool, Bool]:
    """Which view samples are inside the region, and which are on the surface: (n_view,) each."""
    rows = [i for i, surface in enumerate(frame.snapshot.surfaces) if surface.path == path]
    on = np.isin(frame.snapshot.geometry.instance_surface[view.points.instance], rows)
    matrix = np.array(region.to_shape).reshape(3, 4)
    local = (view.points.position.astype(float) + frame.snapshot.centre) @ matrix[:, :3].T + matrix[:, 3]
    return np.asarray((np.abs(local) <= 1).all(axis=1)), on


def _grown(mask: Bool, by: int) -> Bool:
    """Pixels up to `by` pixels away along the axes."""
    for _ in range(by):
        more = mask.copy()
        more[1:] |= mask[:-1]
        more[:-1] |= mask[1:]
        more[:, 1:] |= mask[:, :-1]
        more[:, :-1] |= mask[:, 1:]
        mask = more
    return mask


def _offset(effort: RenderEffort) -> dict[str, Any]:
    """What arrives of an offset that is 0.70 in all."""
    with tempfile.TemporaryDirectory() as scratch:
        stage = write_screened(Path(scratch) / "screened.usda")
        snapshot = as_diffuse(take_snapshot(open_stage(stage), width=16, height=12))
    sent = snapshot.lights.radiance[0].astype(float) * WALL_ALBEDO / np.pi * WALL_COSINE
    density = tuple(float(x) for x in _OFFSET / (sent * WALL_AREA))
    floor, wall = (Selection(frozenset([f"/World/{name}"])) for name in ("Floor", "Wall"))
    paint = Edit("/paint", "paint", {"color": density, "relative": False}, floor, wall)
    # What the sun sends and the wall reflects, and no light of the floor on the wall.
    once = RenderEffort(replace(effort.settings, n_bounces=1), replace(effort.quality, n_bounces=1))
    frame = Frame(snapshot, once)
    image, _ = frame.render(frame.field(EditStack("/Paint", (paint,))))
    added = image.indirect_edited - image.indirect
    return {"expected": _OFFSET, "mean": float(added.mean()), "largest_error": float(np.abs(added - _OFFSET).max())}


def _bits(stage: str, size: tuple[int, int], quick: bool) -> dict[str, Any]:
    """Digests of all layers by number of threads, each in a process of its own."""
    shot = Path(stage).with_name("shot.usda")
    task = {"stage": str(shot if shot.exists() else stage), "width": size[0], "height": size[1], "quick": quick}
    found = {}
    for threads in _THREADS[: 2 if quick else None]:
        environment = os.environ | {"NUMBA_NUM_THREADS": str(threads), "PYTHONPATH": str(ROOT)}
        worker = [sys.executable, "-m", "tools.benchmarking.render_properties", json.dumps(task)]
        done = subprocess.run(worker, env=environment, check=True, stdout=subprocess.PIPE, text=True, cwd=ROOT)
        found[str(threads)] = done.stdout.split()[-1]
    return {"stage": task["stage"], "digests": found, "same_bits": len(set(found.values())) == 1}


def _digest(task: dict[str, Any]) -> str:
    """Of the layers of one frame with the edits of the stage."""
    from icheat_usd.session import Session

    effort = usual(task["quick"])
    size = {"width": task["width"], "height": task["height"]}
    film = Session.open(task["stage"], quality=effort.quality, **size).render(effort.settings)
    digest = hashlib.sha256()
    for name in sorted(film.layers):
        layer: F32 | F64 = film.layers[name]
        digest.update(name.encode() + np.ascontiguousarray(layer).tobytes())
    return digest.hexdigest()


def markdown(results: list[dict[str, Any]]) -> list[str]:
    """Tables for README."""
    found = {one["case"]["property"]: (one["case"]["name"], one["result"]) for one in results if "result" in one}
    lines: list[str] = []
    if "edge" in found:
        stage, edge = found["edge"]
        lines += [
            f"Relative RMS errors (± standard error) within {_BAND} pixels of a hard edge of a mask, {stage},"
            f" {edge['width']} x {edge['height']}: {edge['pixels']} pixels beside it,"
            f" and {edge['crossed']} that it crosses.",
            "",
            "| light scaled | beside it, edited | unedited | pixels that it crosses, edited |",
            "| --- | ---: | ---: | ---: |",
        ]
        for name in ("from all", "from one caster"):
            edited, unedited, crossed = (edge[name][part] for part in ("edited", "unedited", "crossed"))
            lines.append(
                f"| {name} | {100 * edited['rms']:.2f} ± {100 * edited['standard_error']:.2f} % |"
                f" {100 * unedited['rms']:.2f} ± {100 * unedited['standard_error']:.2f} % |"
                f" {100 * crossed['rms']:.2f} ± {100 * crossed['standard_error']:.2f} % |"
            )
        errors = [Goal(f"{name}:", 100 * edge[name]["edited"]["rms"], 1.0) for name in ("from all", "from one caster")]
        lines += ["", at_most("% beside a hard edge", errors), ""]
    if "offset" in found:
        offset = found["offset"][1]
        lines.append(
            f"Offset of {offset['expected']:.2f} from a wall half of which is hidden: {offset['mean']:.5f} arrives,"
            f" largest error of a pixel {offset['largest_error']:.1e}."
        )
    if "bits" in found:
        bits = found["bits"][1]
        same = "the same bits" if bits["same_bits"] else "DIFFERENT BITS"
        lines.append(f"{', '.join(bits['digests'])} threads, {Path(bits['stage']).parent.name} with its edits: {same}.")
    return lines


if __name__ == "__main__":
    print(_digest(json.loads(sys.argv[1])))
