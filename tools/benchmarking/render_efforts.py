"""The efforts of the final gather that `tools/benchmark render` measures, from quick to thorough."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from icheat_usd.final_gather import CacheSettings, GatherSettings
from icheat_usd.session.quality import PREVIEW, QUICK, QUICK_CELLS, Quality


class RenderEffort(NamedTuple):
    """How much work goes into a frame."""

    settings: GatherSettings
    quality: Quality  #: of the gather samples that earlier bounces are taken from


def _with_cells(n_gather: int, bounce_rays: int, light_samples: int, settings: GatherSettings) -> RenderEffort:
    quality = replace(PREVIEW, n_gather=n_gather, rays_per_bounce_row=bounce_rays, light_samples=light_samples)
    return RenderEffort(settings, quality)


#: By name; every one is rendered by itself and gives one point of a curve. Those that are gathered are denoised.
EFFORTS: dict[str, RenderEffort] = {
    "brute 4 x 16": RenderEffort(GatherSettings(method="brute", samples_per_pixel=4, gather_rays=16), PREVIEW),
    "gathered quick": RenderEffort(QUICK, QUICK_CELLS),
    "gathered 0": _with_cells(16_384, 64, 16, replace(QUICK, edge_samples=3, feature_samples=8)),
    "gathered 1": _with_cells(
        32_768,
        64,
        16,
        replace(QUICK, samples_per_pixel=2, gather_rays=16, dome_samples=4, edge_samples=6, feature_samples=8),
    ),
    "cached quick": _with_cells(
        8_192,
        32,
        4,
        GatherSettings(
            1,
            light_samples=1,
            dome_samples=8,
            edge_samples=3,
            cache=CacheSettings(n_theta=8, noise=0.2, least_reach=5.0, most_reach=24.0, coverage=0.3, near_paths=0),
        ),
    ),
    "cached 0": _with_cells(
        16_384,
        64,
        4,
        GatherSettings(
            1,
            light_samples=1,
            dome_samples=16,
            edge_samples=3,
            cache=CacheSettings(noise=0.05, least_reach=3.0, most_reach=24.0),
        ),
    ),
    "cached 1": _with_cells(
        32_768,
        64,
        4,
        GatherSettings(
            1, light_samples=1, dome_samples=16, edge_samples=7, cache=CacheSettings(noise=0.03, most_reach=24.0)
        ),
    ),
    "cached 2": _with_cells(
        65_536,
        64,
        4,
        GatherSettings(
            1,
            light_samples=1,
            dome_samples=32,
            edge_samples=15,
            cache=CacheSettings(noise=0.02, most_reach=24.0, coverage=0.8),
        ),
    ),
    "cached 3": _with_cells(
        65_536,
        128,
        8,
        GatherSettings(2, light_samples=2, dome_samples=16, edge_samples=14, cache=CacheSettings(noise=0.0125)),
    ),
    "cached 4": _with_cells(
        131_072,
        256,
        8,
        GatherSettings(
            4,
            light_samples=2,
            dome_samples=16,
            edge_samples=28,
            cache=CacheSettings(n_theta=16, noise=0.006, least_reach=1.5, most_reach=8.0, coverage=0.8),
        ),
    ),
}

#: What is measured where one effort must do, and where that takes many renders: cost of edits, growth, sequences.
USUAL, LESSER = "cached 3", "cached 2"

_LEAST = replace(PREVIEW, n_gather=512, rays_per_bounce_row=16, light_samples=2)

#: So little that a test can wait for it.
SMALL: dict[str, RenderEffort] = {
    "brute": RenderEffort(GatherSettings(method="brute", samples_per_pixel=1, gather_rays=2, light_samples=1), _LEAST),
    "cached": RenderEffort(GatherSettings(samples_per_pixel=1, light_samples=1, edge_samples=1), _LEAST),
}


def efforts(quick: bool) -> dict[str, RenderEffort]:
    """All of them, or the quick ones."""
    return SMALL if quick else EFFORTS


def usual(quick: bool) -> RenderEffort:
    """The one where one must do."""
    return SMALL["cached"] if quick else EFFORTS[USUAL]


def lesser(quick: bool) -> RenderEffort:
    """The one for many renders."""
    return SMALL["cached"] if quick else EFFORTS[LESSER]


def said_of_lesser(width: int, height: int) -> str:
    """What tables of figures that were measured with it begin with."""
    settings, quality = EFFORTS[LESSER]
    return (
        f"Effort '{LESSER}' of suite rivals ({quality.n_gather:,} gather samples, records of {settings.cache.noise:.0%}"
        f" noise), {width}x{height} unless said otherwise."
    )
