"""Painted masks on the surfaces of one scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from icheat_usd.edits.model import MaskedSurface, SurfaceMask
from icheat_usd.edits.painting import surface_texel_positions
from icheat_usd.errors import EditError
from icheat_usd.kernels import nearest as kernels
from icheat_usd.kernels.texels import bilinear_texels
from icheat_usd.scene import F32, F64, I32, I64, Finding, SceneSnapshot, Surface

#: Texel spacings by which a texel that faces the other way is further off (twice over).
_DETOUR = 2.0


@dataclass(frozen=True, eq=False)
class BoundMask:
    """Painted weights that know which instances of a scene they lie on."""

    texels: F32  #: (n_faces, resolution, resolution)
    first_face: I64  #: (n_instances,) first row of the instance's faces in `texels`, -1 where it has none
    findings: tuple[Finding, ...] = ()  #: surfaces that the weights were carried over to

    def at(self, instance: I32, face: I32, face_uv: F32) -> F32:
        """Weights (n,) in [0, 1] at places on control faces; 0 on surfaces that were not painted.

        Parameters
        ----------
        instance : (n,) rows of the scene's instances, at least 0
        face : (n,) control faces
        face_uv : (n, 2) places in them
        """
        first = np.take(self.first_face, instance)
        if (first >= 0).all():
            return texel_weights(self.texels, first + face, face_uv)
        painted = np.flatnonzero(first >= 0)
        weights = np.zeros(len(instance), np.float32)
        weights[painted] = texel_weights(
            self.texels, np.take(first, painted) + np.take(face, painted), np.take(face_uv, painted, axis=0)
        )
        return weights


def bind_mask(mask: SurfaceMask, snapshot: SceneSnapshot, where: str) -> BoundMask:
    """Find the painted surfaces in a scene.

    Parameters
    ----------
    where
        Whose mask it is, for messages.

    Raises
    ------
    EditError
        None of the surfaces is in the scene, or one has another topology than when it was painted and the mask does
        not tell where its faces lay.
    """
    begins = np.concatenate([[0], np.cumsum([surface.n_faces for surface in mask.surfaces])])
    rows = {(s.path, s.instance_id, s.part): (s, int(begins[i])) for i, s in enumerate(mask.surfaces)}
    first = np.full(len(snapshot.surfaces), -1, np.int64)
    texels, n_texels = [mask.texels], len(mask.texels)
    findings = []
    for i, surface in enumerate(snapshot.surfaces):
        masked, begin = rows.get((surface.path, surface.instance_id, surface.part), (None, -1))
        if masked is None or _same_topology(masked, surface):
            first[i] = begin
            continue
        some = slice(begin, begin + masked.n_faces)
        change = (
            f"its painted mask was made for another topology of {surface.path}"
            f" ({masked.n_faces} faces then, {surface.n_faces} now)"
        )
        if mask.rest is None:
            raise EditError(f"{where}: {change}; paint it again or mute the edit")
        texels.append(_carried_over(mask.texels[some], mask.rest[some], snapshot, i))
        first[i], n_texels = n_texels, n_texels + surface.n_faces
        findings.append(Finding(where, "painted mask", f"{change}; carried over by nearest surface, paint it again"))
    if (first < 0).all():
        raise EditError(
            f"{where}: its payload was made for another scene: none of its {len(mask.surfaces)} painted surfaces"
            f" (such as {mask.surfaces[0].path if mask.surfaces else '-'}) is in this one;"
            " point icheat:filePath at the right sidecar, or set rel icheat:anchor"
        )
    return BoundMask(np.concatenate(texels), first[snapshot.geometry.instance_surface], tuple(findings))


def _same_topology(masked: MaskedSurface, surface: Surface) -> bool:
    """Deformed meshes are the same; a mask that does not know the topology has but the number of faces to go by."""
    digest = masked.topology_digest or surface.topology_digest
    return digest == surface.topology_digest and masked.n_faces == surface.n_faces


def texel_weights(texels: F32, rows: I64, uv: F32) -> F32:
    """Bilinear weights (n,) at places (n, 2) of the faces in some rows of `texels`."""
    weights = np.empty(len(rows), np.float32)
    bilinear_texels(np.ascontiguousarray(texels), rows, np.ascontiguousarray(uv), weights)
    return weights


# --------------------------------------------------------------------------- another topology


def _carried_over(texels: F32, rest: F32, snapshot: SceneSnapshot, row: int) -> F32:
    """Weights of the nearest old texel for each texel of surface `row`: (its n_faces, resolution, resolution).

    "Nearest" counts a texel that faces away as further off, so that a thin
    wall does not take what was painted on its other side.
    """
    resolution = texels.shape[1]
    now = surface_texel_positions(snapshot, row, resolution)
    if not len(texels) or not now.size:
        return np.zeros(now.shape[:3], np.float32)
    then = _spread(rest.astype(np.float64), resolution)
    found = _nearest(then.reshape(-1, 3), _normals(then), now.reshape(-1, 3).astype(np.float64), _normals(now))
    return np.asarray(texels.reshape(-1)[found].reshape(now.shape[:3]))


def _spread(rest: F64, resolution: int) -> F64:
    """Texel centres of any resolution from those of resolution 2: exact on bilinear faces."""
    t = ((np.arange(resolution) + 0.5) / resolution - 0.25) / 0.5
    share = np.stack([1 - t, t], axis=1)
    return np.asarray(np.einsum("yj,xi,fjic->fyxc", share, share, rest))


def _normals(places: NDArray[np.floating]) -> F64:
    """One unit normal per texel, the same all over a face; 0 where the face has no area."""
    n_faces, resolution = places.shape[:2]
    if resolution < 2:
        return np.zeros((n_faces, 3))
    across = (places[:, :, -1] - places[:, :, 0]).sum(axis=1, dtype=np.float64)
    up = (places[:, -1] - places[:, 0]).sum(axis=1, dtype=np.float64)
    normals = np.cross(across, up)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    return np.repeat(normals, resolution * resolution, axis=0)


def _nearest(places: F64, normals: F64, queries: F64, query_normals: F64) -> I64:
    low, high = places.min(axis=0), places.max(axis=0)
    extent = float((high - low).max())
    spacing = max(extent / np.sqrt(len(places)), 1e-30)
    # A few cells for each place: most hold none, as places lie on a surface, and the others about a dozen.
    size = max(float(np.cbrt(np.maximum(high - low, spacing).prod() / (4 * len(places)))), spacing)
    dims = np.maximum(np.ceil((high - low) / size), 1).astype(np.int64)
    begin = np.zeros(int(dims.prod()) + 1, np.int64)
    cell, order = np.empty(len(places), np.int64), np.empty(len(places), np.int64)
    kernels.sort_into_cells(places, low, size, dims, cell, begin, order)
    found = np.empty(len(queries), np.int64)
    kernels.nearest_place(
        places, normals, low, size, dims, begin, order, (_DETOUR * spacing) ** 2, queries, query_normals, found
    )
    return found
