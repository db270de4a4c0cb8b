"""Reflectance of surface points: evaluation, sampling, albedo, and what a path does where nothing scatters it.

The model is Lambert plus one isotropic GGX lobe (height-correlated Smith
shadowing, single scattering) whose Fresnel term is Schlick's, from `specular`
to `specular_edge`. As in USD's own shader of UsdPreviewSurface, a metal keeps
its colour at grazing angles, and what the interface reflects is missing from
the diffuse base; that share is taken at normal incidence, so that albedo does
not depend on the view. Alpha is
roughness squared, but at least 0.001: narrower lobes are below the precision
of float32 normals (only a perfectly smooth black or metal surface becomes a
mirror instead). The cosine to the eye is kept at 1e-4 or more.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from icheat_usd.materials.surface import nonzero_rows
from icheat_usd.scene import F32, Bool, DeltaKind, SurfacePoints


def _rows(values: ArrayLike, n: int, width: int = 3) -> NDArray[np.float32]:
    rows = np.require(values, np.float32, ["C", "W"])
    if rows.shape != (n, width):
        raise ValueError(f"expected one row of {width} per point ({n}); got shape {rows.shape}")
    return rows


def evaluate(points: SurfacePoints, to_eye: F32, to_light: F32) -> F32:
    """BRDF times the cosine to the light.

    Parameters
    ----------
    points : SurfacePoints of n points
    to_eye, to_light : (n, 3) float32
        Away from the surface; any length.

    Returns
    -------
    (n, 3) float32, 1/sr
        Zero where the light is below the horizon of either normal, and at mirrors, glass and holes.
    """
    from icheat_usd.kernels import bsdf

    n = len(points.instance)
    out = np.empty((n, 3), np.float32)
    bsdf.evaluate(points, _rows(to_eye, n), _rows(to_light, n), out)
    return out


class SpecularTerms(NamedTuple):
    """Linear parts of the specular lobe: BRDF times cosine is ``specular * base + specular_edge * edge``."""

    base: F32  #: (n,) 1/sr
    edge: F32  #: (n,) 1/sr
    pdf: F32  #: (n,) 1/sr: density with which `sample_specular` picks the direction


def evaluate_specular(points: SurfacePoints, to_eye: F32, to_light: F32) -> SpecularTerms:
    """The specular lobe alone, in its two linear parts, and the density of sampling it."""
    from icheat_usd.kernels import bsdf

    n = len(points.instance)
    terms = SpecularTerms(*(np.empty(n, np.float32) for _ in range(3)))
    bsdf.evaluate_specular(points, _rows(to_eye, n), _rows(to_light, n), *terms)
    return terms


def sample_specular(points: SurfacePoints, to_eye: F32, u: F32) -> tuple[F32, F32, F32]:
    """Directions distributed as the specular lobe's visible microfacet normals.

    Parameters
    ----------
    points : SurfacePoints of n points
    to_eye : (n, 3) float32
    u : (n, 2) float32
        Uniform in [0, 1).

    Returns
    -------
    directions : (n, 3) float32, unit
    weight_base, weight_edge : (n,) float32
        With L the radiance from `directions`, ``specular * weight_base * L + specular_edge * weight_edge * L``
        estimates the lobe's reflected radiance. Zero below the horizon and where `is_glossy` is false.

    References
    ----------
    .. [1] Heitz 2018, Sampling the GGX Distribution of Visible Normals, JCGT 7(4).
    """
    from icheat_usd.kernels import bsdf

    n = len(points.instance)
    directions = np.empty((n, 3), np.float32)
    base, edge = np.empty(n, np.float32), np.empty(n, np.float32)
    bsdf.sample_specular(points, _rows(to_eye, n), _rows(u, n, 2), directions, base, edge)
    return directions, base, edge


def is_glossy(points: SurfacePoints) -> Bool:
    """(n,) whether a point has a specular lobe that scatters (mirrors and glass have none)."""
    lobe = nonzero_rows(points.specular_edge) | nonzero_rows(points.specular)
    return lobe & (points.delta == DeltaKind.NONE) & (points.instance >= 0)


def reflectance_to_eye(points: SurfacePoints, to_eye: F32) -> F32:
    """What a smooth specular lobe sends to the eye of uniform light: Schlick's term at the angle of the eye.

    Parameters
    ----------
    to_eye : (n, 3) float32, unit

    Returns
    -------
    (n, 3) float32
        From `specular` at normal incidence to `specular_edge` at grazing.
    """
    cosine = np.abs((points.shading_normal * to_eye).sum(axis=1, keepdims=True)).clip(0, 1)
    edge = (1 - cosine) ** 5
    out: F32 = (1 - edge) * points.specular + edge * points.specular_edge
    return out


# Cosine-weighted mean over eye directions of the lobe's directional albedo, for `specular` 1 and for
# `specular_edge` 1: polynomials in roughness fitted to quadrature of `evaluate_specular`; largest error 0.0003.
# A smooth surface gives Schlick's 20/21 and 1/21; a rough one loses what its microfacets hide from each other.
_MEAN_BASE = (0.95332, -0.02947, 0.22604, 0.028797, -4.6303, 6.0181, -2.1604)
_MEAN_EDGE = (0.046685, 0.029568, -0.21852, -0.37636, 1.6564, -1.7221, 0.58725)


def effective_albedo(points: SurfacePoints) -> F32:
    """Diffuse reflectance that stands for the whole surface in every bounce before the last.

    All earlier bounces are diffuse. A surface there reflects what its BRDF
    reflects under uniform light from everywhere (its white-sky albedo): diffuse
    albedo plus the mean of the specular lobe, at most 1. So rough metals, whose
    diffuse albedo is 0, still hand light on.

    Returns
    -------
    (n, 3) float32
        Equal to `albedo` where there is no interface; 0 at mirrors, glass and holes, which hand light on as deltas.
    """
    result = points.albedo.copy()
    glossy = np.flatnonzero(is_glossy(points))
    roughness = np.maximum(points.roughness[glossy].astype(np.float64), 1e-3**0.5)
    base = np.polynomial.polynomial.polyval(roughness, _MEAN_BASE)
    edge = np.polynomial.polynomial.polyval(roughness, _MEAN_EDGE)
    lobe = points.specular[glossy] * base[:, None] + points.specular_edge[glossy] * edge[:, None]
    result[glossy] = np.clip(result[glossy] + lobe, 0, 1)
    return result


class DeltaSplit(NamedTuple):
    """Both continuations of a path at a point that does not scatter all of it."""

    reflected: F32  #: (n, 3) unit
    refracted: F32  #: (n, 3) unit; straight on at holes and see-through surfaces
    weight_reflected: F32  #: (n, 3)
    weight_refracted: F32  #: (n, 3)


def dielectric_split(points: SurfacePoints, directions: F32) -> DeltaSplit:
    """Reflected and refracted continuations with their weights, nothing chosen at random.

    Parameters
    ----------
    points : SurfacePoints of n points
    directions : (n, 3) float32
        Towards the surface, as the rays travel; any length.

    Returns
    -------
    DeltaSplit
        GLASS: the Fresnel reflectance F and 1 - F (clear, unpolarised; 0 under total internal reflection).
        MIRROR: its reflectance and what its opacity lets through. PASS: 0 and 1. NONE: 0 and ``1 - opacity``:
        the rest, `opacity`, ends here and scatters.

    Notes
    -----
    Radiance is not scaled by the squared ratio of indices on entering: what
    enters a solid also leaves it.
    """
    from icheat_usd.kernels import bsdf

    n = len(points.instance)
    split = DeltaSplit(*(np.empty((n, 3), np.float32) for _ in range(4)))
    bsdf.split_delta(points, _rows(directions, n), *split)
    return split
