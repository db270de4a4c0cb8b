"""How many gather rays each row gets: those whose noise shows most get most, so that the image's noise is least."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icheat_usd.scene import F32, F64, I64
from icheat_usd.transport.rays import MOST_RAYS
from icheat_usd.transport.sparse import SparseRows

#: Variance of a row falls by this power of its rays: 1 at random, 1.5 for stratified rays and smooth light.
_CONVERGENCE = 1.2
_NOISE = 0.02  # squared relative error below which a light's noise does not count against it
_NEIGHBOURS = 64  # rows in tile order that are taken to be about as noisy: few rays miss much of what makes noise
LEAST_DIFFUSE, LEAST_SPECULAR = 256, 64


class Counts(NamedTuple):
    """Gather rays of each row, powers of two."""

    diffuse: I64  #: (n_rows,)
    specular: I64  #: (n_rows,) 0 where a row reflects nothing specularly


def allot_rays(
    lobes: list[SparseRows], tints: list[F32], spread: SparseRows, lights: F32, glossy: I64, mean: int
) -> Counts:
    """Rays for each row, by what their noise adds to that of the image (Neyman's allotment of a stratified sample).

    Parameters
    ----------
    lobes
        Diffuse rows of few rays, and the two specular ones.
    tints : (n_view,) each
        What the lobes are multiplied with at the view samples; scalar.
    spread : (n_view x n_rows)
        Interpolation.
    lights : (n_gather, n_lights)
        What the noise is seen under.
    glossy
        Rows with specular rays, ascending.
    mean
        Rays per row, of both kinds together.
    """
    n_view, n_rows = spread.shape
    if not n_rows:
        return Counts(np.zeros(0, np.int64), np.zeros(0, np.int64))
    owner = np.repeat(np.arange(n_view), np.diff(spread.indptr))
    image = np.zeros((n_view, lights.shape[1]), np.float32)
    seen, variances = [], []
    for k, (rows, tint) in enumerate(zip(lobes, tints, strict=True)):
        products = rows.matmul(lights)
        part = spread.matmul(products)
        part *= tint[:, None]  # in place: there are many lights, and new memory costs as much as the product
        image += part
        # Rays of a specular row weigh about as much as each other, though not 1.
        second = rows.matmul(lights * lights) * (rows.row_sums()[:, None] if k else 1)
        variances.append(np.maximum(second - products * products, 0))
        seen.append(np.bincount(spread.indices, (spread.weights * tint[owner]) ** 2, n_rows))
    square = np.mean(image.astype(np.float64) ** 2, axis=0)
    known = square > 0
    per_square = np.where(known, 1 / np.where(known, square, 1), 0) / n_view
    noise = sum(see @ variance for see, variance in zip(seen, variances, strict=True)) * per_square / mean
    weight = per_square / (_NOISE + noise)
    parts = [see * _smoothed(variance @ weight) for see, variance in zip(seen, variances, strict=True)]
    return _counts(parts[0], (parts[1] + parts[2])[glossy], glossy, mean)


def _smoothed(values: F64) -> F64:
    """Half of each value and half of the mean over the rows beside it."""
    first = np.arange(0, len(values), _NEIGHBOURS)
    size = np.diff(np.append(first, len(values)))
    total = np.add.reduceat(values, first) if len(values) else values
    out: F64 = 0.5 * values + 0.5 * np.repeat(total / size, size)
    return out


def _counts(diffuse: F64, specular: F64, glossy: I64, mean: int) -> Counts:
    """Powers of two in proportion to a power of what one ray adds, as large as the mean allows."""
    n_rows = len(diffuse)
    wanted = np.concatenate([diffuse, specular]) ** (1 / (1 + _CONVERGENCE))
    wanted = np.maximum(wanted, 1e-6 * max(wanted.mean(), 1e-30))
    least = np.repeat([LEAST_DIFFUSE, LEAST_SPECULAR], [n_rows, len(glossy)])

    def rounded(scale: float) -> I64:
        exponent = np.rint(np.log2(wanted * scale)).clip(0, 30).astype(np.int64)
        return np.clip(np.int64(1) << exponent, least, MOST_RAYS)

    low, high = 0.0, np.log2(2.0 * MOST_RAYS / wanted.min())
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if rounded(2.0**middle).sum() > mean * n_rows else (middle, high)
    found = rounded(2.0**low)
    of_specular = np.zeros(n_rows, np.int64)
    of_specular[glossy] = found[n_rows:]
    return Counts(found[:n_rows], of_specular)
