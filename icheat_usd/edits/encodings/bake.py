"""Baking: pair functions of an edit, or of a whole stack, sampled and coded as rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from icheat_usd.edits.encodings.coding import CodedRows, RowCoder
from icheat_usd.edits.encodings.places import make_places, masked_surface, object_positions
from icheat_usd.edits.encodings.rows import Mixture, bind_rows
from icheat_usd.edits.encodings.sampled import KINDS, SampledRows, cell_begins, contract, needed_nodes, tree_shape
from icheat_usd.edits.encodings.sites import ChosenSites, choose_sites, pixel_footprint
from icheat_usd.edits.field import EditField, Ends
from icheat_usd.edits.model import Blend, Edit, EditStack, KeyedPayload
from icheat_usd.edits.operations import Level
from icheat_usd.errors import EditError
from icheat_usd.kernels.samples import instance_areas
from icheat_usd.materials import take_points
from icheat_usd.progress import Progress, silent
from icheat_usd.samples import ClusterTree, GatherSamples, ViewSamples
from icheat_usd.samples.tree import build_tree
from icheat_usd.scene import F32, I32, I64, Bool, SceneSnapshot

#: Largest error of S by default. Half of it is for what rows leave out, half for what lies between them.
EPSILON = 0.02

_TEST_LEAVES, _TEST_SAMPLES = 24, 64
_PAIRS_AT_ONCE = 1 << 19
_BYTES_AT_ONCE = 48 << 20
_MEASURED_SAMPLES, _MEASURED_LEAVES = 2048, 64


class BakedRows(NamedTuple):
    """Rows, and how far they were seen to be off between their samples."""

    rows: SampledRows
    measured: float  #: largest difference of S at random view samples and gather samples of the view baked for
    n_view: int  #: view samples that the edit may touch


def at_full_amount(edit: Edit, key: KeyedPayload | None = None) -> EditStack:
    """The one edit that is baked: full amount, one key, all lights; amount, blend and lights stay opinions in USD."""
    keys = () if key is None else (replace(key, weight=1.0),)
    whole = replace(edit, amount=1.0, enabled=True, blend=Blend.COMPOSE, lights=(), keys=keys)
    return EditStack(path="", edits=(whole,))


def check_bakeable(field: EditField, where: str) -> None:
    """Refuse what rows of S, E and O cannot hold.

    Raises
    ------
    EditError
        It says which edit, and what to do.
    """
    if field.n_groups > 1:
        names = ", ".join(bound.edit.path for bound in field.edits if bound.edit.lights)
        raise EditError(
            f"{where}: {names} acts on some lights only, which rows cannot tell apart; mute it or bake it alone"
        )
    for bound in field.edits:
        operation = bound.operation
        if operation is not None and operation.has_through:
            raise EditError(
                f"{bound.edit.path}: operation '{operation.name}' asks for light behind occluders, which is found by"
                " rays and cannot be baked as rows; leave it as its recipe"
            )
        if bound.level is Level.VIEW:
            raise EditError(
                f"{bound.edit.path}: operation '{bound.edit.operation}' acts on receivers alone and is exact as it"
                " is; there is nothing to bake"
            )


def bake_field(
    field: EditField,
    view: ViewSamples,
    gather: GatherSamples,
    snapshot: SceneSnapshot,
    *,
    where: str,
    radiance: F32 | None = None,
    resolved: Sequence[F32] = (),
    epsilon: float = EPSILON,
    coefficients: int | None = None,
    progress: Progress = silent,
) -> BakedRows:
    """Sample S, E and O of a field and code them.

    Parameters
    ----------
    field : EditField
        One edit (see `at_full_amount`), or a stack that is frozen.
    where : str
        Path of the edit, for messages.
    radiance : (n_gather, 3) float32
        Light that leaves the gather samples; needed where the field uses it.
    resolved : sequence of (n_view, 3) float32
        Scale of every aggregate at the view samples.
    epsilon : float
        Allowed error of S; of E and O, relative to their largest value.
    coefficients : int, optional
        Keep this many in each row instead; `epsilon` then only says how far apart rows may lie.

    Raises
    ------
    EditError
        The field is nothing that rows can hold, or it touches no sample.
    """
    check_bakeable(field, where)
    work = _Work(field, view, gather, radiance, resolved)
    if not work.leaves.any():
        raise EditError(f"{where}: its casters hold no gather sample, so there is nothing to bake; check icheatCasters")
    if not work.touched.any():
        raise EditError(f"{where}: the camera sees none of its receivers, so there is nothing to bake; move it")

    tests = work.test_leaves()
    allowed = work.tolerance(tests, 0.5 * epsilon)
    sites = choose_sites(
        view, pixel_footprint(view, snapshot), work.on_touched_sides(), work.judged(tests, allowed, progress), progress
    )
    contraction = contract(gather.tree.lo, gather.tree.mid, gather.tree.hi, work.leaves)
    area = gather.area[work.leaf_numbers]
    tree = build_tree(tree_shape(contraction.split_size, work.n_leaves), area.astype(np.float64), b"rows")
    coder = RowCoder(tree, allowed, coefficients)
    row_of_site, factor = work.code(coder, sites.samples, progress)
    coded = coder.finish()
    rows = _assemble(coded, row_of_site, factor, sites, work, tree, area, snapshot)
    return BakedRows(rows, _measure(rows, work, snapshot, where), int(work.touched.sum()))


@dataclass(frozen=True, eq=False)
class _Ends:
    receivers: Ends
    casters: Ends  #: of the leaves that are edited


class _Work:
    """The field at the samples; leaves are those on sides of surfaces that the edit's casters touch."""

    def __init__(
        self,
        field: EditField,
        view: ViewSamples,
        gather: GatherSamples,
        radiance: F32 | None,
        resolved: Sequence[F32],
    ) -> None:
        self.field, self.view, self.gather, self.resolved = field, view, gather, tuple(resolved)
        casters = field.casters(gather.points)
        self.leaves = _whole_slots(gather, np.asarray(np.any(casters.masks > 0, axis=0), np.bool_))
        self.leaf_numbers = np.flatnonzero(self.leaves)
        self.casters = casters.take(self.leaf_numbers)
        self.receivers = field.receivers(view.points)
        self.touched: Bool = np.asarray(np.any(self.receivers.masks > 0, axis=0), np.bool_)
        b = np.ones((gather.n, 3), np.float32) if radiance is None else radiance
        self.b = np.ascontiguousarray(b[self.leaf_numbers])
        self.kinds = KINDS if field.has_offset else KINDS[:2]
        self.varies = field.uses_receiver or bool(self.resolved) or field.has_offset
        self.is_product = not self.varies and field.n_rows == 1

    @property
    def n_leaves(self) -> int:
        return len(self.leaf_numbers)

    def on_touched_sides(self) -> Bool:
        """View samples on those sides of surfaces on which any sample is touched."""
        points = self.view.points
        side = 2 * points.instance.astype(np.int64) + points.side
        return np.isin(side, side[self.touched])

    # Rows

    def _pairs(self, samples: I64, leaves: I64) -> F32:
        """Values of all pairs, (n_samples, n_leaves, k)."""
        n, m = len(samples), len(leaves)
        receivers = self.receivers.take(np.repeat(samples, m))
        casters = self.casters.take(np.tile(leaves, n))
        b = np.tile(self.b[leaves], (n, 1))[None]
        resolved = [np.repeat(scale[samples], m, axis=0) for scale in self.resolved]
        found = self.field.evaluate(b, receivers, casters, resolved)
        parts = [found.scale[0] - np.float32(1), found.emission]
        if len(self.kinds) == 3:
            offset = np.zeros((n * m, 3), np.float32)
            if found.offset_paint is not None:
                offset += found.offset_paint[0]
            if found.offset_diffuse is not None:
                offset += np.repeat(self.view.points.albedo[samples], m, axis=0) * found.offset_diffuse[0]
            parts.append(offset)
        return np.concatenate(parts, axis=1).reshape(n, m, -1)

    def _whole_row(self) -> F32:
        """The row of a receiver with mask 1, (1, n_leaves, k), where rows are products of masks and this."""
        one = self.receivers.take(np.flatnonzero(self.touched)[:1])
        one = one._replace(masks=np.ones_like(one.masks))
        found = self.field.evaluate(self.b[None], one, self.casters)
        return np.concatenate([found.scale[0] - np.float32(1), found.emission], axis=1)[None]

    def _like(self, samples: I64) -> tuple[I64, I64]:
        """One sample for each set of receivers that have the same row, and which set each sample is in."""
        if self.varies:
            return samples, np.arange(len(samples))
        _, first, of = np.unique(self.receivers.masks[:, samples], axis=1, return_index=True, return_inverse=True)
        return samples[first], of.reshape(-1)

    # What is allowed, and what is judged by it

    def test_leaves(self) -> I64:
        """Some leaves by chance, and those on which rows differ most."""
        tests = np.random.default_rng(0).permutation(self.n_leaves)[:_TEST_LEAVES]
        if not self.varies:
            return tests
        touched = np.flatnonzero(self.touched)
        samples = touched[np.random.default_rng(3).permutation(len(touched))[:_TEST_SAMPLES]]
        every = np.arange(self.n_leaves)
        step = max(1, _PAIRS_AT_ONCE // self.n_leaves)
        low, high = np.full((self.n_leaves, 3), np.inf), np.full((self.n_leaves, 3), -np.inf)
        for begin in range(0, len(samples), step):
            values = self._pairs(samples[begin : begin + step], every)[:, :, :3]
            low, high = np.minimum(low, values.min(axis=0)), np.maximum(high, values.max(axis=0))
        spread = np.argsort(-(high - low).max(axis=1), kind="stable")[:_TEST_LEAVES]
        return np.unique(np.concatenate([tests, spread]))

    def tolerance(self, tests: I64, epsilon: float) -> np.ndarray:
        """Allowed difference of each column: of S as it is, of E and O relative to their largest value."""
        if self.is_product:
            peak = np.abs(self._whole_row()).max(axis=(0, 1))
        else:
            some = np.flatnonzero(self.touched)
            some = some[np.random.default_rng(1).permutation(len(some))[:256]]
            peak = np.abs(self._pairs(some, tests)).max(axis=(0, 1))
        result = np.full(len(peak), epsilon, np.float64)
        for k in range(1, len(self.kinds)):
            result[3 * k : 3 * k + 3] *= max(float(peak[3 * k : 3 * k + 3].max()), 1e-30)
        return result

    def judged(self, tests: I64, allowed: np.ndarray, progress: Progress) -> F32:
        """Columns by which view samples are told apart, in units of what is allowed: (n_view, t)."""
        if self.is_product:
            peak = np.abs(self._whole_row()).max(axis=(0, 1)) / allowed
            return (self.receivers.masks[0] * np.float32(peak.max()))[:, None]
        touched = np.flatnonzero(self.touched)
        like, of = self._like(touched)
        values = np.zeros((self.view.n, len(tests) * len(allowed)), np.float32)
        step = max(1, _PAIRS_AT_ONCE // len(tests))
        found = np.empty((len(like), values.shape[1]), np.float32)
        for begin in range(0, len(like), step):
            part = self._pairs(like[begin : begin + step], tests) / allowed.astype(np.float32)
            found[begin : begin + step] = part.reshape(len(part), -1)
            progress("judge rows", begin / len(like))
        values[touched] = found[of]
        return values

    def code(self, coder: RowCoder, sites: I64, progress: Progress) -> tuple[I64, F32]:
        """Code the rows of the sites: row of each (-1: identity), and its factor."""
        touched = self.touched[sites]
        row, factor = np.full(len(sites), -1, np.int64), np.ones(len(sites), np.float32)
        if self.is_product:
            coder.add(self._whole_row())
            row[touched] = 0
            return row, np.where(touched, self.receivers.masks[0, sites], 1).astype(np.float32)
        like, of = self._like(sites[touched])
        row[touched] = of
        every = np.arange(self.n_leaves)
        at_once = max(
            1, min(_BYTES_AT_ONCE // (4 * self.n_leaves * 3 * len(self.kinds)), _PAIRS_AT_ONCE // self.n_leaves)
        )
        for begin in range(0, len(like), at_once):
            progress("bake rows", begin / len(like))
            coder.add(self._pairs(like[begin : begin + at_once], every))
        progress("bake rows", 1.0)
        return row, factor


def _whole_slots(gather: GatherSamples, edited: Bool) -> Bool:
    """All leaves of the sides of surfaces on which any leaf is edited."""
    begin = gather.locator.table.slot_begin.astype(np.int64)
    any_edited = np.maximum.reduceat(edited.astype(np.uint8), begin[:-1]) > 0
    return np.repeat(any_edited, np.diff(begin))


class _Sides(NamedTuple):
    instance: I64
    side: I64
    leaves: I32  #: (n, 2)


def _sides(gather: GatherSamples, snapshot: SceneSnapshot, leaves: Bool) -> _Sides:
    """Sides of surfaces that have leaves among those that are kept, and which."""
    table = gather.locator.table
    geometry = snapshot.geometry
    area = np.zeros(snapshot.n_instances, np.float64)
    instance_areas(geometry.points, geometry.mesh_begin, geometry.instance_mesh, geometry.instance_to_world, area)
    before = np.concatenate([[0], np.cumsum(leaves)])
    begin = before[table.slot_begin]
    side = np.flatnonzero((np.diff(begin) > 0)[table.slot] & np.repeat(area > 0, 2))
    slot = table.slot[side]
    return _Sides(side // 2, side % 2, np.stack([begin[slot], begin[slot + 1]], axis=1).astype(np.int32))


def _assemble(
    coded: CodedRows,
    row_of_site: I64,
    factor: F32,
    sites: ChosenSites,
    work: _Work,
    tree: ClusterTree,
    area: F32,
    snapshot: SceneSnapshot,
) -> SampledRows:
    kept, steps, indices, numbers = _kept_columns(coded)
    site_row, row_pattern, row_step = _distinct_rows(coded, row_of_site, factor, steps)
    # A side on which no row varies is one leaf: most selections are of whole objects.
    sides = _sides(work.gather, snapshot, work.leaves)
    needed = needed_nodes(tree, indices)
    begins = cell_begins(tree, needed)
    keep = np.ones(tree.n_leaves, np.bool_)
    for first, last in np.unique(sides.leaves, axis=0):
        if not begins[first + 1 : last].any():
            keep[first + 1 : last] = False
    smaller = contract(tree.lo, tree.mid, tree.hi, keep)
    inner = indices > 0
    indices = indices.copy()
    indices[inner] = 1 + smaller.node[indices[inner] - 1]
    new_begin = np.concatenate([[0], np.cumsum(keep)])

    leaf_points = take_points(work.gather.points, work.leaf_numbers[smaller.first])
    site_points = take_points(work.view.points, sites.samples)
    used = np.unique(np.concatenate([sides.instance, site_points.instance, leaf_points.instance]))
    row_of_instance = np.zeros(snapshot.n_instances, np.int32)
    row_of_instance[used] = np.arange(len(used))
    surfaces = tuple(masked_surface(snapshot, int(snapshot.geometry.instance_surface[i])) for i in used)
    at_leaf, at_site = object_positions(snapshot, leaf_points), object_positions(snapshot, site_points)
    bounds = _bounds(
        len(used), [(row_of_instance[leaf_points.instance], at_leaf), (row_of_instance[site_points.instance], at_site)]
    )
    places = make_places(site_points, at_site, row_of_instance[site_points.instance], bounds)
    order = np.lexsort((site_row, places.face, places.side, places.surface))
    # Rows are numbered as the sites come, which makes small differences of large numbers.
    site_row, row_pattern, row_step = _renumbered(site_row[order], row_pattern, row_step)
    linear = snapshot.geometry.instance_to_world[:, :, :3].astype(np.float64)
    scale = np.cbrt(np.abs(np.linalg.det(linear)))[site_points.instance]
    error = coded.error.max(axis=0, initial=0.0)
    bound = {kind: float(error[3 * k : 3 * k + 3].max()) for k, kind in enumerate(work.kinds)}
    return SampledRows(
        surfaces=surfaces,
        bounds=bounds,
        leaves=make_places(leaf_points, at_leaf, row_of_instance[leaf_points.instance], bounds),
        leaf_area=np.add.reduceat(area.astype(np.float64), smaller.first).astype(np.float32),
        split_size=smaller.split_size,
        side_surface=row_of_instance[sides.instance],
        side=sides.side.astype(np.uint8),
        side_leaves=new_begin[sides.leaves].astype(np.int32),
        sites=places.take(order),
        site_reach=(sites.reach / np.where(scale > 0, scale, 1))[order].astype(np.float16).astype(np.float32),
        site_row=site_row,
        row_pattern=row_pattern,
        row_step=row_step,
        indptr=coded.indptr,
        indices=indices,
        numbers=numbers,
        kinds=tuple(kind for k, kind in enumerate(work.kinds) if kept[k]),
        epsilon_scale=bound["delta"],
        epsilon_emission=bound.get("emission", 0.0),
        epsilon_offset=bound.get("offset", 0.0),
    )


def _kept_columns(coded: CodedRows) -> tuple[list[bool], F32, I32, np.ndarray]:
    """Leave out kinds that are 0 in every row."""
    n_kinds = coded.row_step.shape[1] // 3
    used = (coded.row_step != 0).any(axis=0).reshape(n_kinds, 3).any(axis=1)
    columns = np.repeat(used, 3)
    numbers = np.ascontiguousarray(coded.numbers[:, columns])
    return used.tolist(), np.ascontiguousarray(coded.row_step[:, columns]), coded.indices, numbers


def _distinct_rows(coded: CodedRows, row_of_site: I64, factor: F32, steps: F32) -> tuple[I32, I32, F32]:
    """Rows without repetition: row of each site, and the rows' patterns and steps."""
    here = row_of_site >= 0
    pattern = np.full(len(row_of_site), -1, np.int32)
    pattern[here] = coded.row_pattern[row_of_site[here]]
    here = pattern >= 0
    of_site = steps[row_of_site[here]] * factor[here, None]
    table = np.concatenate([pattern[here, None].astype(np.float64), of_site.astype(np.float64)], axis=1)
    rows, of = np.unique(table, axis=0, return_inverse=True)
    site_row = np.full(len(row_of_site), -1, np.int32)
    site_row[here] = of.reshape(-1)
    return site_row, rows[:, 0].astype(np.int32), np.ascontiguousarray(rows[:, 1:], dtype=np.float32)


def _renumbered(site_row: I32, row_pattern: I32, row_step: F32) -> tuple[I32, I32, F32]:
    used, first = np.unique(site_row[site_row >= 0], return_index=True)
    order = used[np.argsort(first)]
    number = np.full(len(row_pattern) + 1, -1, np.int32)
    number[order] = np.arange(len(order))
    return number[site_row], row_pattern[order], row_step[order]


def _bounds(n: int, parts: list[tuple[I32, F32]]) -> F32:
    bounds = np.zeros((n, 2, 3), np.float32)
    bounds[:, 0], bounds[:, 1] = np.inf, -np.inf
    for surface, position in parts:
        np.minimum.at(bounds[:, 0], surface, position)
        np.maximum.at(bounds[:, 1], surface, position)
    # A surface that is named only because it shares leaves with others has no place of its own.
    bounds[~np.isfinite(bounds).all(axis=(1, 2))] = 0
    return bounds


def _measure(rows: SampledRows, work: _Work, snapshot: SceneSnapshot, where: str) -> float:
    """Largest difference of S at random pairs."""
    rng = np.random.default_rng(2)
    touched = np.flatnonzero(work.touched)
    samples = touched[np.sort(rng.permutation(len(touched))[:_MEASURED_SAMPLES])]
    leaves = np.sort(rng.permutation(work.n_leaves)[:_MEASURED_LEAVES])
    bound = bind_rows(rows, snapshot, where)
    mixture = bound.locate_receivers(take_points(work.view.points, samples))
    leaf = bound.locate_casters(take_points(work.gather.points, work.leaf_numbers[leaves]))
    largest, step = 0.0, max(1, _PAIRS_AT_ONCE // len(leaves))
    for begin in range(0, len(samples), step):
        some = slice(begin, begin + step)
        n = len(samples[some])
        wide = Mixture._make(np.repeat(column[some], len(leaves), axis=0) for column in mixture)
        decoded = bound.evaluate(wide, np.tile(leaf, n)).scale - np.float32(1)
        exact = work._pairs(samples[some], leaves)[:, :, :3].reshape(-1, 3)
        largest = max(largest, float(np.abs(decoded - exact).max()))
    return largest
