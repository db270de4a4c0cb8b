"""Coded rows and the samples that they belong to, put together: repeated rows and constant sides kept once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icheat_usd.edits.encodings.coding import CodedRows
from icheat_usd.edits.encodings.pair_samples import PairSamples
from icheat_usd.edits.encodings.places import make_places, masked_surface, object_positions
from icheat_usd.edits.encodings.sampled import SampledRows, cell_begins, contract, needed_nodes
from icheat_usd.edits.encodings.sites import ChosenSites
from icheat_usd.materials import take_points
from icheat_usd.samples import ClusterTree, GatherSamples, instance_areas
from icheat_usd.scene import F32, I32, I64, Bool, SceneSnapshot


class _Sides(NamedTuple):
    instance: I64
    side: I64
    leaves: I32  #: (n, 2)


def _sides(gather: GatherSamples, snapshot: SceneSnapshot, leaves: Bool) -> _Sides:
    """Sides of surfaces that have leaves among those that are kept, and which."""
    table = gather.locator.table
    area = instance_areas(snapshot)
    before = np.concatenate([[0], np.cumsum(leaves)])
    begin = before[table.slot_begin]
    side = np.flatnonzero((np.diff(begin) > 0)[table.slot] & np.repeat(area > 0, 2))
    slot = table.slot[side]
    return _Sides(side // 2, side % 2, np.stack([begin[slot], begin[slot + 1]], axis=1).astype(np.int32))


def assemble(
    coded: CodedRows,
    row_of_site: I64,
    factor: F32,
    sites: ChosenSites,
    work: PairSamples,
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
        site_reach=_short((sites.reach / np.where(scale > 0, scale, 1))[order].astype(np.float32)),
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


def _short(values: F32) -> F32:
    """Rounded to 11 binary digits, so that they take few bytes in a file."""
    bits = (np.ascontiguousarray(values).view(np.uint32) + np.uint32(1 << 12)) & np.uint32(0xFFFFE000)
    return bits.view(np.float32)


def _bounds(n: int, parts: list[tuple[I32, F32]]) -> F32:
    bounds = np.zeros((n, 2, 3), np.float32)
    bounds[:, 0], bounds[:, 1] = np.inf, -np.inf
    for surface, position in parts:
        np.minimum.at(bounds[:, 0], surface, position)
        np.maximum.at(bounds[:, 1], surface, position)
    # A surface that is named only because it shares leaves with others has no place of its own.
    bounds[~np.isfinite(bounds).all(axis=(1, 2))] = 0
    return bounds
