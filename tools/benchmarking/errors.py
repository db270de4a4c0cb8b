"""Errors of the preview against a converged gather, light by light and edit by edit."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from icheat_usd.edits.binding import bind
from icheat_usd.edits.model import Edit, EditStack
from icheat_usd.final_gather.gatherer import Gatherer, gathered_light
from icheat_usd.lighting import build_light_sampler
from icheat_usd.materials import take_points
from icheat_usd.relight import Relighter
from icheat_usd.scene import F32, F64, I64
from icheat_usd.transport import CellLight, SparseRows, Transport, build_bounces, light_cells
from icheat_usd.transport.packed import PackedTransport
from tools.benchmarking.converged import (
    Probe,
    changed_rows,
    choose_pixels,
    converged_products,
    converged_transport,
    lossy_errors,
    samples_of_noisy_pixels,
    view_of,
)
from tools.benchmarking.error_images import write_error_image, write_sheet, write_signed_image
from tools.benchmarking.kernels import measure_frame
from tools.benchmarking.made_up_edits import edits_of_objects_and_brushes, one_edit, ranked_paths
from tools.benchmarking.meter import repeat
from tools.benchmarking.parts import Parts
from tools.benchmarking.statistics import RelativeError, relative_error, relative_error_of_halves


@dataclass(frozen=True)
class ErrorSettings:
    """Effort of the reference."""

    pixels: int = 2000  #: one out of each block of the image
    rays: int = 16_384  #: per pixel and lobe, each of two halves
    record_pixels: int = 2000  #: of these pixels, for the part of interpolation
    record_rays: int = 2048  #: per pixel and record, each of two halves
    noisy_pixels: int = 100  #: of these, that are measured again, as their noise is most of all pixels'
    noisy_rays: int = 32_768  #: with which that is done
    edit_pixels: int = 500
    hit_pixels: int = 200  #: for the comparison with light at true hits
    hit_rays: int = 1024
    sheet_rays: int = 256  #: per pixel of the images to look at
    bounce_rays: int = 1024
    light_samples: int = 64
    n_bounces: int = 16
    tolerances: tuple[float, ...] = (0.2, 0.1, 0.05, 0.025)  #: of packing, for the curve of error against speed
    shares: tuple[float, ...] = (0.05, 0.1)  #: of the view samples that rows are kept at, for another such curve
    seed: int = 20_061

    def of_pixels(self, n: int) -> ErrorSettings:
        """The same with so many pixels, and as many of them measured again as there are to their number."""
        noisy = max(1, round(self.noisy_pixels * n / self.pixels))
        return replace(self, pixels=n, record_pixels=n, noisy_pixels=noisy)


@dataclass(frozen=True)
class References:
    """Two independent estimates of everything, by light."""

    probe: Probe
    same_b: tuple[F32, F32]  #: (n_lights, n_pixels, 3) each: converged rows times the preview's own `b`
    own_b: tuple[F32, F32]  #: the same rows times `b` of seeds of their own
    b: tuple[F32, F32]  #: (n_lights, n_gather, 3) each


@dataclass(frozen=True)
class Dragged:
    """Each light at the end of a drag that began at rest, where it stands in the snapshot."""

    shown: list[F32]  #: (n_view, 3) each
    radiance: F32  #: (n_lights, n_gather, 3)
    rest: F32  #: the same, less what is like it was at rest, whose product is known exactly
    spread: SparseRows | None  #: interpolation with the weights that were fitted at rest, which stay


def measure_errors(
    parts: Parts, settings: ErrorSettings, folder: Path | None, drags: Sequence[Sequence[F64]]
) -> dict[str, Any]:
    """All errors of one scene under the lights of its snapshot; images go to `folder`.

    Parameters
    ----------
    drags
        Of each light, where it is from frame to frame, (3, 4) each: from where it is at rest to where it stands.
    """
    names = [path.rpartition("/")[2] for path in parts.snapshot.light_paths]
    started = time.perf_counter()
    just_made = parts.lights.radiance.copy()  # as while a light moves: a change shows with few samples at first
    parts.refine_lights()
    references = converged_references(parts, settings)
    found: dict[str, Any] = {
        "settings": settings.__dict__,
        "pixels": len(references.probe.pixel),
        "lights": {name: {} for name in names},
        "reference_seconds": time.perf_counter() - started,
    }
    # All of them before any is brought to rest: what refining finds may stay for the lights that follow.
    at_once = [parts.shown(light, at_rest=False) for light in range(len(names))]
    dragged = drag_lights(parts, drags)
    for light, name in enumerate(names):
        found["lights"][name] = _of_light(parts, references, light, at_once[light], dragged.shown[light])
        image = references.probe.to_pixels(parts.packed.to_view(just_made[light])[references.probe.samples])
        moving = relative_error(image, references.own_b[0][light], references.own_b[1][light])
        found["lights"][name]["while_moving"] = moving.as_dict()
    for name, error in _lossy(parts, references, settings, names, dragged):
        found["lights"][name] |= error
    found["edits"] = _of_edits(parts, references, settings)
    found["curve"] = _curve(parts, references, settings)
    if settings.hit_pixels:
        found["cells_against_true_hits"] = _against_true_hits(parts, references, settings, names)
    if folder is not None:
        found["images"] = _images(parts, references, settings, names, folder)
    found["seconds"] = time.perf_counter() - started
    return found


def converged_references(parts: Parts, settings: ErrorSettings) -> References:
    """Two halves with seeds of their own all the way: rows, bounces and light."""
    probe = choose_pixels(parts.view, settings.pixels, settings.seed)
    view = view_of(parts.view, probe.samples)
    own = parts.lights.radiance
    same, other, radiance = [], [], []
    for half in (1, 2):
        seed = settings.seed + 1000 * half
        scene, n = (parts.snapshot, parts.tracer, parts.gather), settings.light_samples
        bounces = build_bounces(*scene, rays_per_row=settings.bounce_rays, seed=seed)
        b = light_cells(*scene, bounces, n_bounces=settings.n_bounces, light_samples=n, seed=seed).radiance
        both = np.concatenate([own, b])
        products = converged_products(parts.snapshot, parts.tracer, parts.gather, view, settings.rays, seed, both)
        pixels = np.stack([probe.to_pixels(product) for product in products])
        same.append(pixels[: len(own)])
        other.append(pixels[len(own) :])
        radiance.append(b)
    return References(probe, (same[0], same[1]), (other[0], other[1]), (radiance[0], radiance[1]))


def drag_lights(parts: Parts, drags: Sequence[Sequence[F64]]) -> Dragged:
    """Bring all lights to rest at the start of their drags, and move one after the other to its end."""
    lights = parts.snapshot.lights
    start = lights._replace(to_world=np.array([drag[0] for drag in drags], np.float32).reshape(lights.to_world.shape))
    other = parts.under(replace(parts.snapshot, lights=start))
    while other.live.refine():
        pass
    known, shown = other.lights.radiance.astype(np.float64), []
    for light, drag in enumerate(drags):
        for to_world in drag[1:]:
            other.lights.change(light, to_world=to_world)
            other.live.frame()
        shown.append(other.shown(light, at_rest=False))
    now, spread = other.lights.radiance, other.live.transport.interpolation
    # As `relight.narrow` has it: of each channel as much as comes nearest.
    factor = (now * known).sum(axis=1) / np.maximum(np.square(known).sum(axis=1), 1e-30)
    return Dragged(shown, now, (now - factor[:, None] * known).astype(np.float32), spread)


def _of_light(parts: Parts, references: References, light: int, at_once: F32, dragged: F32) -> dict[str, Any]:
    """Total error at frame rate, where it comes from, and what is left of it at rest; images are (n_view, 3)."""
    probe, b = references.probe, parts.lights.radiance[light]
    packed = probe.to_pixels(parts.packed.to_view(b)[probe.samples])
    shown = {
        name: probe.to_pixels(image[probe.samples])
        for name, image in (
            ("total", at_once),
            ("dragged", dragged),
            ("at_rest", parts.shown(light, at_rest=True)),
        )
    }
    found = {
        **{
            name: relative_error(image, references.own_b[0][light], references.own_b[1][light])
            for name, image in shown.items()
        },
        "transport": relative_error(packed, references.same_b[0][light], references.same_b[1][light]),
        "cell_light": relative_error_of_halves(
            references.same_b[0][light],
            references.same_b[1][light],
            references.own_b[0][light],
            references.own_b[1][light],
        ),
    }  # fmt: skip
    exact = probe.to_pixels(parts.transport.to_view(b)[probe.samples])
    found["packing"] = _difference(packed, exact, references, light)
    found["unpacked"] = relative_error(exact, references.own_b[0][light], references.own_b[1][light])
    return {name: error.as_dict() for name, error in found.items()}


def _difference(image: F32, exact: F32, references: References, light: int) -> RelativeError:
    """Of two images that both are known, over the light of the reference."""
    a, b = references.same_b[0][light], references.same_b[1][light]
    change = image.astype(np.float64) - exact
    return relative_error_of_halves(a + change, b + change, a, b)


def _lossy(
    parts: Parts, references: References, settings: ErrorSettings, names: list[str], dragged: Dragged
) -> Iterator[tuple[str, dict[str, Any]]]:
    """What is lost with packing, without, dragged and at rest: rows at records as converged as those at the pixels."""
    if parts.transport.interpolation is None:
        return
    probe = references.probe.part(settings.record_pixels, settings.seed)
    kept = np.flatnonzero(np.isin(references.probe.pixel, probe.pixel))
    own, given = parts.lights.radiance, parts.transport.interpolation
    scene = parts.snapshot, parts.tracer, parts.gather, parts.view
    n, every = len(own), np.concatenate([own, dragged.radiance, dragged.rest])
    seeds = settings.seed + 3000, settings.seed + 4000
    losses = lossy_errors(*scene, parts.packed, probe.samples, settings.record_rays, seeds, every)

    def again(packed: PackedTransport, some: I64, seed: int) -> tuple[F32, F32]:
        """The losses, those of some samples by more rays of their own."""
        seeds = settings.seed + seed, settings.seed + seed + 1000
        better = lossy_errors(*scene, packed, probe.samples[some], settings.noisy_rays, seeds, every)
        interpolation, both = losses[0].copy(), losses[1].copy()
        interpolation[:, :, some], both[:, :, some] = better
        return interpolation, both

    def with_weights(spread: SparseRows | None, seed: int) -> tuple[F32, F32]:
        assert spread is not None
        packed = replace(parts.packed, source=replace(parts.transport, interpolation=spread))
        return again(packed, np.flatnonzero(changed_rows(given, spread)[probe.samples]), seed)

    # Of rays that did not choose the pixels: what is measured stays without bias.
    noisy = samples_of_noisy_pixels(probe, (losses[0][:, :n], losses[1][:, :n]), settings.noisy_pixels)
    losses = again(parts.packed, noisy, 5000)
    # Some samples have other weights at rest, which stay while lights are dragged; at rest nothing is packed.
    while parts.live.refine():
        pass
    resting, _ = with_weights(parts.live.transport.interpolation, 7000)
    moving, moving_packed = with_weights(dragged.spread, 9000)
    for light, name in enumerate(names):
        a, b = references.same_b[0][light][kept], references.same_b[1][light][kept]
        found = {}
        kinds = {"interpolation": losses[0], "interpolation_and_packing": losses[1], "lossy_at_rest": resting}
        # What packing loses is linear in the light; that of what is known from rest is not lost.
        kinds["lossy_dragged"] = moving[:, n : 2 * n] + (moving_packed - moving)[:, 2 * n :]
        for kind, off in kinds.items():
            one, two = (probe.to_pixels(half) for half in off[:, light])
            found[kind] = relative_error_of_halves(a + one, b + two, a, b).as_dict()
        yield name, found


def _curve(parts: Parts, references: References, settings: ErrorSettings) -> list[dict[str, Any]]:
    """Errors, bytes and speed by tolerance of packing, and by how many rows there are."""
    found: list[dict[str, Any]] = []
    for tolerance in settings.tolerances:
        found.append(_on_curve(parts, references, parts.transport, parts.pack(tolerance)))
        found[-1] |= {"by": "tolerance of packing", "setting": tolerance}
    for share in settings.shares if parts.transport.interpolation is not None else ():
        other = parts.with_quality(record_share=share)
        found.append(_on_curve(parts, references, other.transport, other.packed))
        found[-1] |= {"by": "share of samples with rows", "setting": share}
    return found


def _on_curve(parts: Parts, references: References, transport: Transport, packed: PackedTransport) -> dict[str, Any]:
    """One point: median and worst error over the lights, bytes, the time of all products of a frame, and frames.

    Frames leave out terms that do not show, and all that did not change; products of a frame with everything do not.
    """
    probe = references.probe
    live = parts.relighter(packed)

    def recolour(i: int) -> None:
        parts.lights.set_gain(0, (1 + 0.1 * (i % 7), 1, 0.9))
        live.frame()

    seconds = repeat(recolour, least=5, seconds=1.0)
    parts.lights.set_gain(0, (1, 1, 1))
    stages = measure_frame(packed, parts.view, parts.lights.total(), parts.lights.view_direct, rounds=5)["stages"]
    whole = next(stage for stage in stages if stage["name"] == "frame" and stage["threads"] == 2)
    total, packing = [], []
    for light, b in enumerate(parts.lights.radiance):
        image, exact = (probe.to_pixels(rows.to_view(b)[probe.samples]) for rows in (packed, transport))
        total.append(relative_error(image, references.own_b[0][light], references.own_b[1][light]).rms)
        packing.append(_difference(image, exact, references, light).rms)
    return {
        "rows": len(transport.row_view),
        "fps": 1 / float(np.median(seconds)),
        "whole_seconds": whole["median_s"],
        "bytes": float(packed.n_bytes),
        "total": float(np.median(total)),
        "packing": float(np.median(packing)),
        "total_worst": max(total),
        "packing_worst": max(packing),
    }


def error_edits(parts: Parts) -> dict[str, Edit]:
    """Edits whose effect is compared."""
    edits = edits_of_objects_and_brushes(parts)
    receivers, casters = (paths[:n] for paths, n in zip(ranked_paths(parts), (4, 8), strict=True))
    edits["gamma"] = one_edit("gamma", "gamma", {"exponent": 0.7}, receivers, casters)
    return edits


def _of_edits(parts: Parts, references: References, settings: ErrorSettings) -> dict[str, Any]:
    """Error of what each edit changes, under all lights at equal strength, over what it changes."""
    probe = references.probe.part(settings.edit_pixels, settings.seed + 1)
    view = view_of(parts.view, probe.samples)
    strength = np.sqrt((references.own_b[0] ** 2).mean(axis=(1, 2)))
    gains = np.repeat((1 / np.maximum(strength, 1e-20))[:, None], 3, axis=1).astype(np.float32)
    evaluators = []
    for half in (0, 1):
        rows = converged_transport(
            parts.snapshot, parts.tracer, parts.gather, view, settings.rays, settings.seed + 1000 * (5 + half)
        )
        cells = CellLight(references.b[half], references.b[half])
        dark = np.zeros((len(gains), view.n, 3), np.float32)
        evaluators.append(Relighter(view, parts.gather, rows, dark, cells))
    found = {}
    for name, edit in error_edits(parts).items():
        field = bind(EditStack("/edit", (edit,)), parts.snapshot)
        changes = []
        for evaluator in evaluators:
            lit = evaluator.relight(field, gains)
            changes.append(probe.to_pixels(lit.indirect_edited - lit.indirect))
        unedited = [probe.to_pixels(evaluator.transport.to_view(evaluator.radiance(gains))) for evaluator in evaluators]
        errors = {}
        for kind, at_rest in (("change", False), ("change_at_rest", True)):
            shown = parts.edit_change(EditStack("/edit", (edit,)), gains, at_rest=at_rest)[probe.samples]
            errors[kind] = relative_error(probe.to_pixels(shown), changes[0], changes[1]).as_dict()
        share = np.sqrt(max((changes[0] * changes[1]).mean(), 0.0) / (unedited[0] * unedited[1]).mean())
        found[name] = errors | {"of_unedited": float(share)}
    return found


def _against_true_hits(
    parts: Parts, references: References, settings: ErrorSettings, names: list[str]
) -> dict[str, Any]:
    """What the cells themselves cost: converged rows of cells against paths that are lit where they hit."""
    probe = references.probe.part(settings.hit_pixels, settings.seed + 2)
    kept = np.flatnonzero(np.isin(references.probe.pixel, probe.pixel))
    view = view_of(parts.view, probe.samples)
    found = {}
    for light, name in enumerate(names):
        alone = one_light_of(parts, light)
        sampler = build_light_sampler(alone, parts.tracer, parts.gather.patch_points, settings.seed)
        gatherer = Gatherer(
            alone, parts.tracer, sampler, settings.hit_rays, settings.n_bounces, bind(EditStack("/none", ()), alone),
            None, (),
        )  # fmt: skip
        stream = np.arange(view.n, dtype=np.int64)
        halves = [probe.to_pixels(_in_chunks(gatherer, view, stream, settings.seed + 77 * half)) for half in (1, 2)]
        a, b = (reference[light][kept] for reference in references.own_b)
        found[name] = relative_error_of_halves(a, b, halves[0], halves[1]).as_dict()
    return found


def _in_chunks(gatherer: Gatherer, view: Any, stream: Any, seed: int) -> F32:
    at_once = max(1, (1 << 18) // gatherer.n_rays)
    out = np.empty((view.n, 3), np.float32)
    for first in range(0, view.n, at_once):
        part = slice(first, min(first + at_once, view.n))
        points = take_points(view.points, part)
        out[part] = gathered_light(gatherer, points, np.ascontiguousarray(view.to_eye[part]), stream[part], seed).base
    return out


def one_light_of(parts: Parts, light: int) -> Any:
    """The scene under one of its lights; a test light, so no mesh."""
    lights = parts.snapshot.lights
    kept = slice(light, light + 1)
    alone = lights._replace(
        kind=lights.kind[kept], to_world=lights.to_world[kept], radiance=lights.radiance[kept],
        size=lights.size[kept], texture=lights.texture[kept], surface=lights.surface[kept],
        triangle_begin=np.zeros(2, np.int64),
    )  # fmt: skip
    whole = parts.snapshot
    return replace(whole, lights=alone, light_paths=whole.light_paths[kept], light_controls=whole.light_controls[kept])


def _images(parts: Parts, references: References, settings: ErrorSettings, names: list[str], folder: Path) -> list[str]:
    """By light: the error at every probed pixel, what packing loses, and reference, preview and difference in full.

    8 % of the light is full colour.
    """
    written = []
    probe = references.probe
    b = ((references.b[0] + references.b[1]) / 2).astype(np.float32)
    seed = settings.seed + 9000
    whole = converged_products(parts.snapshot, parts.tracer, parts.gather, parts.view, settings.sheet_rays, seed, b)
    for light, name in enumerate(names):
        own = parts.lights.radiance[light]
        shown = parts.packed.to_view(own)
        reference = (references.own_b[0][light] + references.own_b[1][light]) / 2
        root = float(np.sqrt(max((references.own_b[0][light] * references.own_b[1][light]).mean(), 1e-30)))
        off = (probe.to_pixels(shown[probe.samples]) - reference) / root
        written.append(write_error_image(folder / f"{parts.name}_{name}_total.png", off, probe))
        lost = (shown - parts.transport.to_view(own)) / root
        written.append(write_signed_image(folder / f"{parts.name}_{name}_packing.png", lost, parts.view))
        sheet = folder / f"{parts.name}_{name}_sheet.png"
        written.append(write_sheet(sheet, whole[light] / root, shown / root, parts.view))
    return written


def overview(found: dict[str, Any]) -> dict[str, float]:
    """Median and worst over the lights of several scenes: ``{stage: measure_errors(...)}``."""
    figures: dict[str, float] = {}
    for kind in (
        "total",
        "at_rest",
        "dragged",
        "while_moving",
        "unpacked",
        "transport",
        "packing",
        "interpolation",
        "interpolation_and_packing",
        "lossy_dragged",
        "lossy_at_rest",
        "cell_light",
    ):
        values = [light[kind]["rms"] for stage in found.values() for light in stage["lights"].values() if kind in light]
        if values:
            figures[f"{kind}_median"] = float(np.median(values))
            figures[f"{kind}_worst"] = float(np.max(values))
    changes = [edit["change"]["rms"] for stage in found.values() for edit in stage["edits"].values()]
    if changes:
        figures["edits_median"], figures["edits_worst"] = float(np.median(changes)), float(np.max(changes))
    return figures
