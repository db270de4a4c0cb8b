"""Choosing which coefficients of exact rows a packed transport keeps, by the error that they cause."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from icheat_usd.kernels import packing as kernels
from icheat_usd.progress import Progress, silent
from icheat_usd.samples import ClusterTree, GatherSamples
from icheat_usd.samples.wavelets import haar_forward
from icheat_usd.scene import F32, F64, I32, I64
from icheat_usd.transport.build import Lobe, Transport
from icheat_usd.transport.packed import LANES, PackedLobe, PackedRows, PackedTransport, PackingReport
from icheat_usd.transport.sparse import SparseRows

_TILES_AT_ONCE = 16
_TILES_OF_A_TRIAL = 32  # that the amount to keep is found on; spread over all
_TRIALS = 6
_CLOSE_ENOUGH = 1.05  # ratio of errors at which the search for the amount ends
_PRIOR = 0.2  # share of the energy that is taken from a coefficient's surroundings: the training lights are few
_PRIOR_LEVELS = 4  # of ancestors that these surroundings reach up
_ANYWHERE = 0.1  # share of those that is the same everywhere: no place stays dark for ever
_UNSEEN = 0.3  # share of the energy that does not go together with that of other coefficients
_DIM = 0.02  # of its mean on the cells: a light that responds less in the view is not measured relative to that


class _Weighted(NamedTuple):
    """Rows of one lobe with what their errors count."""

    rows: SparseRows
    row_weight: F64  #: (n_rows,) RMS tint of the pixels that use a row, times the root of their number
    response: F32  #: (n_rows, n_lights) exact


class _Lights(NamedTuple):
    """Training lights in the Haar basis."""

    coefficients: F32  #: (m, n_lights), each light's response in the whole view is 1
    energy: F64  #: (m,) expected square of each coefficient


class _Chunk(NamedTuple):
    """Some packed tiles."""

    counts: I64  #: (n_tiles,) coefficients
    coefficient: I32
    scale: F32
    value: NDArray[np.int8]


def pack(
    transport: Transport,
    gather: GatherSamples,
    training: F32,
    tolerance: float = 0.015,
    *,
    max_bytes: int | None = None,
    progress: Progress = silent,
) -> PackedTransport:
    """Keep of each tile of rows the coefficients that matter to plausible lights, in 8 bits.

    A coefficient's worth is the squared response it adds at the tile's records
    under the mean training light, in the pixels that use them. One least worth
    for all tiles and lobes is found such that lights that the tiles were not chosen by
    are off by `tolerance`: half of the training lights, for tiles packed by the other half.

    Parameters
    ----------
    transport
        Exact rows; 64 consecutive ones should be neighbours.
    training : (n_lights, n_gather)
        Radiance that plausible lights make leave the cells.
    tolerance
        Relative RMS error at the records, median over such lights.
    max_bytes
        Stop here even where the tolerance asks for more.

    Raises
    ------
    ValueError
        `training` or the rows belong to another gather set, or there is only one training light.

    Notes
    -----
    Bitwise the same for any number of threads.
    """
    return pack_on_tree(transport, gather.tree, training, tolerance, max_bytes=max_bytes, progress=progress)


def pack_on_tree(
    transport: Transport,
    tree: ClusterTree,
    training: F32,
    tolerance: float,
    *,
    max_bytes: int | None = None,
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
    weighted, lights = _normalise(tree, training, weighted)
    least, light_error = _find_least(tree, weighted, lights, tolerance, max_bytes, progress)
    lobes = []
    n_tiles = sum(_n_tiles(part.rows) for part in weighted if part.rows.n_entries)
    done = 0
    for lobe, part in zip(transport.lobes, weighted, strict=True):
        chunks = []
        for first in range(0, _n_tiles(part.rows), _TILES_AT_ONCE) if part.rows.n_entries else ():
            tiles = np.arange(first, min(first + _TILES_AT_ONCE, _n_tiles(part.rows)))
            chunks.append(_pack_tiles(tree, part, lights, tiles, least))
            done += len(tiles)
            progress("pack the transport", done / n_tiles)
        lobes.append(PackedLobe(lobe.name, _join(tree, part.rows.n_rows, chunks), lobe.tint))
    report = PackingReport(light_error)
    return PackedTransport(tuple(lobes), transport.row_view, transport.interpolation, transport, report)


def lossless(rows: SparseRows, tree: ClusterTree) -> PackedRows:
    """All coefficients in float32: exact to rounding, and of a size for small scenes only."""
    tiles = np.arange(_n_tiles(rows))
    ones = np.ones(tree.n_leaves)
    counts, index = _choose(tree, rows, np.ones(rows.n_rows), ones, tiles, 0.0)
    value = _fill(tree, rows, tiles, counts, index)
    return PackedRows(tree, rows.n_rows, _begin(counts), index, np.ones(len(index), np.float32), value)


def residual(packed: PackedTransport, radiance: F32) -> list[F32]:
    """What packing loses of one light, to be added to the products at the records.

    Parameters
    ----------
    radiance : (n_gather, 3)

    Returns
    -------
    list of (n_rows, 3) float32
        Exact minus packed product of each lobe; linear in `radiance`.

    Raises
    ------
    ValueError
        The exact rows were not kept.
    """
    if packed.source is None:
        raise ValueError("a packed transport without its exact rows does not know what it lost")
    return [
        exact.rows.matmul(radiance) - lobe.rows.matmul(radiance)
        for exact, lobe in zip(packed.source.lobes, packed.lobes, strict=True)
    ]


def _weigh(lobe: Lobe, interpolation: SparseRows | None, training: F32) -> _Weighted:
    square = np.mean(lobe.tint.astype(np.float64) ** 2, axis=1)
    if interpolation is not None:
        pixel = np.repeat(np.arange(interpolation.n_rows), np.diff(interpolation.indptr))
        square = np.bincount(interpolation.indices, interpolation.weights * square[pixel], interpolation.n_columns)
    response = lobe.rows.matmul(np.ascontiguousarray(training.T, np.float32))
    return _Weighted(lobe.rows, np.sqrt(square[: lobe.rows.n_rows]), response)


def _normalise(tree: ClusterTree, training: F32, weighted: list[_Weighted]) -> tuple[list[_Weighted], _Lights]:
    """Scale the lights to a response of 1 in the view."""
    squared = sum((_squared_response(part) for part in weighted), np.zeros(len(training)))
    of_white = sum(float(np.sum((part.row_weight * part.rows.row_sums()) ** 2)) for part in weighted)
    mean = training.astype(np.float64) @ tree.weight / tree.weight.sum()
    size = np.maximum(np.sqrt(squared), _DIM * np.abs(mean) * np.sqrt(of_white))
    scale = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0)
    coefficients = haar_forward(tree, np.ascontiguousarray((training * scale[:, None]).T)).astype(np.float32)
    parts = [part._replace(response=np.ascontiguousarray(part.response * scale, np.float32)) for part in weighted]
    return parts, _Lights(coefficients, _energy(tree, coefficients))


def _energy(tree: ClusterTree, coefficients: F32) -> F64:
    if not coefficients.shape[1]:
        return np.ones(tree.n_leaves)
    seen = np.mean(coefficients.astype(np.float64) ** 2, axis=1)
    around = np.empty_like(seen)
    kernels.smooth_energy(tree.left, tree.right, tree.node_weight, _PRIOR_LEVELS, _ANYWHERE, seen, around)
    return (1 - _PRIOR) * seen + _PRIOR * around


def _squared_response(part: _Weighted) -> F64:
    return np.square(part.row_weight) @ np.square(part.response.astype(np.float64))


def _find_least(
    tree: ClusterTree,
    weighted: list[_Weighted],
    lights: _Lights,
    tolerance: float,
    max_bytes: int | None,
    progress: Progress,
) -> tuple[float, F64]:
    """Least worth of a coefficient, and the errors (n_lights,) that it makes.

    Found by trials on some of the tiles, packed by one half of the lights and
    measured with the other, and the other way round.
    """
    parts = [(part, _some_tiles(_n_tiles(part.rows))) for part in weighted if part.rows.n_entries]
    n_lights = lights.coefficients.shape[1]
    total = sum(
        (_squared_response(_part_of_tiles(part, tiles)) * (_n_tiles(part.rows) / len(tiles)) for part, tiles in parts),
        np.zeros(n_lights),
    )
    lit = total > 0
    if not lit.any():
        return float(np.finfo(np.float32).tiny), np.zeros(0)
    halves = [_half(tree, lights, np.arange(side, n_lights, 2)) for side in (0, 1)]
    least = tolerance**2 * 2e-3 / sum(_n_tiles(part.rows) for part, _ in parts)
    tried: list[tuple[float, float, F64]] = []  # logarithms of a worth and of error / tolerance, and errors
    for trial in range(_TRIALS):
        squared, size = np.zeros(n_lights), 0.0
        for part, tiles in parts:
            share = _n_tiles(part.rows) / len(tiles)
            for (half, trained), (_, others) in zip(halves, reversed(halves), strict=True):
                error, n_kept = _try(tree, part, lights, half, trained, others, tiles, least)
                squared[others] += share * error
                size += 0.5 * share * n_kept * (LANES + 8)
        errors = np.sqrt(squared[lit] / total[lit])
        ratio = max(PackingReport(errors).error / tolerance, 1e-12)
        if max_bytes is not None:  # fewer bytes for a larger worth: the same search serves both limits
            ratio = min(ratio, max_bytes / size)
        tried.append((float(np.log(least)), float(np.log(ratio)), errors))
        progress("choose coefficients", (trial + 1) / _TRIALS)
        if 1 / _CLOSE_ENOUGH < ratio < _CLOSE_ENOUGH:
            break
        least = float(np.exp(_next_trial([(worth, off) for worth, off, _ in tried])))
    fitting = [one for one in tried if one[1] < np.log(_CLOSE_ENOUGH)]
    worth, _, errors = max(fitting or [min(tried, key=lambda one: one[0])], key=lambda one: one[0])
    return float(np.exp(worth)), errors


def _half(tree: ClusterTree, lights: _Lights, which: I64) -> tuple[_Lights, I64]:
    coefficients = np.ascontiguousarray(lights.coefficients[:, which])
    return _Lights(coefficients, _energy(tree, coefficients)), which


def _try(
    tree: ClusterTree,
    part: _Weighted,
    lights: _Lights,
    half: _Lights,
    trained: I64,
    others: I64,
    tiles: I64,
    least: float,
) -> tuple[F64, int]:
    """Squared errors of the lights `others` in some tiles packed by the lights `trained`, and entries kept."""
    of_half = part._replace(response=np.ascontiguousarray(part.response[:, trained]))
    squared, n_kept = np.zeros(len(others)), 0
    unknown = np.ascontiguousarray(lights.coefficients[:, others])
    for first in range(0, len(tiles), _TILES_AT_ONCE):
        some = tiles[first : first + _TILES_AT_ONCE]
        chunk = _pack_tiles(tree, of_half, half, some, least)
        exact = _part_of_tiles(part, some)
        product = _join(tree, len(some) * LANES, [chunk]).multiply(unknown)[: len(exact.row_weight)]
        squared += np.square(exact.row_weight) @ np.square((product - exact.response[:, others]).astype(np.float64))
        n_kept += len(chunk.coefficient)
    return squared, n_kept


def _next_trial(tried: list[tuple[float, float]]) -> float:
    """Where the logarithm of the ratio may be 0: by the slope between the nearest points, within what is known."""
    below = max((worth for worth, ratio in tried if ratio < 0), default=-np.inf)
    above = min((worth for worth, ratio in tried if ratio >= 0 and worth > below), default=np.inf)
    nearest = sorted(tried, key=lambda point: abs(point[1]))
    slope = 0.4
    if len(tried) > 1 and nearest[0][0] != nearest[1][0]:
        slope = float(np.clip((nearest[0][1] - nearest[1][1]) / (nearest[0][0] - nearest[1][0]), 0.15, 1.0))
    guess = nearest[0][0] - nearest[0][1] / slope
    return guess if below < guess < above or not np.isfinite(below + above) else 0.5 * (below + above)


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


def _haar_arguments(tree: ClusterTree) -> tuple[Any, ...]:
    of_left, of_right = (np.empty(len(tree.left), np.float32) for _ in range(2))
    kernels.haar_factors(tree.left, tree.right, tree.weight, tree.node_weight, of_left, of_right)
    of_root = np.float32(1 / np.sqrt(tree.node_weight[0] if len(tree.left) else tree.weight[0]))
    return tree.lo, tree.hi, tree.left, tree.right, of_root, of_left, of_right, tree.depth


def _choose(
    tree: ClusterTree, rows: SparseRows, row_weight: F64, energy: F64, tiles: I64, least: float
) -> tuple[I64, I32]:
    """Number and indices of the coefficients of each tile that are worth at least `least`."""
    kept = np.empty((len(tiles), tree.n_leaves), np.uint8)
    entries = rows.indptr, rows.indices, rows.weights
    arguments = *_haar_arguments(tree), *entries, tiles, LANES, row_weight, energy, least, kept
    kernels.choose_coefficients(*arguments)
    return kept.sum(axis=1, dtype=np.int64), np.nonzero(kept)[1].astype(np.int32)


def _fill(tree: ClusterTree, rows: SparseRows, tiles: I64, counts: I64, index: I32) -> F32:
    value = np.empty((len(index), LANES), np.float32)
    entries = rows.indptr, rows.indices, rows.weights
    arguments = *_haar_arguments(tree), *entries, tiles, LANES, _begin(counts), index, value
    kernels.fill_tiles(*arguments)
    return value


def _pack_tiles(tree: ClusterTree, part: _Weighted, lights: _Lights, tiles: I64, least: float) -> _Chunk:
    counts, index = _choose(tree, part.rows, part.row_weight, lights.energy, tiles, least)
    begin = _begin(counts)
    value = _fill(tree, part.rows, tiles, counts, index)
    response = part.response
    kernels.refit_tiles(begin, index, value, tiles, LANES, lights.coefficients, _UNSEEN * lights.energy, response)
    scale, rest_scale = np.empty(len(index), np.float32), np.empty(len(index), np.float32)
    quanta, rest = np.empty(value.shape, np.int8), np.empty(value.shape, np.int8)
    kernels.quantise(begin, index, value, tiles, part.row_weight, lights.energy, least, scale, quanta, rest_scale, rest)
    twice = np.flatnonzero(rest_scale)
    order = np.argsort(np.concatenate([np.arange(len(index)), twice]), kind="stable")
    tile = np.repeat(np.arange(len(tiles)), counts)
    return _Chunk(
        counts + np.bincount(tile[twice], minlength=len(tiles)),
        np.concatenate([index, index[twice]])[order],
        np.concatenate([scale, rest_scale[twice]])[order],
        np.concatenate([quanta, rest[twice]])[order],
    )


def _join(tree: ClusterTree, n_rows: int, chunks: list[_Chunk]) -> PackedRows:
    counts = np.concatenate([chunk.counts for chunk in chunks]) if chunks else np.zeros(-(-n_rows // LANES), np.int64)
    return PackedRows(
        tree,
        n_rows,
        _begin(counts),
        np.concatenate([np.empty(0, np.int32), *(chunk.coefficient for chunk in chunks)]),
        np.concatenate([np.empty(0, np.float32), *(chunk.scale for chunk in chunks)]),
        np.concatenate([np.empty((0, LANES), np.int8), *(chunk.value for chunk in chunks)]),
    )
