"""Places on faces: taken from surface points, and found again on a scene at another time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icheat_usd.edits.encodings.sampled import UV_STEPS, Places
from icheat_usd.edits.model import MaskedSurface
from icheat_usd.kernels import row_sites
from icheat_usd.materials import points_on_surface
from icheat_usd.scene import F32, F64, I32, Finding, SceneSnapshot, SurfacePoints

FEATURE = "icheat:payload"


class FoundPlaces(NamedTuple):
    """Where places lie on a scene."""

    points: SurfacePoints  #: (n,) instance -1 where the surface is gone
    findings: tuple[Finding, ...]


def instance_scale(snapshot: SceneSnapshot) -> F64:
    """Cube root of each instance's change of volume, (n_instances,): world metres per unit of object space."""
    linear = snapshot.geometry.instance_to_world[:, :, :3].astype(np.float64)
    return np.cbrt(np.abs(np.linalg.det(linear))) if len(linear) else np.zeros(0)


def object_positions(snapshot: SceneSnapshot, points: SurfacePoints) -> F32:
    """Positions in the object space of each point's instance, (n, 3)."""
    to_object = snapshot.geometry.instance_to_object[points.instance]
    return np.einsum("nij,nj->ni", to_object[:, :, :3], points.position) + to_object[:, :, 3]


def masked_surface(snapshot: SceneSnapshot, surface: int) -> MaskedSurface:
    """What names a surface of a scene in a payload."""
    s = snapshot.surfaces[surface]
    return MaskedSurface(s.path, s.n_faces, s.instance_id, s.part, s.topology_digest)


def make_places(points: SurfacePoints, position: F32, surface: I32, bounds: F32) -> Places:
    """Places of surface points.

    Parameters
    ----------
    position : (n, 3) object space
    surface : (n,) row of `bounds`
    bounds : (n_surfaces, 2, 3)
    """
    low, extent = bounds[surface, 0], bounds[surface, 1] - bounds[surface, 0]
    share = np.divide(position - low, extent, out=np.zeros_like(position), where=extent > 0)
    return Places(
        surface.astype(np.int32),
        points.side.astype(np.uint8),
        points.face.astype(np.int32),
        np.rint(np.clip(points.face_uv, 0, 1) * UV_STEPS).astype(np.uint16),
        np.rint(np.clip(share, 0, 1) * UV_STEPS).astype(np.uint16),
    )


def instances_of(surfaces: tuple[MaskedSurface, ...], snapshot: SceneSnapshot) -> I32:
    """Instance of each stored surface in the scene, -1 where it is not there."""
    scene = {(s.path, s.instance_id, s.part): i for i, s in enumerate(snapshot.surfaces)}
    instance_of = np.full(len(snapshot.surfaces) + 1, -1, np.int32)
    owners = snapshot.geometry.instance_surface
    instance_of[owners[::-1]] = np.arange(len(owners), dtype=np.int32)[::-1]
    found = [scene.get((s.path, s.instance_id, s.part), -1) for s in surfaces]
    return instance_of[np.array(found, np.int64)] if found else np.zeros(0, np.int32)


def find_places(
    places: Places, surfaces: tuple[MaskedSurface, ...], bounds: F32, snapshot: SceneSnapshot, where: str
) -> FoundPlaces:
    """Find places on a scene, by face where the mesh is the same, else by the nearest point of the surface.

    Parameters
    ----------
    where
        Path of the edit, for findings.
    """
    instance_of = instances_of(surfaces, snapshot)
    geometry = snapshot.geometry
    n = len(places.surface)
    instance = instance_of[places.surface] if n else np.zeros(0, np.int32)
    triangle = np.full(n, -1, np.int32)
    weight = np.zeros((n, 2), np.float64)
    gone, changed = [], []
    order = np.argsort(places.surface, kind="stable")
    begins = np.searchsorted(places.surface[order], np.arange(len(surfaces) + 1))
    for s, surface in enumerate(surfaces):
        which = order[begins[s] : begins[s + 1]]
        if instance_of[s] < 0:
            gone.append(surface.path)
            continue
        if len(which) == 0:
            continue
        mesh = geometry.instance_mesh[instance_of[s]]
        first, last = int(geometry.mesh_begin[mesh]), int(geometry.mesh_begin[mesh + 1])
        now = snapshot.surfaces[geometry.instance_surface[instance_of[s]]]
        found = np.empty(len(which), np.int32)
        at = np.empty((len(which), 2), np.float64)
        if now.n_faces == surface.n_faces and surface.topology_digest in ("", now.topology_digest):
            face = geometry.face[first:last]
            by_face = np.argsort(face, kind="stable")
            begin = np.searchsorted(face[by_face], np.arange(surface.n_faces + 1))
            uv = places.face_uv[which].astype(np.float64) / UV_STEPS
            row_sites.triangles_of_places(
                geometry.face_uv, first, begin, by_face, places.face[which].astype(np.int64), uv, found, at
            )
            # A face without area has no triangle.
            lost = np.flatnonzero(found < 0)
        else:
            changed.append(surface.path)
            lost = np.arange(len(which))
        if len(lost):
            share = places.position[which[lost]].astype(np.float64) / UV_STEPS
            position = bounds[s, 0] + share * (bounds[s, 1] - bounds[s, 0])
            near, near_at = np.empty(len(lost), np.int32), np.empty((len(lost), 2), np.float64)
            row_sites.nearest_on_triangles(geometry.points[first:last], position.astype(np.float32), near, near_at)
            found[lost], at[lost] = first + near, near_at
        triangle[which], weight[which] = found, at
    points = points_on_surface(snapshot, instance, triangle, weight.astype(np.float32), places.side)
    return FoundPlaces(points, (*_gone(gone, where), *_changed(changed, where)))


def _gone(paths: list[str], where: str) -> tuple[Finding, ...]:
    if not paths:
        return ()
    text = f"its baked rows name {_listed(paths)}, not in this scene; there it changes nothing: bake it again"
    return (Finding(where, FEATURE, text),)


def _changed(paths: list[str], where: str) -> tuple[Finding, ...]:
    if not paths:
        return ()
    text = (
        f"the topology of {_listed(paths)} has changed since its rows were baked; they were put where they lay then,"
        " on the nearest surface: look at the image, or bake it again"
    )
    return (Finding(where, FEATURE, text),)


def _listed(paths: list[str]) -> str:
    paths = list(dict.fromkeys(paths))
    return ", ".join(paths[:3]) + (f" and {len(paths) - 3} more" if len(paths) > 3 else "")
