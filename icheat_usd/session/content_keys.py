"""Names for what is computed, made of everything it depends on: equal keys, equal results.

Frames, sessions and processes that would compute the same thing find it by its key. A key covers the arrays of the
scene, the settings, the sources of this package and the versions of the libraries that take part, so that neither an
edited stage nor another version can be served what was made by other code.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterable
from dataclasses import asdict, dataclass, is_dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

import icheat_usd
from icheat_usd.kernels._jit import compiler_facts
from icheat_usd.scene import LightKind, Lights, SceneSnapshot
from icheat_usd.session.quality import Quality

#: Raised when the meaning of a kept part changes without a change of the sources below.
_FORMAT = 1

#: Packages that nothing in this one imports: their sources cannot take part in what is kept.
_ABOVE = ("cli", "ui")

#: Libraries that take part beside those in `compiler_facts`.
_LIBRARIES = ("embreex", "usd-core")


@dataclass(frozen=True)
class ShotKeys:
    """Keys of one frame seen by one camera, at one quality."""

    scene: str  #: geometry, materials and their textures: what rays meet
    view: str
    gather: str
    bounces: str
    rest_bounces: str
    training: str
    transport: str
    packed: str
    lights: str  #: the lights alone
    cell_light: str
    view_light: str


def shot_keys(snapshot: SceneSnapshot, quality: Quality, engine: str) -> ShotKeys:
    """Keys of everything that is computed from a snapshot."""
    scene = digest(
        _FORMAT,
        code_digest(),
        engine,
        snapshot.geometry,
        [(s.path, s.instance_id, s.part) for s in snapshot.surfaces],
        snapshot.materials._replace(texture=np.sign(snapshot.materials.texture)),
        _images(snapshot, snapshot.materials.texture.ravel()),
    )
    camera = asdict(snapshot.camera)
    for unused in ("path", "exposure_scale"):
        del camera[unused]
    sight = digest(scene, camera, quality.samples_per_pixel, quality.seed)
    lights, domes = (_lights(snapshot, only) for only in (None, LightKind.DOME))
    gather = digest("gather", sight, quality.n_gather)
    bounces = digest("bounces", gather, quality.rays_per_bounce_row)
    rest_bounces = digest("rest bounces", bounces, quality.rest_bounce_rays)
    training = digest("training", bounces)
    # Records stand where light that bounces would show them.
    rows = gather if quality.record_error is None else training
    transport = digest("transport", rows, *_transport_settings(quality))
    packed = digest("packed", transport, training, quality.packing_error, quality.packing_spare)
    cell_light = digest("cell light", bounces, lights, quality.n_bounces, quality.light_samples, quality.dome_places)
    view_light = digest("view light", sight, lights, quality.light_samples, quality.dome_samples)
    view = digest("view", sight, domes)  # the sky behind the scene is part of the view
    return ShotKeys(
        scene, view, gather, bounces, rest_bounces, training, transport, packed, lights, cell_light, view_light
    )


def snapshot_key(snapshot: SceneSnapshot, engine: str) -> str:
    """Key of all that a final frame takes from a snapshot, and of the code that makes it."""
    tables = (snapshot.geometry, snapshot.materials, snapshot.textures, snapshot.lights, snapshot.light_paths)
    surfaces = [(s.path, s.instance_id, s.part, s.topology_digest) for s in snapshot.surfaces]
    place = (asdict(snapshot.camera), snapshot.centre, snapshot.radius)
    names = (snapshot.material_paths, snapshot.light_tags)
    return digest(_FORMAT, code_digest(), engine, tables, surfaces, names, place)


def _transport_settings(quality: Quality) -> tuple[Any, ...]:
    """All settings but those that other keys hold, or that come after the transport."""
    elsewhere = {"n_gather", "rays_per_bounce_row", "rest_bounce_rays", "n_bounces"}
    elsewhere |= {"light_samples", "dome_samples", "dome_places", "samples_per_pixel"}
    at_records, everywhere = {"record_rays", "record_share"}, {"rays_per_row", "row_spacing", "shared_rays"}
    unused = at_records if quality.record_error is None else everywhere
    without = elsewhere | unused | {"packing_error", "packing_spare", "moving_detail"}
    return tuple((name, value) for name, value in asdict(quality).items() if name not in without)


def _lights(snapshot: SceneSnapshot, kind: LightKind | None) -> str:
    lights = snapshot.lights
    which = np.arange(len(lights.kind)) if kind is None else np.flatnonzero(lights.kind == kind)
    spans = [
        (lights.triangle[begin:end], lights.triangle_instance[begin:end])
        for begin, end in zip(lights.triangle_begin[which], lights.triangle_begin[which + 1], strict=True)
    ]
    per_light = ("kind", "to_world", "radiance", "size", "surface")
    columns = [getattr(lights, name)[which] for name in per_light]
    # How a camera sees the sky does not depend on what the sky lights.
    controls = snapshot.light_controls if kind is None else ()
    return digest(snapshot.radius, columns, spans, controls, _images(snapshot, lights.texture[which]))


def light_digest(lights: Lights, row: int) -> str:
    """Key of what one analytic light is, apart from its image."""
    return digest(*(getattr(lights, name)[row] for name in ("kind", "to_world", "radiance", "size", "texture")))


def _images(snapshot: SceneSnapshot, rows: Iterable[int]) -> list[Any]:
    """Each image in `rows`, in that order; -1 is none."""
    textures = snapshot.textures
    known: dict[int, str] = {}
    for row in {int(row) for row in rows if row >= 0}:
        size = int(textures.width[row]), int(textures.height[row])
        begin = int(textures.begin[row])
        known[row] = digest(size, textures.wrap[row], textures.texels[begin : begin + size[0] * size[1]])
    return [known.get(int(row), "") for row in rows]


@functools.cache
def code_digest() -> str:
    """Digest of everything but data that decides what is computed; about 10 ms, once."""
    root = Path(icheat_usd.__file__).parent
    found = hashlib.sha256(compiler_facts().encode())
    found.update("\n".join(f"{name} {library_version(name)}" for name in _LIBRARIES).encode())
    for path in code_files(root):
        source = path.read_bytes()
        found.update(f"{path.relative_to(root).as_posix()} {len(source)}\n".encode() + source)
    return found.hexdigest()[:32]


def code_files(root: Path) -> tuple[Path, ...]:
    """Sources below a folder of this package that may take part in what is kept: too many rather than one too few."""
    return tuple(sorted(path for path in root.rglob("*.py") if path.relative_to(root).parts[0] not in _ABOVE))


def library_version(package: str) -> str:
    """Of an installed package; "none" if it is not there."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "none"


def digest(*values: Any) -> str:
    """128 bits (hex) of numbers, texts, arrays, and tuples, lists, dicts, dataclasses or named tuples of such.

    Raises
    ------
    TypeError
        Something is none of these: what cannot be told apart must not share a key.
    """
    found = hashlib.blake2b(digest_size=16)
    _feed(found, values)
    return found.hexdigest()


def _feed(found: Any, value: Any) -> None:
    if isinstance(value, np.ndarray):
        found.update(f"array {value.dtype.str} {value.shape}:".encode())
        found.update(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data if value.size else b"")
    elif value is None or isinstance(value, (bool, int, float, str, np.generic)):
        text = value if isinstance(value, str) else repr(value)
        found.update(f"{type(value).__name__} {len(text)}:{text}".encode())
    elif is_dataclass(value) and not isinstance(value, type):
        _feed(found, {name: getattr(value, name) for name in value.__dataclass_fields__})
    elif isinstance(value, (tuple, list)):
        found.update(f"{len(value)} values:".encode())
        for part in value:
            _feed(found, part)
    elif isinstance(value, dict):
        found.update(f"{len(value)} names:".encode())
        for name, part in value.items():
            _feed(found, (name, part))
    else:
        raise TypeError(f"a {type(value).__name__} has no digest")
