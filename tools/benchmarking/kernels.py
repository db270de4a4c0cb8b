"""The product of a frame beside what others offer for the same matrix, and beside the speed of reading.

Contenders take turns within each round, so that what else the machine does
meets all of them; figures are medians and quartiles over the rounds.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels.assemble import assemble_film, runs_in_order, sum_scaled
from icheat_usd.kernels.film_table import film_table
from icheat_usd.kernels.large_terms import multiply_terms
from icheat_usd.kernels.packed import LANES, multiply_tiles
from icheat_usd.kernels.paired_tiles import PairedTiles, QuantisedTiles, pair_tiles
from icheat_usd.kernels.simd import address_of, load, multiply_add, spread, store, zeros
from icheat_usd.samples import ViewSamples
from icheat_usd.samples.wavelets import haar_of_versions, plan_haar
from icheat_usd.scene import F32, I32
from icheat_usd.transport.packed import PackedRows, PackedTransport
from icheat_usd.transport.sparse import SparseRows

Work = Callable[[], Any]

_NONE: F32 = np.zeros((1, 0), np.float32)  # no term is left out
_READ_PARTS = 32
_MOST_ENTRIES = 150_000_000  # of a peer's matrix, 8 bytes each


@dataclass(frozen=True)
class Timing:
    """Seconds over the rounds."""

    name: str
    threads: int
    median: float
    quartiles: tuple[float, float]
    least: float
    n_bytes: int  #: that it must touch

    @property
    def gigabytes_per_second(self) -> float:
        return self.n_bytes / self.median / 1e9

    def as_dict(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "threads": self.threads,
            "median_s": self.median,
            "quartiles_s": list(self.quartiles),
            "least_s": self.least,
            "bytes": self.n_bytes,
            "GB/s": self.gigabytes_per_second,
        }


def time_in_turns(contenders: dict[tuple[str, int], tuple[Work, int]], rounds: int) -> list[Timing]:
    """Time contenders, named by name and threads, with the bytes each must touch; the first round does not count."""
    seconds: dict[tuple[str, int], list[float]] = {key: [] for key in contenders}
    before = numba.get_num_threads()
    try:
        for _ in range(rounds + 1):
            for key, (work, _bytes) in contenders.items():
                numba.set_num_threads(min(key[1], numba.config.NUMBA_NUM_THREADS))
                start = time.perf_counter()
                work()
                seconds[key].append(time.perf_counter() - start)
    finally:
        numba.set_num_threads(before)
    timings = []
    for (name, threads), (_, n_bytes) in contenders.items():
        low, middle, high = np.percentile(seconds[name, threads][1:], [25, 50, 75])
        timings.append(
            Timing(name, threads, float(middle), (float(low), float(high)), min(seconds[name, threads][1:]), n_bytes)
        )
    return timings


@numba.njit(nogil=True)
def _read(place, n):  # type: ignore[no-untyped-def]
    a = b = c = d = e = f = g = h = zeros()
    one = spread(np.float32(1.0))
    for _ in range(n):
        a, b = multiply_add(load(place), one, a), multiply_add(load(place + 64), one, b)
        c, d = multiply_add(load(place + 128), one, c), multiply_add(load(place + 192), one, d)
        e, f = multiply_add(load(place + 256), one, e), multiply_add(load(place + 320), one, f)
        g, h = multiply_add(load(place + 384), one, g), multiply_add(load(place + 448), one, h)
        place += 512
    a, b = multiply_add(a, one, b), multiply_add(c, one, d)
    c, d = multiply_add(e, one, f), multiply_add(g, one, h)
    return multiply_add(multiply_add(a, one, b), one, multiply_add(c, one, d))


@numba.njit(nogil=True, parallel=True)
def read_sum(values, out):  # type: ignore[no-untyped-def]
    """Read an array (n,) of float32 in blocks of 512 bytes; sums go to `out` (32, 16)."""
    n_blocks = values.size // 128
    for part in prange(_READ_PARTS):
        begin, end = part * n_blocks // _READ_PARTS, (part + 1) * n_blocks // _READ_PARTS
        store(address_of(out) + 64 * part, _read(address_of(values) + 512 * begin, end - begin))


def reading(n_bytes: int) -> Work:
    """Reads as many bytes as given, the same ones every time: from the cache where they fit."""
    values, out = np.ones(n_bytes // 4, np.float32), np.empty((_READ_PARTS, 16), np.float32)
    return lambda: read_sum(values, out)


@dataclass(frozen=True, eq=False)
class _Product:
    """One lobe's rows, ready for every contender."""

    rows: PackedRows
    paired: PairedTiles
    coefficients: F32  #: (1, n_leaves, 4)
    tile: I32
    version: I32
    out: F32

    @property
    def n_bytes(self) -> int:
        """Memory that a product touches: tiles, light, and what it writes."""
        return self.rows.n_bytes + self.coefficients.nbytes + self.out.nbytes

    def in_floats(self) -> None:
        rows = self.rows
        multiply_tiles(
            rows.tile_begin, rows.index, rows.scale, rows.value, self.coefficients, self.tile, self.version, self.out
        )

    def in_integers(self) -> None:
        multiply_terms(*self.paired, self.coefficients, _NONE, _NONE[0], self.tile, self.version, self.tile, self.out)


def _products(packed: PackedTransport, b: F32) -> list[_Product]:
    products = []
    for lobe in packed.lobes:
        rows = lobe.rows
        if len(rows.index) and rows.value.dtype == np.int8:
            n = len(rows.tile_begin) - 1
            quanta = np.asarray(rows.value, np.int8)
            paired = pair_tiles([QuantisedTiles(rows.tile_begin, rows.index, rows.scale, rows.worth, quanta)])
            coefficients = haar_of_versions(plan_haar(rows.tree), b[None])
            tile = np.arange(n, dtype=np.int32)
            products.append(
                _Product(rows, paired, coefficients, tile, np.zeros(n, np.int32), np.empty((n, LANES, 4), np.float32))
            )
    return products


def one_matrix(packed: PackedTransport) -> tuple[PackedRows, int]:
    """Tiles of all lobes as rows of one matrix; of large transports every k-th, and k."""
    lobes = [lobe.rows for lobe in packed.lobes if len(lobe.rows.index) and lobe.rows.value.dtype == np.int8]
    step = -(-sum(len(rows.index) for rows in lobes) * LANES // _MOST_ENTRIES)
    tiles = [rows.tiles(tile, tile + 1) for rows in lobes for tile in range(0, rows.n_tiles, max(step, 1))]
    begin = np.concatenate([[0], np.cumsum([len(tile.index) for tile in tiles])]).astype(np.int64)
    columns = {
        name: np.concatenate([getattr(tile, name) for tile in tiles]) for name in ("index", "scale", "worth", "value")
    }
    return replace(lobes[0], n_rows=len(tiles) * LANES, tile_begin=begin, **columns), step


def dequantised(rows: PackedRows) -> SparseRows:
    """Packed rows as a sparse matrix of Haar coefficients, without those that are 0."""
    n_tiles = len(rows.tile_begin) - 1
    indices, weights, counts = [], [], []
    for tile in range(n_tiles):
        part = slice(rows.tile_begin[tile], rows.tile_begin[tile + 1])
        value = (rows.value[part].astype(np.float32) * rows.scale[part, None]).T[: rows.n_rows - tile * LANES]
        row, column = np.nonzero(value)
        indices.append(rows.index[part][column])
        weights.append(value[row, column])
        counts.append(np.bincount(row, minlength=len(value)))
    indptr = np.concatenate([[0], np.cumsum(np.concatenate(counts))]).astype(np.int64)
    return SparseRows(
        indptr,
        np.concatenate(indices).astype(np.int32),
        np.concatenate(weights).astype(np.float32),
        rows.tree.n_leaves,
    )


def _scipy_peers(matrix: SparseRows, b: F32, label: str) -> dict[tuple[str, int], tuple[Work, int]]:
    """Forms of scipy's product with three columns."""
    from scipy.sparse import csr_matrix

    def csr(part: SparseRows) -> Any:
        return csr_matrix((part.weights, part.indices, part.indptr.astype(np.int32)), shape=part.shape)

    whole = csr(matrix)
    half = int(np.searchsorted(matrix.indptr, matrix.n_entries // 2))
    halves = [csr(matrix.rows(0, half)), csr(matrix.rows(half, matrix.n_rows))]
    columns = [np.ascontiguousarray(b[:, c]) for c in range(3)]
    pool = ThreadPoolExecutor(2)

    def three(part: Any) -> list[Any]:
        return [part @ column for column in columns]

    of_matrix, of_light = matrix.n_entries * 8, b.nbytes + 12 * matrix.n_rows
    once, thrice = of_matrix + of_light, 3 * of_matrix + of_light
    return {
        (f"scipy CSR {label}, dense (m, 3)", 1): (lambda: whole @ b, once),
        (f"scipy CSR {label}, three vectors", 1): (lambda: three(whole), thrice),
        (f"scipy CSR {label}, rows in halves, dense (m, 3)", 2): (
            lambda: list(pool.map(lambda part: part @ b, halves)),
            once,
        ),
        (f"scipy CSR {label}, rows in halves, three vectors", 2): (lambda: list(pool.map(three, halves)), thrice),
    }


def _find_mkl() -> None:
    """Point sparse_dot_mkl to the library that pip installs, with the OpenMP that Numba uses as well."""
    os.environ.setdefault("MKL_THREADING_LAYER", "GNU")
    for library in sorted((Path(sys.prefix) / "lib").glob("libmkl_rt.so*")):
        os.environ.setdefault("MKL_RT", str(library))


def _mkl_peers(matrix: SparseRows, b: F32, label: str) -> dict[tuple[str, int], tuple[Work, int]]:
    """MKL's product with three columns; nothing where it is not installed."""
    try:
        _find_mkl()
        import sparse_dot_mkl
        from scipy.sparse import csr_matrix
    except (ImportError, OSError):
        return {}
    whole = csr_matrix((matrix.weights, matrix.indices, matrix.indptr.astype(np.int32)), shape=matrix.shape)
    out = np.zeros((matrix.n_rows, 3), np.float32)
    touched = matrix.n_entries * 8 + b.nbytes + out.nbytes

    def product(threads: int) -> None:
        sparse_dot_mkl.mkl_set_num_threads(threads)
        sparse_dot_mkl.dot_product_mkl(whole, b, out=out, out_scalar=0.0)

    return {
        (f"MKL {label}, dense (m, 3)", threads): (lambda threads=threads: product(threads), touched)
        for threads in (1, 2)
    }


def per_pixel(packed: PackedTransport) -> SparseRows | None:
    """Interpolation times records of the first lobe, or None where that has too many entries to hold."""
    from scipy.sparse import csr_matrix

    spread_rows = packed.interpolation
    if spread_rows is None or len(packed.lobes[0].rows.index) * LANES > _MOST_ENTRIES:
        return None
    records = dequantised(packed.lobes[0].rows)
    counts = np.diff(records.indptr)
    bound = int(counts[spread_rows.indices].sum())
    if bound > 4 * _MOST_ENTRIES:
        return None
    left = csr_matrix((spread_rows.weights, spread_rows.indices, spread_rows.indptr), shape=spread_rows.shape)
    product = left @ csr_matrix((records.weights, records.indices, records.indptr), shape=records.shape)
    if product.nnz > _MOST_ENTRIES:
        return None
    product.sort_indices()
    return SparseRows(
        product.indptr.astype(np.int64),
        product.indices.astype(np.int32),
        product.data.astype(np.float32),
        records.n_columns,
    )


def measure_product(packed: PackedTransport, b: F32, rounds: int = 21) -> dict[str, Any]:
    """Our product, its peers' and reading, for the records of all lobes as one matrix.

    Of matrices with more entries than peers have memory for, every k-th tile is taken, by all contenders.

    Parameters
    ----------
    b : (n_leaves, 3) float32
        Light that leaves the gather cells.

    Returns
    -------
    ``timings`` (see `Timing`), and per number of threads in ``summary``: our best product, the share of the
    time that reading its bytes takes, the best peer and how many times longer that one took. ``difference``
    is ours to the peers' result, relative to it; ``every_tile`` is k.
    """
    if not any(len(lobe.rows.index) and lobe.rows.value.dtype == np.int8 for lobe in packed.lobes):
        return {"timings": [], "summary": [], "difference": {}, "bytes": 0, "every_tile": 1}
    rows, step = one_matrix(packed)
    (item,) = _products(replace(packed, lobes=(replace(packed.lobes[0], rows=rows),)), b)
    n_bytes = item.n_bytes
    read = reading(n_bytes)
    contenders: dict[tuple[str, int], tuple[Work, int]] = {}
    for threads in (1, 2):
        contenders["ours, float sums", threads] = (item.in_floats, n_bytes)
        contenders["ours, integer sums", threads] = (item.in_integers, n_bytes)
        contenders["reading as many bytes", threads] = (read, n_bytes)
    matrix, light = dequantised(rows), np.ascontiguousarray(item.coefficients[0, :, :3])
    contenders |= _scipy_peers(matrix, light, "of records") | _mkl_peers(matrix, light, "of records")
    differences = {}
    for name, work in (("floats", item.in_floats), ("integers", item.in_integers)):
        work()
        differences[name] = _difference(item, matrix.matmul(light))
    pixels = per_pixel(packed)
    if pixels is not None:
        contenders |= _scipy_peers(pixels, light, "of pixels") | _mkl_peers(pixels, light, "of pixels")
    timings = time_in_turns(contenders, rounds)
    return {
        "timings": [timing.as_dict() for timing in timings],
        "summary": [_summary(timings, threads) for threads in (1, 2)],
        "difference": differences,
        "bytes": n_bytes,
        "entries": matrix.n_entries,
        "every_tile": step,
    }


def measure_frame(
    packed: PackedTransport, view: ViewSamples, b: F32, direct: F32, rounds: int = 41
) -> dict[str, list[dict[str, Any]]]:
    """Each stage of a frame from the cells' light to the film, the frame, and reading what each must read.

    Parameters
    ----------
    b : (n_leaves, 3) float32
        Light that leaves the gather cells.
    direct : (n_lights, n_view, 3) float32
        Reflected direct light.

    Notes
    -----
    All lobes are taken to have the tiles of the first, as `pack` makes them.
    """
    products = _products(packed, b)
    n_rows = products[0].out.shape[0] * LANES
    plan, values = plan_haar(products[0].rows.tree), np.ascontiguousarray(b[None])
    out = np.zeros((len(products), n_rows, 4), np.float32)
    products = [replace(item, out=out[i].reshape(-1, LANES, 4)) for i, item in enumerate(products)]
    spread_rows = packed.interpolation
    if spread_rows is None:
        n = view.n
        spread_rows = SparseRows(np.arange(n + 1), np.arange(n, dtype=np.int32), np.ones(n, np.float32), n)
    tint = np.stack([lobe.tint for lobe in packed.lobes if len(lobe.rows.index)])
    table = tuple(film_table(spread_rows.indptr, spread_rows.indices, spread_rows.weights, tint))
    kept = np.empty(direct.shape[1:], np.float32)
    sum_scaled(direct, np.ones((len(direct), 3), np.float32), kept)
    summed = (kept, direct[:0], np.zeros((0, 48), np.float32))
    n_pixels = view.width * view.height
    sample_begin = np.searchsorted(view.pixel, np.arange(n_pixels + 1)).astype(np.int32)
    dimmed = np.flatnonzero((view.throughput != 1).any(axis=1)).astype(np.int32)
    still = np.flatnonzero(view.background.any(axis=1)).astype(np.int32)
    background = np.ascontiguousarray(view.background[still])
    film = np.empty((n_pixels, 3), np.float32)
    unedited = (np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 3), np.float32))
    seen = (dimmed, view.throughput[dimmed], sample_begin, runs_in_order(sample_begin), still, background)

    def haar() -> None:
        haar_of_versions(plan, values, products[0].coefficients)

    def floats() -> None:
        for item in products:
            item.in_floats()

    def integers() -> None:
        for item in products:
            item.in_integers()

    def pixels() -> None:
        assemble_film(table, out, unedited, summed, seen, film)

    def frame() -> None:
        haar()
        integers()
        pixels()

    sizes = {
        "Haar transform": values.nbytes + 16 * len(b) + 16 * len(b),
        "product": sum(item.n_bytes for item in products),
        "pixels": sum(column.nbytes for column in table) + kept.nbytes + view.throughput[dimmed].nbytes + film.nbytes,
    }
    contenders: dict[tuple[str, int], tuple[Work, int]] = {}
    for threads in (1, 2):
        contenders["Haar transform", threads] = (haar, sizes["Haar transform"])
        contenders["product, float sums", threads] = (floats, sizes["product"])
        contenders["product, integer sums", threads] = (integers, sizes["product"])
        contenders["pixels", threads] = (pixels, sizes["pixels"])
        contenders["frame", threads] = (frame, sum(sizes.values()))
        for name, size in (*sizes.items(), ("frame", sum(sizes.values()))):
            contenders[f"reading as many bytes: {name}", threads] = (reading(size), size)
    return {"stages": [timing.as_dict() for timing in time_in_turns(contenders, rounds)]}


def _difference(item: _Product, expected: F32) -> float:
    got: NDArray[np.float32] = item.out.reshape(-1, 4)[: item.rows.n_rows, :3]
    return float(np.linalg.norm(got - expected) / max(float(np.linalg.norm(expected)), 1e-30))


def _summary(timings: list[Timing], threads: int) -> dict[str, Any]:
    """Ours, reading and the best peer for the same matrix."""
    of = [timing for timing in timings if timing.threads == threads]
    ours = min((t for t in of if t.name.startswith("ours")), key=lambda t: t.median)
    read = next(t for t in of if t.name.startswith("reading"))
    peers = [t for t in of if "of records," in t.name]
    result: dict[str, Any] = {
        "threads": threads,
        "ours": ours.name,
        "ours_s": ours.median,
        "read_GB/s": read.gigabytes_per_second,
        "share_of_read_speed": read.median / ours.median,
    }
    if peers:
        best = min(peers, key=lambda t: t.median)
        result |= {"best_peer": best.name, "best_peer_s": best.median, "times_best_peer": best.median / ours.median}
    return result
