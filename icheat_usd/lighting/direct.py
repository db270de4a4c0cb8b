"""Direct light at surface points, per light, with visibility."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from icheat_usd.kernels.direct import (
    fill_analytic,
    fill_mesh,
    fill_specular_numbers,
    meet_analytic,
    mesh_pdfs,
    sum_rays,
)
from icheat_usd.lighting.controls import hidden_instances, lit_instances, receives, shape, tracer_for, without
from icheat_usd.lighting.sampler import LightSampler
from icheat_usd.materials import (
    evaluate,
    evaluate_specular,
    is_glossy,
    points_on_surface,
    sample_specular,
    shade_hits,
    take_points,
)
from icheat_usd.materials.surface import nonzero_rows
from icheat_usd.scene import F32, F64, Bool, DeltaKind, Hits, LightControls, LightKind, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, spawn_points, transmittance
from icheat_usd.tracing.paths import passing_materials

# Rays in flight: enough to keep every thread busy, few enough for some tens of megabytes.
_RAYS = 1 << 18

# A shadow ray stops short of an analytic light by this share of its length: such lights are often
# authored in the plane of a ceiling, and they are not geometry that could stop it.
_STOP_SHORT = np.float32(1.0 - 1e-4)

# Surfaces that a specular ray goes through in search of mesh lights behind them.
_LAYERS = 32


def irradiance(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    sampler: LightSampler,
    points: SurfacePoints,
    seed: int,
    n_samples: int | Sequence[int],
) -> F32:
    """Irradiance of every light at surface points, shadowed by the scene.

    Parameters
    ----------
    points : SurfacePoints of n points
        Those with ``instance == -1`` get zero.
    n_samples : int or one int per light
        Shadow rays per point and light; powers of two are stratified best. A distant light without
        an angle takes one.

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
    on (seed, point, light, sample) alone.

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
    n_samples: int | Sequence[int],
) -> F32:
    """Radiance that surface points reflect towards the eye, straight from each light.

    Parameters
    ----------
    to_eye : (n, 3) float32, unit

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
    out = _direct(snapshot, tracer, sampler, points, seed, n_samples, eye)
    counts = _counts(n_samples, len(snapshot.lights.kind))
    _add_specular_rays(snapshot, tracer, sampler, points, eye, seed, counts, out)
    return out


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


def _direct(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    sampler: LightSampler,
    points: SurfacePoints,
    seed: int,
    n_samples: int | Sequence[int],
    to_eye: F32 | None,
) -> F32:
    lights = snapshot.lights
    n = len(points.position)
    counts = _counts(n_samples, len(lights.kind))
    n_specular = _n_specular(counts)
    out = np.zeros((len(lights.kind), n, 3), np.float32)
    for light in np.flatnonzero(nonzero_rows(lights.radiance)).tolist():
        controls, to_light = snapshot.controls(light), tracer_for(snapshot, tracer, light)
        delta = _is_delta(snapshot, light)
        count = 1 if delta else counts[light]
        step = max(1, _RAYS // count)
        for first in range(0, n, step):
            part = slice(first, min(first + step, n))
            chunk = _part(points, part)
            rays = _shadow_rays(snapshot, sampler, chunk, light, first, count, seed, to_eye is None)
            if not len(rays.point):
                continue
            value = rays.radiance
            if to_eye is not None:
                shares = None if delta else (count, n_specular)
                value = value * _response(chunk, to_eye[part], rays, shares, controls)
                lit = np.flatnonzero(nonzero_rows(value))
                rays, value = rays.take(lit), value[lit]
            elif controls.diffuse != 1.0:
                value = value * np.float32(controls.diffuse)
            value = value * _visibility(snapshot, to_light, chunk, rays)
            _add(value, rays.point, out[light, part])
    return out


def _is_delta(snapshot: SceneSnapshot, light: int) -> bool:
    """Whether a light shines from exactly one direction, which no ray finds by chance."""
    return bool(snapshot.lights.kind[light] == LightKind.DISTANT and snapshot.lights.size[light, 0] <= 0.0)


def _n_specular(counts: list[int]) -> int:
    """Rays of the specular lobe per point, beside the shadow rays of each light; they serve all lights."""
    return max(1, max(counts, default=1) // 2)


def _power_heuristic(this: F64, other: F64) -> F32:
    """Weight (m, 1) of a technique with expected density `this` (Veach 1997, eq. 9.13)."""
    return np.asarray(this * this / (this * this + other * other), np.float32)[:, None]


def _add(values: F32, point: NDArray[np.int64], out: F32) -> None:
    """Sum rays (m, 3), in the order of their points, into (n, 3)."""
    begin = np.searchsorted(point, np.arange(len(out) + 1))
    sum_rays(np.ascontiguousarray(values, np.float32), begin, out)


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
        lobe *= _power_heuristic(shares[0] * of_rays, shares[1] * terms.pdf.astype(np.float64))
    value[glossy] += lobe
    return value


def _add_specular_rays(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    sampler: LightSampler,
    points: SurfacePoints,
    to_eye: F32,
    seed: int,
    counts: list[int],
    out: F32,
) -> None:
    """Add what rays of the specular lobe find, weighted against the shadow rays of `_direct`."""
    lights = snapshot.lights
    glossy = np.flatnonzero(is_glossy(points))
    shapes = [i for i, kind in enumerate(lights.kind) if kind != LightKind.MESH and not _is_delta(snapshot, i)]
    meshes = _mesh_lights(snapshot)
    if not len(glossy) or not (shapes or meshes):
        return
    count = _n_specular(counts)
    step = max(1, _RAYS // count)
    for first in range(0, len(glossy), step):
        chosen = glossy[first : first + step]
        rays = _specular_rays(snapshot, points, to_eye, chosen, seed, count)
        if not len(rays.owner):
            continue
        unblocked: dict[Tracer, F32] = {}
        for light in shapes:
            m, to_light = len(rays.owner), tracer_for(snapshot, tracer, light)
            distance, pdf, radiance = np.zeros(m, np.float32), np.zeros(m), np.zeros((m, 3), np.float32)
            place = (rays.points.position, rays.points.shading_normal, rays.direction)
            tables = lights, snapshot.textures, sampler.tables, sampler.guide
            meet_analytic(*tables, light, *place, distance, pdf, radiance)
            shape(snapshot, light, rays.direction, radiance)
            shines = nonzero_rows(radiance)
            lit = receives(snapshot, light, rays.points.instance)
            if lit is not None:
                shines &= lit
            if lights.kind[light] == LightKind.DOME:
                if to_light not in unblocked:
                    unblocked[to_light] = transmittance(snapshot, to_light, rays.origin, rays.direction, np.inf)
                met = np.flatnonzero(shines & nonzero_rows(unblocked[to_light]))
                visible = unblocked[to_light][met]
            else:
                met = np.flatnonzero(shines)
                visible = transmittance(
                    snapshot, to_light, rays.origin[met], rays.direction[met], distance[met] * _STOP_SHORT
                )
            share = _power_heuristic(count * rays.pdf[met], counts[light] * pdf[met])
            value = rays.weight[met] * radiance[met] * visible * share
            if snapshot.controls(light).specular != 1.0:
                value *= np.float32(snapshot.controls(light).specular)
            sums = np.zeros((len(chosen), 3), np.float32)
            _add(value, rays.owner[met], sums)
            out[light, chosen] += sums
        for hidden, some in meshes:
            to_lights = without(snapshot, tracer, hidden)
            for light, owner, value in _mesh_hits(snapshot, to_lights, sampler, some, rays, count, counts):
                sums = np.zeros((len(chosen), 3), np.float32)
                _add(value, owner, sums)
                out[light, chosen] += sums


def _mesh_lights(snapshot: SceneSnapshot) -> list[tuple[Bool | None, Bool]]:
    """Glowing meshes, (n_lights,), by what does not block them, (n_instances,)."""
    groups: dict[bytes, tuple[Bool | None, Bool]] = {}
    for light in np.flatnonzero(snapshot.lights.kind == LightKind.MESH).tolist():
        hidden = hidden_instances(snapshot, light)
        key = b"" if hidden is None else hidden.tobytes()
        group = groups.setdefault(key, (hidden, np.zeros(len(snapshot.lights.kind), np.bool_)))
        group[1][light] = True
    return list(groups.values())


class _SpecularRays(NamedTuple):
    owner: NDArray[np.int64]  #: (m,) ascending: row of the chosen points
    points: SurfacePoints  #: (m,) where they start
    origin: F32  #: (m, 3) off the surface
    direction: F32  #: (m, 3) unit
    pdf: F64  #: (m,) per solid angle
    weight: F32  #: (m, 3) BRDF times cosine over pdf and number of rays


def _specular_rays(
    snapshot: SceneSnapshot, points: SurfacePoints, to_eye: F32, chosen: NDArray[np.int64], seed: int, count: int
) -> _SpecularRays:
    numbers = np.empty((len(chosen) * count, 2), np.float32)
    fill_specular_numbers(chosen, count, seed & 0xFFFFFFFF, numbers)
    owner = np.repeat(np.arange(len(chosen)), count)
    starts, eye = take_points(points, chosen[owner]), to_eye[chosen[owner]]
    direction, base, edge = sample_specular(starts, eye, numbers)
    weight = (starts.specular * base[:, None] + starts.specular_edge * edge[:, None]) * np.float32(1.0 / count)
    alive = np.flatnonzero(nonzero_rows(weight))
    starts, direction = take_points(starts, alive), np.ascontiguousarray(direction[alive])
    pdf = evaluate_specular(starts, eye[alive], direction).pdf.astype(np.float64)
    return _SpecularRays(owner[alive], starts, spawn_points(snapshot, starts, direction), direction, pdf, weight[alive])


def _mesh_hits(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    sampler: LightSampler,
    some: Bool,
    rays: _SpecularRays,
    count: int,
    counts: list[int],
) -> list[tuple[int, NDArray[np.int64], F32]]:
    """What specular rays bring from some mesh lights (n_lights,): light, owners (ascending) and values.

    Light that shadow rays get straight through glass and holes must be found here too, so a ray goes on
    behind what it hits as long as it might get through.
    """
    see_through = bool(passing_materials(snapshot.materials)[np.unique(snapshot.geometry.material)].any())
    found: list[tuple[int, NDArray[np.int64], F32]] = []
    ray = np.arange(len(rays.owner))
    origin = rays.origin
    for _ in range(_LAYERS if see_through else 1):
        direction = np.ascontiguousarray(rays.direction[ray])
        hits = tracer.intersect(origin, direction)
        row = sampler.emissive_rows(hits.instance, hits.triangle)
        lit = np.flatnonzero(row >= 0)
        if not some.all():
            lit = lit[some[sampler.emissive_light[row[lit]]]]
        if len(lit):
            found += _weigh_mesh_hits(snapshot, tracer, sampler, rays, ray[lit], row[lit], hits, lit, count, counts)
        met = np.flatnonzero(hits.instance >= 0)
        if not see_through or not len(met):
            break
        surface = shade_hits(snapshot, Hits._make(column[met] for column in hits), direction[met])
        on = np.flatnonzero((surface.delta != DeltaKind.MIRROR) & (surface.opacity < 1.0))
        ray, surface = ray[met[on]], take_points(surface, on)
        if not len(ray):
            break
        origin = spawn_points(snapshot, surface, rays.direction[ray])
    return found


def _weigh_mesh_hits(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    sampler: LightSampler,
    rays: _SpecularRays,
    ray: NDArray[np.int64],
    row: NDArray[np.int64],
    hits: Hits,
    lit: NDArray[np.int64],
    count: int,
    counts: list[int],
) -> list[tuple[int, NDArray[np.int64], F32]]:
    lights = snapshot.lights
    starts, direction = take_points(rays.points, ray), np.ascontiguousarray(rays.direction[ray])
    ends = shade_hits(snapshot, Hits._make(column[lit] for column in hits), direction)
    light = sampler.emissive_light[row]
    pdf = np.zeros(len(row))
    mesh_pdfs(lights, sampler.tables, light, row, starts.position, ends.position, pdf)
    share = _power_heuristic(count * rays.pdf[ray], np.array(counts)[light] * pdf)
    value = rays.weight[ray] * ends.emission * lights.radiance[light] * share
    stop = spawn_points(snapshot, ends, -direction)
    start = rays.origin[ray]
    value = value * transmittance(snapshot, tracer, start, stop - start, 1.0)
    found = []
    for one in np.unique(light).tolist():
        mine = light == one
        received = receives(snapshot, one, starts.instance)
        if received is not None:
            mine &= received
        brought = value[mine]
        if snapshot.controls(one).specular != 1.0:
            brought *= np.float32(snapshot.controls(one).specular)
        found.append((one, rays.owner[ray[mine]], brought))
    return found


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
    surface = (chunk.position, chunk.normal, chunk.shading_normal, lit_instances(snapshot, light, chunk.instance))
    place = (*surface, first, count, seed & 0xFFFFFFFF, cosine)
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
        return transmittance(snapshot, tracer, start, rays.direction, rays.distance * _STOP_SHORT)
    # both ends stand on geometry: offset the far one as well, or a mesh light shadows itself
    stop = spawn_points(snapshot, rays.end, -rays.direction)
    return transmittance(snapshot, tracer, start, stop - start, 1.0)
