"""Camera samples of an image, band by band: some for every pixel, more where the picture has edges."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from icheat_usd.final_gather.settings import GatherSettings
from icheat_usd.materials import concatenate_points, take_points
from icheat_usd.samples import ViewSamples, view_samples
from icheat_usd.samples.adaptive import edge_pixels, join_looks, look_over
from icheat_usd.samples.develop import average
from icheat_usd.samples.pixel_filter import PixelFilter
from icheat_usd.samples.view import SkyPaths
from icheat_usd.scene import F32, F64, I64, SceneSnapshot
from icheat_usd.tracing import Tracer

#: Camera samples that are kept from the first pass for the second, of all bands; 200 bytes each.
_KEPT = 2_000_000

_NO_EDGES: I64 = np.empty(0, np.int64)

#: Something that is to be known of every view sample, (n,): how near the next surface is.
Measure = Callable[[ViewSamples], F32]


class Band(NamedTuple):
    """A part of the image."""

    pixels: tuple[int, int]  #: the first and the one behind the last, row-major: whole rows
    view: ViewSamples
    edges: I64  #: (m,) ascending: pixels with more samples than the others
    measured: F32  #: (n,) of each view sample; zeros where nothing is measured
    seen: F64  #: (n_pixels, 1) share of each pixel's camera samples that end on a surface
    more: ViewSamples | None = None  #: of pixels with edges, which tell of surfaces and of the sky, and get no light


class CameraPass:
    """Camera samples of a view; the same ones every time they are asked for.

    Parameters
    ----------
    n_edge : int
        More samples of pixels with edges.
    band : int
        Samples per band, about.
    measure : Measure, optional
        What is to be known of every sample, and found once.
    """

    def __init__(
        self,
        snapshot: SceneSnapshot,
        tracer: Tracer,
        settings: GatherSettings,
        n_edge: int,
        band: int,
        measure: Measure = lambda view: np.zeros(view.n, np.float32),
    ) -> None:
        self._snapshot, self._tracer, self._settings = snapshot, tracer, settings
        self._n, self._n_edge, n = settings.samples_per_pixel, n_edge, settings.samples_per_pixel
        # A lone sample of a lone image looks through the centre of its pixel.
        self._centred = settings.first_sample is None and n + n_edge == 1
        self._first = settings.first_sample or 0
        self._first_edge = self._first + n if settings.first_edge_sample is None else settings.first_edge_sample
        self._filter = PixelFilter(settings.pixel_filter, settings.filter_width)
        camera = snapshot.camera
        n_pixels = camera.width * camera.height
        pixels = max(1, band // n // camera.width) * camera.width
        self.bands = [(first, min(first + pixels, n_pixels)) for first in range(0, n_pixels, pixels)]
        self._measure = measure
        self._kept: dict[int, tuple[ViewSamples, F32]] = {}
        self._edges = _NO_EDGES
        self._is_kept = n_pixels * n <= _KEPT

    def first(self) -> Iterator[Band]:
        """Samples that every pixel has; finds the edges on the way."""
        looks = []
        for number, pixels in enumerate(self.bands):
            view = self._trace(pixels, self._n, self._first)
            measured = self._measure(view)
            if self._is_kept:
                self._kept[number] = view, measured
            if self._n_edge or self._settings.feature_samples:
                looks.append(look_over(view, self._snapshot.camera, pixels))
            yield Band(pixels, view, _NO_EDGES, measured, self._seen(view, pixels, _NO_EDGES))
        if looks:
            self._edges = edge_pixels(join_looks(*looks), self._snapshot.camera.width)

    def sharpen(self, pixels: I64) -> None:
        """More samples for some pixels beside those with edges."""
        self._edges = np.union1d(self._edges, pixels)

    def all(self) -> Iterator[Band]:
        """All samples, after `first` has been gone through."""
        for number, pixels in enumerate(self.bands):
            if number in self._kept:
                view, measured = self._kept.pop(number)
            else:
                view = self._trace(pixels, self._n, self._first)
                measured = self._measure(view)
            begin, end = np.searchsorted(self._edges, pixels)
            edges = self._edges[begin:end]
            if len(edges) and self._n_edge:
                further = self._trace(edges, self._n_edge, self._first_edge)
                both = np.concatenate([measured, self._measure(further)])
                view, order = _joined(view, further, edges)
                measured = both[order]
            seen, more = self._seen(view, pixels, edges), None
            if len(edges) and self._settings.feature_samples:
                more = self._trace(edges, self._settings.feature_samples, self._first_edge + self._n_edge)
                share = more.samples_per_pixel / (self._n + self._n_edge + more.samples_per_pixel)
                view, seen = _with_sky_of(view, more, edges, share, seen, pixels[0])
            yield Band(pixels, view, edges, measured, seen, more)

    def _seen(self, view: ViewSamples, pixels: tuple[int, int], edges: I64) -> F64:
        first, end = pixels
        number = np.full(end - first, self._n)
        if len(edges):
            number[edges - first] += self._n_edge
        return (np.bincount(view.pixel - first, minlength=end - first) / number)[:, None]

    def features(self, band: Band) -> tuple[F64, F64]:
        """Mean albedo and shading normal of the pixels of a band, (n_pixels, 3) each; with edges, of more samples."""
        view, more = band.view, band.more
        albedo = average(view, view.points.albedo, band.pixels)
        normal = average(view, view.points.shading_normal, band.pixels)
        if more is not None:
            # Of samples that see a surface.
            seen, seen_more = (np.bincount(one.pixel, minlength=view.width * view.height) for one in (view, more))
            share = (seen_more / np.maximum(seen + seen_more, 1))[band.edges, None]
            rows = band.edges - band.pixels[0]
            albedo[rows] += share * (average(more, more.points.albedo, band.edges) - albedo[rows])
            normal[rows] += share * (average(more, more.points.shading_normal, band.edges) - normal[rows])
        return albedo, normal

    def _trace(self, pixels: tuple[int, int] | I64, n: int, first: int) -> ViewSamples:
        return view_samples(
            self._snapshot,
            self._tracer,
            samples_per_pixel=n,
            first_sample=first,
            centred=self._centred,
            pixel_filter=self._filter,
            seed=self._settings.seed,
            max_splits=0,
            pixels=pixels,
        )


def _with_sky_of(
    view: ViewSamples, more: ViewSamples, pixels: I64, share: float, seen: F64, first: int
) -> tuple[ViewSamples, F64]:
    """A view with the sky of both in `pixels`, whose surfaces fill as much of these as both see of them.

    Parameters
    ----------
    share : float
        What samples of `more` are of all.
    seen : (n_pixels, 1) float64
        Shares of the view's samples that end on surfaces, from pixel `first` on.

    Returns
    -------
    (ViewSamples, (n_pixels, 1) float64)
        And the shares of both. Where the view has none its pixel stays without light.
    """
    seen_more = np.bincount(more.pixel, minlength=view.width * view.height)[pixels, None] / more.samples_per_pixel
    before, rows = seen, pixels - first
    seen = before.copy()
    seen[rows] += share * (seen_more - before[rows])
    filled = np.divide(seen, before, out=np.ones_like(seen), where=before > 0)
    has_more = np.zeros(view.width * view.height, np.bool_)
    has_more[pixels] = True
    kept, rest = np.where(has_more, np.float32(1 - share), np.float32(1)), np.float32(share)
    background = view.background * kept[:, None]
    background[pixels] += more.background[pixels] * rest
    sky = SkyPaths(
        np.concatenate([view.sky.pixel, more.sky.pixel]),
        np.concatenate([view.sky.throughput * kept[view.sky.pixel, None], more.sky.throughput * rest]),
        np.concatenate([view.sky.direction, more.sky.direction]),
    )
    throughput = view.throughput * np.take(filled, view.pixel - first, axis=0).astype(np.float32)
    return replace(view, throughput=throughput, background=background, sky=sky), seen


def draws_of(view: ViewSamples, settings: GatherSettings) -> I64:
    """What each view sample draws its random numbers from, (n, 2): its pixel's sequence, and its number in the pixel.

    Images that are parts of one count on.
    """
    begin = np.flatnonzero(np.diff(view.pixel, prepend=-1))
    number = np.arange(view.n) - np.repeat(begin, np.diff(begin, append=view.n))
    first, first_edge = settings.first_sample or 0, settings.first_edge_sample
    if first_edge is not None:
        number += np.where(number < settings.samples_per_pixel, first, first_edge - settings.samples_per_pixel)
    else:
        number += first
    return np.stack([view.pixel.astype(np.int64), number], axis=1)


def _joined(view: ViewSamples, more: ViewSamples, pixels: I64) -> tuple[ViewSamples, I64]:
    """Samples of both, and which each was; in `pixels`, which `more` has, each counts as much as any other."""
    n, m = view.samples_per_pixel, more.samples_per_pixel
    has_more = np.zeros(view.width * view.height, bool)
    has_more[pixels] = True
    share, rest = np.float32(n / (n + m)), np.float32(m / (n + m))
    scale = np.where(has_more, share, np.float32(1))
    pixel = np.concatenate([view.pixel, more.pixel])
    order = np.argsort(pixel, kind="stable")
    throughput = np.concatenate([view.throughput * scale[view.pixel, None], more.throughput * rest])

    def both(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(np.concatenate([a, b])[order])

    sky = SkyPaths(
        np.concatenate([view.sky.pixel, more.sky.pixel]),
        np.concatenate([view.sky.throughput * scale[view.sky.pixel, None], more.sky.throughput * rest]),
        np.concatenate([view.sky.direction, more.sky.direction]),
    )
    background = view.background * scale[:, None]
    background[pixels] += more.background[pixels] * rest
    joined = replace(
        view,
        pixel=pixel[order],
        throughput=np.ascontiguousarray(throughput[order]),
        points=take_points(concatenate_points(view.points, more.points), order),
        to_eye=both(view.to_eye, more.to_eye),
        depth=both(view.depth, more.depth),
        background=background,
        stream=both(view.stream, more.stream),
        sky=sky,
    )
    return joined, order
