"""The efforts of the final gather that `tools/benchmark render` measures, from quick to thorough."""

from __future__ import annotations

from icheat_usd.final_gather import GatherSettings

#: By name; every one is rendered by itself and gives one point of a curve.
EFFORTS: dict[str, GatherSettings] = {
    "1 x 4": GatherSettings(samples_per_pixel=1, gather_rays=4),
    "1 x 16": GatherSettings(samples_per_pixel=1, gather_rays=16),
    "4 x 16": GatherSettings(samples_per_pixel=4, gather_rays=16),
}

#: What is measured where one effort must do: cost of edits, growth.
USUAL = "1 x 16"

#: So little that a test can wait for it.
QUICK: dict[str, GatherSettings] = {
    "1 x 2": GatherSettings(samples_per_pixel=1, gather_rays=2, light_samples=1),
    "2 x 2": GatherSettings(samples_per_pixel=2, gather_rays=2, light_samples=1),
}


def efforts(quick: bool) -> dict[str, GatherSettings]:
    """All of them, or the quick ones."""
    return QUICK if quick else EFFORTS


def usual(quick: bool) -> GatherSettings:
    """The one where one must do."""
    return next(iter(QUICK.values())) if quick else EFFORTS[USUAL]
