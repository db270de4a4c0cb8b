"""Final gathers of one view at several moments, laid over each other as an open shutter does."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from icheat_usd.final_gather.integrator import CacheRecords, FinalGather
from icheat_usd.image.cryptomatte import Coverage, weighted_sum
from icheat_usd.scene import F64

#: Layers of light: zero where nothing is seen.
_LIGHT = ("background", "emission", "direct", "indirect", "indirect_edited", "seen")
#: Layers of surfaces: moments at which a pixel shows none have no say in them.
_SURFACE = ("albedo", "normal", "depth")


def weighted_gather(moments: Iterable[tuple[float, FinalGather]]) -> FinalGather:
    """One image of several, which are asked for one by one.

    Parameters
    ----------
    moments : (weight, image) pairs
        The weights sum to 1. A single moment is returned as it is.
    """
    light: dict[str, F64] = {}
    surface: dict[str, F64] = {}
    groups: dict[str, dict[Any, F64]] = {"contributions": {}, "light_groups": {}}
    coverage: dict[str, list[tuple[float, Coverage]]] = {}
    records: list[CacheRecords] = []
    seen: F64 | None = None
    first: FinalGather | None = None
    count = 0
    for weight, image in moments:
        count += 1
        first = image if count == 1 else None
        is_seen: F64 = np.where(image.depth > 0, np.float64(weight), np.float64(0))
        seen = is_seen if seen is None else seen + is_seen
        _add(light, {name: getattr(image, name) for name in _LIGHT}, weight)
        _add(surface, {name: getattr(image, name) for name in _SURFACE}, is_seen)
        for name, sums in groups.items():
            _add(sums, getattr(image, name), weight)
        records += [] if image.records is None else [image.records]
        for name, found in image.coverage.items():
            coverage.setdefault(name, []).append((weight, found))
    if first is not None:
        return first
    if seen is None:
        raise ValueError("there is no moment to show")
    shown = {name: values / np.where(seen > 0, seen, 1.0) for name, values in surface.items()}
    mattes = {name: weighted_sum(parts) for name, parts in coverage.items()}
    layers = {**light, **shown}
    return FinalGather(
        background=layers["background"],
        emission=layers["emission"],
        direct=layers["direct"],
        indirect=layers["indirect"],
        indirect_edited=layers["indirect_edited"],
        albedo=layers["albedo"],
        normal=layers["normal"],
        depth=layers["depth"],
        seen=layers["seen"],
        contributions=groups["contributions"],
        light_groups=groups["light_groups"],
        coverage=mattes,
        records=CacheRecords(*map(np.concatenate, zip(*records, strict=True))) if records else None,
    )


def _add(sums: dict[Any, F64], layers: Mapping[Any, F64], weight: float | F64) -> None:
    for name, values in layers.items():
        part = weight * values
        sums[name] = sums[name] + part if name in sums else part
