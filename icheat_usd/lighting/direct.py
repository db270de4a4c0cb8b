"""Direct light at surface points, per light, with visibility."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icheat_usd.kernels.direct import fill_analytic, fill_mesh, sum_rays
from icheat_usd.lighting.sampler import LightSampler
from icheat_usd.materials import evaluate, points_on_surface
from icheat_usd.scene import F32, I64, LightKind, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, spawn_origins, transmittance

# Rays in flight: enough to keep every thread busy, few enough for some tens of megabytes.
_RAYS = 1 << 18

# A shadow ray stops short of an analytic light by this share of its length: such lights are often
# authored in the plane of a ceiling, and they are not geometry that could stop it.
_STOP_SHORT = np.float32(1.0 - 1e-4)


def irradiance(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    sampler: LightSampler,
    points: SurfacePoints,
    seed: int,
    n_samples: int,
) -> F32:
    """Irradiance of every light at surface points, shadowed by the scene.

    Parameters
    ----------
    points : SurfacePoints of n points
        Those with ``instance == -1`` get zero.
    n_samples : int
        Shadow rays per point and light; powers of two are stratified best. A distant light without
        an angle takes one.

    Returns
    -------
    (n_lights, n, 3) float32, irradiance: W/m^2 where radiance is in W/(m^2 sr)
        About the shading normal; light from below the geometric normal does not count.

    Notes
    -----
    Rectangles are sampled uniformly in solid angle [1]_, spheres in the cone they fill, cylinders over
    the side that is in sight, disks and mesh triangles by area, domes by their image or, without one,
    by the cosine. Random numbers depend on (seed, point, light, sample) alone.

    References
    ----------
    .. [1] Urena, Fajardo, King 2013, An area-preserving parametrization for spherical rectangles.
    """
    return _direct(snapshot, tracer, sampler, points, seed, n_samples, None)


def reflected_direct(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    sampler: LightSampler,
    points: SurfacePoints,
    to_eye: F32,
    seed: int,
    n_samples: int,
) -> F32:
    """Radiance that surface points reflect towards the eye, straight from each light.

    Parameters
    ----------
    to_eye : (n, 3) float32, unit

    Returns
    -------
    (n_lights, n, 3) float32, radiance, scene-linear
        Without the emission of the points themselves. Delta surfaces reflect nothing here.
    """
    eye = np.require(to_eye, np.float32, ("C", "W"))
    return _direct(snapshot, tracer, sampler, points, seed, n_samples, eye)


def _direct(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    sampler: LightSampler,
    points: SurfacePoints,
    seed: int,
    n_samples: int,
    to_eye: F32 | None,
) -> F32:
    lights = snapshot.lights
    n = len(points.position)
    out = np.zeros((len(lights.kind), n, 3), np.float32)
    for light, kind in enumerate(lights.kind):
        single = kind == LightKind.DISTANT and lights.size[light, 0] <= 0.0
        count = 1 if single else max(int(n_samples), 1)
        step = max(1, _RAYS // count)
        for first in range(0, n, step):
            part = slice(first, min(first + step, n))
            chunk = _take(points, part)
            rays = _shadow_rays(snapshot, sampler, chunk, light, first, count, seed, to_eye is None)
            if not len(rays.point):
                continue
            value = rays.radiance
            if to_eye is not None:
                value = value * evaluate(_take(chunk, rays.point), to_eye[part][rays.point], rays.direction)
                lit = np.flatnonzero(value.any(axis=1))
                rays, value = rays.take(lit), np.ascontiguousarray(value[lit])
            value = value * _visibility(snapshot, tracer, chunk, rays)
            begin = np.searchsorted(rays.point, np.arange(len(chunk.position) + 1))
            sum_rays(np.ascontiguousarray(value), begin, out[light, part])
    return out


@dataclass(frozen=True, eq=False)
class _ShadowRays:
    """Rays that can carry light, in the order of their points."""

    point: I64  #: (m,) row of the chunk
    direction: F32  #: (m, 3) unit
    distance: F32  #: (m,)
    pdf: F32  #: (m,) per solid angle
    radiance: F32  #: (m, 3) over pdf and number of samples
    end: F32 | None  #: (m, 3) point on geometry, for mesh lights
    end_normal: F32 | None  #: (m, 3) turned to the receiver

    def take(self, rows: I64) -> _ShadowRays:
        return _ShadowRays(
            self.point[rows],
            self.direction[rows],
            self.distance[rows],
            self.pdf[rows],
            self.radiance[rows],
            None if self.end is None else self.end[rows],
            None if self.end_normal is None else self.end_normal[rows],
        )


def _take(points: SurfacePoints, rows: slice | I64) -> SurfacePoints:
    return SurfacePoints._make(np.require(column[rows], None, ("C", "W")) for column in points)


def _shadow_rays(
    snapshot: SceneSnapshot,
    sampler: LightSampler,
    chunk: SurfacePoints,
    light: int,
    first: int,
    count: int,
    seed: int,
    cosine: bool,
) -> _ShadowRays:
    n = len(chunk.position) * count
    direction = np.zeros((n, 3), np.float32)
    distance = np.zeros(n, np.float32)
    pdf = np.zeros(n, np.float32)
    radiance = np.zeros((n, 3), np.float32)
    surface = (chunk.position, chunk.normal, chunk.shading_normal, chunk.instance)
    place = (*surface, first, count, seed & 0xFFFFFFFF, cosine)
    if snapshot.lights.kind[light] != LightKind.MESH:
        fill_analytic(
            snapshot.lights, snapshot.textures, sampler.tables, light, *place, direction, distance, pdf, radiance
        )
        rows = np.flatnonzero(radiance.any(axis=1))
        return _ShadowRays(rows // count, direction[rows], distance[rows], pdf[rows], radiance[rows], None, None)

    emissive = np.full(n, -1, np.int64)
    barycentric = np.zeros((n, 2), np.float32)
    end = np.zeros((n, 3), np.float32)
    end_normal = np.zeros((n, 3), np.float32)
    side = np.zeros(n, np.uint8)
    fill_mesh(
        snapshot.lights, sampler.tables, light, *place,
        direction, distance, pdf, radiance, emissive, barycentric, end, end_normal, side,
    )  # fmt: skip
    rows = np.flatnonzero(radiance.any(axis=1))
    textured = rows[sampler.tables.triangle_textured[emissive[rows]] > 0]
    if len(textured):
        triangles = emissive[textured]
        radiance[textured] *= points_on_surface(
            snapshot,
            snapshot.lights.triangle_instance[triangles],
            snapshot.lights.triangle[triangles],
            barycentric[textured],
            side[textured],
        ).emission
        rows = rows[radiance[rows].any(axis=1)]
    return _ShadowRays(
        rows // count, direction[rows], distance[rows], pdf[rows], radiance[rows], end[rows], end_normal[rows]
    )


def _visibility(snapshot: SceneSnapshot, tracer: Tracer, chunk: SurfacePoints, rays: _ShadowRays) -> F32:
    start = spawn_origins(chunk.position[rays.point], chunk.normal[rays.point], rays.direction)
    if rays.end is None or rays.end_normal is None:
        return transmittance(snapshot, tracer, start, rays.direction, rays.distance * _STOP_SHORT)
    # both ends stand on geometry: offset the far one as well, or a mesh light shadows itself
    stop = spawn_origins(rays.end, rays.end_normal, -rays.direction)
    segment = np.ascontiguousarray(stop - start)
    return transmittance(snapshot, tracer, start, segment, np.ones(len(segment), np.float32))
