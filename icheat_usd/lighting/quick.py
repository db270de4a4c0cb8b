"""Direct light at fixed places from lights that move: what is kept for the places, and one light at them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from icheat_usd.kernels.bsdf import LEAST_ALPHA
from icheat_usd.kernels.see_through import cross_layers
from icheat_usd.kernels.shadow import light_places
from icheat_usd.lighting.points import light_points
from icheat_usd.materials import is_glossy
from icheat_usd.scene import F32, I32, I64, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import build_tracer, spawn_points
from icheat_usd.tracing.embree import EmbreeTracer
from icheat_usd.tracing.paths import passing_materials


@dataclass(frozen=True, eq=False)
class Shadows:
    """Tracers for shadow rays that need no look at the surfaces they meet: opaque ones apart from all others."""

    opaque: EmbreeTracer
    passing: EmbreeTracer | None  #: triangles that may let light through; None: there are none

    def crossing(self, snapshot: SceneSnapshot, origin: F32, direction: F32, limit: float) -> F32:
        """Share of light (n,) that crosses the see-through triangles up to `limit`; see `tracing.transmittance`."""
        out = np.ones(len(origin), np.float32)
        if self.passing is not None:
            function, scene = self.passing.address_of("rtcIntersect1")
            geometry = snapshot.geometry
            cross_layers(
                function,
                scene,
                geometry.mesh_begin,
                geometry.instance_mesh,
                geometry,
                snapshot.materials,
                snapshot.textures,
                np.ascontiguousarray(origin, np.float32),
                np.ascontiguousarray(direction, np.float32),
                limit,
                out,
            )
        return out


def build_shadows(snapshot: SceneSnapshot, tracer: EmbreeTracer) -> Shadows:
    """Tracers of the opaque and of the other triangles; `tracer` itself where all are opaque."""
    passes = passing_materials(snapshot.materials)[snapshot.geometry.material]
    if not passes.any():
        return Shadows(tracer, None)
    return Shadows(_tracer_of(snapshot, ~passes), _tracer_of(snapshot, passes))


def _tracer_of(snapshot: SceneSnapshot, kept: np.ndarray) -> EmbreeTracer:
    """Tracer of some triangles; the others shrink to points, which no ray meets, so that all keep their numbers."""
    points = snapshot.geometry.points.copy()
    points[~kept] = points[~kept][:, :1]
    tracer = build_tracer(replace(snapshot, geometry=snapshot.geometry._replace(points=points)))
    assert isinstance(tracer, EmbreeTracer)
    return tracer


@dataclass(frozen=True, eq=False)
class Places:
    """Surface points made ready for `direct_at`."""

    row: I32  #: (n,) point of each place
    place: F32  #: (n, 9), see `kernels.shadow.light_places`
    tint: F32  #: (n, 3)
    gloss: F32  #: (n, 12), or (0, 12) where no lobe is wanted


def prepare_places(
    snapshot: SceneSnapshot, points: SurfacePoints, albedo: F32, to_eye: F32 | None, order: I64 | None = None
) -> Places:
    """Gather what does not depend on lights.

    Parameters
    ----------
    albedo : (n, 3), 0 for points that reflect nothing
    to_eye : (n, 3), unit; None: diffuse reflection alone
    """
    place = np.concatenate([spawn_points(snapshot, points, points.normal), points.normal, points.shading_normal], 1)
    place[points.instance < 0] = 0.0
    tint = albedo / np.float32(np.pi)
    gloss = np.zeros((0, 12), np.float32)
    if to_eye is not None and is_glossy(points).any():
        gloss = _lobes(points, to_eye)
    row = np.arange(len(place), dtype=np.int32) if order is None else order.astype(np.int32)
    if order is not None:
        place, tint = place[order], tint[order]
        gloss = gloss[order] if len(gloss) else gloss
    return Places(row, *(np.ascontiguousarray(table, np.float32) for table in (place, tint, gloss)))


def _lobes(points: SurfacePoints, to_eye: F32) -> F32:
    glossy = is_glossy(points)
    alpha = np.maximum(points.roughness.astype(np.float64) ** 2, LEAST_ALPHA)
    cosine = np.maximum(np.einsum("ij,ij->i", points.shading_normal, to_eye, dtype=np.float64), 1e-4)
    square = np.minimum(cosine * cosine, 1.0)
    smith = 0.5 * (np.sqrt(1.0 + alpha * alpha * (1.0 - square) / square) - 1.0)
    scalars = np.stack([alpha * glossy, cosine, smith], axis=1)
    table = np.concatenate([points.specular, points.specular_edge, scalars, to_eye], axis=1).astype(np.float32)
    table[~glossy, :7] = 0.0
    return table


def direct_at(
    snapshot: SceneSnapshot, shadows: Shadows, places: Places, seed: int, share_rays: bool, out: F32, turn: int = 0
) -> None:
    """Light of a one-light snapshot that places reflect, one shadow ray each, into `out` (n, 3) in the points' order.

    The mean over turns 0, 1, 2, ... converges: every turn looks at other points of the light.
    Kinds with a surface of their own and distant lights only. Surfaces that let light through dim it as for all
    shadow rays.
    """
    table, distant = light_points(snapshot, seed)
    through = np.empty(len(places.place), np.int32)
    function, opaque = shadows.opaque.address_of("rtcOccluded16")
    passing = 0 if shadows.passing is None else shadows.passing.address_of("rtcOccluded16")[1]
    tables = places.place, places.tint, places.gloss
    similar = shadows.opaque.compiled().arguments if share_rays else 0
    light_places(
        function, similar, opaque, passing, table, distant, seed, turn, *tables, share_rays, places.row, out, through
    )
    if shadows.passing is not None:
        rows = np.flatnonzero(through)
        origin, end = places.place[rows, :3], table[through[rows] - 1, :3]
        direction, limit = (end, np.inf) if distant else (end - origin, 1.0 - 1e-4)
        out[places.row[rows]] *= shadows.crossing(snapshot, origin, direction, limit)[:, None]
