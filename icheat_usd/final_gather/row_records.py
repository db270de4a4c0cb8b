"""Edited light of camera samples under stacks of sampled rows."""

from __future__ import annotations

import numpy as np

from icheat_usd.final_gather.gatherer import Gatherer
from icheat_usd.final_gather.hemispheres import Hemispheres
from icheat_usd.final_gather.irradiance_cache import IrradianceCache, Lookup
from icheat_usd.final_gather.receiver_sets import Touched
from icheat_usd.final_gather.row_light import row_light
from icheat_usd.final_gather.row_stack import RowStack
from icheat_usd.materials import take_points
from icheat_usd.scene import F32, I64, SurfacePoints


class RowRecords:
    """Changes of the irradiance of camera samples, as `EditedRecords` finds them for other stacks."""

    #: Receivers' masks are mixed from sets of edits, of no more than `MOST_SOFT` masks.
    takes_soft_masks = False

    def __init__(self, gatherer: Gatherer, cache: IrradianceCache, hemispheres: Hemispheres) -> None:
        assert gatherer.solution is not None
        self._gatherer, self._stack = gatherer, RowStack(gatherer.field)
        self._light = row_light(gatherer, self._stack, hemispheres, cache.table.position, cache.table.normal)

    def change(self, found: Lookup, points: SurfacePoints, receivers: Touched) -> F32:
        """Change of irradiance at m receivers with records, (m, 3); `found` is of all points."""
        return self._light.change(found, points, receivers)

    def change_alone(self, points: SurfacePoints, rays: Hemispheres, row: I64, receivers: Touched) -> F32:
        """The same at m receivers without records, from hemispheres of their own; `row` (m,) is that of each."""
        m, stands = len(row), rays.parts[0].points
        own = row_light(self._gatherer, self._stack, rays, stands.position, stands.shading_normal)
        # Each is its own record.
        itself = Lookup(np.ones(m, np.int32), row[:, None].astype(np.int32), *np.ones((2, m, 1), np.float32))
        at = take_points(points, receivers.where)
        return own.change(itself, at, receivers._replace(where=np.arange(m)))
