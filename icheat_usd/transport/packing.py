"""Choosing which coefficients of exact rows a packed transport keeps, by the error that they cause."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from icheat_usd.kernels import packing as kernels
from icheat_usd.kernels.workers import overlapping
from icheat_usd.progress import Progress, silent
from icheat_usd.samples import ClusterTree, GatherSamples
from icheat_usd.samples.wavelets import haar_forward
from icheat_usd.scene import F32, F64, I32, I64
from icheat_usd.transport.build import Lobe, Transport
from icheat_usd.transport.packed import LANES, PackedLobe, PackedRows, PackedTransport, PackingReport
from icheat_usd.transport.sparse import SparseRows

_TILES_AT_ONCE = 8
# That the amount to keep is found on; spread over all. With 16, and 48 lights instead of 96, it jumped by up to 14
# times when other samples were drawn, now by 3.
_TILES_OF_A_TRIAL = 64
_TRIALS = 6
_FIRST_ROOM = 16384  # coefficients of a tile
_FIRST_LEAST = 0.1  # worth of a coefficient to begin the search with, of a tile's tolerated squared error
_CLOSE_ENOUGH = 1.08  # ratio of errors at which the search for the amount ends
_FINEST = 0.7  # of the tolerated error: it is not worth bytes to go below, however few these are
_PRIOR = 0.2  # share of the energy that is taken from a coefficient's surroundings: the training lights are few
_PRIOR_LEVELS = 4  # of ancestors that these surroundings reach up
_ANYWHERE = 0.1  # share of those that is the same everywhere: no place stays dark for ever
_UNSEEN = 0.3  # share of the energy that does not go together with that of other coefficients
_DIM = 0.02  # of its mean on the cells: a light that responds less in the view counts little, and is not measured


class _Weighted(NamedTuple):
    """Rows of one lobe with what their errors count."""

    rows: SparseRows
    row_weight: F64  #: (n_rows,) RMS tint of the pixels that use a row, times the root of their number
    response: F32  #: (n_rows, n_lights) exact


class _Tile(NamedTuple):
    """A packed tile."""

    coefficient: I32
    scale: F32
    worth: F32
    value: NDArray[np.int8]


class _Trial(NamedTuple):
    """What some tiles lose with one least worth of a coefficient."""

    worth: float  #: its logarithm
    off: float  #: error of the lights, of the tolerated one
    n_kept: float  #: coefficients of 64 records, on average
    errors: F64  #: (n_lights,)


class _Room(threading.local):
    """Scratch and results of a few tiles, of each thread that packs."""

    def __init__(self, room: int) -> None:
        self.make(room)

    def make(self, room: int) -> None:
        n = _TILES_AT_ONCE
        self.index, self.value = np.empty((n, room), np.int32), np.empty((n, room, LANES), np.float32)
        self.packed = _Tile(
            np.empty((n, 2 * room), np.int32),
            np.empty((n, 2 * room), np.float32),
            np.empty((n, 2 * room), np.float32),
            np.empty((n, 2 * room, LANES), np.int8),
        )


class _Packer:
    """Packs tiles of rows on one tree; keeps what that needs from one time to the next."""

    def __init__(self, tree: ClusterTree) -> None:
        self.tree = tree
        self._tables = _haar_tables(tree)
        self._room = _Room(min(tree.n_leaves, _FIRST_ROOM))

    def pack(self, part: _Weighted, light: kernels.Light, tiles: I64, least: float) -> list[_Tile]:
        """Pack a few tiles with the coefficients that are worth at least `least`."""
        count, n_kept = np.zeros((2, len(tiles)), np.int64)
        room = self._room
        while True:
            kernels.pack_tiles(
                self._tables,
                _sparse_tiles(part),
                tiles,
                light,
                np.float32(least),
                room.index,
                room.value,
                *room.packed,
                count,
                n_kept,
            )
            if n_kept.max() <= room.index.shape[1]:
                break
            room.make(min(self.tree.n_leaves, 5 * int(n_kept.max()) // 4))
        index, scale, worth, value = room.packed
        return [
            _Tile(index[i, :n].copy(), scale[i, :n].copy(), worth[i, :n].copy(), value[i, :n].copy())
            for i, n in enumerate(count)
        ]


def pack(
    transport: Transport,
    gather: GatherSamples,
    training: F32,
    tolerance: float = 0.015,
    *,
    spare: int = 0,
    progress: Progress = silent,
) -> PackedTransport:
    """Keep of each tile of rows the coefficients that matter to plausible lights, in 8 bits.

    A coefficient's worth is the squared response it adds at the tile's records
    under the mean training light, in the pixels that use them. One least worth
    for all tiles and lobes is found such that lights that the tiles were not chosen by
    are off by `tolerance`: half of the training lights, for tiles packed by the other half. Where few
    coefficients do that, more are kept: rows that are read in no time need not lose as much.

    Parameters
    ----------
    transport
        Exact rows; 64 consecutive ones should be neighbours.
    training : (n_lights, n_gather)
        Radiance that plausible lights make leave the cells.
    tolerance
        Relative RMS error at the records, median over such lights, but for those that the view hardly sees.
    spare
        Coefficients of 64 records, on average, that are kept in any case, until the error is 0.7 of the tolerated one.

    Raises
    ------
    ValueError
        `training` or the rows belong to another gather set, or there is only one training light.

    Notes
    -----
    Bitwise the same for any number of threads.
    """
    return pack_on_tree(transport, gather.tree, training, tolerance, spare=spare, progress=progress)


def pack_on_tree(
    transport: Transport,
    tree: ClusterTree,
    training: F32,
    tolerance: float,
    *,
    spare: int = 0,
    progress: Progress = silent,
) -> PackedTransport:
    """`pack` for whoever has no more of the gather samples than their tree."""
    if training.ndim != 2 or training.shape[1] != tree.n_leaves:
        raise ValueError(f"training radiance of shape {training.shape} for {tree.n_leaves} gather samples")
    if len(training) < 2:
        raise ValueError("packing needs two training lights at least: some choose, others measure")
    if any(lobe.rows.n_columns != tree.n_leaves for lobe in transport.lobes):
        raise ValueError("the rows belong to another gather set than the one given")
    progress("choose coefficients", 0.0)
    weighted = [_weigh(lobe, transport.interpolation, training) for lobe in transport.lobes]
    weighted, light, response = _normalise(tree, training, weighted)
    packer = _Packer(tree)
    least, light_error = _find_least(packer, weighted, light, response, tolerance, spare, progress)
    lobes = []
    n_tiles = sum(_n_tiles(part.rows) for part in weighted if part.rows.n_entries)
    done = 0
    for lobe, part in zip(transport.lobes, weighted, strict=True):
        tiles: list[_Tile] = []
        some = _few_at_once(np.arange(_n_tiles(part.rows) if part.rows.n_entries else 0))
        for packed in overlapping([partial(packer.pack, part, light, few, least) for few in some]):
            tiles += packed
            done += len(packed)
            progress("pack the transport", done / n_tiles)
        lobes.append(PackedLobe(lobe.name, _join(tree, part.rows.n_rows, tiles), lobe.tint))
    report = PackingReport(light_error)
    return PackedTransport(tuple(lobes), transport.row_view, transport.interpolation, transport, report)


def lossless(rows: SparseRows, tree: ClusterTree) -> PackedRows:
    """All coefficients in float32: exact to rounding, and of a size for small scenes only."""
    n_tiles, room = _n_tiles(rows), tree.n_leaves
    weighted = _Weighted(rows, np.ones(rows.n_rows), np.zeros((rows.n_rows, 0), np.float32))
    index, value = np.empty((n_tiles, room), np.int32), np.empty((n_tiles, room, LANES), np.float32)
    counts = np.empty(n_tiles, np.int64)
    kernels.transform_tiles(
        _haar_tables(tree),
        _sparse_tiles(weighted),
        np.arange(n_tiles),
        np.ones(tree.n_leaves, np.float32),
        np.float32(0),
        index,
        value,
        counts,
    )
    used = np.arange(room) >= room - counts[:, None]
    value = value[used]
    one = np.ones(len(value), np.float32)
    worth = np.sqrt(np.sum(np.square(value), axis=1))
    return PackedRows(tree, rows.n_rows, _begin(counts), index[used], one, worth, value)


def _weigh(lobe: Lobe, interpolation: SparseRows | None, training: F32) -> _Weighted:
    square = np.mean(lobe.tint.astype(np.float64) ** 2, axis=1)
    if interpolation is not None:
        pixel = np.repeat(np.arange(interpolation.n_rows), np.diff(interpolation.indptr))
        square = np.bincount(interpolation.indices, interpolation.weights * square[pixel], interpolation.n_columns)
    response = lobe.rows.matmul(np.ascontiguousarray(training.T, np.float32))
    return _Weighted(lobe.rows, np.sqrt(square[: lobe.rows.n_rows]), response)


def _normalise(
    tree: ClusterTree, training: F32, weighted: list[_Weighted]
) -> tuple[list[_Weighted], kernels.Light, F64]:
    """Scale the lights to a response of 1 in the view, dim ones to less; these responses (n_lights,)."""
    squared = sum((_squared_response(part) for part in weighted), np.zeros(len(training)))
    of_white = sum(float(np.sum((part.row_weight * part.rows.row_sums()) ** 2)) for part in weighted)
    mean = training.astype(np.float64) @ tree.weight / tree.weight.sum()
    size = np.maximum(np.sqrt(squared), _DIM * np.abs(mean) * np.sqrt(of_white))
    scale = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0)
    coefficients = haar_forward(tree, np.ascontiguousarray((training * scale[:, None]).T)).astype(np.float32)
    parts = [part._replace(response=np.ascontiguousarray(part.response * scale, np.float32)) for part in weighted]
    return parts, _light(tree, coefficients), np.sqrt(squared) * scale


def _light(tree: ClusterTree, coefficients: F32) -> kernels.Light:
    seen = np.mean(coefficients.astype(np.float64) ** 2, axis=1)
    around = np.empty_like(seen)
    kernels.smooth_energy(tree.left, tree.right, tree.node_weight, _PRIOR_LEVELS, _ANYWHERE, seen, around)
    energy = (1 - _PRIOR) * seen + _PRIOR * around
    return kernels.Light(coefficients, energy.astype(np.float32), (_UNSEEN * energy).astype(np.float32))


def _squared_response(part: _Weighted) -> F64:
    return np.square(part.row_weight) @ np.square(part.response.astype(np.float64))


def _find_least(
    packer: _Packer,
    weighted: list[_Weighted],
    light: kernels.Light,
    response: F64,
    tolerance: float,
    spare: int,
    progress: Progress,
) -> tuple[float, F64]:
    """Least worth of a coefficient, and the errors that it makes of the lights that the view sees.

    Found by trials on some of the tiles, packed by one half of the lights and
    measured with the other, and the other way round. Where all lights are dim, all that the view sees at all count.
    Where the error is `tolerance` with less than `spare` coefficients of 64 records, the search goes on to these or to
    `_FINEST` of `tolerance`, whichever comes first.
    """
    parts = [(part, _some_tiles(_n_tiles(part.rows))) for part in weighted if part.rows.n_entries]
    n_lights = light.coefficients.shape[1]
    shown = response > 0.999
    if not shown.any():
        shown = response > 0
    if not shown.any():
        return float(np.finfo(np.float32).tiny), np.zeros(0)
    halves = [np.arange(side, n_lights, 2) for side in (0, 1)]
    of_half = [_light(packer.tree, np.ascontiguousarray(light.coefficients[:, half])) for half in halves]
    n_tiles = max(_n_tiles(part.rows) for part, _ in parts)

    def tried(least: float) -> _Trial:
        squared, n_kept = np.zeros(n_lights), 0.0
        for part, tiles in parts:
            share = _n_tiles(part.rows) / len(tiles)
            for known, trained, others in zip(of_half, halves, reversed(halves), strict=True):
                error, n = _try(packer, part, light, known, trained, others, tiles, least)
                squared[others] += share * error
                n_kept += share * n / len(halves)
        errors = np.sqrt(squared[shown]) / response[shown]
        return _Trial(float(np.log(least)), PackingReport(errors).error / tolerance, n_kept / n_tiles, errors)

    least = tolerance**2 * _FIRST_LEAST / sum(_n_tiles(part.rows) for part, _ in parts)
    found = [tried(least)]
    best = _search(tried, found, lambda one: one.off, progress)
    if best.n_kept < spare:
        # Either falls as more is kept.
        best = _search(tried, found, lambda one: min(one.off / _FINEST, spare / max(one.n_kept, 1.0)), progress)
    return float(np.exp(best.worth)), best.errors


def _search(
    tried: Callable[[float], _Trial], found: list[_Trial], ratio: Callable[[_Trial], float], progress: Progress
) -> _Trial:
    """The least that is kept with a ratio of about 1, from what was found before and a few trials that join it."""

    def points() -> list[tuple[float, float]]:
        return [(one.worth, float(np.log(max(ratio(one), 1e-12)))) for one in found]

    for _ in range(1, _TRIALS):
        progress("choose coefficients", len(found) / (2 * _TRIALS))  # two searches at most
        if any(abs(off) < np.log(_CLOSE_ENOUGH) for _, off in points()):
            break
        found.append(tried(float(np.exp(_next_trial(points())))))
    fitting = [one for one, (_, off) in zip(found, points(), strict=True) if off < np.log(_CLOSE_ENOUGH)]
    return max(fitting, key=lambda one: one.worth) if fitting else min(found, key=lambda one: one.worth)


def _try(
    packer: _Packer,
    part: _Weighted,
    light: kernels.Light,
    known: kernels.Light,
    trained: I64,
    others: I64,
    tiles: I64,
    least: float,
) -> tuple[F64, int]:
    """Squared errors of the lights `others` in some tiles packed by the lights `trained`, and what these keep."""
    of_half = part._replace(response=np.ascontiguousarray(part.response[:, trained]))
    unknown = np.ascontiguousarray(light.coefficients[:, others])

    def of_few(few: I64) -> tuple[F64, int]:
        packed = _join(packer.tree, len(few) * LANES, packer.pack(of_half, known, few, least))
        exact = _part_of_tiles(part, few)
        product = packed.multiply(unknown)[: len(exact.row_weight)]
        error: F64 = np.square(exact.row_weight) @ np.square((product - exact.response[:, others]).astype(np.float64))
        return error, len(packed.index)

    found = list(overlapping([partial(of_few, few) for few in _few_at_once(tiles)]))
    return sum((error for error, _ in found), np.zeros(len(others))), sum(n for _, n in found)


def _few_at_once(tiles: I64) -> list[I64]:
    return [tiles[first : first + _TILES_AT_ONCE] for first in range(0, len(tiles), _TILES_AT_ONCE)]


def _next_trial(tried: list[tuple[float, float]]) -> float:
    """Where the logarithm of the ratio may be 0: between the nearest points on either side, or beyond those on one."""
    below = max((point for point in tried if point[1] < 0), default=None)
    above = min((point for point in tried if point[1] >= 0 and (below is None or point[0] > below[0])), default=None)
    if below is not None and above is not None:
        share = below[1] / (below[1] - above[1])
        return below[0] + float(np.clip(share, 0.1, 0.9)) * (above[0] - below[0])
    nearest = sorted(tried, key=lambda point: abs(point[1]))
    slope = 0.3
    if len(tried) > 1 and nearest[0][0] != nearest[1][0]:
        slope = float(np.clip((nearest[0][1] - nearest[1][1]) / (nearest[0][0] - nearest[1][0]), 0.15, 1.0))
    return nearest[0][0] - nearest[0][1] / slope


def _some_tiles(n_tiles: int) -> I64:
    return np.unique(np.linspace(0, n_tiles - 1, min(n_tiles, _TILES_OF_A_TRIAL)).astype(np.int64))


def _part_of_tiles(part: _Weighted, tiles: I64) -> _Weighted:
    row = (tiles[:, None] * LANES + np.arange(LANES)).ravel()
    row = row[row < part.rows.n_rows]
    return part._replace(row_weight=part.row_weight[row], response=part.response[row])


def _n_tiles(rows: SparseRows) -> int:
    return -(-rows.n_rows // LANES)


def _begin(counts: I64) -> I64:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def _haar_tables(tree: ClusterTree) -> kernels.HaarTables:
    of_left, of_right = (np.empty(len(tree.left), np.float32) for _ in range(2))
    kernels.haar_factors(tree.left, tree.right, tree.weight, tree.node_weight, of_left, of_right)
    of_root = 1 / float(np.sqrt(tree.node_weight[0] if len(tree.left) else tree.weight[0]))
    return kernels.HaarTables(tree.lo, tree.hi, tree.left, tree.right, of_root, of_left, of_right, int(tree.depth))


def _sparse_tiles(part: _Weighted) -> kernels.SparseTiles:
    rows = part.rows
    weight = part.row_weight.astype(np.float32)
    return kernels.SparseTiles(rows.indptr, rows.indices, rows.weights, weight, part.response)


def _join(tree: ClusterTree, n_rows: int, tiles: list[_Tile]) -> PackedRows:
    """Rows of tiles, which leave the list one by one: all of them together take as much memory as the rows."""
    none = _Tile(np.empty(0, np.int32), np.empty(0, np.float32), np.empty(0, np.float32), np.empty((0, LANES), np.int8))
    counts = [len(tile.coefficient) for tile in tiles] or [0] * -(-n_rows // LANES)
    begin = _begin(np.array(counts, np.int64))
    index, scale, worth, value = _Tile(*(np.empty((begin[-1], *part.shape[1:]), part.dtype) for part in none))
    while tiles:
        last = slice(begin[len(tiles) - 1], begin[len(tiles)])
        index[last], scale[last], worth[last], value[last] = tiles.pop()
    return PackedRows(tree, n_rows, begin, index, scale, worth, value)
