"""A rendered frame whose edits can be changed: their light is found again from what its rays brought."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from icheat_usd.edits.bound import BoundEdit
from icheat_usd.edits.field import EditField
from icheat_usd.edits.offsets import offset_casters
from icheat_usd.final_gather.cached import CachedGather, under_stack
from icheat_usd.final_gather.edited_records import edited_records
from icheat_usd.final_gather.gatherer import Gatherer, GatherSolution
from icheat_usd.final_gather.receiver_sets import Touched, touched
from icheat_usd.final_gather.same_stack import same_receivers
from icheat_usd.samples import ViewSamples
from icheat_usd.samples.develop import develop
from icheat_usd.scene import F32, F64
from icheat_usd.tracing import build_tracer
from icheat_usd.transport import sum_groups


class KeptBand(NamedTuple):
    """Camera samples of a part of the image."""

    pixels: tuple[int, int]
    view: ViewSamples


class Replay:
    """Edited light of a frame under other stacks, without a ray for stacks that a record's rays can tell everything of.

    Curves, light from behind occluders and mixtures of many soft masks gather
    rays of their own again, as when they are rendered.

    Parameters
    ----------
    cached : CachedGather
        With its samples, one for each band.
    per_light : (n_lights, n_gather, 3) float32
        The gather-sample solution.
    """

    def __init__(self, gatherer: Gatherer, cached: CachedGather, bands: list[KeptBand], per_light: F32) -> None:
        self._gatherer, self._cached, self._bands, self._per_light = gatherer, cached, bands, per_light
        self._receivers = cached.receivers  # of each band, under the last stack

    @property
    def known(self) -> dict[str, BoundEdit]:
        """Edits of the last stack by path: what `bind` need not find again."""
        return {bound.edit.path: bound for bound in self._gatherer.field.edits}

    def edited(self, field: EditField) -> F64:
        """Indirect light under a stack, (height, width, 3).

        Parameters
        ----------
        field : EditField
            Bound to the snapshot that was rendered.
        """
        gatherer = self._gatherer = self._under(field)
        cache = self._cached.cache
        records = None if field.is_identity else edited_records(gatherer, cache, self._cached.hemispheres)
        parts = []
        receivers = self._touched(field)
        for band, ((pixels, view), sampled) in enumerate(zip(self._bands, self._cached.samples, strict=True)):
            light = sampled.base if records is None else under_stack(gatherer, records, sampled, receivers[band])
            parts.append(develop(view, light, pixels))
        camera = gatherer.snapshot.camera
        return np.concatenate(parts).reshape(camera.height, camera.width, 3)

    def _touched(self, field: EditField) -> list[Touched]:
        """Receivers in each band, found again only if other places are touched than by the last stack."""
        if field.is_identity:
            return []
        if self._receivers and same_receivers(self._receivers[0].field, field):
            self._receivers = [receivers._replace(field=field) for receivers in self._receivers]
        else:
            self._receivers = [touched(field, sampled.points) for sampled in self._cached.samples]
        return self._receivers

    def _under(self, field: EditField) -> Gatherer:
        g = self._gatherer
        assert g.solution is not None
        gather = g.solution.gather
        b = sum_groups(self._per_light, field.light_group, field.n_groups)
        offsets = offset_casters(field, field.casters(gather.points), b, gather.area) if field.has_offset else None
        hidden = [field.edits[edit].occluders for edit in field.throughs]
        return replace(
            g,
            field=field,
            solution=GatherSolution(gather, b, g.solution.total, offsets),
            clear=tuple(build_tracer(g.snapshot, g.tracer.engine, hidden=one) for one in hidden),
            prefixes=(),
        )
