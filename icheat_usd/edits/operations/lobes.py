"""Cosine lobes and their means over the hemisphere of a surface."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from icheat_usd.scene import F32, F64

_NODES = 4097  # of the table over the cosine; linear in between, off by less than 1e-5 up to exponents of 5000
_ORDER = 48  # of the quadrature, off by less than 1e-8


def lobe(cosine: F32, exponent: float) -> F32:
    """``cosine^exponent``, 0 where the cosine is not positive; an exponent of 0 is 1 on the positive side."""
    positive = cosine > 0
    power = np.where(positive, cosine, np.float32(1)) ** np.float32(exponent)
    return np.where(positive, power, np.float32(0)).astype(np.float32)


def mean_lobe(cosine: F32, exponent: float) -> F32:
    """Cosine-weighted mean of a lobe over the hemisphere of a normal; interpolated, fast for many.

    Parameters
    ----------
    cosine : (n,) float32
        Of the angle between the normal and the lobe's axis.
    exponent
        At least 0.

    Returns
    -------
    (n,) float32
        ``1 / pi`` times the integral of ``lobe(axis . w) (normal . w)`` over the hemisphere: ``2 / (exponent + 2)``
        for an axis along the normal, and 0 for one opposite to it.
    """
    table = _table(float(exponent))
    place = (np.clip(cosine, -1, 1).astype(np.float64) + 1.0) * ((_NODES - 1) / 2)
    below = np.minimum(place.astype(np.int64), _NODES - 2)
    share = place - below
    return (table[below] * (1 - share) + table[below + 1] * share).astype(np.float32)


@lru_cache(maxsize=64)
def _table(exponent: float) -> F64:
    return integrate_lobe(np.linspace(-1.0, 1.0, _NODES), exponent)


def integrate_lobe(cosine: ArrayLike, exponent: float) -> F64:
    """What `mean_lobe` interpolates, by quadrature.

    Notes
    -----
    Over directions at a cosine t from the axis, the clamped cosine to the
    normal has a closed integral I(t): with c the cosine between the two and
    s its sine, ``2 pi c t`` or 0 for t > s, where the whole circle lies on one
    side of the horizon, and else ``2 (c t phi + s sqrt(1 - t^2) sin phi)``, where
    ``cos phi = -c t / (s sqrt(1 - t^2))`` is where the circle meets it. The mean
    is the integral of ``t^exponent I(t) / pi`` over [0, 1]: closed from s on,
    Gauss-Legendre below. There ``t = s u^(1 / (exponent + 1))`` takes the power
    up, and u runs through a polynomial that is flat at both ends, where I has
    fractional powers.
    """
    c = np.asarray(cosine, np.float64)[..., None]
    s = np.sqrt(np.maximum(1 - c * c, 0.0))
    node, weight = np.polynomial.legendre.leggauss(_ORDER)
    v, weight = 0.5 * (node + 1), 0.5 * weight
    u = v**3 * (10 - 15 * v + 6 * v * v)
    weight = weight * 30 * v**2 * (1 - v) ** 2
    x = u ** (1 / (exponent + 1))
    rim = np.sqrt(1 - (s * x) ** 2)
    phi = np.arccos(np.clip(-c * x / rim, -1, 1))
    circle = 2 * (c * s * x * phi + s * rim * np.sin(phi))
    partial = (s ** (exponent + 1) / (exponent + 1) * circle * weight).sum(axis=-1)
    whole = np.where(c > 0, 2 * np.pi * c * (1 - s ** (exponent + 2)) / (exponent + 2), 0.0)[..., 0]
    mean: F64 = (partial + whole) / np.pi
    return mean
