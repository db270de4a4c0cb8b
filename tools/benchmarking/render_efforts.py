"""The efforts of the final gather that `tools/benchmark render` measures, from quick to thorough."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from icheat_usd.final_gather import GatherSettings
from icheat_usd.session.quality import PREVIEW, Quality


class RenderEffort(NamedTuple):
    """How much work goes into a frame."""

    settings: GatherSettings
    quality: Quality  #: of the gather samples that earlier bounces are taken from


#: By name; every one is rendered by itself and gives one point of a curve.
EFFORTS: dict[str, RenderEffort] = {
    "brute 1 x 4": RenderEffort(GatherSettings(method="brute", samples_per_pixel=1, gather_rays=4), PREVIEW),
    "brute 4 x 16": RenderEffort(GatherSettings(method="brute", samples_per_pixel=4, gather_rays=16), PREVIEW),
    "cached 1": RenderEffort(GatherSettings(samples_per_pixel=1), PREVIEW),
    "cached 4": RenderEffort(GatherSettings(samples_per_pixel=4), PREVIEW),
}

#: What is measured where one effort must do: cost of edits, growth.
USUAL = "cached 4"

_LEAST = replace(PREVIEW, n_gather=512, rays_per_bounce_row=16, light_samples=2)

#: So little that a test can wait for it.
QUICK: dict[str, RenderEffort] = {
    "brute": RenderEffort(GatherSettings(method="brute", samples_per_pixel=1, gather_rays=2, light_samples=1), _LEAST),
    "cached": RenderEffort(GatherSettings(samples_per_pixel=1, light_samples=1, edge_samples=1), _LEAST),
}


def efforts(quick: bool) -> dict[str, RenderEffort]:
    """All of them, or the quick ones."""
    return QUICK if quick else EFFORTS


def usual(quick: bool) -> RenderEffort:
    """The one where one must do."""
    return QUICK["cached"] if quick else EFFORTS[USUAL]
