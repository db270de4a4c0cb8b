"""What a payload is made against, as a few short texts and numbers that travel in it.

Geometry and lights are tables of text: a line for each surface or light, with
digests of what is exact and numbers of what is not. Where something stands is
a number, because its last bits depend on the rest of the scene: positions are
kept about the scene's centre. Paths are relative to an anchor, so that a
reference under another name changes nothing.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from icheat_usd.edits.model import Edit, Limit
from icheat_usd.scene import F64, PLAIN, LightKind, SceneSnapshot

Facts = dict[str, str | float | int]

Row = TypeVar("Row")

#: Most surfaces and lights that a payload names one by one; the others are summed up in one line.
MAX_SURFACES, MAX_LIGHTS = 256, 64

#: Path of the line that sums up the others.
OTHERS = "*"

#: Texels of one image that are looked at.
_MAX_TEXELS = 1 << 14


class SurfaceFacts(NamedTuple):
    """All surfaces of one path: one, or those of a point instancer."""

    n: int
    topology: str  #: digest of control faces, 8 hexadecimal digits; summed over surfaces, as `shape` is
    shape: str  #: digest of points and normals in object space
    look: str  #: digest of materials, where the light matters; else zero
    place: F64  #: (3, 4) mean transform, metres about the scene's centre
    spread: float  #: root of the mean square deviation from it


class LightFacts(NamedTuple):
    """One light, or the sum of several."""

    n: int
    kind: str  #: as in `LightKind`
    image: str  #: digest of its texture and of its controls, "" for neither
    radiance: F64  #: (3,) mean
    size: F64  #: (2,)
    place: F64  #: (3, 4)


def facts(
    snapshot: SceneSnapshot,
    anchor: str = "/",
    *,
    geometry: bool = True,
    lights: bool = True,
    edit: Edit | None = None,
    limit: bool = True,
) -> Facts:
    """Facts about a scene that a payload may depend on; about 10 ms for 150,000 triangles.

    Parameters
    ----------
    anchor
        Scene path that surface paths in the payload are relative to.
    geometry, lights
        What the payload depends on; see `staleness.Needs`. Lights include the materials that colour their bounces.
    edit
        Given one, the facts hold what it selects too.
    limit
        False names all surfaces and lights: to compare with, not to store.
    """
    camera = snapshot.camera
    found: Facts = {
        "camera": relative(camera.path, anchor),
        "width": camera.width,
        "height": camera.height,
    }
    if snapshot.time_code is not None:
        found["time"] = float(snapshot.time_code)
    if geometry or lights:
        view = [*camera.to_world.ravel(), *camera.window, camera.lens_radius, camera.focus_distance]
        found["camera-view"] = _numbers(view)
        found["orthographic"] = int(camera.orthographic)
        found["centre"] = " ".join(repr(float(x)) for x in snapshot.centre)
        found["radius"] = float(snapshot.radius)
    if geometry:
        rows = surface_facts(snapshot, anchor, looks=lights)
        found["surfaces"] = _write_surfaces(rows, MAX_SURFACES if limit else None)
    if lights:
        light_rows = light_facts(snapshot, anchor)
        found["lights"] = _write_lights(light_rows, MAX_LIGHTS if limit else None)
    if edit is not None:
        found |= selection_facts(edit, anchor)
    return found


def relative(path: str, anchor: str) -> str:
    """`path` from `anchor` on where it lies at or below it, else as it is."""
    prefix = anchor.rstrip("/") + "/"
    if path == anchor:
        return "."
    return path[len(prefix) :] if prefix != "/" and path.startswith(prefix) else path


def selection_facts(edit: Edit, anchor: str) -> Facts:
    """What an edit selects: digests that change when its members, limits, target, lights or occluders do."""

    def limit_text(limit: Limit) -> str:
        parts = getattr(limit, "parts", None)
        if parts is not None:
            return f"{getattr(limit, 'rule', '')}({','.join(limit_text(part) for part in parts)})"
        paths = getattr(limit, "paths", None) or getattr(limit, "materials", None)
        if paths is not None:
            return f"{type(limit).__name__}({sorted(relative(path, anchor) for path in paths)})"
        # Through float32, so that the last bits of a composed transform do not count.
        place = [f"{np.float32(x):.4g}" for x in getattr(limit, "to_shape", ())]
        return f"{getattr(limit, 'shape', '')}{place}{getattr(limit, 'softness', '')}"

    def digest(*texts: object) -> str:
        return hashlib.blake2b(repr(texts).encode(), digest_size=6).hexdigest()

    def paths(names: Iterable[str]) -> list[str]:
        return sorted(relative(name, anchor) for name in names)

    sides = {
        name: digest(paths(side.paths), [limit_text(limit) for limit in side.limits])
        for name, side in (("receivers", edit.receivers), ("casters", edit.casters))
    }
    target = [f"{x:.4g}" for x in edit.target or ()]
    others = digest(paths(edit.occluders), paths(edit.lights), target)
    return {**sides, "aims": others}


# --------------------------------------------------------------------------- surfaces


def surface_facts(snapshot: SceneSnapshot, anchor: str, *, looks: bool) -> dict[str, SurfaceFacts]:
    """Facts of every surface path, in the order of the snapshot."""
    geometry = snapshot.geometry
    n_meshes = len(geometry.mesh_begin) - 1
    shapes = [_shape_digest(snapshot, mesh) for mesh in range(n_meshes)]
    seen = _look_digests(snapshot) if looks else [""] * n_meshes
    rows: dict[str, list[int]] = {}
    for instance, surface in enumerate(geometry.instance_surface.tolist()):
        rows.setdefault(snapshot.surfaces[surface].path, []).append(instance)
    found = {}
    for path, instances in rows.items():
        places = geometry.instance_to_world[instances].astype(np.float64)
        place = places.mean(axis=0)
        surfaces = [snapshot.surfaces[geometry.instance_surface[i]] for i in instances]
        found[relative(path, anchor)] = SurfaceFacts(
            len(instances),
            _sum_digests(surface.topology_digest[:8] for surface in surfaces),
            _sum_digests(shapes[mesh] for mesh in geometry.instance_mesh[instances].tolist()),
            _sum_digests(seen[mesh] for mesh in geometry.instance_mesh[instances].tolist()),
            place,
            float(np.sqrt(np.square(places - place).sum(axis=(1, 2)).mean())),
        )
    return found


def sum_surfaces(rows: Iterable[SurfaceFacts]) -> SurfaceFacts | None:
    """Several lines as one; None for none."""
    rows = list(rows)
    if not rows:
        return None
    n = sum(row.n for row in rows)
    counts = np.array([row.n for row in rows], np.float64)
    places = np.array([row.place for row in rows])
    place = np.tensordot(counts, places, 1) / n
    square = np.array([row.spread**2 for row in rows]) + np.square(places - place).sum(axis=(1, 2))
    return SurfaceFacts(
        n,
        _sum_digests(row.topology for row in rows),
        _sum_digests(row.shape for row in rows),
        _sum_digests(row.look for row in rows),
        place,
        float(np.sqrt(counts @ square / n)),
    )


def read_surfaces(text: str) -> dict[str, SurfaceFacts]:
    """The table that `facts` wrote. Raises `ValueError` for anything else."""
    found = {}
    for line in text.splitlines():
        path, digests, place, *several = line.split("\t")
        topology, shape, look = digests.split()
        for digest in (topology, shape, look):
            int(digest, 16)
        n, spread = (int(several[0]), float(several[1])) if several else (1, 0.0)
        found[path] = SurfaceFacts(n, topology, shape, look, _read_place(place), spread)
    return found


def _write_surfaces(rows: Mapping[str, SurfaceFacts], limit: int | None) -> str:
    def line(path: str, row: SurfaceFacts) -> str:
        cells = [path, f"{row.topology} {row.shape} {row.look}", _place(row.place)]
        return "\t".join([*cells, *([str(row.n), f"{row.spread:.7g}"] if row.n > 1 else [])])

    named, others = _split(rows, limit)
    rest = sum_surfaces(others)
    return "\n".join([line(path, row) for path, row in named] + ([line(OTHERS, rest)] if rest else []))


def _shape_digest(snapshot: SceneSnapshot, mesh: int) -> str:
    rows = slice(int(snapshot.geometry.mesh_begin[mesh]), int(snapshot.geometry.mesh_begin[mesh + 1]))
    digest = hashlib.blake2b(digest_size=4)
    for table in (snapshot.geometry.points, snapshot.geometry.normals):
        digest.update(np.ascontiguousarray(table[rows]).data)
    return digest.hexdigest()


def _sum_digests(digests: Iterable[str]) -> str:
    """One of many, whatever their order; that of one is itself."""
    return f"{sum(int(digest or '0', 16) for digest in digests) & 0xFFFF_FFFF:08x}"


# --------------------------------------------------------------------------- lights


def light_facts(snapshot: SceneSnapshot, anchor: str) -> dict[str, LightFacts]:
    """Facts of every light, by path."""
    lights = snapshot.lights
    found: dict[str, LightFacts] = {}
    for row, path in enumerate(snapshot.light_paths):
        radiance = lights.radiance[row].astype(np.float64)
        kind, image = LightKind(int(lights.kind[row])), _image_digest(snapshot, int(lights.texture[row]))
        if snapshot.controls(row) is not PLAIN:
            image = _sum_digests([image, _controls_digest(snapshot, row, anchor)])
        place = lights.to_world[row].astype(np.float64)
        if kind is LightKind.MESH:
            triangles = lights.triangle[lights.triangle_begin[row] : lights.triangle_begin[row + 1]]
            materials = snapshot.geometry.material[triangles]
            radiance = radiance * snapshot.materials.emission[materials].astype(np.float64).mean(axis=0)
        name = relative(path, anchor)
        while name in found:  # several placements of one prototype
            name += "'"
        found[name] = LightFacts(1, kind.name.lower(), image, radiance, lights.size[row].astype(np.float64), place)
    return found


def sum_lights(rows: Iterable[LightFacts]) -> LightFacts | None:
    """Several lines as one; None for none."""
    rows = list(rows)
    if not rows:
        return None
    counts = np.array([row.n for row in rows], np.float64)
    n = int(counts.sum())

    def mean(name: str) -> F64:
        values: F64 = np.tensordot(counts, np.array([getattr(row, name) for row in rows]), 1) / n
        return values

    images = _sum_digests(row.image for row in rows)
    return LightFacts(n, OTHERS, images, mean("radiance"), mean("size"), mean("place"))


def read_lights(text: str) -> dict[str, LightFacts]:
    """The table that `facts` wrote. Raises `ValueError` for anything else."""
    found = {}
    for line in text.splitlines():
        path, n, kind, image, radiance, size, place = line.split("\t")
        found[path] = LightFacts(
            int(n),
            kind,
            image,
            _read_numbers(radiance, 3),
            _read_numbers(size, 2),
            _read_place(place),
        )
    return found


def _write_lights(rows: Mapping[str, LightFacts], limit: int | None) -> str:
    def line(path: str, row: LightFacts) -> str:
        numbers = (_numbers(row.radiance), _numbers(row.size), _place(row.place))
        return "\t".join([path, str(row.n), row.kind, row.image, *numbers])

    named, others = _split(rows, limit)
    rest = sum_lights(others)
    return "\n".join([line(path, row) for path, row in named] + ([line(OTHERS, rest)] if rest else []))


# --------------------------------------------------------------------------- materials


def _look_digests(snapshot: SceneSnapshot) -> list[str]:
    """One for each mesh, of everything about its materials that colours light."""
    geometry, materials = snapshot.geometry, snapshot.materials
    tables: dict[str, NDArray[Any]] = materials._asdict()
    of_material = []
    for row in range(len(materials.metallic)):
        digest = hashlib.blake2b(digest_size=8)
        for name, table in tables.items():
            if name != "texture":  # rows, which say nothing by themselves
                digest.update(np.ascontiguousarray(table[row]).tobytes())
        for image in materials.texture[row].tolist():
            digest.update(_image_digest(snapshot, image).encode() or b"-")
        of_material.append(digest.digest())
    shows_colour = materials.use_display_color.astype(bool)
    found = []
    for begin, end in zip(geometry.mesh_begin[:-1].tolist(), geometry.mesh_begin[1:].tolist(), strict=True):
        rows = geometry.material[begin:end]
        used, inverse = np.unique(rows, return_inverse=True)
        digest = hashlib.blake2b(b"".join(of_material[row] for row in used.tolist()), digest_size=4)
        if len(used) > 1:
            digest.update(np.ascontiguousarray(inverse, np.int32).data)
        if shows_colour[used].any():
            digest.update(np.ascontiguousarray(geometry.color[begin:end]).data)
        found.append(digest.hexdigest())
    return found


def _controls_digest(snapshot: SceneSnapshot, row: int, anchor: str) -> str:
    """Of links by the surfaces' names, so that other surfaces elsewhere do not count."""
    controls = snapshot.controls(row)
    digest = hashlib.blake2b(repr((controls.diffuse, controls.specular)).encode(), digest_size=4)
    for table in (controls.receivers, controls.blockers):
        out = np.zeros(0, np.int64) if table is None else np.flatnonzero(table == 0)
        names = {snapshot.surfaces[surface].path for surface in snapshot.geometry.instance_surface[out].tolist()}
        digest.update(repr((table is None, sorted(relative(name, anchor) for name in names))).encode())
    for value in controls.shaping or ():
        digest.update(np.ascontiguousarray(value, np.float64).data)
    return digest.hexdigest()


def _image_digest(snapshot: SceneSnapshot, row: int) -> str:
    if row < 0:
        return ""
    textures = snapshot.textures
    size = int(textures.width[row]), int(textures.height[row])
    n = size[0] * size[1]
    begin = int(textures.begin[row])
    texels = textures.texels[begin : begin + n : max(1, n // _MAX_TEXELS)]
    digest = hashlib.blake2b(repr(size).encode(), digest_size=4)
    digest.update(np.ascontiguousarray(texels).data)
    return digest.hexdigest()


# --------------------------------------------------------------------------- text


def _split(rows: Mapping[str, Row], limit: int | None) -> tuple[list[tuple[str, Row]], list[Row]]:
    items = list(rows.items())
    if limit is None or len(items) <= limit:
        return items, []
    return items[: limit - 1], [row for _, row in items[limit - 1 :]]


def _numbers(values: Iterable[float] | NDArray[np.floating]) -> str:
    # Six digits: nearly what float32 holds. `+ 0.0` makes -0 and 0 one text.
    return " ".join(f"{float(value) + 0.0:.6g}" for value in values)


def _place(place: F64) -> str:
    """A (3, 4) transform: four numbers, scale and translation, where it does not turn anything; else all twelve."""
    scale = float(np.trace(place[:, :3])) / 3
    if scale > 0 and np.abs(place[:, :3] - scale * np.eye(3)).max() <= 1e-6 * scale:
        return _numbers([scale, *place[:, 3]])
    # What is tiny beside the others is rounding, and would only be long.
    kept = np.where(np.abs(place) > 1e-7 * np.abs(place).max(axis=0), place, 0.0)
    return _numbers(kept.ravel())


def _read_place(text: str) -> F64:
    n = len(text.split())
    if n != 4:
        return _read_numbers(text, 12).reshape(3, 4)
    scale, *translation = _read_numbers(text, 4)
    return np.concatenate([scale * np.eye(3), np.reshape(translation, (3, 1))], axis=1)


def _read_numbers(text: str, n: int) -> F64:
    values = np.array([float(word) for word in text.split()], np.float64)
    if len(values) != n or not np.isfinite(values).all():
        raise ValueError(f"{n} numbers expected")
    return values
