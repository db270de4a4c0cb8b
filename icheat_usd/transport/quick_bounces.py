"""Bounces between gather cells at interactive rates: exact rows correct what clusters of cells guess."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from icheat_usd.kernels import quick_bounces as kernels
from icheat_usd.kernels.workers import take_back
from icheat_usd.samples import ClusterTree
from icheat_usd.scene import F32, I32, I64
from icheat_usd.steps import Steps, all_steps
from icheat_usd.transport.bounces import Bounces
from icheat_usd.transport.sparse import SparseRows, concatenate_rows
from icheat_usd.transport.thinning import thin_rows

# Of a row that light on the move goes by: its time goes by the entries.
_ENTRIES = 96
# Entries of all rows that are thinned at a time, and bounces of all cells: some hundredths of a second.
_ENTRIES_AT_ONCE, _BOUNCES_AT_ONCE = 1 << 22, 4

_CLUSTERS = 1024  # at most: their matrices take 12 MB
_FEW_CLUSTERS = 256  # whose bounces add up in some hundredths of a second
_CELLS_PER_CLUSTER = 32  # where there are more clusters than that
_FIRST_STEPS = 3  # of light from nothing: what is caught between white surfaces is most of a pixel's, and comes last
_ALL = (0, 1)  # every cell

_WHITE, _WHITE_COUNTS = 0.9, 8  # cells of a larger albedo stand for so many

# With so many bounces, an equilibrium stands for their sum, under albedos of which it has no more light; at fewer the
# sum is made as it is.
_LASTING = 12

# Of larger albedos clusters send on so much. Light between white surfaces lasts for many bounces, and where clusters
# have cells on both sides of such a surface, what they add for these is wrong and sent on as well.
_SENT_ON = 0.8

#: Bounces of a light that moves are found for one of so many cells at a time.
PARTS = 8

# And then for all cells of the clusters where most is probably still missing, of so many of the cells at most, until
# what is missing of others, in root mean square, is less than such a share of the mean light. What is missing is near
# what moves: looks at another eighth of all cells, and the whole mean of a part for the others, left images of
# veach-ajar 1.1 to 2.5 % off all bounces while a rectangle moved, this .5 to .6.
_MOST, _LEFT = 1 / 16, 0.01

# An error that is left alone must shrink: over the last of so many steps, a whole round, to less than this of itself in
# each.
_TRIED, _LAST_TRIED = 3 * PARTS, PARTS
_SHRINKS = 0.85
_FACTORS = 1.0, 0.5, 0.25, 0.125  # of what clusters send on, until it does; else they send on nothing

# All cells are looked at if the light was out of balance by more than this share of it.
_FAR = 0.1


@dataclass(frozen=True, eq=False)
class QuickBounces:
    """Thinned bounce rows in a word per entry, and the mean rows of clusters of neighbouring cells.

    Light `g` after all bounces balances ``g = d + A R g`` (d direct light, A albedo, R rows); see `lasting_albedo`
    for those that are not all. A step adds what is missing, ``r = d + A R g - g`` with the exact rows, and what
    becomes of `r` in further bounces between clusters: an iteration with a preconditioner [1]_, which gains a factor
    of two to ten per step. Weights are rounded by at most 0.4 % each at 65,536 cells, of either sign, and so is the
    light that they reach.

    .. [1] Saad 2003, Iterative Methods for Sparse Linear Systems, section 9.
    """

    indptr: I64  #: (n_gather + 1,)
    entries: np.ndarray  #: (n_entries,) uint32: column in the last `column_bits`, weight's leading bits in the others
    column_bits: int
    albedo: F32  #: (n_gather, 3); if `lasting`, those of `lasting_albedo`
    mean_albedo: F32  #: (n_clusters, 3)
    begin: I64  #: (n_clusters + 1,) first cell of each cluster
    share: F32  #: (n_gather,) of the cell in its cluster's area
    blocks: NDArray[np.uint16]  #: later bounces, between clusters, per colour; see `kernels.reach_clusters`
    lasting: bool  #: whether there are enough bounces for a balance
    sent_on: float  #: factor of later bounces while light follows changes, less than 1 where errors would grow
    most_sent_on: float  #: what it was when these clusters were made: no rows need more
    scratch: F32  #: (2, n_gather, 4) for `solve` and `follow`, which thus serve one thread at a time
    short: NDArray[np.uint64]  #: (n_gather,) as well, for light that rows reach

    def solve(self, direct: F32, out: F32 | None = None) -> F32:
        """Approximation of `solve_bounces` for one light: (n_gather, 3) to (n_gather, 3)."""
        out = np.empty_like(direct) if out is None else out
        none = np.empty((0, 3), np.float32)
        leaves, _ = self._take_change(none, none, direct)
        if not self.lasting:  # one bounce is what light without any lacks
            self._step(direct, _ALL, 1.0, out)
            return out
        # Nothing grows in so few steps.
        self._add(leaves, None, _ALL, 1.0, none)
        for _ in range(_FIRST_STEPS):
            self._step(direct, _ALL, 1.0, out)
        return out

    def follow(
        self, radiance: F32, before: F32, direct: F32, out: F32 | None = None, part: tuple[int, int] = (0, 1)
    ) -> F32:
        """Light for direct light that has changed from `before`, of which came `radiance`; all (n_gather, 3).

        Parameters
        ----------
        out : (n_gather, 3), optional
            May be `radiance`.
        part : (int, int)
            Rows of every so-manieth cell alone are looked at, from this number on; for the others clusters stand,
            until their number comes.
        """
        out = np.empty_like(direct) if out is None else out
        if not self.lasting:
            return self.solve(direct, out)
        leaves, (changed, all_of_it) = self._take_change(radiance, before, direct)
        if changed > all_of_it:
            return self.solve(direct, out)
        self._add(leaves, None, _ALL, self.sent_on, np.empty((0, 3), np.float32))
        lacking, light, left, of_all = self._step(direct, part, self.sent_on, out).T
        if lacking.sum() > _FAR * light.sum():
            self._step(direct, _ALL, self.sent_on, out)
        elif len(worst := self._worst(left, float(of_all.sum()))):
            rows = self.indptr, self.entries, self.column_bits
            take_back()
            kernels.balance_clusters(worst, self.begin, *rows, direct, self.short, self.albedo, out)
        return out

    def _worst(self, left: F32, light: float) -> I32:
        """Clusters where most is still missing, worst first: squares of it (n_clusters,), beside all cells' light."""
        n, order = len(self.albedo), np.argsort(-left, kind="stable")
        # of the clusters from each one on, which is left to the others if it is little
        still = np.cumsum(left[order[::-1]], dtype=np.float64)[::-1]
        worth_it = still > (_LEFT * light) ** 2 / n
        affordable = np.cumsum(np.diff(self.begin)[order]) <= _MOST * n
        return order[worth_it & affordable].astype(np.int32)

    def _take_change(self, radiance: F32, before: F32, direct: F32) -> tuple[F32, F32]:
        """Mean change of each cluster (3, n_clusters), and the sizes of all change and of all direct light."""
        leaves, sizes = np.empty((3, self.n_clusters), np.float32), np.empty((self.n_clusters, 2), np.float32)
        kernels.take_change(
            self.begin, self.share, radiance, before, direct, self.scratch[0], self.short, leaves, sizes
        )
        return leaves, sizes.sum(axis=0)

    def _step(self, direct: F32, part: tuple[int, int], sent_on: float, out: F32) -> F32:
        """Add what is missing; (n_clusters, 4) `sizes` of `kernels.find_missing`, of before."""
        light, missing = self.scratch
        leaves, sizes = np.empty((3, self.n_clusters), np.float32), np.empty((self.n_clusters, 4), np.float32)
        arriving = np.empty((self.n_clusters, 3), np.float32)
        rows = self.indptr, self.entries, self.column_bits
        take_back()
        kernels.find_missing(
            self.begin,
            self.share,
            *rows,
            direct,
            light,
            self.short,
            self.albedo,
            self.mean_albedo,
            *part,
            missing,
            arriving,
            leaves,
            sizes,
        )
        self._add(leaves, arriving, part, sent_on, out)
        return sizes

    def _add(self, leaves: F32, here: F32 | None, part: tuple[int, int], sent_on: float, out: F32) -> None:
        """Add the later bounces of light that leaves clusters; and what is missing, which arrives as `here` says."""
        later = np.empty((self.n_clusters, 3), np.float32)
        take_back()
        kernels.reach_clusters(self.blocks, leaves * np.float32(sent_on), later)
        light, missing = self.scratch
        here, missing = (later, missing[:0]) if here is None else (here, missing)
        kernels.add_missing(self.begin, self.albedo, missing, here, later, *part, light, self.short, out)

    @property
    def n_clusters(self) -> int:
        """Number of clusters."""
        return len(self.begin) - 1


def build_quick_bounces(
    bounces: Bounces, tree: ClusterTree, n_bounces: int = 16, most_clusters: int | None = None
) -> QuickBounces:
    """Thin the rows, merge them over nodes of the tree and add up all bounces after the first between those.

    Parameters
    ----------
    n_bounces : int
        Diffuse reflections before the last one, as for `solve_bounces`; at least 2.
    """
    rows = thin_rows(bounces.rows, _ENTRIES, np.ones(tree.n_leaves, np.float32))
    lasting = n_bounces >= _LASTING
    albedo = lasting_albedo(rows, bounces.albedo, n_bounces) if lasting else bounces.albedo
    bits = max(1, int(tree.n_leaves - 1).bit_length())
    if most_clusters is None:
        most_clusters = min(_CLUSTERS, max(_FEW_CLUSTERS, tree.n_leaves // _CELLS_PER_CLUSTER))
    begin = _clusters(tree, bounces.albedo, most_clusters)
    size = np.diff(begin)
    cluster = np.repeat(np.arange(len(size), dtype=np.int32), size)
    area = np.add.reduceat(tree.weight, begin[:-1])
    share = (tree.weight / area[cluster]).astype(np.float32)
    factors = np.zeros((len(size), len(size)), np.float32)
    kernels.merge_rows(begin, share, cluster, rows.indptr, rows.indices, rows.weights, factors)
    mean_albedo = _cluster_means(albedo, share, begin)
    sent_on = np.minimum(mean_albedo, np.float32(_SENT_ON)) if lasting else mean_albedo
    matrices = [_all_bounces(factors, channel, n_bounces - 2) for channel in sent_on.T]
    quick = QuickBounces(
        rows.indptr,
        _short_entries(rows, bits),
        bits,
        albedo,
        mean_albedo,
        begin,
        share,
        _in_blocks(matrices),
        lasting,
        1.0,
        1.0,
        np.zeros((2, tree.n_leaves, 4), np.float32),
        np.zeros(tree.n_leaves, np.uint64),
    )
    if not lasting:
        return quick
    steady = all_steps(_steady(quick))
    return replace(steady, most_sent_on=steady.sent_on)


def suit_to_light(quick: QuickBounces, bounces: Bounces, n_bounces: int, importance: F32) -> Steps[QuickBounces]:
    """The same with rows that are thinned for light that is like some other; in steps of some hundredths of a second.

    What is bright there keeps its entries, so that light which is alike has as little noise as rows of all rays
    leave.

    Parameters
    ----------
    bounces : Bounces
        Of the same cells; their rows may have more rays than those that `quick` was made from.
    n_bounces : int
        As for `build_quick_bounces`.
    importance : (n_gather,) float32
        See `thin_rows`.
    """
    parts, first = [], 0
    while first < bounces.rows.n_rows:
        end = bounces.rows.indptr[first] + _ENTRIES_AT_ONCE
        last = max(first + 1, int(np.searchsorted(bounces.rows.indptr, end, side="right")) - 1)
        parts.append(thin_rows(bounces.rows.rows(first, last), _ENTRIES, importance, first))
        first = last
        yield
    rows = concatenate_rows(parts, bounces.rows.n_columns)
    suited = replace(quick, indptr=rows.indptr, entries=_short_entries(rows, quick.column_bits))
    if not quick.lasting:
        return suited
    albedo = yield from _lasting_albedo(rows, bounces.albedo, n_bounces)
    mean_albedo = _cluster_means(albedo, quick.share, quick.begin)
    return (yield from _steady(replace(suited, albedo=albedo, mean_albedo=mean_albedo)))


def _short_entries(rows: SparseRows, column_bits: int) -> NDArray[np.uint32]:
    entries = np.empty(rows.n_entries, np.uint32)
    kernels.shorten(rows.indices, rows.weights, column_bits, entries)
    return entries


def _cluster_means(values: F32, share: F32, begin: I64) -> F32:
    means: F32 = np.add.reduceat(values * share[:, None], begin[:-1], axis=0, dtype=np.float32)
    return means


def _steady(quick: QuickBounces) -> Steps[QuickBounces]:
    """The same with clusters that send on less, as far as errors would else grow from frame to frame; in steps."""
    for factor in _FACTORS:
        if factor <= quick.most_sent_on:
            tried = replace(quick, sent_on=factor)
            growth = yield from _growth(tried)
            if growth < _SHRINKS:
                return tried
    return replace(quick, sent_on=0.0)


def _growth(quick: QuickBounces) -> Steps[float]:
    """Factor of an error in one step, once what shrinks faster is gone: of light where there should be none."""
    n = len(quick.albedo)
    dark, light = np.zeros((n, 3), np.float32), np.random.default_rng(0).standard_normal((n, 3), np.float32)
    sizes = np.empty(_TRIED)
    for step in range(_TRIED):
        quick.follow(light, dark, dark, light, (step % PARTS, PARTS))
        sizes[step] = np.abs(light).sum()
        if step % PARTS == PARTS - 1:
            yield
    before, after = sizes[-1 - _LAST_TRIED], sizes[-1]
    return float((after / before) ** (1 / _LAST_TRIED)) if before > 0 else 0.0


def lasting_albedo(rows: SparseRows, albedo: F32, n_bounces: int) -> F32:
    """Albedo whose balance is the light of so many bounces, where all cells send as much at first.

    With v that light, of n bounces, ``v = 1 + A R v'`` and v' that of one less; so ``v = 1 + A' R v`` where
    ``A' = A (R v') / (R v)``. Light that soon finds its way out keeps its albedo, and where it lasts, as between white
    surfaces, each bounce loses a little. Other light than v has no more of it for ever either: ``A' R v <= (1 - 1 / max
    v) v``, by which no error is kept (the bound of Collatz and Wielandt; Horn and Johnson 2013, Matrix Analysis,
    section 8.1).
    """
    return all_steps(_lasting_albedo(rows, albedo, n_bounces))


def _lasting_albedo(rows: SparseRows, albedo: F32, n_bounces: int) -> Steps[F32]:
    light, arriving = np.ones_like(albedo), np.zeros_like(albedo)
    for bounce in range(1, n_bounces):
        arriving = rows.matmul(light)
        light = 1 + albedo * arriving
        if bounce % _BOUNCES_AT_ONCE == 0:
            yield
    return np.asarray(albedo * arriving / np.maximum(rows.matmul(light), np.finfo(np.float32).tiny))


def _all_bounces(factors: F32, albedo: F32, n: int) -> F32:
    """Sum of ``(F A)^k F`` for k below `n`: light that arrives after 1 to n bounces, F form factors, A albedo."""
    step = factors * albedo
    total, power = np.zeros_like(factors), np.eye(len(factors), dtype=np.float32)
    reached = 0  # total = sum of step^k for k < reached, power = step^reached
    for bit in bin(n)[2:] if n > 0 else "":
        total, power = total + power @ total, power @ power
        reached *= 2
        if bit == "1":
            total, power = total + power, power @ step
            reached += 1
    return total @ factors


def _in_blocks(matrices: list[F32]) -> NDArray[np.uint16]:
    n = len(matrices[0])
    blocks = np.zeros((-(-n // kernels.LANES), 3, n, kernels.LANES), np.uint16)
    for channel, matrix in enumerate(matrices):
        # The leading half of a float32, rounded to nearest, is a bfloat16.
        short = ((np.ascontiguousarray(matrix).view(np.uint32) + 0x8000) >> 16).astype(np.uint16)
        for block, first in enumerate(range(0, n, kernels.LANES)):
            rows = short[first : first + kernels.LANES]
            blocks[block, channel, :, : len(rows)] = rows.T
    return blocks


def _clusters(tree: ClusterTree, albedo: F32, most: int) -> I64:
    """Clusters of at most so many cells that there are no more than `most`; smaller ones of white cells."""
    # Light is caught between white surfaces for many bounces, and its differences with it.
    count = np.where(albedo.max(axis=1) > _WHITE, _WHITE_COUNTS, 1)
    cells = max(1, tree.n_leaves // most)
    while len(begin := cluster_begins(tree, cells, count)) - 1 > most:
        cells += max(1, cells // 8)
    return begin


def cluster_begins(tree: ClusterTree, most: int, count: I64 | None = None) -> I64:
    """First leaves of the largest nodes with at most `most` leaves, and the number of leaves: (n_clusters + 1,).

    A leaf counts `count` (n_leaves,) times, by default once; a single one is never too much.
    """
    before = np.concatenate([[0], np.cumsum(np.ones(tree.n_leaves, np.int64) if count is None else count)])
    if tree.n_leaves == 1 or before[-1] <= most:
        return np.array([0, tree.n_leaves], np.int64)
    small = before[tree.hi] - before[tree.lo] <= most
    inner = np.flatnonzero(~small)
    children = np.concatenate([tree.left[inner], tree.right[inner]]).astype(np.int64)
    leaf = children < 0
    first = np.where(leaf, -1 - children, tree.lo[np.maximum(children, 0)])
    kept = leaf | small[np.maximum(children, 0)]
    return np.append(np.sort(first[kept]), tree.n_leaves).astype(np.int64)
