"""Painted masks on the surfaces of one scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icheat_usd.edits.model import SurfaceMask
from icheat_usd.errors import EditError
from icheat_usd.scene import F32, I32, I64, SceneSnapshot


@dataclass(frozen=True, eq=False)
class BoundMask:
    """Painted weights that know which instances of a scene they lie on."""

    texels: F32  #: (n_faces, resolution, resolution)
    first_face: I64  #: (n_instances,) first row of the instance's faces in `texels`, -1 where it has none

    def at(self, instance: I32, face: I32, face_uv: F32) -> F32:
        """Weights (n,) in [0, 1] at places on control faces; 0 on surfaces that were not painted.

        Parameters
        ----------
        instance : (n,) rows of the scene's instances, at least 0
        face : (n,) control faces
        face_uv : (n, 2) places in them
        """
        first = self.first_face[instance]
        painted = first >= 0
        weights = np.zeros(len(instance), np.float32)
        weights[painted] = _bilinear(self.texels, first[painted] + face[painted], face_uv[painted])
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
        A surface has another topology than when it was painted, or none of them is in the scene.
    """
    begins = np.concatenate([[0], np.cumsum([surface.n_faces for surface in mask.surfaces])])
    rows = {(s.path, s.instance_id, s.part): (s, int(begins[i])) for i, s in enumerate(mask.surfaces)}
    first = np.full(len(snapshot.surfaces), -1, np.int64)
    found = 0
    for i, surface in enumerate(snapshot.surfaces):
        entry = rows.get((surface.path, surface.instance_id, surface.part))
        if entry is None:
            continue
        masked, begin = entry
        if masked.topology_digest and masked.topology_digest != surface.topology_digest:
            raise EditError(
                f"{where}: its painted mask was made for another topology of {surface.path}"
                f" ({masked.n_faces} faces then, {surface.n_faces} now); paint it again or mute the edit"
            )
        first[i] = begin
        found += 1
    if not found:
        raise EditError(
            f"{where}: its payload was made for another scene: none of its {len(mask.surfaces)} painted surfaces"
            f" (such as {mask.surfaces[0].path if mask.surfaces else '-'}) is in this one;"
            " point icheat:filePath at the right sidecar, or set rel icheat:anchor"
        )
    return BoundMask(mask.texels, first[snapshot.geometry.instance_surface])


def _bilinear(texels: F32, rows: I64, uv: F32) -> F32:
    resolution = texels.shape[1]
    place = np.clip(uv * np.float32(resolution) - np.float32(0.5), 0, resolution - 1)
    low = np.minimum(place.astype(np.int64), max(resolution - 2, 0))
    high = np.minimum(low + 1, resolution - 1)
    f = (place - low).astype(np.float32)
    x0, y0, x1, y1 = low[:, 0], low[:, 1], high[:, 0], high[:, 1]
    top = texels[rows, y0, x0] * (1 - f[:, 0]) + texels[rows, y0, x1] * f[:, 0]
    bottom = texels[rows, y1, x0] * (1 - f[:, 0]) + texels[rows, y1, x1] * f[:, 0]
    return (top * (1 - f[:, 1]) + bottom * f[:, 1]).astype(np.float32)
