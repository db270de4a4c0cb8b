"""What rays of the specular lobe find of the lights, weighted against shadow rays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icheat_usd.kernels.direct import fill_specular_numbers, meet_analytic, mesh_pdfs, sum_rays
from icheat_usd.lighting.controls import hidden_instances, receives, shape, tracer_for, without
from icheat_usd.lighting.sampler import LightSampler
from icheat_usd.materials import evaluate_specular, is_glossy, sample_specular, shade_hits, take_points
from icheat_usd.materials.surface import nonzero_rows
from icheat_usd.scene import F32, F64, I64, Bool, DeltaKind, Hits, LightKind, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, spawn_points, transmittance
from icheat_usd.tracing.paths import passing_materials

# Rays in flight; as of shadow rays.
_RAYS = 1 << 18

# A shadow ray stops short of an analytic light by this share of its length: such lights are often
# authored in the plane of a ceiling, and they are not geometry that could stop it.
STOP_SHORT = np.float32(1.0 - 1e-4)

# Surfaces that a specular ray goes through in search of mesh lights behind them.
_LAYERS = 32


def is_delta(snapshot: SceneSnapshot, light: int) -> bool:
    """Whether a light shines from exactly one direction, which no ray finds by chance."""
    return bool(snapshot.lights.kind[light] == LightKind.DISTANT and snapshot.lights.size[light, 0] <= 0.0)


def power_heuristic(this: F64, other: F64) -> F32:
    """Weight (m, 1) of a technique with expected density `this` (Veach 1997, eq. 9.13)."""
    return np.asarray(this * this / (this * this + other * other), np.float32)[:, None]


def add_rays(values: F32, point: I64, out: F32) -> None:
    """Sum rays (m, 3), in the order of their points, into (n, 3)."""
    begin = np.searchsorted(point, np.arange(len(out) + 1))
    sum_rays(np.ascontiguousarray(values, np.float32), begin, out)


def add_specular_rays(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    sampler: LightSampler,
    points: SurfacePoints,
    to_eye: F32,
    draws: I64,
    seed: int,
    count: int,
    counts: list[int],
    out: F32,
) -> None:
    """Add what `count` rays of each point's specular lobe find, weighted against `counts` shadow rays of each light.

    `draws` (n, 2) as of `reflected_direct`; `out` (n_lights, n, 3).
    """
    lights = snapshot.lights
    glossy = np.flatnonzero(is_glossy(points))
    shapes = [i for i, kind in enumerate(lights.kind) if kind != LightKind.MESH and not is_delta(snapshot, i)]
    meshes = _mesh_lights(snapshot)
    if not len(glossy) or not (shapes or meshes):
        return
    step = max(1, _RAYS // count)
    for first in range(0, len(glossy), step):
        chosen = glossy[first : first + step]
        rays = _specular_rays(snapshot, points, to_eye, chosen, draws[chosen], seed, count)
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
                    snapshot, to_light, rays.origin[met], rays.direction[met], distance[met] * STOP_SHORT
                )
            share = power_heuristic(count * rays.pdf[met], counts[light] * pdf[met])
            value = rays.weight[met] * radiance[met] * visible * share
            if snapshot.controls(light).specular != 1.0:
                value *= np.float32(snapshot.controls(light).specular)
            sums = np.zeros((len(chosen), 3), np.float32)
            add_rays(value, rays.owner[met], sums)
            out[light, chosen] += sums
        for hidden, some in meshes:
            to_lights = without(snapshot, tracer, hidden)
            for light, owner, value in _mesh_hits(snapshot, to_lights, sampler, some, rays, count, counts):
                sums = np.zeros((len(chosen), 3), np.float32)
                add_rays(value, owner, sums)
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
    owner: I64  #: (m,) ascending: row of the chosen points
    points: SurfacePoints  #: (m,) where they start
    origin: F32  #: (m, 3) off the surface
    direction: F32  #: (m, 3) unit
    pdf: F64  #: (m,) per solid angle
    weight: F32  #: (m, 3) BRDF times cosine over pdf and number of rays


def _specular_rays(
    snapshot: SceneSnapshot, points: SurfacePoints, to_eye: F32, chosen: I64, draws: I64, seed: int, count: int
) -> _SpecularRays:
    numbers = np.empty((len(chosen) * count, 2), np.float32)
    fill_specular_numbers(draws, count, seed & 0xFFFFFFFF, numbers)
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
) -> list[tuple[int, I64, F32]]:
    """What specular rays bring from some mesh lights (n_lights,): light, owners (ascending) and values.

    Light that shadow rays get straight through glass and holes must be found here too, so a ray goes on
    behind what it hits as long as it might get through.
    """
    see_through = bool(passing_materials(snapshot.materials)[np.unique(snapshot.geometry.material)].any())
    found: list[tuple[int, I64, F32]] = []
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
    ray: I64,
    row: I64,
    hits: Hits,
    lit: I64,
    count: int,
    counts: list[int],
) -> list[tuple[int, I64, F32]]:
    lights = snapshot.lights
    starts, direction = take_points(rays.points, ray), np.ascontiguousarray(rays.direction[ray])
    ends = shade_hits(snapshot, Hits._make(column[lit] for column in hits), direction)
    light = sampler.emissive_light[row]
    pdf = np.zeros(len(row))
    mesh_pdfs(lights, sampler.tables, light, row, starts.position, ends.position, pdf)
    share = power_heuristic(count * rays.pdf[ray], np.array(counts)[light] * pdf)
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
