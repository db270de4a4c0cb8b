"""A stack bound to a scene: masks at surface points, and the composed pair functions S, E and O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icheat_usd.edits import operations
from icheat_usd.edits.model import Blend, Edit, EditStack, Selection, SurfaceMask, Value
from icheat_usd.edits.operations import Operation, PairCoefficients, Pairs
from icheat_usd.errors import EditError
from icheat_usd.scene import F32, I64, SceneSnapshot, SurfacePoints


class StackCoefficients(NamedTuple):
    """The composed pair functions at n pairs: ``t (scale b + emission) + A offset b``."""

    scale: F32  #: (n, 3)
    emission: F32  #: (n, 3)
    offset_diffuse: F32 | None  #: (n, 3) to be multiplied by the receiver's albedo; None is 0
    offset_paint: F32 | None  #: (n, 3) not to be; None is 0


@dataclass(frozen=True, eq=False)
class BoundMask:
    """Weights of one selection on the surfaces of one scene."""

    member: F32  #: (n_instances,) 1 where the collection includes the instance's surface
    mask: SurfaceMask | None
    first_face: I64  #: (n_instances,) first row of the mask's texels, -1 where it has none

    def at(self, points: SurfacePoints) -> F32:
        """Weights of the points, (n,) in [0, 1]; 0 where a point is no hit."""
        hit = points.instance >= 0
        instance = np.where(hit, points.instance, 0)
        weights = np.where(hit, self.member[instance], np.float32(0)).astype(np.float32)
        if self.mask is None:
            return weights
        first = self.first_face[instance]
        painted = (weights > 0) & (first >= 0)
        result = np.zeros(len(weights), np.float32)
        rows = first[painted] + points.face[painted]
        result[painted] = weights[painted] * _bilinear(self.mask.texels, rows, points.face_uv[painted])
        return result


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


@dataclass(frozen=True, eq=False)
class BoundEdit:
    """An edit that knows the scene: its operation, and parameters, masks and a weight for each key."""

    edit: Edit
    operation: Operation | None  #: None: unknown here, `baked` is used
    parameters: tuple[dict[str, Value], ...]
    baked: tuple[F32, ...]  #: scale - 1, baked by who authored it; unused where the operation is known
    receivers: tuple[BoundMask, ...]
    casters: tuple[BoundMask, ...]
    key_weights: tuple[float, ...]

    def evaluate(self, key: int, incident: F32) -> PairCoefficients:
        """Coefficients at full amount and masks, as of one key."""
        if self.operation is None:
            return PairCoefficients(scale=np.float32(1) + self.baked[key][None, :])
        return self.operation.evaluate(self.parameters[key], Pairs(incident))


@dataclass(frozen=True, eq=False)
class EditField:
    """The active edits of a stack on one scene, weakest first.

    Masks come as rows: one per edit and key, in the order of the edits.
    """

    edits: tuple[BoundEdit, ...]

    @property
    def is_identity(self) -> bool:
        return not self.edits

    @property
    def uses_incident(self) -> bool:
        """True if S depends on the colour of the light, so that a renderer must supply it."""
        return any(bound.operation is not None and bound.operation.uses_incident for bound in self.edits)

    @property
    def has_offset(self) -> bool:
        """True if an operation may give offsets, which reach receivers through occluders."""
        return any(bound.operation is not None and bound.operation.has_offset for bound in self.edits)

    @property
    def n_rows(self) -> int:
        return sum(len(bound.receivers) for bound in self.edits)

    def receiver_masks(self, points: SurfacePoints) -> F32:
        """Soft receiver masks u at the points, (n_rows, n)."""
        return self._rows([mask.at(points) for bound in self.edits for mask in bound.receivers], points)

    def caster_masks(self, points: SurfacePoints) -> F32:
        """Soft caster masks w at the points, (n_rows, n)."""
        return self._rows([mask.at(points) for bound in self.edits for mask in bound.casters], points)

    def _rows(self, rows: list[F32], points: SurfacePoints) -> F32:
        return np.stack(rows) if rows else np.zeros((0, len(points.instance)), np.float32)

    def evaluate(self, incident: F32, receiver: F32, caster: F32) -> StackCoefficients:
        """Compose the stack at n pairs (DESIGN, Semantics).

        Parameters
        ----------
        incident : (n, 3) float32, radiance, scene-linear
            Unedited light `b` that the caster sends to the receiver.
        receiver : (n_rows, n) or (n_rows, 1) float32
            Receiver masks u.
        caster : (n_rows, n) float32
            Caster masks w.

        Returns
        -------
        StackCoefficients
        """
        n = len(incident)
        scale = np.ones((n, 3), np.float32)
        emission = np.zeros((n, 3), np.float32)
        offsets: list[F32 | None] = [None, None]
        row = 0
        for bound in self.edits:
            n_keys = len(bound.receivers)
            weights = [
                np.float32(bound.edit.amount * key_weight) * receiver[row + k] * caster[row + k]
                for k, key_weight in enumerate(bound.key_weights)
            ]
            row += n_keys
            touched = np.flatnonzero(np.any([w != 0 for w in weights], axis=0))
            if len(touched) == 0:
                continue
            blend = bound.edit.blend
            seen = incident[touched]
            if blend is Blend.COMPOSE:
                seen = scale[touched] * seen + emission[touched]
            delta, added, offset = _interpolate_keys(bound, seen, [w[touched, None] for w in weights])
            kept = np.sum([w[touched, None] for w in weights], axis=0)
            if blend is Blend.COMPOSE:
                factor, carried = 1 + delta, 1 + delta
            elif blend is Blend.OVER:
                factor, carried = 1 - kept, 1 - kept
            else:
                factor = carried = np.ones_like(delta)
            scale[touched] = (
                factor * scale[touched] + {Blend.COMPOSE: 0, Blend.OVER: kept + delta, Blend.ADD: delta}[blend]
            )
            emission[touched] = carried * emission[touched] + added
            paints = bound.operation is not None and not bound.operation.offset_times_albedo
            for slot in range(2):
                before = offsets[slot]
                after = None if before is None else before.copy()
                if after is not None:
                    after[touched] *= carried
                if offset is not None and slot == int(paints):
                    after = np.zeros((n, 3), np.float32) if after is None else after
                    after[touched] += offset
                offsets[slot] = after
        return StackCoefficients(scale, emission, offsets[0], offsets[1])


def _interpolate_keys(bound: BoundEdit, seen: F32, weights: list[F32]) -> tuple[F32, F32, F32 | None]:
    """Sum over keys of weight x (scale - 1, emission, offset)."""
    delta = np.zeros_like(seen)
    added = np.zeros_like(seen)
    offset: F32 | None = None
    for key, weight in enumerate(weights):
        coefficients = bound.evaluate(key, seen)
        delta += weight * (coefficients.scale - np.float32(1))
        if coefficients.emission is not None:
            added += weight * coefficients.emission
        if coefficients.offset is not None:
            offset = weight * coefficients.offset + (0 if offset is None else offset)
    return delta, added, offset


def bind(stack: EditStack, snapshot: SceneSnapshot) -> EditField:
    """Bind the active edits of `stack` to a scene.

    Raises
    ------
    EditError
        An operation is unknown and no payload holds it baked, a parameter is
        wrong, or a painted mask was made for another mesh.
    """
    bound = (_bind_edit(edit, snapshot) for edit in stack.active)
    # An edit that is blocked at this time has no key left: the identity.
    return EditField(tuple(edit for edit in bound if edit.key_weights))


def _bind_edit(edit: Edit, snapshot: SceneSnapshot) -> BoundEdit:
    operation = operations.find(edit.operation)
    keys = [(key.payload, key.weight) for key in edit.keys if key.payload is not None]
    if operation is None and (not keys or any(payload.scale_delta is None for payload, _ in keys)):
        raise EditError(
            f"{edit.path}: operation '{edit.operation}' is unknown and no payload holds it baked;"
            f" known are {', '.join(operations.names())}; install the package that brings it, or mute the edit"
        )
    if not edit.keys:
        plain = {} if operation is None else operation.complete(edit.parameters, edit.path)
        receivers = _bound_mask(edit, edit.receivers, None, snapshot)
        casters = _bound_mask(edit, edit.casters, None, snapshot)
        return BoundEdit(edit, operation, (plain,), (), (receivers,), (casters,), (1.0,))
    return BoundEdit(
        edit,
        operation,
        parameters=tuple({} if operation is None else operation.complete(p.parameters, edit.path) for p, _ in keys),
        baked=tuple(np.asarray(p.scale_delta or (0.0, 0.0, 0.0), np.float32) for p, _ in keys),
        receivers=tuple(_bound_mask(edit, edit.receivers, p.receiver_mask, snapshot) for p, _ in keys),
        casters=tuple(_bound_mask(edit, edit.casters, p.caster_mask, snapshot) for p, _ in keys),
        key_weights=tuple(weight for _, weight in keys),
    )


_NO_FACES = np.zeros(0, np.int64)


def _member(selection: Selection, snapshot: SceneSnapshot) -> F32:
    included = np.array([surface.path in selection.paths for surface in snapshot.surfaces], np.float32)
    return included[snapshot.geometry.instance_surface] if len(included) else np.zeros(0, np.float32)


def _bound_mask(edit: Edit, selection: Selection, mask: SurfaceMask | None, snapshot: SceneSnapshot) -> BoundMask:
    member = _member(selection, snapshot)
    if mask is None:
        return BoundMask(member, None, _NO_FACES)
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
                f"{edit.path}: its painted mask was made for another topology of {surface.path}"
                f" ({masked.n_faces} faces then, {surface.n_faces} now); paint it again or mute the edit"
            )
        first[i] = begin
        found += 1
    if not found:
        raise EditError(
            f"{edit.path}: its payload was made for another scene: none of its {len(mask.surfaces)} painted surfaces"
            f" (such as {mask.surfaces[0].path if mask.surfaces else '-'}) is in this one;"
            " point icheat:filePath at the right sidecar, or set rel icheat:anchor"
        )
    return BoundMask(member, mask, first[snapshot.geometry.instance_surface])
