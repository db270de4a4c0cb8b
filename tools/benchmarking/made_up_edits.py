"""Edits for any scene: between what the camera sees most of, and what it is lit by most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from icheat_usd.edits.model import Edit, EditStack, KeyedPayload, Payload, Selection
from icheat_usd.edits.painting import paint_mask, soft_sphere
from icheat_usd.errors import EditError
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.scene import SceneSnapshot


class Sampled(Protocol):
    """A scene with its samples; a session is one."""

    @property
    def snapshot(self) -> SceneSnapshot: ...
    @property
    def view(self) -> ViewSamples: ...
    @property
    def gather(self) -> GatherSamples: ...


def one_edit(
    name: str, operation: str, parameters: dict[str, Any], receivers: Sequence[str], casters: Sequence[str]
) -> Edit:
    """An edit of whole surfaces, by scene path."""
    return Edit(f"/{name}", operation, parameters, Selection(frozenset(receivers)), Selection(frozenset(casters)))


def ranked_paths(scene: Sampled) -> tuple[list[str], list[str]]:
    """Paths of surfaces, those seen most first, and those that send most first; others are left out."""
    surface = scene.snapshot.geometry.instance_surface
    names = [s.path for s in scene.snapshot.surfaces]

    def ranked(instance: Any) -> list[str]:
        count = np.bincount(surface[instance], minlength=len(names))
        order = np.argsort(-count, kind="stable")
        return list(dict.fromkeys(names[i] for i in order if count[i]))

    return ranked(scene.view.points.instance), ranked(scene.gather.points.instance)


def painted(scene: Sampled, edit: Edit, side: str, centre: Any = None, radius: float | None = None) -> Edit:
    """The edit with a soft round mask: by default around the middle of what it selects on that side."""
    points = scene.view.points if side == "receiver_mask" else scene.gather.points
    paths = edit.receivers.paths if side == "receiver_mask" else edit.casters.paths
    if centre is None or radius is None:
        position = points.position[_on(scene.snapshot, points.instance, paths)]
        spread = 0.5 * float(np.linalg.norm(position.std(axis=0)) + 1e-3)
        centre = np.median(position, axis=0)
        inner, outer = 0.3 * spread, 2 * spread
    else:
        inner, outer = 0.5 * radius, radius
    mask = paint_mask(scene.snapshot, paths, soft_sphere(tuple(float(x) for x in centre), inner, outer))
    payload = edit.keys[0].payload if edit.keys else Payload(edit.operation, edit.parameters)
    return replace(edit, keys=(KeyedPayload(replace(payload, **{side: mask}), 1.0),))


def edits_of_objects_and_brushes(scene: Sampled) -> dict[str, Edit]:
    """Some of each kind, by name."""
    receivers, casters = (paths[:n] for paths, n in zip(ranked_paths(scene), (4, 8), strict=True))
    brush = painted(
        scene, one_edit("brush", "scale", {"gain": 2.0, "color": (1.0, 0.8, 0.6)}, receivers[:2], casters[:2]),
        "receiver_mask",
    )  # fmt: skip
    dab = one_edit("dab", "hsv", {"hue": -60.0}, receivers[:2], casters[:2])
    return {
        "object scale": one_edit("objects", "scale", {"gain": 0.5}, receivers, casters),
        "object hsv": one_edit("hue", "hsv", {"hue": 40.0, "saturation": 1.5}, receivers, casters[:4]),
        "brush scale": painted(scene, brush, "caster_mask"),
        "brush hsv": painted(scene, dab, "receiver_mask"),
        "falloff": one_edit("falloff", "falloff", {"exponent": 1.0}, receivers[:1], casters[:2]),
    }


def many_edits(scene: Sampled, n: int = 64, overlapping: int = 16, *, mixed: bool = False, seed: int = 0) -> EditStack:
    """`n` edits, `overlapping` of them on the same receivers in ever other combinations, the others apart.

    They scale by a colour; `mixed`, every fourth turns the hue instead. Of those that overlap every fourth
    has a soft painted mask; those apart are objects while there are enough, and painted patches.
    """
    rng = np.random.default_rng([seed, 0x64])
    seen, sending = ranked_paths(scene)
    shared = _up_to_a_quarter(scene, seen)
    apart = seen[len(shared) :] or shared
    edits = []
    for i in range(overlapping):
        # Every edit on at least half of the shared surfaces: any two meet somewhere.
        some = rng.choice(shared, max(1, (len(shared) + 1) // 2), replace=False).tolist()
        edit = _of_kind(f"over{i:02d}", i, some, _some(rng, sending), rng, mixed)
        edits.append(_or_whole(scene, edit) if i % 4 == 3 else edit)
    edits += _edits_apart(scene, n - overlapping, apart, sending, rng, mixed)
    order = rng.permutation(len(edits))
    return EditStack("/ManyEdits", tuple(edits[i] for i in order))


def _edits_apart(
    scene: Sampled, n: int, paths: list[str], sending: list[str], rng: np.random.Generator, mixed: bool
) -> list[Edit]:
    n_objects = min(n, len(paths)) if len(paths) >= n else len(paths) // 2
    edits = []
    objects, carriers = (
        (paths[:n], []) if len(paths) >= n else (paths[len(paths) - n_objects :], paths[: -n_objects or None])
    )
    for i, path in enumerate(objects):
        edits.append(_of_kind(f"object{i:02d}", i, [path], _some(rng, sending), rng, mixed))
    n_patches = n - len(edits)
    if n_patches <= 0:
        return edits
    points = scene.view.points
    on = _on(scene.snapshot, points.instance, frozenset(carriers))
    centres = _far_apart(points.position[on], n_patches, rng)
    radius = 0.5 * _nearest(centres)
    for i, (centre, reach) in enumerate(zip(centres, radius.tolist(), strict=True)):
        edit = _of_kind(f"patch{i:02d}", i, carriers, _some(rng, sending), rng, mixed)
        edits.append(_or_whole(scene, edit, centre, max(reach, 1e-4)))
    return edits


def _of_kind(
    name: str, number: int, receivers: list[str], casters: list[str], rng: np.random.Generator, mixed: bool
) -> Edit:
    if mixed and number % 4 == 2:
        return one_edit(name, "hsv", {"hue": float(rng.uniform(-60, 60)), "saturation": 1.3}, receivers, casters)
    color = tuple(float(x) for x in rng.uniform(0.5, 1.5, 3))
    return one_edit(name, "scale", {"gain": 1.2, "color": color}, receivers, casters)


def _or_whole(scene: Sampled, edit: Edit, centre: Any = None, radius: float | None = None) -> Edit:
    """Painted, or as it is where the brush meets no texel."""
    try:
        found = painted(scene, edit, "receiver_mask", centre, radius)
    except EditError:
        return edit
    mask = found.keys[0].payload.receiver_mask
    return found if mask is not None and mask.texels.any() else edit


def _some(rng: np.random.Generator, sending: list[str]) -> list[str]:
    """One to three casters of those that send most."""
    first = sending[:16]
    return rng.choice(first, min(len(first), int(rng.integers(1, 4))), replace=False).tolist()


def _up_to_a_quarter(scene: Sampled, seen: list[str]) -> list[str]:
    """The most seen surfaces, four at least, up to a quarter of the view."""
    shared: list[str] = []
    covered = 0
    for path in seen[: max(1, len(seen) - 1)]:
        if len(shared) >= 4 and covered > 0.25 * scene.view.n:
            break
        shared.append(path)
        covered += int(_on(scene.snapshot, scene.view.points.instance, frozenset([path])).sum())
    return shared


def _on(snapshot: SceneSnapshot, instance: Any, paths: Any) -> Any:
    rows = [i for i, surface in enumerate(snapshot.surfaces) if surface.path in paths]
    return np.isin(snapshot.geometry.instance_surface[instance], rows)


def _far_apart(position: Any, n: int, rng: np.random.Generator) -> Any:
    """`n` of the places, each as far from the others as can be."""
    places = position[rng.choice(len(position), min(len(position), 4000), replace=False)]
    chosen = [0]
    distance = np.linalg.norm(places - places[0], axis=1)
    while len(chosen) < min(n, len(places)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return places[chosen]


def _nearest(places: Any) -> Any:
    """Distance of each place to the nearest other."""
    between = np.linalg.norm(places[:, None] - places[None], axis=2)
    np.fill_diagonal(between, np.inf)
    nearest = between.min(axis=1)
    return np.where(np.isfinite(nearest), nearest, 0.1)
