"""Light of cache records by the surface, and the painted part of it, that it comes from.

This is all that edits need to know of rays whose factors depend on nothing but masks: for any amounts and colours.
"""

from __future__ import annotations

from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from icheat_usd.edits.bound import Ends, StackCoefficients
from icheat_usd.edits.field import EditField
from icheat_usd.edits.masks import BoundMask
from icheat_usd.edits.operations import Level
from icheat_usd.final_gather.gatherer import GatherSolution
from icheat_usd.final_gather.hemispheres import Hemispheres
from icheat_usd.final_gather.irradiance_cache import RecordValues
from icheat_usd.final_gather.record_rays import RecordRays
from icheat_usd.kernels import caster_sums as kernels
from icheat_usd.scene import F32, I32, I64, Bool, Geometry

#: Tables of light by key that are kept for other stacks.
_MOST_KEPT = 32


def is_of_masks(field: EditField) -> bool:
    """Whether casters differ in nothing but instances and painted masks, and receivers in nothing but their masks."""
    if field.uses_incident or field.uses_caster or field.uses_receiver:
        return False
    return all(
        bound.level is not Level.AGGREGATE and rows is None and not casters.within
        for bound in field.edits
        for casters, rows in zip(bound.casters, bound.rows, strict=True)
    )


class CasterKeys(NamedTuple):
    """What light is told apart by: the instance that sends it, and products of the painted masks on it."""

    table: kernels.KeyTable
    row: I32  #: (n_instances, MOST_MASKS) row of each of an instance's masks among all masks of the stack, or -1
    instance: I32  #: (n_keys,)
    subset: I32  #: (n_keys,) masks that are multiplied, as bits

    def has(self, other: CasterKeys) -> bool:
        """Whether light by these tells all that light by the others would."""
        if self.table.first is other.table.first:
            return True
        mine, theirs = self.table, other.table
        if mine.n_masks.any() or theirs.n_masks.any():
            pairs: list[tuple[Any, Any]] = list(zip((*mine, self.row), (*theirs, other.row), strict=True))
            return all(np.array_equal(a, b) for a, b in pairs)
        return not ((theirs.count > 0) & (mine.count == 0)).any()


def caster_keys(field: EditField, rows: Bool) -> CasterKeys | None:
    """Keys for some rows of a stack, (n_rows,); None if a caster has too many painted masks."""
    selections = [casters for bound in field.edits for casters in bound.casters]
    acts = [bound.level is not Level.VIEW for bound in field.edits for _ in bound.casters]
    n_instances = len(selections[0].on_instances)
    n_masks, count = np.zeros(n_instances, np.int32), np.zeros(n_instances, np.int32)
    mask = np.zeros((n_instances, kernels.MOST_MASKS), np.int32)
    row_of = np.full((n_instances, kernels.MOST_MASKS), -1, np.int32)
    is_plain = np.zeros(n_instances, np.bool_)
    painted: list[BoundMask] = []
    for row in np.flatnonzero(rows & acts).tolist():
        selected = selections[row].on_instances > 0
        bound = selections[row].mask
        if bound is None:
            is_plain |= selected
            continue
        here = np.flatnonzero(selected & (bound.first_face >= 0))
        if (n_masks[here] == kernels.MOST_MASKS).any():
            return None
        mask[here, n_masks[here]], row_of[here, n_masks[here]] = len(painted), row
        n_masks[here] += 1
        painted.append(bound)
    some = is_plain | (n_masks > 0)
    count[some] = (1 << n_masks[some]) - ~is_plain[some]
    sizes = [bound.texels.size for bound in painted]
    table = kernels.KeyTable(
        (np.cumsum(count) - count).astype(np.int32),
        count,
        n_masks,
        mask,
        np.concatenate([np.zeros(0, np.float32), *(bound.texels.reshape(-1) for bound in painted)]),
        np.cumsum([0, *sizes], dtype=np.int64)[:-1],
        np.array([bound.texels.shape[1] for bound in painted], np.int64),
        np.array([bound.first_face for bound in painted], np.int64).reshape(len(painted), n_instances),
    )
    instance = np.repeat(np.arange(n_instances, dtype=np.int32), count)
    subset = np.arange(len(instance), dtype=np.int32) - table.first[instance] + ~is_plain[instance]
    return CasterKeys(table, row_of, instance, subset.astype(np.int32))


class CasterLight:
    """Irradiance of records and its gradients, of each group of lights and each key apart.

    Parameters
    ----------
    solution : GatherSolution
        What gather cells send, or some lights' part of it, to which nothing that edits add belongs.
    """

    def __init__(self, geometry: Geometry, solution: GatherSolution) -> None:
        self._b = solution.b if solution.sent is None else solution.sent
        self._geometry, self._is_part = geometry, solution.sent is not None
        self._found: WeakKeyDictionary[Hemispheres, dict[int, LightByKey]] = WeakKeyDictionary()

    def change(self, of: Hemispheres, field: EditField, keys: CasterKeys, is_in: Bool, needed: Bool) -> RecordValues:
        """What edits make of records where receivers are in some of them.

        Parameters
        ----------
        keys : CasterKeys
            For these edits at least; kept by the caller.
        is_in : (n_rows,)
        needed : (n_records,)

        Returns
        -------
        RecordValues
            Changes for the needed records, ascending.
        """
        n_groups = len(self._b)
        wanted = np.flatnonzero(needed)
        out = RecordValues(
            np.zeros((len(wanted), 3), np.float32), *(np.zeros((len(wanted), 3, 3), np.float32) for _ in range(2))
        )
        adds = not self._is_part and _adds_light(field)
        light = self._light(of, keys, adds)
        if len(light.keys.instance) == 0:  # Edits of nothing but views.
            return out
        factor, added = _coefficients(field, light.keys, is_in)
        weight = np.zeros((len(factor), light.values.irradiance.shape[1]), np.float32)
        weight[:, : 3 * n_groups] = factor.reshape(len(factor), -1)
        if adds:
            weight[:, 3 * n_groups :] = added
        if weight.any():
            light.find(of, needed, self._geometry)
            kernels.weigh_keys(wanted, light.begin, light.key, *light.values, weight, of.shrink, *out)
        return out

    def _light(self, of: Hemispheres, keys: CasterKeys, adds: bool) -> LightByKey:
        """What is known of hemispheres by these keys or more."""
        found = self._found.setdefault(of, {})
        if id(keys) in found:
            return found[id(keys)]
        for one in of.light:
            if (one.adds or not adds) and one.keys.has(keys) and np.array_equal(one.b, self._b):
                break
        else:
            # Added emission travels on transport alone, which is the light of cells that send 1.
            columns = [*self._b, np.ones_like(self._b[0])] if adds else list(self._b)
            one = LightByKey(self._b, np.ascontiguousarray(np.concatenate(columns, axis=1)), keys, adds, of.n)
            of.light[:] = [*of.light[-_MOST_KEPT:], one]
        found[id(keys)] = one
        return one


class LightByKey:
    """Light of hemispheres by key, found when it is first asked for."""

    def __init__(self, b: F32, sent: F32, keys: CasterKeys, adds: bool, n: int) -> None:
        self.b, self.keys, self.adds, self._sent = b, keys, adds, sent
        self._is_known = np.zeros(n, np.bool_)
        channels = sent.shape[1]
        self._record = np.empty(0, np.int64)
        self.key = np.empty(0, np.int32)
        self.values = RecordValues(
            np.empty((0, channels), np.float32), *(np.empty((0, channels, 3), np.float32) for _ in range(2))
        )
        self.begin = np.zeros(n + 1, np.int64)  #: entries of each record

    def find(self, of: Hemispheres, needed: Bool, geometry: Geometry) -> None:
        """See to it that some records are known."""
        new = needed & ~self._is_known
        if not new.any():
            return
        self._is_known |= new
        share = of.shares()
        records, keys, values = [self._record], [self.key], [self.values]
        for rays, _, owner in of.chunks():
            some = new[owner]
            if not some.any():
                continue
            row, key, light = self._of_rays(rays, share[owner], some, geometry)
            records.append(owner[row])
            keys.append(key)
            values.append(light)
        record = np.concatenate(records)
        order = np.argsort(record, kind="stable")
        self._record, self.key = record[order], np.concatenate(keys)[order]
        columns = (np.concatenate(column) for column in zip(*values, strict=True))
        self.values = RecordValues(*(np.take(column, order, axis=0) for column in columns))
        self.begin = np.searchsorted(self._record, np.arange(of.n + 1))

    def _of_rays(self, rays: RecordRays, share: F32, some: Bool, geometry: Geometry) -> tuple[I64, I32, RecordValues]:
        """Row, key and light of every pair of a row and what it sees."""
        n, n_rays = rays.cell.shape
        table = self.keys.table
        ends = rays.detour_ends
        lit = rays.cell.reshape(-1)[rays.detour] >= 0
        ray_table = kernels.RayTable(
            rays.cell,
            rays.distance,
            rays.instance,
            rays.triangle,
            rays.uv,
            rays.shading_normal,
            rays.stream,
            np.searchsorted(rays.detour, n_rays * np.arange(n + 1)),
            rays.detour,
            np.searchsorted(rays.adjusted, n_rays * np.arange(n + 1)),
            rays.adjusted,
            np.ascontiguousarray(rays.throughput, np.float32),
            np.where(lit, ends.instance, np.int32(-1)).astype(np.int32),
            ends.face,
            ends.face_uv,
        )
        most = int(table.count.max(initial=0))
        room = min(len(self.keys.instance), most * n_rays)
        local, listed = np.empty((n, n_rays), np.int16), np.empty((n, room), np.int32)
        number = np.empty(n, np.int32)
        kernels.list_keys(ray_table, table, some.view(np.uint8), local, number, listed)
        begin = np.concatenate([[0], np.cumsum(number, dtype=np.int64)])
        total, channels = int(begin[-1]), self._sent.shape[1]
        light = RecordValues(
            np.zeros((total, channels), np.float32),
            np.zeros((total, channels, 3), np.float32),
            np.zeros((total, channels, 3), np.float32),
        )
        kernels.caster_sums(
            ray_table,
            table,
            geometry.face,
            geometry.face_uv,
            self._sent,
            local,
            begin,
            share,
            rays.seed,
            rays.n_theta,
            rays.n_phi,
            *light,
        )
        row = np.repeat(np.arange(n), number)
        return row, listed[row, np.arange(total) - begin[row]], light


def _adds_light(field: EditField) -> bool:
    """Whether an edit may add emission."""
    for bound in field.edits:
        for key in range(bound.n_keys):
            if bound.operation is None:
                baked = bound.baked[key]
                if baked is None or baked.emission is not None:
                    return True
            elif bound.level is Level.PAIR:
                constants = bound.operation.constants(bound.parameters[key])
                if constants is None or constants.emission is not None:
                    return True
    return False


def _coefficients(field: EditField, keys: CasterKeys, is_in: Bool) -> tuple[F32, F32]:
    """Factors on the light of each key, (n_keys, G, 3), and on its transport, (n_keys, 3), in some edits.

    S - 1 and E are straight lines in each mask: their values where masks are 0 or 1 tell the factor on each product.
    """
    table, instance, subset = keys.table, keys.instance, keys.subset
    weights = np.stack([casters.on_instances for bound in field.edits for casters in bound.casters])
    masks = weights[:, instance].astype(np.float32)
    position = 0
    for bound in field.edits:
        for casters in bound.casters:
            if casters.mask is not None:
                masks[position] = 0
            position += 1
    which = np.arange(len(instance))
    for bit in range(kernels.MOST_MASKS):
        row = keys.row[instance, bit]
        held = np.flatnonzero((subset >> bit & 1 == 1) & (row >= 0))
        masks[row[held], held] = weights[row[held], instance[held]]
    different, inverse = np.unique(masks, axis=1, return_inverse=True)
    n = different.shape[1]
    here = np.repeat(is_in.astype(np.float32)[:, None], n, axis=1)
    anything = np.ones((field.n_groups, n, 3), np.float32)
    found: StackCoefficients = field.evaluate(anything, Ends(here, None, ()), Ends(different, None, ()))
    inverse = inverse.reshape(-1)
    factor = (found.scale - np.float32(1)).transpose(1, 0, 2)[inverse]
    added = found.emission[inverse]
    first = subset[table.first[instance]]
    for bit in range(kernels.MOST_MASKS):
        held = np.flatnonzero(subset >> bit & 1 == 1)
        # What has no key of its own is what no edit acts on: 0.
        held = held[subset[held] - (1 << bit) >= first[held]]
        without = which[held] - (1 << bit)
        factor[held] -= factor[without]
        added[held] -= added[without]
    return factor, added
