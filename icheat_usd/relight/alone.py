"""View samples whose edits look at each of them: evaluated pair by pair on the exact rows, as a difference."""

from __future__ import annotations

import numpy as np

from icheat_usd.edits.field import EditField
from icheat_usd.errors import EditError
from icheat_usd.materials import take_points
from icheat_usd.relight.editing import LitCasters, edit_samples, unedited_samples
from icheat_usd.relight.receivers import Receivers, behind_occluders, group_samples
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.scene import F32, I64
from icheat_usd.transport import HeldBack, Transport
from icheat_usd.transport.packed import PackedTransport


class AloneSamples:
    """Some view samples under one field, whichever lights shine and whatever the amounts."""

    def __init__(
        self,
        field: EditField,
        samples: I64,
        view: ViewSamples,
        transport: Transport | PackedTransport,
        held_back: HeldBack | None,
    ) -> None:
        exact = transport.source if isinstance(transport, PackedTransport) else transport
        if exact is None:
            names = ", ".join(bound.edit.name for bound in field.edits)
            raise EditError(f"among {names} are edits that look at receivers, which needs exact rows; build them again")
        self._transport, self._view = exact, view
        points = take_points(view.points, samples)
        self._receivers: Receivers = behind_occluders(
            field, group_samples(field, samples, field.receivers(points)), held_back
        )

    def difference(self, field: EditField, gather: GatherSamples, by_group: F32) -> F32:
        """What the edits of pairs and aggregates add to the unedited light, (n, 3)."""
        samples = self._receivers.samples
        lit = LitCasters(field.casters(gather.points), by_group, gather.area, self._view.points.albedo)
        before = unedited_samples(self._transport, samples, by_group.sum(axis=0))
        light = before.copy()
        edit_samples(self._transport, lit, field, self._receivers, light)
        return np.asarray(light - before)
