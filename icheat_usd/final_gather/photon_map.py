"""Photon map: irradiance from the density of photons, and the light that leaves gather cells by it.

An estimate is a sum over the nearest photons under an Epanechnikov kernel, divided
by the part of the kernel that lies on the surface and that the place can see. So
the edges of a wall are not darkened, and light beyond a thin wall does not count.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from icheat_usd.final_gather.photons import Photons, PhotonSettings, trace_photons
from icheat_usd.kernels import photon_map as kernels
from icheat_usd.kernels.random import hash_combine
from icheat_usd.kernels.rows import mean_over_segments
from icheat_usd.lighting import build_light_sampler
from icheat_usd.materials import effective_albedo, shade_hits
from icheat_usd.progress import Progress, silent
from icheat_usd.samples import GatherSamples
from icheat_usd.scene import F32, I32, Bool, Hits, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, spawn_origins

_AT_ONCE = 1 << 14  # density estimates, to bound memory
_FLATNESS = 5.0  # photons off the plane of a place are as far as others at this multiple of their height
_SAME_PLANE = 0.9  # cosine between the normals of a place and of its photons
_SAME_SIDE = 0.7  # cosine between the normals of a place and of the irradiance that stands for it
_SITES_PER_ESTIMATE = 16  # irradiance is kept where that many photons share those that it is estimated from
_PROBES = 16  # places where the kernel looks for its surface
_LIFT = 0.001  # segments that tell what a place sees run so far above the surface, in radii of the kernel
_ABOVE_PLANE = 0.49  # of the way of a probe, which crosses the plane at a half
_LEAST_COVERAGE = 1.0 / _PROBES
_LOPSIDED = 0.35  # radii from a place to the mean of its photons: four times what chance does to 80 of them


class Sites(NamedTuple):
    """Irradiance kept at some photons."""

    tree: kernels.PhotonTree
    irradiance: F32  #: (n_lights, n_sites, 3)
    radius: F32  #: (n_sites,) squared, of the estimate
    is_open: Bool  #: (n_sites,) whether the place sees all of the surface within that radius


class _Estimates(NamedTuple):
    irradiance: F32  #: (n_lights, n, 3)
    radius: F32  #: (n,) squared
    is_open: Bool  #: (n,)


@dataclass(frozen=True, eq=False)
class PhotonMap:
    """Photons that can be found by place, and irradiance kept at some of them."""

    snapshot: SceneSnapshot
    tracer: Tracer
    settings: PhotonSettings
    photons: Photons  #: in the order of `tree`
    tree: kernels.PhotonTree
    n_lights: int
    sites: Sites | None = None

    def estimate(self, position: F32, normal: F32) -> F32:
        """Irradiance by density of the photons about each place.

        Parameters
        ----------
        position, normal : (n, 3) float32
            Normals of the surface's plane, unit, on the lit side.

        Returns
        -------
        (n_lights, n, 3) float32
        """
        return self._estimates(position, normal).irradiance

    def irradiance(self, points: SurfacePoints) -> F32:
        """Irradiance kept at the nearest site of the same plane (Christensen 1999), (n_lights, n, 3).

        Where that is further than its own photons, or behind a wall, the density about the point is estimated.

        Raises
        ------
        ValueError
            The map was built without sites.
        """
        if self.sites is None:
            raise ValueError("this photon map keeps no irradiance; build it with sites")
        sites, n = self.sites, len(points.instance)
        if not len(sites.radius):
            return np.zeros((self.n_lights, n, 3), np.float32)
        index, distance = np.empty((n, 1), np.int32), np.empty((n, 1), np.float32)
        kernels.nearest_photons(
            sites.tree, points.position, points.normal, self._limit, _SAME_SIDE, _FLATNESS, index, distance,
            np.empty(n, np.float32),
        )  # fmt: skip
        site = index[:, 0]
        out: F32 = np.take(sites.irradiance, np.maximum(site, 0), axis=1)
        hit = points.instance >= 0
        near = hit & (site >= 0) & (distance[:, 0] <= sites.radius[site])
        closed = np.flatnonzero(near & ~sites.is_open[site])
        owner = site[closed]
        near[closed] = self._sees(
            points.position, points.normal, sites.radius[site], closed, sites.tree.position[owner],
            sites.tree.normal[owner],
        )  # fmt: skip
        out[:, ~hit] = 0
        alone = np.flatnonzero(hit & ~near)
        out[:, alone] = self.estimate(points.position[alone], points.normal[alone])
        return out

    @property
    def _limit(self) -> float:
        return self.settings.max_radius * float(self.snapshot.radius)

    def _estimates(self, position: F32, normal: F32) -> _Estimates:
        n = len(position)
        irradiance = np.zeros((self.n_lights, n, 3), np.float32)
        radius, is_open = np.full(n, self._limit**2, np.float32), np.ones(n, np.bool_)
        for first in range(0, n if len(self.photons.light) else 0, _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            here, up = np.ascontiguousarray(position[part]), np.ascontiguousarray(normal[part])
            irradiance[:, part], radius[part], is_open[part] = self._estimate(here, up, first)
        return _Estimates(irradiance, radius, is_open)

    def _estimate(self, position: F32, normal: F32, first: int) -> _Estimates:
        n, k = len(position), self.settings.n_nearest
        index, distance = np.empty((n, k), np.int32), np.empty((n, k), np.float32)
        radius = np.empty(n, np.float32)
        kernels.nearest_photons(
            self.tree, position, normal, self._limit, _SAME_PLANE, _FLATNESS, index, distance, radius
        )
        seed = int(hash_combine(hash_combine(self.settings.seed, 0xB0), first))
        coverage, clear = self._coverage(position, normal, radius, index[:, 0] >= 0, seed)
        # All of the kernel is seen nearly everywhere; elsewhere its photons must be seen as well.
        is_open = np.empty(n, np.bool_)
        kernels.lopsided(self.photons.position, position, index, radius, _LOPSIDED, is_open)
        is_open = ~is_open & clear
        visible = (index >= 0).astype(np.uint8)
        partly = np.flatnonzero(~is_open)
        row, column = np.nonzero(visible[partly])
        photon = index[partly[row], column]
        visible[partly[row], column] = self._sees(
            position, normal, radius, partly[row], self.photons.position[photon], self.photons.normal[photon]
        )
        out = np.zeros((self.n_lights, n, 3), np.float32)
        coverage = np.maximum(coverage, np.float32(_LEAST_COVERAGE))
        kernels.sum_photons(self.photons.power, self.photons.light, index, distance, radius, visible, coverage, out)
        return _Estimates(out, radius, is_open)

    def _coverage(self, position: F32, normal: F32, radius: F32, wanted: Bool, seed: int) -> tuple[F32, Bool]:
        """Share of each kernel that lies on the surface in sight, and whether nothing else is within it, (n,)."""
        coverage, clear = np.ones(len(position), np.float32), np.ones(len(position), np.bool_)
        rows = np.flatnonzero(wanted)
        m = len(rows) * _PROBES
        if not m:
            return coverage, clear
        origin, direction = np.empty((m, 3), np.float32), np.empty((m, 3), np.float32)
        kernels.probe_rays(position[rows], normal[rows], radius[rows], _PROBES, _FLATNESS, seed, origin, direction)
        owner = np.repeat(rows, _PROBES)
        on = np.zeros(m, np.bool_)
        # Again from just above the plane where something lies in between: below a rug the floor goes on.
        for begin in (0.0, _ABOVE_PLANE):
            left = np.flatnonzero(~on)
            start = origin[left] + np.float32(begin) * direction[left]
            along = np.float32(1.0 - begin) * direction[left]
            hits = self.tracer.intersect(start, along, 1.0)
            met = np.flatnonzero(hits.instance >= 0)
            surface = shade_hits(self.snapshot, Hits._make(column[met] for column in hits), along[met])
            same = np.einsum("ij,ij->i", surface.normal, normal[owner[left[met]]]) >= _SAME_PLANE
            met = left[met[same]]
            on[met] = self._sees(position, normal, radius, owner[met], surface.position[same], surface.normal[same])
            if begin == 0.0:
                clear[rows] = on.reshape(-1, _PROBES).all(axis=1)
        coverage[rows] = on.reshape(-1, _PROBES).mean(axis=1, dtype=np.float32)
        return coverage, clear

    def _sees(
        self, position: F32, normal: F32, radius: F32, rows: NDArray[np.int64], target: F32, target_normal: F32
    ) -> Bool:
        """Whether places `rows` see their targets along the surface."""
        lift = (np.float32(_LIFT) * np.sqrt(radius[rows]))[:, None]
        size = np.float32(self.snapshot.radius)
        start = spawn_origins(position[rows] + lift * normal[rows], normal[rows], normal[rows], size)
        stop = spawn_origins(target + lift * target_normal, target_normal, target_normal, size)
        return ~self.tracer.occluded(start, stop - start, 1.0)


def build_photon_map(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    photons: Photons,
    settings: PhotonSettings,
    *,
    sites: bool = False,
) -> PhotonMap:
    """Prepare density estimates among photons.

    Parameters
    ----------
    photons : Photons
        All that shall count: direct ones only where no shadow rays find direct light.
    sites : bool
        Whether to keep irradiance at some of the photons, for `PhotonMap.irradiance`.
    """
    order = _morton_order(photons.position, photons.normal)
    photons = photons.take(order)
    n_lights = len(snapshot.lights.kind)
    tree = _tree(photons.position, photons.normal)
    plain = PhotonMap(snapshot, tracer, settings, photons, tree, n_lights)
    if not sites:
        return plain
    # Every fourth photon, as in Christensen's paper, where estimates are of 64.
    stride = max(1, settings.n_nearest // _SITES_PER_ESTIMATE)
    position, normal = photons.position[::stride].copy(), photons.normal[::stride].copy()
    kept = Sites(_tree(position, normal), *plain._estimates(position, normal))
    return PhotonMap(snapshot, tracer, settings, photons, tree, n_lights, kept)


def indirect_photon_map(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    settings: PhotonSettings,
    *,
    sites: bool = True,
    progress: Progress = silent,
) -> PhotonMap:
    """Photon map of light that was reflected at least once: what adds to direct light from shadow rays."""
    photons = trace_photons(snapshot, tracer, build_light_sampler(snapshot), settings, progress=progress)
    return build_photon_map(snapshot, tracer, photons.take(photons.bounce > 0), settings, sites=sites)


def photon_cell_radiance(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    gather: GatherSamples,
    direct: F32,
    settings: PhotonSettings,
    *,
    progress: Progress = silent,
) -> F32:
    """Radiance that leaves the gather cells after one to `n_bounces` diffuse reflections; after the first, by photons.

    The same quantity as `transport.solve_bounces` gives, from light traced forwards: neither shares rays with the
    other.

    Parameters
    ----------
    direct : (n_lights, n_gather, 3) float32
        Reflected direct radiance, per light (`samples.cell_direct`).

    Returns
    -------
    (n_lights, n_gather, 3) float32

    Raises
    ------
    ValueError
        `direct` belongs to another gather set.
    """
    if direct.shape != (len(snapshot.lights.kind), gather.n, 3):
        raise ValueError(f"direct light of shape {direct.shape} for {gather.n} gather cells")
    out = direct.astype(np.float32, copy=True)
    if settings.n_bounces < 2:
        return out
    photon_map = indirect_photon_map(snapshot, tracer, settings, sites=False, progress=progress)
    progress("estimate irradiance", 0.0)
    arriving = photon_map.estimate(gather.points.position, gather.points.normal)
    albedo = np.empty((gather.n, 3), np.float32)
    mean_over_segments(gather.cell_begin, effective_albedo(gather.patch_points), albedo)
    out += arriving * (albedo / np.float32(np.pi))
    return out


def _tree(position: F32, normal: F32) -> kernels.PhotonTree:
    """Tree over points in Morton order."""
    n_leaves = 1 << max(-(-len(position) // kernels.LEAF) - 1, 0).bit_length()
    box = np.empty((2 * n_leaves, 12), np.float32)
    kernels.fill_boxes(position, normal, n_leaves, box)
    return kernels.PhotonTree(position, normal, box, n_leaves)


def _morton_order(position: F32, normal: F32) -> I32:
    """Order of points along a Morton curve, once for each of six directions."""
    code = np.empty(len(position), np.uint64)
    if not len(code):
        return np.zeros(0, np.int32)
    low, high = position.min(axis=0).astype(np.float64), position.max(axis=0).astype(np.float64)
    kernels.morton_codes(position, normal, low, 524288.0 / max(float((high - low).max()), 1e-30), code)
    return np.argsort(code, kind="stable").astype(np.int32)
