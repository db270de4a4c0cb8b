"""Light of cache records by the surface that it comes from: all that edits of whole objects need to know of rays."""

from __future__ import annotations

import numpy as np

from icheat_usd.edits.bound import Ends, StackCoefficients
from icheat_usd.edits.field import EditField
from icheat_usd.edits.operations import Level
from icheat_usd.final_gather.gatherer import GatherSolution
from icheat_usd.final_gather.irradiance_cache import IrradianceCache, RecordValues
from icheat_usd.final_gather.record_rays import take_rays
from icheat_usd.kernels import record_sums
from icheat_usd.scene import F32, I64, Bool

_RAYS_AT_ONCE = 1 << 19


def is_of_objects(field: EditField) -> bool:
    """Whether casters differ in nothing but which instance they lie on, and receivers in nothing but their masks."""
    if field.uses_incident or field.uses_caster or field.uses_receiver:
        return False
    return all(
        bound.level is not Level.AGGREGATE and rows is None and casters.constant_on_instances
        for bound in field.edits
        for casters, rows in zip(bound.casters, bound.rows, strict=True)
    )


class CasterLight:
    """Irradiance of records and its gradients, of each group of lights and each instance apart.

    Parameters
    ----------
    solution : GatherSolution
        What gather cells send, or some lights' part of it, to which nothing that edits add belongs.
    """

    def __init__(self, cache: IrradianceCache, solution: GatherSolution) -> None:
        b = solution.b if solution.sent is None else solution.sent
        self._is_part = solution.sent is not None
        self._cache, self._n_groups = cache, len(b)
        # Added emission travels on transport alone, which is the light of cells that send 1.
        sent = np.concatenate([*b, np.ones_like(b[0])], axis=1)
        self._sent = np.concatenate([sent, np.zeros((1, sent.shape[1]), np.float32)])
        self._is_known = np.zeros(cache.n, bool)
        self._record = np.empty(0, np.int64)
        self._instance = np.empty(0, np.int64)
        channels = sent.shape[1]
        gradients = (np.empty((0, channels, 3), np.float32) for _ in range(2))
        self._values = RecordValues(np.empty((0, channels), np.float32), *gradients)

    def change(self, field: EditField, is_in: Bool, needed: Bool) -> RecordValues:
        """What edits make of records where receivers are in some of them.

        Parameters
        ----------
        is_in : (n_rows,)
        needed : (n_records,)

        Returns
        -------
        RecordValues
            Changes for the needed records, ascending.
        """
        self._find(needed)
        factor, added = _coefficients(field, is_in)
        if self._is_part:
            added = np.zeros_like(added)
        acts: Bool = np.asarray(factor.any(axis=(1, 2)) | added.any(axis=1), np.bool_)
        some = np.flatnonzero(needed[self._record] & acts[self._instance])
        instance = self._instance[some]
        record = self._record[some]
        begin = np.flatnonzero(np.diff(record, prepend=-1))
        slot = (np.cumsum(needed) - 1)[record[begin]]
        groups = [factor[:, group][instance] for group in range(self._n_groups)]
        weights = np.concatenate([*groups, added[instance]], axis=1)
        n = int(needed.sum())
        out = RecordValues(np.zeros((n, 3), np.float32), *(np.zeros((n, 3, 3), np.float32) for _ in range(2)))
        for total, column in zip(out, self._values, strict=True):
            shape = weights.shape + (1,) * (column.ndim - 2)
            light = column[some] * weights.reshape(shape)
            light = light.reshape(len(some), self._n_groups + 1, 3, *column.shape[2:]).sum(axis=1)
            if len(some):
                total[slot] = np.add.reduceat(light, begin, axis=0)
        out.by_move[...] *= self._cache.shrink[needed][:, None, None]
        return out

    def _find(self, needed: Bool) -> None:
        cache = self._cache
        new = needed & ~self._is_known
        if not new.any():
            return
        self._is_known |= new
        share = (1 / np.bincount(cache.owner, minlength=cache.n)).astype(np.float32)
        hemispheres = np.flatnonzero(new[cache.owner])
        records, instances, values = [self._record], [self._instance], [self._values]
        at_once = max(1, _RAYS_AT_ONCE // cache.rays.n_rays)
        for begin in range(0, len(hemispheres), at_once):
            chunk = hemispheres[begin : begin + at_once]
            owner = cache.owner[chunk]
            row, instance, light = self._of_hemispheres(chunk)
            for column in light:
                column *= share[owner[row]].reshape(-1, *(1,) * (column.ndim - 1))
            records.append(owner[row])
            instances.append(instance)
            values.append(light)
        record = np.concatenate(records)
        order = np.argsort(record, kind="stable")
        self._record, self._instance = record[order], np.concatenate(instances)[order]
        self._values = RecordValues(*(np.concatenate(columns)[order] for columns in zip(*values, strict=True)))

    def _of_hemispheres(self, chunk: I64) -> tuple[I64, I64, RecordValues]:
        """Row in the chunk, instance, and light of every pair of a hemisphere and what it sees."""
        rays = take_rays(self._cache.rays, chunk)
        instance = rays.sender
        n, n_rays = instance.shape
        local, listed = np.empty((n, n_rays), np.int16), np.empty((n, n_rays), np.int32)
        number = np.empty(n, np.int32)
        record_sums.list_casters(instance, local, number, listed)
        begin = np.concatenate([[0], np.cumsum(number, dtype=np.int64)])
        total, channels = int(begin[-1]), self._sent.shape[1]
        light = RecordValues(
            np.zeros((total, channels), np.float32),
            np.zeros((total, channels, 3), np.float32),
            np.zeros((total, channels, 3), np.float32),
        )
        record_sums.caster_sums(
            rays.radiance(self._sent),
            rays.distance,
            local,
            begin[:-1],
            rays.shading_normal,
            rays.stream,
            rays.seed,
            rays.n_theta,
            rays.n_phi,
            *light,
        )
        row = np.repeat(np.arange(n), number)
        return row, listed[row, np.arange(total) - begin[row]].astype(np.int64), light


def _coefficients(field: EditField, is_in: Bool) -> tuple[F32, F32]:
    """S - 1, (n_instances, G, 3), and added emission, (n_instances, 3), for receivers in some edits."""
    weights = [casters.on_instances for bound in field.edits for casters in bound.casters]
    masks = np.stack(weights).astype(np.float32)
    different, which = np.unique(masks, axis=1, return_inverse=True)
    n = different.shape[1]
    here = np.repeat(is_in.astype(np.float32)[:, None], n, axis=1)
    anything = np.ones((field.n_groups, n, 3), np.float32)
    found: StackCoefficients = field.evaluate(anything, Ends(here, None, ()), Ends(different, None, ()))
    which = which.reshape(-1)
    return (found.scale - np.float32(1)).transpose(1, 0, 2)[which], found.emission[which]
