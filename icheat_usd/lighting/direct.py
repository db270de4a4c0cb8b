"""Direct light at surface points, per light, with visibility."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from icheat_usd.kernels.direct import fill_analytic, fill_mesh
from icheat_usd.kernels.shadowed import Weights, add_shadowed
from icheat_usd.lighting.controls import lit_instances, shape, tracer_for
from icheat_usd.lighting.sampler import LightSampler
from icheat_usd.lighting.specular_rays import STOP_SHORT, add_rays, add_specular_rays, is_delta, power_heuristic
from icheat_usd.materials import evaluate, evaluate_specular, is_glossy, points_on_surface, take_points
from icheat_usd.materials.surface import nonzero_rows
from icheat_usd.scene import F32, I64, LightControls, LightKind, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, spawn_points, transmittance
from icheat_usd.tracing.paths import is_see_through

# Rays in flight: enough to keep every thread busy, few enough for some tens of megabytes.
_RAYS = 1 << 18


def irradiance(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    sampler: LightSampler,
    points: SurfacePoints,
    seed: int,
    n_samples: int | Sequence[int],
    sequence: I64 | None = None,
) -> F32:
    """Irradiance of every light at surface points, shadowed by the scene.

    Parameters
    ----------
    points : SurfacePoints of n points
        Those with ``instance == -1`` get zero.
    n_samples : int or one int per light
        Shadow rays per point and light; powers of two are stratified best. A distant light without
        an angle takes one.
    sequence : (n, 2) int64, optional
        Which sequence of random numbers each point draws from, and how many points draw from it before;
        one for each point by default.

    Returns
    -------
    (n_lights, n, 3) float32, irradiance: W/m^2 where radiance is in W/(m^2 sr)
        About the shading normal; light from below the geometric normal does not count. It is what diffuse
        responses see: each light's `diffuse` is a factor, and lights shine on their receivers alone.

    Notes
    -----
    Rectangles are sampled uniformly in solid angle [1]_, spheres in the cone they fill, cylinders over
    the side that is in sight, disks and mesh triangles by area, domes by their image or, without one,
    by the cosine, and by what the sampler's guide has learnt of their visibility. Random numbers depend
    on (seed, sequence, light, sample) alone.

    References
    ----------
    .. [1] Urena, Fajardo, King 2013, An area-preserving parametrization for spherical rectangles.
    """
    counts = _counts(n_samples, len(snapshot.lights.kind))
    return _direct(snapshot, tracer, sampler, points, seed, counts, None, 1, sequence)


def reflected_direct(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    sampler: LightSampler,
    points: SurfacePoints,
    to_eye: F32,
    seed: int,
    n_samples: int | Sequence[int],
    sequence: I64 | None = None,
) -> F32:
    """Radiance that surface points reflect towards the eye, straight from each light.

    Parameters
    ----------
    to_eye : (n, 3) float32, unit
    sequence : (n, 2) int64, optional
        As for `irradiance`.

    Returns
    -------
    (n_lights, n, 3) float32, radiance, scene-linear
        Without the emission of the points themselves. Delta surfaces reflect nothing here.

    Notes
    -----
    The diffuse lobe is sampled by `n_samples` shadow rays per light. The specular lobe shares those with
    half the largest `n_samples` (at least one) rays of its own per point, which look for every light,
    analytic ones included; the two are joined by the power heuristic [1]_. A distant light without an angle is found by
    its shadow ray alone. Glass dims light without bending it, as for all shadow rays.

    References
    ----------
    .. [1] Veach 1997, Robust Monte Carlo Methods for Light Transport Simulation, section 9.2.
    """
    eye = np.require(to_eye, np.float32, ("C", "W"))
    counts = _counts(n_samples, len(snapshot.lights.kind))
    n_specular = specular_count(counts)
    sequence = own_draws(0, len(points.instance)) if sequence is None else sequence
    out = _direct(snapshot, tracer, sampler, points, seed, counts, eye, n_specular, sequence)
    draws = sequence * np.array([1, n_specular])
    add_specular_rays(snapshot, tracer, sampler, points, eye, draws, seed, n_specular, counts, out)
    return out


def own_draws(first: int, end: int) -> I64:
    """Random numbers for points from number `first` to `end`, a sequence for each; (n, 2): sequence and place in it."""
    draws = np.zeros((end - first, 2), np.int64)
    draws[:, 0] = np.arange(first, end)
    return draws


def samples_per_light(snapshot: SceneSnapshot, light_samples: int, dome_samples: int | None) -> list[int]:
    """Shadow rays for each light: domes get `dome_samples`, or four times `light_samples` where that is None.

    A dome is the light with most to miss: all of the sky, behind anything.
    """
    of_dome = 4 * light_samples if dome_samples is None else dome_samples
    return [of_dome if kind == LightKind.DOME else light_samples for kind in snapshot.lights.kind.tolist()]


def _counts(n_samples: int | Sequence[int], n_lights: int) -> list[int]:
    """Shadow rays of each light, at least one.

    Raises
    ------
    ValueError
        A sequence has not one entry per light.
    """
    counts = list(n_samples) if isinstance(n_samples, Sequence) else [int(n_samples)] * n_lights
    if len(counts) != n_lights:
        raise ValueError(f"{len(counts)} sample counts for {n_lights} lights; give one for each, or a single number")
    return [max(int(count), 1) for count in counts]


def specular_count(counts: Sequence[int]) -> int:
    """Rays of the specular lobe per point, beside shadow rays of each light; they serve all lights."""
    return max(1, max(counts, default=1) // 2)


def _direct(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    sampler: LightSampler,
    points: SurfacePoints,
    seed: int,
    counts: Sequence[int],
    to_eye: F32 | None,
    n_specular: int,
    sequence: I64 | None = None,
) -> F32:
    lights = snapshot.lights
    n = len(points.instance)
    out = np.zeros((len(lights.kind), n, 3), np.float32)
    sequence = own_draws(0, n) if sequence is None else sequence
    for light in np.flatnonzero(nonzero_rows(lights.radiance)).tolist():
        count = 1 if is_delta(snapshot, light) else counts[light]
        draws = sequence * np.array([1, count])
        add_shadow_rays(
            snapshot, tracer, sampler, points, to_eye, light, draws, seed, count, (count, n_specular), out[light]
        )
    return out


def add_shadow_rays(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    sampler: LightSampler,
    points: SurfacePoints,
    to_eye: F32 | None,
    light: int,
    draws: I64,
    seed: int,
    count: int,
    shares: tuple[int, int],
    out: F32,
    extremes: F32 | None = None,
) -> None:
    """Add what one light brings to each point along `count` shadow rays.

    Parameters
    ----------
    to_eye : (n, 3) float32, optional
        Radiance towards there is added; irradiance where it is None.
    draws : (n, 2) int64
        Which sequence of random numbers each point draws from, and the number in it of its first ray.
    shares : (int, int)
        How many shadow and specular rays a point has in all, by which the specular lobe is weighted.
    out : (n, 3) float32
    extremes : (n, 2) float32, optional
        Lowered and raised to the least and the largest irradiance that a ray brings, of points that face the light.
    """
    controls, to_light = snapshot.controls(light), tracer_for(snapshot, tracer, light)
    if _add_in_one_pass(snapshot, to_light, sampler, points, to_eye, light, draws, seed, count, shares, out, extremes):
        return
    step = max(1, _RAYS // count)
    n = len(points.instance)
    for first in range(0, n, step):
        part = slice(first, min(first + step, n))
        chunk = _part(points, part)
        rays = _shadow_rays(snapshot, sampler, chunk, light, draws[part], count, seed, to_eye is None)
        if not len(rays.point):
            continue
        value = rays.radiance
        if to_eye is not None:
            known = None if is_delta(snapshot, light) else shares
            value = value * _response(chunk, to_eye[part], rays, known, controls)
            lit = np.flatnonzero(nonzero_rows(value))
            rays, value = rays.take(lit), value[lit]
        elif controls.diffuse != 1.0:
            value = value * np.float32(controls.diffuse)
        passed = _visibility(snapshot, to_light, chunk, rays)
        if extremes is not None and len(rays.point):
            _note_extremes(chunk, rays, passed, extremes[part])
        add_rays(value * passed, rays.point, out[part])


def _add_in_one_pass(
    snapshot: SceneSnapshot,
    to_light: Tracer,
    sampler: LightSampler,
    points: SurfacePoints,
    to_eye: F32 | None,
    light: int,
    draws: I64,
    seed: int,
    count: int,
    shares: tuple[int, int],
    out: F32,
    extremes: F32 | None,
) -> bool:
    """`add_shadow_rays` of a light without a mesh or shaping, in a scene that no light gets through, if it is that."""
    controls, trace = snapshot.controls(light), to_light.compiled_shadows()
    lights = snapshot.lights
    if (
        trace is None
        or lights.kind[light] == LightKind.MESH
        or controls.shaping is not None
        or is_see_through(snapshot)
    ):
        return False
    points = _part(points, slice(None))
    n_specular = 0.0 if is_delta(snapshot, light) else float(shares[1])
    weights = Weights(
        float(shares[0]), n_specular, float(controls.diffuse), float(controls.specular), float(STOP_SHORT)
    )
    eye = np.empty((0, 3), np.float32) if to_eye is None else np.require(to_eye, np.float32, ["C", "W"])
    add_shadowed(
        trace,
        lights,
        snapshot.textures,
        sampler.tables,
        sampler.guide,
        light,
        points,
        lit_instances(snapshot, light, points.instance),
        spawn_points(snapshot, points, points.normal),
        eye,
        draws,
        count,
        seed & 0xFFFFFFFF,
        weights,
        out,
        np.empty((0, 2), np.float32) if extremes is None else extremes,
    )
    return True


def _note_extremes(chunk: SurfacePoints, rays: _ShadowRays, passed: F32, extremes: F32) -> None:
    cosine = np.einsum("ij,ij->i", chunk.shading_normal[rays.point], rays.direction)
    brought = (rays.radiance * passed).max(axis=1) * cosine
    begin = np.flatnonzero(np.diff(rays.point, prepend=-1))
    point = rays.point[begin]
    extremes[point, 0] = np.minimum(extremes[point, 0], np.minimum.reduceat(brought, begin))
    extremes[point, 1] = np.maximum(extremes[point, 1], np.maximum.reduceat(brought, begin))


def _response(
    chunk: SurfacePoints, to_eye: F32, rays: _ShadowRays, shares: tuple[int, int] | None, controls: LightControls
) -> F32:
    """BRDF times cosine; the specular part weighted by the numbers of shadow and specular rays if there are both."""
    points, eye = take_points(chunk, rays.point), to_eye[rays.point]
    glossy = np.flatnonzero(is_glossy(points))
    is_even = controls.diffuse == controls.specular == 1.0
    if is_even and (shares is None or not len(glossy)):
        return evaluate(points, eye, rays.direction)
    none = np.zeros_like(points.specular)
    diffuse = points._replace(specular=none, specular_edge=none)
    value = evaluate(diffuse, eye, rays.direction)
    if not is_even:
        value *= np.float32(controls.diffuse)
    points = take_points(points, glossy)
    terms = evaluate_specular(points, eye[glossy], rays.direction[glossy])
    lobe = points.specular * terms.base[:, None] + points.specular_edge * terms.edge[:, None]
    if not is_even:
        lobe *= np.float32(controls.specular)
    if shares is not None:
        of_rays = rays.pdf[glossy].astype(np.float64)
        lobe *= power_heuristic(shares[0] * of_rays, shares[1] * terms.pdf.astype(np.float64))
    value[glossy] += lobe
    return value


@dataclass(frozen=True, eq=False)
class _ShadowRays:
    """Rays that can carry light, in the order of their points."""

    point: NDArray[np.int64]  #: (m,) row of the chunk
    direction: F32  #: (m, 3) unit
    distance: F32  #: (m,)
    pdf: F32  #: (m,) per solid angle
    radiance: F32  #: (m, 3) over pdf and number of samples
    end: SurfacePoints | None  #: (m,) on geometry, for mesh lights

    def take(self, rows: NDArray[np.int64]) -> _ShadowRays:
        return _ShadowRays(
            self.point[rows],
            self.direction[rows],
            self.distance[rows],
            self.pdf[rows],
            self.radiance[rows],
            None if self.end is None else take_points(self.end, rows),
        )


def _part(points: SurfacePoints, part: slice) -> SurfacePoints:
    return SurfacePoints._make(np.require(column[part], None, ("C", "W")) for column in points)


def _shadow_rays(
    snapshot: SceneSnapshot,
    sampler: LightSampler,
    chunk: SurfacePoints,
    light: int,
    draws: I64,
    count: int,
    seed: int,
    cosine: bool,
) -> _ShadowRays:
    n = len(chunk.position) * count
    direction = np.zeros((n, 3), np.float32)
    distance = np.zeros(n, np.float32)
    pdf = np.zeros(n, np.float32)
    radiance = np.zeros((n, 3), np.float32)
    surface = (chunk.position, chunk.normal, chunk.shading_normal, lit_instances(snapshot, light, chunk.instance))
    place = (*surface, draws, count, seed & 0xFFFFFFFF, cosine)
    if snapshot.lights.kind[light] != LightKind.MESH:
        fill_analytic(
            snapshot.lights,
            snapshot.textures,
            sampler.tables,
            sampler.guide,
            light,
            *place,
            direction,
            distance,
            pdf,
            radiance,
        )
        shape(snapshot, light, direction, radiance)
        rows = np.flatnonzero(nonzero_rows(radiance))
        return _ShadowRays(rows // count, direction[rows], distance[rows], pdf[rows], radiance[rows], None)

    emissive = np.full(n, -1, np.int64)
    barycentric = np.zeros((n, 2), np.float32)
    fill_mesh(
        snapshot.lights, sampler.tables, light, *place, direction, distance, pdf, radiance, emissive, barycentric
    )  # fmt: skip
    rows = np.flatnonzero(nonzero_rows(radiance))
    triangles = emissive[rows]
    owner, triangle = snapshot.lights.triangle_instance[triangles], snapshot.lights.triangle[triangles]
    end = points_on_surface(snapshot, owner, triangle, barycentric[rows], 0)  # both sides emit alike
    rays = _ShadowRays(rows // count, direction[rows], distance[rows], pdf[rows], radiance[rows] * end.emission, end)
    dark = ~nonzero_rows(rays.radiance)
    return rays.take(np.flatnonzero(~dark)) if dark.any() else rays


def _visibility(snapshot: SceneSnapshot, tracer: Tracer, chunk: SurfacePoints, rays: _ShadowRays) -> F32:
    # every ray leaves above the geometric normal, so one origin per point serves
    start = spawn_points(snapshot, chunk, chunk.normal)[rays.point]
    if rays.end is None:
        return transmittance(snapshot, tracer, start, rays.direction, rays.distance * STOP_SHORT)
    # both ends stand on geometry: offset the far one as well, or a mesh light shadows itself
    stop = spawn_points(snapshot, rays.end, -rays.direction)
    return transmittance(snapshot, tracer, start, stop - start, 1.0)
