"""References on disk: two independent halves of a scene's light, which grow with every run that has time for it."""

from __future__ import annotations

import hashlib
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from icheat_usd.scene import F64, SceneSnapshot
from tools.benchmarking.mitsuba_layers import MitsubaLayers

#: Bits of a seed that tell the two halves, and the renders that are measured, apart. Mitsuba's scalar variant takes a
#: seed times the number of pixels, in 32 bits: of 640 x 480 = 75 << 12 pixels, bits above the 19th of a seed are lost.
_FIRST_SEED = (1 << 18, 1 << 19)
_GEOMETRY = ("points", "normals", "st", "material", "mesh_begin", "instance_mesh", "instance_to_world")
_MATERIALS = ("diffuse", "emission", "use_display_color", "texture", "texture_transform", "texture_scale")
_LIGHTS = ("kind", "to_world", "radiance", "size", "texture", "triangle", "triangle_instance")


@dataclass(frozen=True)
class Reference:
    """Two independent, unbiased estimates of the same light, (height, width, 3) each."""

    indirect: tuple[F64, F64]
    whole: tuple[F64, F64]  #: direct and indirect, without sources that the camera sees
    samples: int  #: per pixel, of each half
    seconds: float  #: that rendering both took

    def noise(self, trimmed: float = 0.0) -> float:
        """Relative mean square of the noise of the mean of the indirect halves.

        Parameters
        ----------
        trimmed
            Share of the pixels, those with the most noise, that is left out.
        """
        a, b = self.indirect
        squares = np.sort((((a - b) / 2) ** 2).mean(axis=2), axis=None)
        kept = len(squares) - int(np.ceil(trimmed * len(squares)))
        return float(squares[:kept].sum() / len(squares) / max((a * b).mean(), 1e-30))


def default_folder() -> Path:
    """In the user's cache folder."""
    cache = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(cache) / "icheat-benchmark" / "references"


def scene_key(snapshot: SceneSnapshot, depth: int) -> str:
    """Digest of all that a reference depends on."""
    import mitsuba as mi

    digest = hashlib.sha256(f"1 {depth} {mi.__version__}".encode())
    tables: list[Any] = [getattr(snapshot.geometry, name) for name in _GEOMETRY]
    tables += [getattr(snapshot.materials, name) for name in _MATERIALS]
    tables += [getattr(snapshot.lights, name) for name in _LIGHTS]
    tables += [snapshot.geometry.color, *snapshot.textures, snapshot.camera.to_world]
    for table in tables:
        digest.update(str((table.shape, table.dtype)).encode())
        digest.update(np.ascontiguousarray(table).tobytes())
    camera = snapshot.camera
    digest.update(repr((camera.window, camera.width, camera.height)).encode())
    return digest.hexdigest()[:20]


def reference(
    name: str, snapshot: SceneSnapshot, depth: int, folder: Path, *, minutes: float, most_samples: int = 1 << 16
) -> Reference:
    """What is on disk, after rendering more of it for at most `minutes`; two passes are made in any case.

    Files are replaced as a whole, one a minute, so a run that is broken off loses little.

    Raises
    ------
    ValueError
        Mitsuba's render is no image, or both halves are the same one.
    """
    path = folder / f"{name}-{snapshot.camera.width}x{snapshot.camera.height}-{scene_key(snapshot, depth)}.npz"
    sums, samples, spent, n_passes = _read(path)
    if sums is not None:
        _refuse_one_half(f"{path}, which is to be deleted", sums)
    deadline = time.perf_counter() + 60 * minutes
    if samples and (minutes <= 0 or samples >= most_samples):
        return _reference(sums, samples, spent)
    renderer = MitsubaLayers(snapshot, depth, "fast")
    start = saved = time.perf_counter()
    while samples < most_samples and (time.perf_counter() < deadline or not samples):
        both = [renderer.layers(renderer.most_samples, first + n_passes) for first in _FIRST_SEED]
        more = np.stack([[half.indirect, half.whole] for half in both]) * renderer.most_samples
        if not np.isfinite(more).all():
            raise ValueError(f"{name}: Mitsuba's render holds values that are no numbers, so it is no reference")
        _refuse_one_half(name, more)
        sums = more if sums is None else sums + more
        samples, n_passes = samples + renderer.most_samples, n_passes + 1
        if time.perf_counter() > saved + 60:
            saved = time.perf_counter()
            _write(path, sums, samples, spent + saved - start, n_passes)
    spent += time.perf_counter() - start
    _write(path, sums, samples, spent, n_passes)
    return _reference(sums, samples, spent)


def _refuse_one_half(name: str, sums: F64) -> None:
    if sums.any() and np.array_equal(sums[0], sums[1]):
        raise ValueError(f"{name}: Mitsuba rendered both halves with the same random numbers, so they are one")


def _reference(sums: Any, samples: int, seconds: float) -> Reference:
    (indirect_a, whole_a), (indirect_b, whole_b) = sums / samples
    return Reference((indirect_a, indirect_b), (whole_a, whole_b), samples, seconds)


def _read(path: Path) -> tuple[Any, int, float, int]:
    if not path.exists():
        return None, 0, 0.0, 0
    with np.load(path) as found:
        return found["sums"], int(found["samples"]), float(found["seconds"]), int(found["passes"])


def _write(path: Path, sums: F64, samples: int, seconds: float, passes: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    whole = path.with_name(f".{path.stem}.{os.getpid()}.npz")
    np.savez(whole, sums=sums, samples=samples, seconds=seconds, passes=passes)
    os.replace(whole, path)
