"""Suite `rivals`: error over time of the indirect light, beside what a user would run today.

Every renderer gets the same snapshot, camera, resolution, box filter and length of paths. Times are those of
rendering alone: scenes are loaded and kernels compiled before, and what compiling took is said apart. Path tracers
are followed sample by sample, and charged for the light of all paths but not for what is subtracted to get the
indirect part; our own time has direct light and the
light of the gather samples in it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from icheat_usd.errors import ImageError
from icheat_usd.final_gather import FinalGather, GatherSettings, denoised_layer
from icheat_usd.image.denoise import denoise
from icheat_usd.samples import view_samples
from icheat_usd.samples.develop import average
from icheat_usd.scene import F32, F64, Bool, SceneSnapshot
from icheat_usd.tracing import Tracer, build_tracer
from tools.benchmarking import rival_summary
from tools.benchmarking.mitsuba_layers import MitsubaLayers
from tools.benchmarking.parts import Effort
from tools.benchmarking.references import Reference, default_folder, reference
from tools.benchmarking.render_efforts import RenderEffort, efforts
from tools.benchmarking.render_frame import Frame, warm
from tools.benchmarking.render_images import write_sheet
from tools.benchmarking.rival_errors import TRIMMED, errors
from tools.benchmarking.rival_scenes import RivalScene, rival_scene
from tools.peers import luxcore_peer, oidn_peer

#: Diffuse reflections before the last one that ours follows, and Mitsuba's depth for the same paths.
N_BOUNCES = GatherSettings().n_bounces
DEPTH = N_BOUNCES + 2

REFERENCE = "reference"
RENDERERS = ("ours", "llvm", "scalar", "luxcore")

#: Sheets show each renderer after so many seconds.
_SHOWN_AFTER = 4.0

#: Samples a pixel after which a path tracer is looked at: denoising and FLIP take seconds.
_SHOWN_SAMPLES = tuple(4**i for i in range(12))

#: Camera samples a pixel that are in memory together.
_AT_ONCE = 4

_LUXCORE_SAMPLES, _QUICK_LUXCORE_SAMPLES = (4, 16, 64), (2,)
_SCALAR_SECONDS = 30.0  # what it is for is seen by then


def cases(stages: list[str], quick: bool) -> list[dict[str, Any]]:
    """The reference of every stage first, which the others read."""
    found = []
    for stage in stages:
        found.append({"stage": stage, "renderer": REFERENCE})
        found += [{"stage": stage, "renderer": name} for name in RENDERERS]
    return found


def measure(case: dict[str, Any], effort: Effort, quick: bool, folder: Path) -> dict[str, Any]:
    """Curves by name, with what is to be known of them; `absent` says why there are none."""
    renderer = case["renderer"]
    if case["renderers"] and renderer not in (*case["renderers"].split(","), REFERENCE):
        return {"curves": {}, "absent": {renderer: "not asked for"}}
    scene = rival_scene(case["stage"], effort.width, effort.height)
    kept = Path(case["references"]) if case["references"] else default_folder()
    minutes = case["reference_minutes"] if renderer == REFERENCE else 0.0
    known = reference(scene.name, scene.snapshot, DEPTH, kept, minutes=minutes)
    if renderer == REFERENCE:
        return _of_reference(known, scene)
    stand = _Stand(scene.snapshot, known, folder, scene.name, quick)
    if renderer == "ours":
        chosen = efforts(quick)
        names = case["efforts"].split(",") if case["efforts"] else list(chosen)
        return _ours(stand, {name: chosen[name] for name in names})
    if renderer == "luxcore":
        return _luxcore(stand, _QUICK_LUXCORE_SAMPLES if quick else _LUXCORE_SAMPLES)
    seconds = min(case["seconds"], _SCALAR_SECONDS) if renderer == "scalar" else case["seconds"]
    return _mitsuba(stand, renderer, seconds)


def markdown(results: list[dict[str, Any]]) -> list[str]:
    """Tables for README."""
    return rival_summary.markdown(results)


class _Render(NamedTuple):
    """One point of a curve."""

    label: str
    seconds: float
    indirect: F64
    whole: F64


class _Stand:
    """A scene on which renderers are measured."""

    def __init__(self, snapshot: SceneSnapshot, known: Reference, folder: Path, name: str, quick: bool) -> None:
        self.snapshot, self.known, self.quick = snapshot, known, quick
        self._folder, self._name = folder, name
        self.tracer: Tracer = build_tracer(snapshot)
        self.albedo, self.normal, self.seen = _features(snapshot, self.tracer, 4 if quick else 32)

    def curve(self, name: str, renders: Iterator[_Render]) -> list[dict[str, Any]]:
        """Errors of renders, which come from quick to thorough; one of them is written as a sheet."""
        points: list[dict[str, Any]] = []
        for one in renders:
            found = errors(one.indirect, one.whole, self.known, self.seen)
            points.append({"label": one.label, "seconds": one.seconds, **found})
            print(
                f"  {name:<24} {one.label:<10} {one.seconds:8.3f} s  relMSE {found['rel_mse']:.5f}"
                f"  trimmed {found['rel_mse_trimmed']:.5f}",
                flush=True,
            )
            if len(points) == 1 or points[-2]["seconds"] < _SHOWN_AFTER:
                mean = (self.known.indirect[0] + self.known.indirect[1]) / 2
                file = f"{self._name} {name}.png".replace(" ", "_")
                points[-1]["image"] = write_sheet(self._folder / "rivals" / file, one.indirect, mean)
        return points


def _features(snapshot: SceneSnapshot, tracer: Tracer, samples: int) -> tuple[F32, F32, Bool]:
    """Albedo and normal (height, width, 3) of many camera samples, and which pixels show nothing but surfaces.

    Those that show some of a source, whose cover is black, or of the void do not count: sources are seen in some
    renderers only.
    """
    camera = snapshot.camera
    shape = (camera.height, camera.width)
    layers, n_lit = np.zeros((2, *shape, 3)), np.zeros(shape, np.int64)
    for part in range(0, samples, _AT_ONCE):
        view = view_samples(snapshot, tracer, samples_per_pixel=_AT_ONCE, centred=False, seed=part, max_splits=0)
        layers += [average(view, x).reshape(*shape, 3) for x in (view.points.albedo, view.points.normal)]
        lit = view.points.albedo.any(axis=1)
        n_lit += np.bincount(view.pixel[lit], minlength=n_lit.size).reshape(shape)
    albedo, normal = (layers * (_AT_ONCE / samples)).astype(np.float32)
    return albedo, normal, n_lit == samples


def _of_reference(known: Reference, scene: RivalScene) -> dict[str, Any]:
    print(f"  {known.samples} samples per pixel and half, noise of the mean {known.noise():.2e}", flush=True)
    return {
        "curves": {},
        "reference": {
            "samples_per_half": known.samples,
            "seconds": known.seconds,
            "noise": known.noise(),
            "noise_trimmed": known.noise(TRIMMED),
            "depth": DEPTH,
            "lights_left_out": scene.left_out,
            "lights_added": scene.added,
            "triangles": len(scene.snapshot.geometry.face),
        },
    }


def _ours(stand: _Stand, chosen: dict[str, RenderEffort]) -> dict[str, Any]:
    """Every effort from the snapshot on: none has anything of another."""
    curves, absent = {}, {}
    for name, effort in chosen.items():
        if effort.settings.denoise:
            try:
                denoise(np.ones(stand.albedo.shape, np.float32), stand.albedo, stand.normal)  # loading it is not timed
            except ImageError as error:
                absent[f"ours, {name}"] = str(error)
                continue
        settings, quality = (replace(part, n_bounces=N_BOUNCES) for part in effort)
        effort = RenderEffort(settings, quality)
        warm(stand.snapshot, effort)
        frame = Frame(stand.snapshot, effort)
        found, seconds = frame.render(frame.field())
        render = _Render(name, seconds, found.indirect, found.direct + found.indirect)
        if settings.denoise:
            render = _denoised_ours(render, found)
        curves[f"ours, {name}"] = stand.curve(f"ours {name}", iter([render]))
    return {"curves": curves, "absent": absent}


def _denoised_ours(render: _Render, found: FinalGather) -> _Render:
    """As `_denoised` has it, but with the features of the frame."""
    start = time.perf_counter()
    indirect = denoised_layer(found, found.indirect)
    spent = time.perf_counter() - start
    direct = denoised_layer(found, found.direct)
    return _Render(render.label, render.seconds + spent, indirect, direct + indirect)


def _mitsuba(stand: _Stand, variant: str, seconds: float) -> dict[str, Any]:
    """The path tracer, and the same samples denoised."""
    tracer = MitsubaLayers(stand.snapshot, DEPTH, "fast" if variant == "llvm" else "scalar_rgb")
    if variant == "llvm" and not tracer.variant.startswith("llvm"):
        return {"curves": {}, "absent": {"mitsuba llvm": "no LLVM 19: install libllvm19, or set DRJIT_LIBLLVM_PATH"}}
    sizes = list(_sizes(tracer.most_samples))
    compiling = tracer.warm(sorted(set(sizes))) if variant == "llvm" else None
    absent = {}
    denoise = oidn_peer.denoiser(stand.albedo, stand.normal) if variant == "llvm" else None
    if variant == "llvm" and denoise is None:
        absent["mitsuba llvm + OIDN"] = "pyoidn is not installed"
    denoised: list[_Render] = []

    def renders() -> Iterator[_Render]:
        total, n, spent, seed = np.zeros((2, *stand.known.whole[0].shape)), 0, 0.0, 1
        while spent < seconds:
            samples = sizes[min(seed - 1, len(sizes) - 1)]
            found = tracer.layers(samples, seed)
            total += samples * np.stack([found.indirect, found.whole])
            n, spent, seed = n + samples, spent + found.seconds, seed + 1
            if n in _SHOWN_SAMPLES or spent >= seconds:
                indirect, whole = total / n
                if denoise is not None:
                    denoised.append(_denoised(denoise, f"{n} spp", spent, indirect, whole))
                yield _Render(f"{n} spp", spent, indirect, whole)

    curves = {f"mitsuba {variant}": stand.curve(f"mitsuba {variant}", renders())}
    if denoise is not None:
        curves["mitsuba llvm + OIDN"] = stand.curve("mitsuba llvm + OIDN", iter(denoised))
    return {"curves": curves, "absent": absent, "compile_seconds": compiling}


def _sizes(most: int) -> Iterator[int]:
    """Samples of the passes, so that sums are powers of two: 1, 1, 2, 4, ... up to `most`, which goes on."""
    yield 1
    size = 1
    while 2 * size <= most:
        yield size
        size *= 2
    yield size


def _denoised(denoise: Callable[[F64], F64], label: str, seconds: float, indirect: F64, whole: F64) -> _Render:
    """Both images by themselves; the time is that of one of them, as a user needs only one."""
    start = time.perf_counter()
    smooth = denoise(indirect)
    spent = time.perf_counter() - start
    return _Render(label, seconds + spent, smooth, denoise(whole))


def _luxcore(stand: _Stand, samples: tuple[int, ...]) -> dict[str, Any]:
    name = "LuxCore PhotonGI"
    try:
        scene = luxcore_peer.LuxCoreScene(stand.snapshot)
    except (ImportError, ValueError) as error:
        return {"curves": {}, "absent": {name: str(error)}}
    direct = sum(whole - indirect for whole, indirect in zip(stand.known.whole, stand.known.indirect, strict=True)) / 2

    def renders() -> Iterator[_Render]:
        for n, (whole, seconds) in zip(samples, scene.render(samples, DEPTH), strict=True):
            whole[~stand.seen] = direct[~stand.seen]  # sources
            # The reference's direct light is subtracted; what LuxCore's own is off counts as error.
            yield _Render(f"{n} spp", seconds, whole - direct, whole)

    return {"curves": {name: stand.curve(name, renders())}}
