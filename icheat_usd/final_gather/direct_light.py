"""Direct light of camera samples: a few shadow rays for every pixel, more where those of a neighbourhood disagree.

All camera samples of a pixel draw from one low-discrepancy sequence for each
light, so that the pixel's rays are stratified over the light together; pixels
with more camera samples take fewer rays at each. Penumbrae are found by the
first rays of a pixel and of those around it, and all rays count. A denoiser
wants noise that is alike everywhere, and gets as many rays of every pixel.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from icheat_usd.final_gather.camera_pass import Band, draws_of
from icheat_usd.final_gather.settings import GatherSettings
from icheat_usd.lighting import LightSampler, samples_per_light
from icheat_usd.lighting.direct import add_shadow_rays, specular_count
from icheat_usd.lighting.specular_rays import add_specular_rays, is_delta
from icheat_usd.materials import take_points
from icheat_usd.materials.surface import nonzero_rows
from icheat_usd.samples import ViewSamples
from icheat_usd.scene import F32, I64, Bool, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer

#: Share of a light's usual rays that every pixel takes first. Fewer miss the tips of penumbrae, and are noisy close to
#: a light even where nothing hides it.
_FIRST = 0.5

#: Rays that a pixel in doubt takes in all: so many times `GatherSettings.light_samples`, or the light's usual number
#: where that is larger, as of domes.
_IN_DOUBT = 4

#: Rays of a neighbourhood agree where the least brings this share of what the largest brings.
_AGREEING = 0.2

#: Where a pixel's second rays begin in its sequence.
_SECOND = 1 << 20


class _Part(NamedTuple):
    """Camera samples of a band whose pixels have equally many."""

    rows: I64  #: (m,) of the view
    first: list[int]  #: by light: shadow rays that every sample takes
    whole: list[int]  #: by light: shadow rays of a sample in doubt
    n_specular: int  #: rays of each sample's specular lobe


class _Some(NamedTuple):
    """Some camera samples of a band."""

    points: SurfacePoints
    to_eye: F32  #: (m, 3)
    draws: I64  #: (m, 2)

    @classmethod
    def of(cls, view: ViewSamples, draws: I64, rows: I64) -> _Some:
        """Ascending rows of a view and its draws, without copies where they are all."""
        if len(rows) == view.n:
            return cls(view.points, view.to_eye, draws)
        return cls(take_points(view.points, rows), np.take(view.to_eye, rows, axis=0), draws[rows])


class _First(NamedTuple):
    """What first rays bring."""

    band: Band
    parts: list[_Part]
    draws: I64  #: (n, 2) of each view sample: `draws_of`
    light: F32  #: (n_lights, n, 3) for each view sample
    extremes: F32  #: (n_lights, rows of the image, width, 2) least and largest irradiance by a ray of each pixel


class DirectLight:
    """Direct light of an image's camera samples.

    What a pixel gets depends on no pixels but those next to it, and not on the bands.
    """

    def __init__(
        self, snapshot: SceneSnapshot, tracer: Tracer, sampler: LightSampler, settings: GatherSettings
    ) -> None:
        self._snapshot, self._tracer, self._sampler, self._settings = snapshot, tracer, sampler, settings
        self._usual = samples_per_light(snapshot, settings.light_samples, settings.dome_samples)
        self._lights = np.flatnonzero(nonzero_rows(snapshot.lights.radiance)).tolist()

    def bands(self, bands: Iterable[Band]) -> Iterator[tuple[Band, F32]]:
        """Each band of whole rows, from top to bottom, and radiance towards the eye by light, (n_lights, n, 3)."""
        waiting: _First | None = None
        above: F32 | None = None
        for band in bands:
            found = self._first(band)
            if waiting is not None:
                yield waiting.band, self._whole(waiting, above, found.extremes[:, :1])
                above = waiting.extremes[:, -1:]
            waiting = found
        if waiting is not None:
            yield waiting.band, self._whole(waiting, above, None)

    def _first(self, band: Band) -> _First:
        view, n_lights = band.view, len(self._usual)
        light = np.zeros((n_lights, view.n, 3), np.float32)
        seen = np.empty((n_lights, view.n, 2), np.float32)
        seen[...] = np.inf, -np.inf
        parts, draws = self._parts(band), draws_of(view, self._settings)
        for part in parts:
            some = _Some.of(view, draws, part.rows)
            for one in self._lights:
                extremes = seen[one, part.rows]
                light[one, part.rows] = self._shadowed(some, part, one, False, extremes)
                seen[one, part.rows] = extremes
        first, end = band.pixels
        of_pixels = np.empty((n_lights, end - first, 2), np.float32)
        of_pixels[...] = np.inf, -np.inf
        if view.n:
            begin = np.flatnonzero(np.diff(view.pixel, prepend=-1))
            shown = view.pixel[begin] - first
            of_pixels[:, shown, 0] = np.minimum.reduceat(seen[:, :, 0], begin, axis=1)
            of_pixels[:, shown, 1] = np.maximum.reduceat(seen[:, :, 1], begin, axis=1)
        by_rows = of_pixels.reshape(
            n_lights, (end - first) // self._snapshot.camera.width, self._snapshot.camera.width, 2
        )
        return _First(band, parts, draws, light, by_rows)

    def _whole(self, first: _First, above: F32 | None, below: F32 | None) -> F32:
        view, light = first.band.view, first.light
        # Nobody is asked where all pixels have had their rays.
        has_second = any(whole > n for part in first.parts for n, whole in zip(part.first, part.whole, strict=True))
        doubtful = _disagreeing(first.extremes, above, below) if has_second else np.empty((0, 0), np.bool_)
        place = view.pixel - first.band.pixels[0]
        for part in first.parts:
            for one in self._lights:
                n, whole = part.first[one], part.whole[one]
                if whole > n:
                    rows = part.rows[doubtful[one, place[part.rows]]]
                    more = self._shadowed(_Some.of(view, first.draws, rows), part, one, True)
                    light[one, rows] = light[one, rows] * np.float32(n / whole) + more * np.float32(1 - n / whole)
            found = np.zeros((len(light), len(part.rows), 3), np.float32)
            some = _Some.of(view, first.draws, part.rows)
            add_specular_rays(
                self._snapshot, self._tracer, self._sampler, some.points, some.to_eye,
                some.draws * (1, part.n_specular), self._settings.seed, part.n_specular, part.whole, found,
            )  # fmt: skip
            light[:, part.rows] += found
        return light

    def _shadowed(self, some: _Some, part: _Part, light: int, is_second: bool, extremes: F32 | None = None) -> F32:
        """Radiance by the first or the second shadow rays of some samples of a part."""
        count = part.whole[light] - part.first[light] if is_second else part.first[light]
        own = some.draws * (1, count) + (0, _SECOND * is_second)
        found = np.zeros((len(own), 3), np.float32)
        add_shadow_rays(
            self._snapshot, self._tracer, self._sampler, some.points, some.to_eye, light, own, self._settings.seed,
            count, (part.whole[light], part.n_specular), found, extremes,
        )  # fmt: skip
        return found

    def _parts(self, band: Band) -> list[_Part]:
        s = self._settings
        has_edge = np.zeros(len(band.view.background), np.bool_)
        has_edge[band.edges] = True
        is_edge = has_edge[band.view.pixel]
        most, begun = [max(usual, _IN_DOUBT * s.light_samples) for usual in self._usual], _FIRST
        if s.denoise:
            most, begun = self._usual, 1.0
        parts = []
        for mine, n in ((~is_edge, s.samples_per_pixel), (is_edge, s.samples_per_pixel + s.edge_samples)):
            rows = np.flatnonzero(mine)
            if len(rows):
                share = s.samples_per_pixel / n
                first, whole = self._counts(self._usual, begun * share), self._counts(most, share)
                n_specular = specular_count([math.ceil(share * usual) for usual in self._usual])
                parts.append(_Part(rows, first, whole, n_specular))
        return parts

    def _counts(self, usual: list[int], share: float) -> list[int]:
        """Shadow rays of a camera sample for each light."""
        snapshot = self._snapshot
        return [1 if is_delta(snapshot, light) else math.ceil(share * n) for light, n in enumerate(usual)]


def _disagreeing(extremes: F32, above: F32 | None, below: F32 | None) -> Bool:
    """(n_lights, n_pixels) where rays of a pixel and of the eight around it differ; rows next to these may be known."""
    n_lights, rows, width, _ = extremes.shape
    padded = np.empty((n_lights, rows + 2, width + 2, 2), np.float32)
    padded[...] = np.inf, -np.inf
    padded[:, 1:-1, 1:-1] = extremes
    if above is not None:
        padded[:, :1, 1:-1] = above
    if below is not None:
        padded[:, -1:, 1:-1] = below
    least, most = padded[..., 0], padded[..., 1]
    least = np.minimum(np.minimum(least[:, :-2], least[:, 1:-1]), least[:, 2:])
    most = np.maximum(np.maximum(most[:, :-2], most[:, 1:-1]), most[:, 2:])
    least = np.minimum(np.minimum(least[:, :, :-2], least[:, :, 1:-1]), least[:, :, 2:])
    most = np.maximum(np.maximum(most[:, :, :-2], most[:, :, 1:-1]), most[:, :, 2:])
    return np.asarray(least < np.float32(_AGREEING) * most, np.bool_).reshape(n_lights, rows * width)
