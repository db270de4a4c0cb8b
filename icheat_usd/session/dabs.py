"""Dabs of a brush on the masks of an edit: what lies under the brush moves towards full weight, or towards none."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from icheat_usd.edits.model import MaskedSurface, SurfaceMask
from icheat_usd.edits.painting import soft_sphere, surface_texel_positions
from icheat_usd.errors import EditError
from icheat_usd.scene import F32, I64, SceneSnapshot

RESOLUTION = 16  #: texels along each side of a control face
_FACES_AT_ONCE = 1024  # whose texels are looked at together


class TexelPlaces:
    """Where texels of a scene's surfaces lie; of each surface that is painted on, the boxes of its faces are kept."""

    def __init__(self, snapshot: SceneSnapshot) -> None:
        self.snapshot = snapshot
        #: row of each surface by path, instance and part
        self.rows = {(s.path, s.instance_id, s.part): row for row, s in enumerate(snapshot.surfaces)}
        self._boxes: dict[tuple[int, int], F32] = {}

    def near(self, row: int, resolution: int, centre: F32, radius: float) -> tuple[I64, F32]:
        """Faces of a surface that may have a texel so near, and the places of theirs.

        Returns
        -------
        faces : (n,) ascending
        places : (n, resolution, resolution, 3) world metres about the scene's centre
        """
        if (row, resolution) not in self._boxes:
            self._boxes[row, resolution] = self._box_of_faces(row, resolution)
        boxes = self._boxes[row, resolution]
        outside = np.maximum(np.maximum(boxes[:, 0] - centre, centre - boxes[:, 1]), 0)
        faces = np.flatnonzero(np.einsum("fi,fi->f", outside, outside) <= np.float32(radius * 1.0001) ** 2)
        return faces, self._places(row, resolution, faces)

    def _places(self, row: int, resolution: int, faces: I64) -> F32:
        places = surface_texel_positions(self.snapshot, row, resolution, faces)
        for instance in np.flatnonzero(self.snapshot.geometry.instance_surface == row)[:1]:
            matrix = self.snapshot.geometry.instance_to_world[instance]
            places = (places @ matrix[:, :3].T + matrix[:, 3]).astype(np.float32)
        return places

    def _box_of_faces(self, row: int, resolution: int) -> F32:
        """Least and greatest coordinates of the texels of each face, (n_faces, 2, 3)."""
        n_faces = self.snapshot.surfaces[row].n_faces
        boxes = np.empty((n_faces, 2, 3), np.float32)
        for first in range(0, n_faces, _FACES_AT_ONCE):
            faces = np.arange(first, min(first + _FACES_AT_ONCE, n_faces))
            places = self._places(row, resolution, faces)
            boxes[faces, 0], boxes[faces, 1] = places.min(axis=(1, 2)), places.max(axis=(1, 2))
        return boxes


def filled_mask(places: TexelPlaces, paths: Iterable[str], weight: float) -> SurfaceMask:
    """A mask of one weight on all surfaces at some paths.

    Raises
    ------
    EditError
        The weight is not in [0, 1], or there is no such surface.
    """
    if not 0 <= weight <= 1:
        raise EditError(f"a mask's weight lies between 0 and 1, not at {weight!r}")
    rows = _rows(places.snapshot, paths)
    masked = tuple(_masked(places.snapshot, row) for row in rows)
    n_faces = sum(surface.n_faces for surface in masked)
    texels = np.full((n_faces, RESOLUTION, RESOLUTION), round(weight * 255) / 255, np.float32)
    return SurfaceMask(masked, texels, _rest(places.snapshot, rows))


def dabbed(
    places: TexelPlaces, paths: Iterable[str], mask: SurfaceMask | None, centre: F32, radius: float, strength: float
) -> SurfaceMask:
    """A mask with one more dab.

    Parameters
    ----------
    paths
        Surfaces that the edit selects.
    mask : SurfaceMask, optional
        None is full weight on all of them.
    centre : (3,) metres about the scene's centre
    radius : metres
        Where the brush ends; it is soft from its centre on.
    strength : in [-1, 1]
        Of the way that the weight under the brush's centre goes, towards 1 or, if negative, towards 0.

    Raises
    ------
    EditError
        A number is out of its range.
    """
    if not (-1 <= strength <= 1 and radius > 0 and np.isfinite(centre).all()):
        raise EditError(
            f"a dab has a strength in [-1, 1], a radius above 0 and a finite place,"
            f" not {strength!r}, {radius!r} and {centre.tolist()}"
        )
    snapshot = places.snapshot
    if mask is None:
        mask = filled_mask(places, paths, 1.0)
    brush = soft_sphere((float(centre[0]), float(centre[1]), float(centre[2])), 0.0, radius)
    texels = mask.texels.copy()
    begin = 0
    for surface in mask.surfaces:
        some = slice(begin, begin + surface.n_faces)
        begin += surface.n_faces
        row = places.rows.get((surface.path, surface.instance_id, surface.part))
        if row is None or snapshot.surfaces[row].n_faces != surface.n_faces:
            continue
        faces, at = places.near(row, mask.resolution, centre, radius)
        faces = some.start + faces
        texels[faces] = _moved(texels[faces], brush(at.reshape(-1, 3)).reshape(at.shape[:3]), strength)
    wanted = frozenset(paths)
    named = {(surface.path, surface.instance_id, surface.part) for surface in mask.surfaces}
    new: list[tuple[int, F32]] = []
    for row in [row for name, row in places.rows.items() if strength > 0 and name[0] in wanted and name not in named]:
        faces, at = places.near(row, mask.resolution, centre, radius)
        weights = np.zeros((snapshot.surfaces[row].n_faces, mask.resolution, mask.resolution), np.float32)
        weights[faces] = brush(at.reshape(-1, 3)).reshape(at.shape[:3])
        if weights.any():
            new.append((row, _moved(np.zeros_like(weights), weights, strength)))
    if not new:
        return SurfaceMask(mask.surfaces, texels, mask.rest)
    rest = None if mask.rest is None else np.concatenate([mask.rest, _rest(snapshot, [row for row, _ in new])])
    return SurfaceMask(
        (*mask.surfaces, *(_masked(snapshot, row) for row, _ in new)),
        np.concatenate([texels, *(weights for _, weights in new)]),
        rest,
    )


def _moved(old: F32, brush: F32, strength: float) -> F32:
    """Rounded to 1/255, which a sidecar keeps in one byte without loss."""
    goal = np.float32(1 if strength > 0 else 0)
    moved = old + (goal - old) * (brush * np.float32(abs(strength)))
    rounded: F32 = (np.round(moved * 255) / np.float32(255)).astype(np.float32)
    return rounded


def _rows(snapshot: SceneSnapshot, paths: Iterable[str]) -> list[int]:
    wanted = frozenset(paths)
    rows = [row for row, surface in enumerate(snapshot.surfaces) if surface.path in wanted]
    if not rows:
        raise EditError(f"nothing to paint: none of {sorted(wanted)} is a surface of {snapshot.stage_path}")
    return rows


def _masked(snapshot: SceneSnapshot, row: int) -> MaskedSurface:
    surface = snapshot.surfaces[row]
    return MaskedSurface(surface.path, surface.n_faces, surface.instance_id, surface.part, surface.topology_digest)


def _rest(snapshot: SceneSnapshot, rows: list[int]) -> F32:
    return np.concatenate([surface_texel_positions(snapshot, row, 2) for row in rows])
