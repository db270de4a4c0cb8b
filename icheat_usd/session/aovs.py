"""Films of a final gather, with the layers that are asked for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from icheat_usd.edits.model import EditStack
from icheat_usd.errors import ImageError
from icheat_usd.final_gather import Extras, FinalGather
from icheat_usd.image.cryptomatte import Cryptomatte, manifest, rank
from icheat_usd.image.film import Film
from icheat_usd.scene import F32, F64, SceneSnapshot
from icheat_usd.session.layer_names import MATTES, MEMBERS, SCALARS, Layer, channel_name

#: The ratio of edited to unedited light where there was little of it: what the limit cuts off, edit_delta has.
RATIO_LIMIT = 64.0


#: What a layer of a light is the sum of.
_PARTS = {
    "light": ("seen", "direct", "indirect_edited"),
    "light_direct": ("seen", "direct"),
    "light_indirect": ("indirect",),
    "light_indirect_edited": ("indirect_edited",),
}


@dataclass(frozen=True)
class Scene:
    """What lights and edits are called in layers: paths by name."""

    lights: Mapping[str, tuple[str, ...]]  #: a group has several
    edits: Mapping[str, str]


def layer_scene(snapshot: SceneSnapshot, stack: EditStack) -> Scene:
    """Names for the lights of a snapshot and the active edits of a stack; two of one name are numbered.

    Lights of one tag are a group, which is called like it.
    """
    groups: dict[tuple[str, str], dict[str, None]] = {}
    tags = snapshot.light_tags or ("",) * len(snapshot.light_paths)
    for path, tag in zip(snapshot.light_paths, tags, strict=True):
        groups.setdefault((tag, "" if tag else path), {})[path] = None
    # A group keeps its name where a light has the same.
    ordered = sorted(groups, key=lambda group: not group[0])
    named = dict(zip(ordered, names_of([tag or path for tag, path in ordered]), strict=True))
    edits = tuple(edit.path for edit in stack.active)
    return Scene(
        {named[group]: tuple(paths) for group, paths in groups.items()},
        dict(zip(names_of(edits), edits, strict=True)),
    )


def names_of(paths: Sequence[str]) -> list[str]:
    """The last part of each path as the name of a channel; numbered where two share one."""
    seen: dict[str, int] = {}
    names = []
    for path in paths:
        name = channel_name(path.rpartition("/")[2])
        seen[name] = seen.get(name, 0) + 1
        names.append(name if seen[name] == 1 else f"{name}_{seen[name]}")
    return names


def expanded(layers: Iterable[Layer], scene: Scene) -> tuple[Layer, ...]:
    """Layers of a frame: families as their members, each layer once.

    Raises
    ------
    ImageError
        A light or an edit is not there at this frame, or two layers share a name.
    """
    found: dict[str, Layer] = {}
    for layer in layers:
        members = [layer]
        for family, prefix in MEMBERS.items():
            names = _names(prefix, scene)
            if layer.source == family:
                members = [Layer(f"{prefix}.{name}", f"{prefix}.{name}") for name in names]
            elif layer.source.startswith(f"{prefix}.") and layer.source.partition(".")[2] not in names:
                there = ", ".join(f"{prefix}.{name}" for name in names) or "none"
                raise ImageError(f"there is no layer '{layer.source}' at this frame; there are {there}")
        for member in members:
            if found.setdefault(member.name, member).source != member.source:
                raise ImageError(
                    f"two layers, {found[member.name].source} and {member.source}, are both called '{member.name}'"
                )
    return tuple(found.values())


def needed(layers: Iterable[Layer], scene: Scene) -> Extras:
    """What the final gather has to compute for expanded layers beside the usual ones."""
    sources = {layer.source for layer in layers}
    of_lights = {source.partition(".")[::2] for source in sources if source.startswith("light")}
    wanted = {name for _, name in of_lights}
    lights = {name: paths for name, paths in scene.lights.items() if name in wanted or "unlit" in sources}
    return Extras(
        contributions=any(source.startswith("edit.") for source in sources),
        light_groups=lights,
        indirect="unlit" in sources or any(prefix != "light_direct" for prefix, _ in of_lights),
        objects=not sources.isdisjoint({"alpha", "crypto_object"}),
        edits="crypto_edit" in sources,
    )


def _names(prefix: str, scene: Scene) -> Mapping[str, object]:
    """Names of the members of a family."""
    return scene.edits if prefix == "edit" else scene.lights


def make_film(
    result: FinalGather,
    layers: Iterable[Layer],
    scene: Scene,
    snapshot: SceneSnapshot,
    metadata: Mapping[str, str],
) -> Film:
    """Expanded layers of a final gather as a film; its metadata name the prims of lights and edits."""
    height, width, _ = result.indirect.shape
    pixels: dict[str, F32] = {}
    mattes = []
    about = dict(metadata)
    for layer in layers:
        if layer.source in MATTES:
            mattes.append(_matte(result, layer, scene, snapshot))
            continue
        values = _values(result, layer.source, scene)
        shape = (height, width) if layer.source in SCALARS else (height, width, 3)
        pixels[layer.name] = np.ascontiguousarray(values.reshape(shape), np.float32)
        family, _, name = layer.source.partition(".")
        if name:
            about[f"layer:{layer.name}"] = scene.edits[name] if family == "edit" else ", ".join(scene.lights[name])
    return Film(width, height, pixels, about, tuple(mattes), pixel_aspect(snapshot))


def pixel_aspect(snapshot: SceneSnapshot) -> float:
    """Width of a pixel over its height, to six digits: what rounding makes of a square is square."""
    left, right, bottom, top = snapshot.camera.window
    aspect = (right - left) / (top - bottom) * snapshot.camera.height / snapshot.camera.width
    return float(f"{aspect:.6g}")


def _values(result: FinalGather, source: str, scene: Scene) -> F64:
    direct = result.background + result.emission + result.direct
    if source == "beauty":
        return direct + result.indirect_edited
    if source == "direct":
        return direct
    if source == "edit_delta":
        return result.indirect_edited - result.indirect
    if source == "edit_ratio":
        return edit_ratio(direct + result.indirect_edited, direct + result.indirect)
    if source == "records":
        return _records(result)
    if source == "alpha":
        covered = result.coverage["object"]
        height, width, _ = direct.shape
        return np.bincount(covered.pixel, covered.share, height * width).astype(np.float64)
    family, _, name = source.partition(".")
    if source == "unlit":
        return result.indirect_edited - sum(result.light_groups["indirect_edited", light] for light in scene.lights)
    if family in _PARTS:
        return sum((result.light_groups[kind, name] for kind in _PARTS[family]), np.zeros_like(result.indirect))
    if family == "edit":
        # An edit that rests at this frame was not bound.
        return result.contributions.get(scene.edits[name], np.zeros_like(result.indirect))
    values: F64 = getattr(result, source)
    return values


def _records(result: FinalGather) -> F64:
    """Number of records in each pixel, widest reach and coarsest spacing."""
    height, width, _ = result.indirect.shape
    found = np.zeros((height * width, 3))
    if result.records is not None:
        pixel, reach, spacing = result.records
        found[:, 0] = np.bincount(pixel, minlength=height * width)
        np.maximum.at(found[:, 1], pixel, reach)
        np.maximum.at(found[:, 2], pixel, spacing)
    return found


def edit_ratio(edited: F64, unedited: F64) -> F64:
    """Edited over unedited light per channel: 1 where they are equal, `RATIO_LIMIT` at most.

    A ratio cannot put light where there was none; there it is the limit, and `edit_delta` has the whole change.
    """
    limit = np.full_like(edited, RATIO_LIMIT)
    ratio = np.divide(edited, unedited, out=limit, where=unedited > 0)
    return np.where(edited == unedited, 1.0, np.clip(ratio, 0.0, RATIO_LIMIT))


def _matte(result: FinalGather, layer: Layer, scene: Scene, snapshot: SceneSnapshot) -> Cryptomatte:
    kind = MATTES[layer.source].kind
    covered = result.coverage[kind]
    height, width, _ = result.indirect.shape
    names = {surface.path for surface in snapshot.surfaces} if kind == "object" else set(scene.edits.values())
    ranks = rank(covered, width * height).reshape(height, width, -1, 2)
    return Cryptomatte(layer.name, ranks, manifest(names, covered.id))
