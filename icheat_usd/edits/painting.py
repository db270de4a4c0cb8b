"""Soft masks on surfaces, painted from a function of position."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from icheat_usd.edits.model import MaskedSurface, SurfaceMask
from icheat_usd.errors import EditError
from icheat_usd.kernels.texels import texel_positions
from icheat_usd.scene import F32, I64, SceneSnapshot

#: (n, 3) world positions in metres about the scene's centre -> (n,) weights.
Brush = Callable[[F32], F32]


def soft_sphere(centre: tuple[float, float, float], inner: float, outer: float) -> Brush:
    """Weight 1 within `inner` of `centre`, falling smoothly to 0 at `outer` (metres)."""
    if not 0 <= inner < outer:
        raise EditError(f"a soft sphere needs 0 <= inner < outer, got inner {inner} and outer {outer}")

    def weights(positions: F32) -> F32:
        distance = np.linalg.norm(positions - np.asarray(centre, np.float32), axis=1)
        x = np.clip((outer - distance) / (outer - inner), 0, 1)
        return (x * x * (3 - 2 * x)).astype(np.float32)

    return weights


def paint_mask(snapshot: SceneSnapshot, paths: Iterable[str], brush: Brush, *, resolution: int = 16) -> SurfaceMask:
    """Paint the surfaces at `paths` with `brush`.

    Weights are rounded to 1/255, which a sidecar keeps in one byte without loss.

    Parameters
    ----------
    paths : scene paths of surfaces
    resolution : int
        Texels along each side of a control face.

    Raises
    ------
    EditError
        None of the paths is a surface of the scene.
    """
    wanted = frozenset(paths)
    rows = [row for row, surface in enumerate(snapshot.surfaces) if surface.path in wanted]
    if not rows:
        raise EditError(f"nothing to paint: none of {sorted(wanted)} is a surface of {snapshot.stage_path}")
    texels = {row: _painted(snapshot, row, brush, resolution) for row in rows}
    # What the brush did not touch needs no mention; a mask that is empty still says where it was painted.
    touched = [row for row in rows if texels[row].any()] or rows
    return SurfaceMask(
        tuple(
            MaskedSurface(surface.path, surface.n_faces, surface.instance_id, surface.part, surface.topology_digest)
            for surface in (snapshot.surfaces[row] for row in touched)
        ),
        np.concatenate([texels[row] for row in touched]),
        np.concatenate([surface_texel_positions(snapshot, row, 2) for row in touched]),
    )


def _painted(snapshot: SceneSnapshot, row: int, brush: Brush, resolution: int) -> F32:
    """Weights on one surface, (n_faces, resolution, resolution)."""
    positions = surface_texel_positions(snapshot, row, resolution)
    for instance in np.flatnonzero(snapshot.geometry.instance_surface == row)[:1]:
        matrix = snapshot.geometry.instance_to_world[instance]
        positions = (positions @ matrix[:, :3].T + matrix[:, 3]).astype(np.float32)
    weights = np.clip(brush(positions.reshape(-1, 3)), 0, 1)
    return (np.round(weights * 255) / np.float32(255)).astype(np.float32).reshape(positions.shape[:3])


def surface_texel_positions(snapshot: SceneSnapshot, row: int, resolution: int, faces: I64 | None = None) -> F32:
    """Texel centres on control faces of one surface, (n_faces, resolution, resolution, 3) in object space.

    0 for a surface that nothing shows.

    Parameters
    ----------
    faces : (n,), optional
        Which of them, ascending; all if not given.
    """
    geometry = snapshot.geometry
    wanted = np.arange(snapshot.surfaces[row].n_faces) if faces is None else faces
    positions = np.zeros((len(wanted), resolution, resolution, 3), np.float32)
    for instance in np.flatnonzero(geometry.instance_surface == row)[:1]:
        mesh = geometry.instance_mesh[instance]
        triangles = np.arange(geometry.mesh_begin[mesh], geometry.mesh_begin[mesh + 1])
        if faces is not None:
            triangles = triangles[np.isin(geometry.face[triangles], faces)]
        face = geometry.face[triangles]
        order = np.argsort(face, kind="stable")
        begins = np.searchsorted(face[order], np.append(wanted, wanted[-1:] + 1)).astype(np.int64)
        points, uv = (np.ascontiguousarray(values[triangles[order]]) for values in (geometry.points, geometry.face_uv))
        texel_positions(begins, points, uv, resolution, positions)
    return positions
