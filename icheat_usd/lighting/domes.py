"""Domes that turn or change their image: what places see of the sky is kept, the sky is binned anew."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from icheat_usd.kernels import domes as kernels
from icheat_usd.kernels.direct import fill_analytic
from icheat_usd.kernels.workers import overlapping
from icheat_usd.lighting.change import LightImages, append_texture, new_light, texture_image
from icheat_usd.lighting.direct import own_draws
from icheat_usd.lighting.guide import Effort
from icheat_usd.lighting.quick import Shadows
from icheat_usd.lighting.sampler import LightSampler, build_light_sampler
from icheat_usd.materials import evaluate_specular, is_glossy, take_points
from icheat_usd.scene import (
    F32,
    F64,
    I64,
    PLAIN,
    Bool,
    LightControls,
    LightKind,
    SceneSnapshot,
    SurfacePoints,
    Textures,
)
from icheat_usd.tracing import Tracer, spawn_points

_RAYS = 1 << 18  # at a time
_WIDTH = 256  # an image is brought to this width once, so that a small sun is never missed between lookups
_LOOKS = 2  # lookups per bin and axis
_NO_LOBES: F32 = np.empty(0, np.float32)


@dataclass(frozen=True, eq=False)
class SeenSky:
    """Directions in which each place sees the sky, by bin, and what light from there is worth."""

    begin: I64  #: (n + 1,)
    bins: np.ndarray  #: (n_entries,) uint16
    diffuse: F32  #: (n_entries,) irradiance per radiance
    glossy: F32  #: (n_entries,) reflected radiance per radiance of the specular lobe; or none
    tint: F32  #: (n, 3) albedo over pi
    gloss_tint: F32  #: (n, 3) colour of the specular lobe

    def light(self, sky: F32, out: F32, controls: LightControls = PLAIN) -> None:
        """Reflected light of a binned sky (n_bins, 4), into `out` (n, 3), which is contiguous."""
        tint, gloss_tint = self.tint, self.gloss_tint
        if controls.diffuse != 1.0:
            tint = tint * np.float32(controls.diffuse)
        if controls.specular != 1.0:
            gloss_tint = gloss_tint * np.float32(controls.specular)
        kernels.shine(self.begin, self.bins, self.diffuse, self.glossy, sky, tint, gloss_tint, out)


class _Seen(NamedTuple):
    """What some points see of the sky, by ray."""

    point: I64
    bins: np.ndarray  # uint16
    irradiance: F32  # per radiance
    lobe: np.ndarray  # the same of the specular lobe, or none
    edges: F64  # (n_points, 2) sums of what multiplies the two specular colours


def white_sky(
    snapshot: SceneSnapshot, tracer: Tracer, points: SurfacePoints, seed: int, effort: Effort | None = None
) -> tuple[SceneSnapshot, LightSampler]:
    """The scene under an even sky, and a sampler that has learnt from where around some points it is seen."""
    even = new_light(
        snapshot, LightImages(snapshot.textures), "", LightKind.DOME, to_world=np.eye(3, 4), radiance=(1, 1, 1)
    )
    return even, build_light_sampler(even, tracer, points, seed, effort)


def see_sky(
    even: SceneSnapshot,
    sampler: LightSampler,
    shadows: Shadows,
    points: SurfacePoints,
    tint: F32,
    to_eye: F32 | None,
    n_samples: int,
    seed: int,
    begin: I64 | None = None,
    lit: Bool | None = None,
) -> SeenSky:
    """Sample where places see the sky.

    Parameters
    ----------
    even, sampler
        Of `white_sky`.
    tint : (n_places, 3), albedo over pi
    to_eye : (n, 3), unit; None: diffuse reflection alone
    n_samples : int
        Rays per point.
    begin : (n_places + 1,)
        A place is the mean of its points; by default every point is one.
    lit : (n,) bool, optional
        Points that the sky shines on; by default all.
    """
    step = max(1, _RAYS // n_samples)

    def look(first: int) -> _Seen:
        part = take_points(points, slice(first, first + step))
        point, direction, value = _visible(even, sampler, shadows, part, first, n_samples, seed)
        if lit is not None:
            kept = np.flatnonzero(lit[first + point])
            point, direction, value = point[kept], np.take(direction, kept, axis=0), value[kept]
        cosine = np.maximum(np.einsum("ij,ij->i", part.shading_normal[point], direction), 1e-6)
        row = np.empty(len(point), np.uint16)
        kernels.find_bins(direction, row)
        if to_eye is None:
            return _Seen(point + first, row, value, _NO_LOBES, np.zeros((len(part.instance), 2)))
        there = take_points(part, point)
        terms = evaluate_specular(there, to_eye[first + point], direction)
        base, edge = (term / cosine * value for term in (terms.base, terms.edge))
        edges = [np.bincount(point, of_lobe, len(part.instance)) for of_lobe in (base, edge)]
        # as grey as dielectrics are; the colour of metals comes with `gloss_tint`
        lobe = there.specular.mean(axis=1) * base + there.specular_edge.mean(axis=1) * edge
        return _Seen(point + first, row, value, lobe, np.stack(edges, axis=1))

    # an empty one first: a camera may see no surface
    seen = [_Seen(np.empty(0, np.int64), np.empty(0, np.uint16), _NO_LOBES, _NO_LOBES, np.zeros((0, 2)))]
    seen += overlapping([partial(look, first) for first in range(0, len(points.instance), step)])
    owner, bins, weight, lobes, edge_parts = (np.concatenate(columns) for columns in zip(*seen, strict=True))
    if begin is not None:
        cell = np.repeat(np.arange(len(begin) - 1), np.diff(begin))
        weight = np.asarray(weight / np.diff(begin)[cell[owner]], np.float32)
        owner = cell[owner]
    ends = np.searchsorted(owner, np.arange(len(tint) + 1)).astype(np.int64)
    gloss_tint = np.zeros((len(tint), 3), np.float32)
    glossy = np.empty(0, np.float32)
    if to_eye is not None and is_glossy(points).any():
        color = points.specular * edge_parts[:, :1] + points.specular_edge * edge_parts[:, 1:]
        gloss_tint = (color / np.maximum(color.mean(axis=1, keepdims=True), 1e-30)).astype(np.float32)
        glossy = lobes.astype(np.float32)
    return SeenSky(
        ends,
        bins,
        weight.astype(np.float32),
        glossy,
        np.ascontiguousarray(tint, np.float32),
        gloss_tint,
    )


def _visible(
    even: SceneSnapshot, sampler: LightSampler, shadows: Shadows, points: SurfacePoints, first: int, n: int, seed: int
) -> tuple[I64, F32, F32]:
    """Point, direction and irradiance per radiance of the rays that see the sky."""
    size = len(points.instance) * n
    draws = own_draws(first, first + len(points.instance))
    direction, radiance = np.zeros((size, 3), np.float32), np.zeros((size, 3), np.float32)
    distance, pdf = np.zeros(size, np.float32), np.zeros(size, np.float32)
    fill_analytic(
        even.lights, even.textures, sampler.tables, sampler.guide, 0, points.position, points.normal,
        points.shading_normal, points.instance, draws, n, seed & 0xFFFFFFFF, True, direction, distance, pdf, radiance,
    )  # fmt: skip
    rows = np.flatnonzero(radiance[:, 0])
    start = np.take(spawn_points(even, points, points.normal), rows // n, axis=0)
    direction = np.take(direction, rows, axis=0)
    seen = np.flatnonzero(~shadows.opaque.occluded(start, direction))
    rows, direction, value = rows[seen], np.take(direction, seen, axis=0), radiance[rows[seen], 0]
    return rows // n, direction, value * shadows.crossing(even, start[seen], direction, np.inf)


class BinnedSky:
    """Bins of one dome under any rotation."""

    def __init__(self, alone: SceneSnapshot) -> None:
        row = int(alone.lights.texture[0])
        none = Textures(
            np.empty((0, 4), np.float32), np.empty(0, np.int64), np.empty(0, np.int32), np.empty(0, np.int32),
            np.empty((0, 2), np.int32),
        )  # fmt: skip
        self._image = -1 if row < 0 else 0
        self._texture = none if row < 0 else append_texture(none, _smaller(texture_image(alone.textures, row)))[0]

    def under(self, alone: SceneSnapshot) -> F32:
        """Mean radiance of each bin as the dome stands in `alone`, and 0: (n_bins, 4)."""
        out = np.zeros((kernels.ROWS * kernels.COLUMNS, 4), np.float32)
        linear = alone.lights.to_world[0, :, :3].astype(np.float64)
        if np.linalg.det(linear) != 0.0:
            to_local = np.ascontiguousarray(np.linalg.inv(linear))
            kernels.bin_sky(self._texture, self._image, alone.lights.radiance[0], to_local, _DIRECTIONS, out)
        return out


def _smaller(image: F32) -> F32:
    """Means over blocks of texels; texels that are no number count as black."""
    height, width = image.shape[:2]
    factor = max(1, width // _WIDTH)
    clean = np.where(np.isfinite(image[..., :3]).all(axis=2, keepdims=True), image[..., :3], 0.0)
    if factor == 1 or height % factor or width % factor:
        rows, columns = (np.arange(n) * max(1, n // factor) // n for n in (height, width))
        sums = np.zeros((rows[-1] + 1, columns[-1] + 1, 3))
        np.add.at(sums, (rows[:, None], columns[None]), clean)
        count = np.bincount(rows)[:, None] * np.bincount(columns)[None]
        return (sums / count[..., None]).astype(np.float32)
    return clean.reshape(height // factor, factor, width // factor, factor, 3).mean(axis=(1, 3)).astype(np.float32)


def _bin_directions() -> F32:
    """Directions of the lookups of each bin, one bin after another."""
    look = (np.arange(_LOOKS) + 0.5) / _LOOKS
    row, column, v, u = np.meshgrid(np.arange(kernels.ROWS), np.arange(kernels.COLUMNS), look, look, indexing="ij")
    y = 1.0 - 2.0 * (row + v) / kernels.ROWS
    longitude = 2.0 * np.pi * ((column + u) / kernels.COLUMNS - 0.5)
    r = np.sqrt(1.0 - y * y)
    directions = np.stack([r * np.sin(longitude), y, r * np.cos(longitude)], -1)
    return directions.reshape(-1, _LOOKS * _LOOKS, 3).astype(np.float32)


_DIRECTIONS = _bin_directions()
