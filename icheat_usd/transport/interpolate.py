"""Fewer rows than view samples: where to compute them, and how to interpolate between them."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels import transport as kernels
from icheat_usd.kernels.rows import pack_rows
from icheat_usd.samples import ViewSamples
from icheat_usd.scene import F32, I32, I64, Bool, Camera
from icheat_usd.transport.sparse import SparseRows

_LEAST_COSINE = 0.2  # at grazing angles neighbouring pixels lie this much further apart, and no more


def sparse_rows_of_view(view: ViewSamples, camera: Camera, spacing: int) -> tuple[I32, SparseRows]:
    """Choose view samples whose rows the others can be interpolated from.

    Rows stand on a pixel grid; where no row lies near enough on the same sheet
    of surface, finer grids add some, down to the view sample itself.

    Parameters
    ----------
    spacing : at least 2
        Pixels between rows.

    Returns
    -------
    row_view : (n_rows,) int32
        View samples with rows of their own, ascending.
    interpolation : (n_view x n_rows)
        Weights, each row's sum is 1; a view sample with a row of its own has weight 1 there.

    Notes
    -----
    Neighbours are looked for in the image, then accepted by place and normal,
    so nothing leaks across silhouettes. Franke-Little weights [1]_ are continuous
    where the set of neighbours changes.

    References
    ----------
    .. [1] Franke 1982, Scattered Data Interpolation: Tests of Some Methods, Mathematics of Computation 38.
    """
    x, y = view.pixel % view.width, view.pixel // view.width
    n_blocks_x = (view.width + spacing - 1) // spacing
    n_blocks_y = (view.height + spacing - 1) // spacing
    block = (y // spacing) * n_blocks_x + x // spacing
    extent = _pixel_extent(view, camera) * np.float32(spacing)
    has_row = np.zeros(view.n, bool)
    missing = np.ones(view.n, bool)
    step = spacing
    while True:
        on_grid = (x % step == step // 2) & (y % step == step // 2)
        has_row |= missing & on_grid
        row_view = np.flatnonzero(has_row)
        # What has a row near keeps one: more rows change its weights, and these are needed at the end alone.
        rows = _weights(view, block, n_blocks_x, n_blocks_y, extent, row_view, missing)
        missing &= np.diff(rows.indptr) == 0
        if not missing.any():
            everywhere = np.ones(view.n, bool)
            rows = _weights(view, block, n_blocks_x, n_blocks_y, extent, row_view, everywhere)
            return row_view.astype(np.int32), rows
        step = max(1, step // 2)


def _pixel_extent(view: ViewSamples, camera: Camera) -> F32:
    """Distance on the surface between view samples of neighbouring pixels, metres: (n,)."""
    left, right, _, _ = camera.window
    extent = np.full(view.n, (right - left) / view.width, np.float32)
    if not camera.orthographic:
        extent *= view.depth
    cosine = np.abs(np.einsum("ij,ij->i", view.to_eye, view.points.normal))
    return np.maximum(extent / np.maximum(cosine, np.float32(_LEAST_COSINE)), np.float32(1e-20))


def _weights(
    view: ViewSamples, block: I32, n_blocks_x: int, n_blocks_y: int, extent: F32, row_view: I64, wanted: Bool
) -> SparseRows:
    """Weights of some view samples; the others have none."""
    n_rows = len(row_view)
    row_of_view = np.full(view.n, -1, np.int64)
    row_of_view[row_view] = np.arange(n_rows)
    bucket_row = np.argsort(block[row_view], kind="stable")
    bucket_begin = np.searchsorted(block[row_view][bucket_row], np.arange(n_blocks_x * n_blocks_y + 1))
    count = np.empty(view.n, np.int64)
    near = np.empty((view.n, 4), np.int32)
    weight = np.empty((view.n, 4), np.float32)
    points = view.points
    kernels.interpolation_weights(
        points.position,
        points.normal,
        points.instance,
        extent,
        block,
        n_blocks_x,
        n_blocks_y,
        row_view,
        row_of_view,
        bucket_begin,
        bucket_row,
        wanted,
        count,
        near,
        weight,
    )
    indptr = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    indices, weights = np.empty(indptr[-1], np.int32), np.empty(indptr[-1], np.float32)
    pack_rows(count, indptr, near, weight, indices, weights)
    return SparseRows(indptr, indices, weights, n_rows)
