"""Sampled rows on a scene: which rows hold at a receiver, which sample a caster is, and what a pair gets."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from icheat_usd.edits.encodings.places import find_places, instance_scale, instances_of
from icheat_usd.edits.encodings.sampled import SampledRows, cell_begins, contract, needed_nodes, tree_shape
from icheat_usd.edits.operations import PairCoefficients
from icheat_usd.kernels import row_coding, row_sites
from icheat_usd.samples import instance_areas
from icheat_usd.samples.locate import Locator, build_locator
from icheat_usd.samples.tree import ClusterTree
from icheat_usd.scene import F32, F64, I32, I64, Finding, SceneSnapshot, SurfacePoints

#: How far apart a turn of the normal by one radian puts two sites, in mean reaches: across an edge of a mesh is far.
NORMAL_REACH = 0.7

#: Decoded rows are kept if they fit; else every pair walks its rows' coefficients, some ten times slower.
TABLE_BYTES = 256 << 20


class Mixture(NamedTuple):
    """Rows that hold at n receivers."""

    rows: I32  #: (n, 4) -1: the identity
    weights: F32  #: (n, 4) they sum to the confidence
    confidence: F32  #: (n,) 1 amid samples, 0 far from any


class _Search(NamedTuple):
    """k-d tree over the sites of each side; columns in its order."""

    key: F64  #: (n, 6) position, and normal times its weight
    axis: I64
    begin: I64  #: (n_groups + 1,)
    normal: F32
    reach: F64
    row: I32
    site: I64  #: row of `SampledRows.sites`
    group: I64  #: (2 n_instances,) of each side, -1 where it has no sites
    turn: F64  #: (n_groups,) weight of the normal, metres


class _Coefficients(NamedTuple):
    """Rows on the tree whose leaves are the cells on which all rows are constant."""

    mid: I32
    left: I32
    right: I32
    weight: F64
    node_weight: F64
    indptr: I64
    indices: I32
    numbers: np.ndarray
    steps: F32
    pattern: I32


@dataclass(frozen=True, eq=False)
class BoundRows:
    """`SampledRows` on one scene; make one with `bind_rows`."""

    rows: SampledRows
    findings: tuple[Finding, ...]
    cell: I32  #: (n_leaves,) cell of each leaf
    coefficients: _Coefficients
    search: _Search
    locator: Locator
    on_side: I32  #: (2 n_instances,) group of leaves of each side, -1 where it has none

    @property
    def has_offset(self) -> bool:
        return "offset" in self.rows.kinds

    @property
    def n_cells(self) -> int:
        return len(self.coefficients.weight)

    @property
    def n_distinct(self) -> int:
        return 1 + int(self.rows.distinct_columns.max(initial=-1))

    @cached_property
    def table(self) -> F32 | None:
        """(n_rows, n_cells, n_columns) decoded, if it is small enough."""
        c, shape = self.coefficients, (len(self.rows.row_pattern), self.n_cells, self.rows.n_columns)
        if 4 * np.prod(shape, dtype=np.int64) > TABLE_BYTES:
            return None
        table = np.empty(shape, np.float32)
        row_coding.decode_rows(
            c.left, c.right, c.weight, c.node_weight, c.indptr, c.indices, c.numbers, c.steps, c.pattern, table
        )
        return table

    def decode(self, rows: I64) -> F32:
        """Some rows, (n, n_distinct, n_cells) float32; see `SampledRows.distinct_columns`."""
        c = self.coefficients
        first = np.unique(self.rows.distinct_columns, return_index=True)[1]
        out = np.empty((len(rows), len(first), self.n_cells), np.float32)
        steps = np.ascontiguousarray(c.steps[rows][:, first])
        row_coding.decode_columns(
            c.left, c.right, *self._shares, c.indptr, c.indices, c.numbers, first, steps, c.pattern[rows], out
        )
        return out

    @cached_property
    def _shares(self) -> tuple[F64, F64]:
        """Share of each node's weight that its children have."""
        c = self.coefficients
        a, b = (
            np.where(child < 0, c.weight[np.maximum(-1 - child, 0)], c.node_weight[np.maximum(child, 0)])
            if len(child)
            else np.zeros(0)
            for child in (c.left, c.right)
        )
        return a / (a + b), b / (a + b)

    def locate_receivers(self, points: SurfacePoints) -> Mixture:
        """Rows around each point, by place and normal on the same side of the same surface.

        Weights change continuously with the place, and fade to nothing (the
        identity) away from samples.
        """
        return self._mixtures(points)[0]

    def nearest_site(self, points: SurfacePoints) -> tuple[I64, F64]:
        """Nearest site of each point, -1 where its side has none, and its distance in metres."""
        nearest = self._mixtures(points)[1]
        found = nearest[:, 0].astype(np.int64)
        if not len(self.search.site):
            return found, nearest[:, 1]
        return np.where(found >= 0, self.search.site[np.maximum(found, 0)], -1), nearest[:, 1]

    def _mixtures(self, points: SurfacePoints) -> tuple[Mixture, F64]:
        n = len(points.instance)
        search = self.search
        hit = points.instance >= 0
        side = 2 * np.where(hit, points.instance, 0).astype(np.int64) + points.side
        group = np.where(hit, search.group[side], -1) if len(search.group) else np.full(n, -1, np.int64)
        rows = np.empty((n, row_sites.NEIGHBOURS), np.int32)
        weights = np.empty((n, row_sites.NEIGHBOURS), np.float32)
        confidence, nearest = np.empty(n, np.float32), np.empty((n, 2), np.float64)
        row_sites.mixtures(
            search.key,
            search.axis,
            search.begin,
            search.normal,
            search.reach,
            search.row,
            search.turn,
            group,
            np.require(points.position, np.float32, ["C", "W"]),
            np.require(points.shading_normal, np.float32, ["C", "W"]),
            rows,
            weights,
            confidence,
            nearest,
        )
        return Mixture(rows, weights, confidence), nearest

    def locate_casters(self, points: SurfacePoints) -> I32:
        """Leaf of each point: the nearest on the same side of the same surface, -1 where that has none."""
        hit = points.instance >= 0
        side = 2 * np.where(hit, points.instance, 0).astype(np.int64) + points.side
        found = hit & (self.on_side[side] >= 0) if len(self.on_side) else np.zeros(len(side), np.bool_)
        instance = np.where(found, points.instance, -1).astype(np.int32)
        return self.locator.locate(points.position, points.normal, instance, points.side)

    def evaluate(self, mixture: Mixture, leaves: I32) -> PairCoefficients:
        """Coefficients of n pairs; a mixture or a leaf may be one that all pairs share."""
        cell = np.where(leaves >= 0, self.cell[np.maximum(leaves, 0)], -1).astype(np.int32)
        n = max(len(mixture.rows), len(cell)) if len(mixture.rows) and len(cell) else 0
        out = np.zeros((n, self.rows.n_columns), np.float32)
        rows, weights = np.ascontiguousarray(mixture.rows), np.ascontiguousarray(mixture.weights)
        if n and self.rows.n_columns:
            if self.table is not None:
                row_coding.mix_decoded(self.table, rows, weights, cell, out)
            else:
                row_coding.mix_coded(*self.coefficients, rows, weights, cell, out)
        column = {kind: out[:, 3 * k : 3 * k + 3] for k, kind in enumerate(self.rows.kinds)}
        delta = column.get("delta", np.zeros((1, 3), np.float32))
        return PairCoefficients(np.float32(1) + delta, column.get("emission"), column.get("offset"))


#: What is the same on every scene: the frames of a sequence share it.
_CONTRACTED: WeakKeyDictionary[SampledRows, tuple[_Coefficients, I32]] = WeakKeyDictionary()


def bind_rows(rows: SampledRows, snapshot: SceneSnapshot, where: str) -> BoundRows:
    """Find the samples of `rows` on a scene, at its time.

    Surfaces that are gone keep their light as it is; places on meshes whose
    topology has changed go to the nearest surface. Both are reported in
    `findings`.
    """
    leaves = find_places(rows.leaves, rows.surfaces, rows.bounds, snapshot, where)
    sites = find_places(rows.sites, rows.surfaces, rows.bounds, snapshot, where)
    if rows not in _CONTRACTED:
        _CONTRACTED[rows] = _contracted(rows)
    coefficients, cell = _CONTRACTED[rows]
    locator, on_side = _leaf_locator(rows, leaves.points, snapshot)
    return BoundRows(
        rows,
        tuple(dict.fromkeys(leaves.findings + sites.findings)),
        cell,
        coefficients,
        _search(rows, sites.points, snapshot),
        locator,
        on_side,
    )


def _contracted(rows: SampledRows) -> tuple[_Coefficients, I32]:
    tree = rows.tree
    needed = needed_nodes(tree, rows.indices)
    smaller = contract(tree.lo, tree.mid, tree.hi, cell_begins(tree, needed))
    shape = tree_shape(smaller.split_size, len(smaller.first))
    node = np.arange(len(shape.mid), dtype=np.int32)
    # Sums as they are in the large tree: decoding gives the same bits on either.
    children = np.concatenate([tree.left[needed], tree.right[needed]]) if needed.any() else _root(tree)
    inside = np.maximum(children, 0)
    is_leaf = children < 0
    undivided = children[is_leaf | ~needed[inside]] if len(needed) else children
    inside, is_leaf, leaf = np.maximum(undivided, 0), undivided < 0, np.maximum(-1 - undivided, 0)
    weight = np.empty(len(smaller.first), np.float64)
    if len(needed):
        total = np.where(is_leaf, tree.weight[leaf], tree.node_weight[inside])
        weight[smaller.leaf[np.where(is_leaf, leaf, tree.lo[inside])]] = total
    else:
        weight[0] = tree.weight[0]
    indices = rows.indices.copy()
    inner = indices > 0
    indices[inner] = 1 + smaller.node[indices[inner] - 1]
    coefficients = _Coefficients(
        shape.mid,
        np.where(shape.mid - shape.lo == 1, -1 - shape.lo, node + 1).astype(np.int32),
        np.where(shape.hi - shape.mid == 1, -1 - shape.mid, node + shape.mid - shape.lo).astype(np.int32),
        weight,
        np.ascontiguousarray(tree.node_weight[needed]),
        rows.indptr,
        indices,
        rows.numbers,
        rows.row_step,
        rows.row_pattern,
    )
    return coefficients, smaller.leaf


def _root(tree: ClusterTree) -> I32:
    return np.array([0 if len(tree.left) else -1], np.int32)


def _leaf_locator(rows: SampledRows, points: SurfacePoints, snapshot: SceneSnapshot) -> tuple[Locator, I32]:
    ranges, group_of_side = np.unique(rows.side_leaves, axis=0, return_inverse=True)
    instance = instances_of(rows.surfaces, snapshot)[rows.side_surface]
    on_side = np.full(2 * snapshot.n_instances, -1, np.int32)
    here = instance >= 0
    side = 2 * instance[here].astype(np.int64) + rows.side[here]
    on_side[side] = group_of_side.reshape(-1)[here]
    area = instance_areas(snapshot)
    group_area = np.bincount(on_side[side], area[instance[here]], len(ranges)).astype(np.float64)
    shape = tree_shape(rows.split_size, rows.n_leaves)
    # Of the nodes that begin with a leaf, one ends with another at most.
    nodes = np.full(len(ranges), -1, np.int32)
    for one, (first, last) in enumerate(ranges.tolist()):
        found = np.flatnonzero((shape.lo == first) & (shape.hi == last))
        nodes[one] = found[0] if len(found) else -1
    begin = np.concatenate([ranges[:, 0], [rows.n_leaves]]).astype(np.int64)
    shape = replace(shape, group_node=nodes)
    depth = rows.tree.depth
    slot = np.maximum(on_side, 0)
    return build_locator(points.position, points.normal, shape, depth, slot, begin, group_area), on_side


def _search(rows: SampledRows, points: SurfacePoints, snapshot: SceneSnapshot) -> _Search:
    """Sites sorted by side and into trees; those on surfaces that are gone are left out."""
    here = np.flatnonzero(points.instance >= 0)
    side = 2 * points.instance[here].astype(np.int64) + points.side[here]
    order = np.argsort(side, kind="stable")
    here, side = here[order], side[order]
    sides, begin = np.unique(side, return_index=True)
    begin = np.concatenate([begin, [len(here)]]).astype(np.int64)
    group = np.full(2 * snapshot.n_instances, -1, np.int64)
    group[sides] = np.arange(len(sides))
    scale = instance_scale(snapshot)
    reach = rows.site_reach[here].astype(np.float64) * scale[points.instance[here]]
    mean = np.add.reduceat(reach, begin[:-1]) / np.diff(begin) if len(here) else np.zeros(0)
    turn = NORMAL_REACH * mean
    of_site = np.repeat(np.arange(len(sides)), np.diff(begin))
    normal = points.shading_normal[here]
    key = np.concatenate([points.position[here], normal * turn[of_site, None]], axis=1).astype(np.float64)
    number, axis = np.arange(len(here)), np.zeros(len(here), np.int64)
    row_sites.build_search(key, begin, number, axis)
    return _Search(
        key,
        axis,
        begin,
        np.ascontiguousarray(normal[number]),
        np.ascontiguousarray(reach[number]),
        np.ascontiguousarray(rows.site_row[here][number]),
        here[number],
        group,
        turn,
    )
