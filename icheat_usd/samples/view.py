"""View samples: the visible points whose indirect light is shown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from icheat_usd.kernels.camera import camera_rays
from icheat_usd.lighting import environment_radiance
from icheat_usd.materials import concatenate_points, dielectric_split, empty_points, shade_hits, take_points
from icheat_usd.samples.pixel_filter import BOX, PixelFilter
from icheat_usd.scene import F32, I32, I64, DeltaKind, LightKind, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, first_surfaces, spawn_points

_RAYS_AT_ONCE = 1 << 19
_MAX_DEPTH = 16  # deltas along a path that never needs to choose


class SkyPaths(NamedTuple):
    """Camera paths that leave the scene."""

    pixel: I32  #: (n,)
    throughput: F32  #: (n, 3)
    direction: F32  #: (n, 3) unit


@dataclass(frozen=True)
class ViewSamples:
    """First non-delta vertices of camera paths; zero to many per pixel.

    The image is ``background + sum over the samples of a pixel of throughput * radiance``,
    radiance being what a sample sends along `to_eye`.
    """

    width: int
    height: int
    samples_per_pixel: int
    pixel: I32  #: (n,) row-major from the top left, ascending
    throughput: F32  #: (n, 3) of the delta vertices before it; 1 / samples_per_pixel is in it
    points: SurfacePoints  #: (n,)
    to_eye: F32  #: (n, 3) unit, back along the last segment of the path
    depth: F32  #: (n,) length of the path from the eye, metres
    background: F32  #: (width * height, 3) radiance of the paths that left the scene, already weighted
    stream: I32  #: (n,) random counters: by pixel, number of the sample and turn at glass, whatever is traced with it
    sky: SkyPaths  #: the paths that left the scene, for another sky

    @property
    def n(self) -> int:
        return len(self.pixel)


class _Paths(NamedTuple):
    """Camera paths on their way."""

    pixel: I32
    origin: F32
    direction: F32  # unit
    throughput: F32
    travelled: F32
    splits: I32  # how often this path was divided so far
    stream: I32  # counter of its random numbers

    def take(self, rows: I64) -> _Paths:
        columns: tuple[Any, ...] = self
        return _Paths(*(np.ascontiguousarray(column[rows]) for column in columns))


class _Found(NamedTuple):
    """Ends of camera paths."""

    points: SurfacePoints
    pixel: I32
    throughput: F32
    to_eye: F32
    depth: F32
    stream: I32


def view_samples(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    *,
    samples_per_pixel: int = 1,
    first_sample: int = 0,
    centred: bool | None = None,
    pixel_filter: PixelFilter = BOX,
    seed: int = 0,
    max_splits: int = 2,
    pixels: tuple[int, int] | I64 | None = None,
) -> ViewSamples:
    """Trace the camera's rays to the points that it sees.

    Mirrors and holes are followed. Smooth glass and translucent surfaces
    divide a path in two, so that both what they reflect and what shines
    through have view samples. What a pixel gets depends on no other pixel.

    Parameters
    ----------
    samples_per_pixel
        Stratified over the pixel filter and the lens. The throughput of
        a call's samples is shared among them; who adds calls up weights them anew.
    first_sample
        Number of the first one in each pixel's sequence: a second call goes on where the first one ended.
    centred
        Look through pixel centres and the centre of the lens instead; by default for a single sample.
    pixel_filter
        How far around its centre a pixel looks; all samples count the same.
    max_splits
        Divisions of one path; where more would follow, one continuation is chosen at random.
    pixels
        First pixel and the one behind the last, row-major, of a part of the
        image, or an ascending list of pixels (n,) int64; the whole image by default.

    Raises
    ------
    ValueError
        `samples_per_pixel` is less than 1.
    """
    if samples_per_pixel < 1:
        raise ValueError(f"a pixel needs at least one sample, not {samples_per_pixel}")
    if centred is None:
        centred = samples_per_pixel == 1 and first_sample == 0
    camera = snapshot.camera
    n_pixels = camera.width * camera.height
    if not isinstance(pixels, np.ndarray):
        pixels = np.arange(*(pixels or (0, n_pixels)), dtype=np.int64)
    escaped: list[SkyPaths] = []
    found: list[_Found] = []
    at_once = max(1, _RAYS_AT_ONCE // samples_per_pixel)
    for begin in range(0, len(pixels), at_once):
        some = np.ascontiguousarray(pixels[begin : begin + at_once], np.int64)
        paths, limit = _camera_paths(snapshot, some, samples_per_pixel, first_sample, centred, pixel_filter, seed)
        found += _follow(snapshot, tracer, paths, limit, seed, max_splits, escaped)
    ends = _by_pixel(found)
    nothing = SkyPaths(np.empty(0, np.int32), np.empty((0, 3), np.float32), np.empty((0, 3), np.float32))
    sky = SkyPaths(*(np.concatenate(columns) for columns in zip(nothing, *escaped, strict=True)))
    return ViewSamples(
        camera.width,
        camera.height,
        samples_per_pixel,
        ends.pixel,
        ends.throughput,
        ends.points,
        ends.to_eye,
        ends.depth,
        sky_behind(snapshot, sky, n_pixels),
        ends.stream,
        sky,
    )


def _camera_paths(
    snapshot: SceneSnapshot,
    pixels: I64,
    n_samples: int,
    first_sample: int,
    centred: bool,
    pixel_filter: PixelFilter,
    seed: int,
) -> tuple[_Paths, F32]:
    """Paths of pixels, begun at the near plane, and the length to the far plane."""
    camera = snapshot.camera
    n = len(pixels) * n_samples
    origin, direction = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32)
    axial, stream = np.empty(n, np.float64), np.empty(n, np.int32)
    camera_rays(
        np.ascontiguousarray(camera.to_world, np.float64),
        camera.window,
        camera.width,
        camera.height,
        camera.orthographic,
        camera.lens_radius,
        max(camera.focus_distance, 1e-9),
        pixels,
        n_samples,
        first_sample,
        centred,
        pixel_filter.inverse,
        seed & 0xFFFFFFFF,
        origin,
        direction,
        axial,
        stream,
    )
    near = (camera.near / axial).astype(np.float32)
    limit = ((camera.far - camera.near) / axial).astype(np.float32)
    if camera.near > 0:
        origin += near[:, None] * direction
    pixel = np.repeat(pixels.astype(np.int32), n_samples)
    throughput = np.full((n, 3), 1.0 / n_samples, np.float32)
    return _Paths(pixel, origin, direction, throughput, near, np.zeros(n, np.int32), stream), limit


def _follow(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    paths: _Paths,
    limit: F32 | None,
    seed: int,
    max_splits: int,
    sky: list[SkyPaths],
) -> list[_Found]:
    """Follow paths to their ends; what leaves the scene goes into `sky`."""
    found: list[_Found] = []
    for _ in range(_MAX_DEPTH):
        if not len(paths.pixel):
            break
        hits = tracer.intersect(paths.origin, paths.direction, limit)
        limit = None
        points = shade_hits(snapshot, hits, paths.direction)
        _escape(paths, np.flatnonzero(points.instance < 0), sky)
        scatters = (points.instance >= 0) & (points.delta == DeltaKind.NONE)
        solid = np.flatnonzero(scatters & (points.opacity >= 1))
        found.append(_end(paths, points, hits.distance, solid, None))
        carry_on = np.flatnonzero((points.instance >= 0) & ~(scatters & (points.opacity >= 1)))
        if not len(carry_on):
            return found

        paths, points, length = paths.take(carry_on), take_points(points, carry_on), hits.distance[carry_on]
        split = dielectric_split(points, paths.direction)
        reflects = split.weight_reflected.max(axis=1) > 0
        refracts = split.weight_refracted.max(axis=1) > 0
        stays = (points.delta == DeltaKind.NONE) & (points.opacity > 0)
        divides = reflects.astype(np.int32) + refracts + stays > 1
        chosen = divides & (paths.splits >= max_splits)
        found += _follow_by_chance(snapshot, tracer, paths.take(np.flatnonzero(chosen)), seed, sky)
        followed = ~chosen
        found.append(_end(paths, points, length, np.flatnonzero(stays & followed), points.opacity))
        travelled = paths.travelled + length
        splits = paths.splits + divides
        parts = []
        for turn, goes, direction, weight in (
            (1, reflects & followed, split.reflected, split.weight_reflected),
            (2, refracts & followed, split.refracted, split.weight_refracted),
        ):
            rows = np.flatnonzero(goes)
            turned = np.ascontiguousarray(direction[rows])
            origin = spawn_points(snapshot, take_points(points, rows), turned)
            throughput = paths.throughput[rows] * weight[rows]
            # Each side of a division has random numbers of its own; a path that only turns keeps its counter.
            stream = np.where(divides[rows], paths.stream[rows] * np.int32(3) + np.int32(turn), paths.stream[rows])
            parts.append(_Paths(paths.pixel[rows], origin, turned, throughput, travelled[rows], splits[rows], stream))
        paths = _Paths(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    return found


def _follow_by_chance(
    snapshot: SceneSnapshot, tracer: Tracer, paths: _Paths, seed: int, sky: list[SkyPaths]
) -> list[_Found]:
    if not len(paths.pixel):
        return []
    ends = first_surfaces(snapshot, tracer, paths.origin, paths.direction, seed, counters=paths.stream)
    paths = paths._replace(direction=ends.direction, throughput=paths.throughput * ends.throughput)
    alive = paths.throughput.max(axis=1) > 0
    _escape(paths, np.flatnonzero(alive & (ends.points.instance < 0)), sky)
    return [_end(paths, ends.points, ends.distance, np.flatnonzero(alive & (ends.points.instance >= 0)), None)]


def _escape(paths: _Paths, rows: I64, sky: list[SkyPaths]) -> None:
    if len(rows):
        sky.append(SkyPaths(paths.pixel[rows], paths.throughput[rows], paths.direction[rows]))


def sky_behind(snapshot: SceneSnapshot, paths: SkyPaths, n_pixels: int) -> F32:
    """Radiance of the domes along camera paths that leave the scene, (n_pixels, 3), weighted."""
    background = np.zeros((n_pixels, 3), np.float32)
    if len(paths.pixel) and np.any(snapshot.lights.kind == LightKind.DOME):
        radiance = environment_radiance(snapshot, np.ascontiguousarray(paths.direction))
        seen = paths.throughput.astype(np.float64) * radiance
        # Only the stretch of the image that is traced is touched: a band costs the same in an image of any size.
        first, end = int(paths.pixel.min()), int(paths.pixel.max()) + 1
        for channel in range(3):
            background[first:end, channel] = np.bincount(paths.pixel - first, seen[:, channel], end - first)
    return background


def _by_pixel(found: list[_Found]) -> _Found:
    """All ends of paths, those of a pixel together; nothing is copied where they are in order."""
    parts = [part for part in found if len(part.pixel)]
    if not parts:
        nothing = np.empty((0, 3), np.float32)
        return _Found(empty_points(0), np.empty(0, np.int32), nothing, nothing, nothing[:, 0], np.empty(0, np.int32))
    ends = parts[0]
    if len(parts) > 1:
        rest: Any = zip(*(part[1:] for part in parts), strict=True)
        ends = _Found(concatenate_points(*(part.points for part in parts)), *map(np.concatenate, rest))
    if (np.diff(ends.pixel) < 0).any():
        order = np.argsort(ends.pixel, kind="stable")
        columns: Any = [np.take(column, order, axis=0) for column in ends[1:]]
        ends = _Found(take_points(ends.points, order), *columns)
    return ends


def _end(paths: _Paths, points: SurfacePoints, length: F32, rows: I64, share: F32 | None) -> _Found:
    throughput = paths.throughput[rows]
    if share is not None:
        throughput = throughput * share[rows, None]
    return _Found(
        points if len(rows) == len(paths.pixel) else take_points(points, rows),
        paths.pixel[rows],
        throughput,
        -paths.direction[rows],
        paths.travelled[rows] + length[rows],
        paths.stream[rows],
    )
