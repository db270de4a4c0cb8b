"""Places, lengths and directions that a stage says, taken to metres and stage axes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from pxr import Usd, UsdGeom

from icheat_usd.edits import operations
from icheat_usd.edits.model import Edit, Value
from icheat_usd.edits.operations.base import Measure, Parameter
from icheat_usd.errors import EditError
from icheat_usd.scene import F64
from icheat_usd.stage import schema
from icheat_usd.stage.stacks import EditFinding, targets
from icheat_usd.stage.transforms import Placement

#: A point parameter of this name is what `rel icheat:target` stands for.
_TARGET = "target"

#: Below this share of the largest column's cube, a transform has squashed space flat.
_FLAT = 1e-12

_ALL_PURPOSES = [UsdGeom.Tokens.default_, UsdGeom.Tokens.render, UsdGeom.Tokens.proxy, UsdGeom.Tokens.guide]


def meters_per_unit(stage: Usd.Stage) -> float:
    """Metres per scene unit; USD's own fallback where the stage says nothing usable, as in snapshots."""
    value = float(UsdGeom.GetStageMetersPerUnit(stage))
    return value if np.isfinite(value) and value > 0 else 0.01


def to_metres(prim: Usd.Prim, time: float | None) -> F64:
    """``(3, 4) float64`` from a prim's own space to metres in stage axes.

    A prim that is not xformable, as a Scope, has the space of its nearest ancestor that is.
    """
    xforms = UsdGeom.XformCache(schema.time_code(time))
    placement = Placement(meters_per_unit(prim.GetStage()), np.zeros(3))
    return placement.matrix(xforms.GetLocalToWorldTransform(prim))


def is_degenerate(matrix: F64) -> bool:
    """Whether a (3, 4) transform is not finite or has no inverse worth the name."""
    linear = matrix[:, :3]
    largest = np.abs(linear).max()
    return not np.isfinite(matrix).all() or largest == 0 or abs(np.linalg.det(linear / largest)) < _FLAT


def in_scene_space(prim: Usd.Prim, edit: Edit, time: float | None) -> tuple[Edit, list[EditFinding]]:
    """Take the parameters of an edit, and those of its payloads, to metres and stage axes; find its target.

    Parameters
    ----------
    prim
        The edit's prim, whose space its parameters are in.

    Raises
    ------
    EditError
        The prim's transform or the target cannot be used.
    """
    target, findings = read_target(prim, time)
    operation = operations.find(edit.operation)
    edit = replace(edit, target=target)
    measured = [p for p in operation.parameters if p.measure is not Measure.PLAIN] if operation else []
    if not measured:
        return edit, findings
    matrix = to_metres(prim, time)
    if is_degenerate(matrix):
        raise EditError(
            f"{prim.GetPath()}: its transform squashes space flat or is not finite, so that"
            f" {', '.join(p.name for p in measured)} of '{edit.operation}' have no place; correct the transform of"
            " the prims above it"
        )

    def converted(parameters: Mapping[str, Value]) -> Mapping[str, Value]:
        places = {p.name: _convert(parameters[p.name], p, matrix, prim) for p in measured if p.name in parameters}
        if target is not None and _TARGET in places:
            places[_TARGET] = target
        return MappingProxyType({**parameters, **places})

    keys = [
        replace(key, payload=replace(key.payload, parameters=converted(key.payload.parameters)))
        if key.payload is not None and key.payload.operation == edit.operation
        else key
        for key in edit.keys
    ]
    return replace(edit, parameters=converted(edit.parameters), keys=tuple(keys)), findings


def _convert(value: Value, parameter: Parameter, matrix: F64, prim: Usd.Prim) -> Value:
    """A value as `parameter.measure` says; one of the wrong kind is left for the operation to refuse."""
    linear = matrix[:, :3]
    if parameter.measure is Measure.LENGTH:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return value
        # Of a transform that stretches: the mean of its factors.
        return float(value) * float(abs(np.linalg.det(linear)) ** (1 / 3))
    if not isinstance(value, tuple) or len(value) != 3:
        return value
    vector = np.asarray(value, np.float64)
    if parameter.measure is Measure.POINT:
        return _numbers(linear @ vector + matrix[:, 3])
    turned = linear @ vector
    length = float(np.linalg.norm(turned))
    if length == 0:
        raise EditError(
            f"{prim.GetPath()}: {parameter.name} is {value}, which points nowhere; give a vector such as (0, 1, 0)"
        )
    return _numbers(turned / length)


def read_target(prim: Usd.Prim, time: float | None) -> tuple[tuple[float, float, float] | None, list[EditFinding]]:
    """Centre of the bounds of the one prim that `rel icheat:target` names: metres, stage axes.

    Bounds are of all purposes and whether visible or not, so that a guide or a hidden locator can be aimed at. A
    prim without geometry is where its origin is.

    Raises
    ------
    EditError
        There are several targets, or the one has no finite place.
    """
    named = targets(prim, schema.TARGET)
    if not named:
        return None, []
    if len(named) > 1:
        raise EditError(f"{prim.GetPath()}: {schema.TARGET} has {len(named)} targets, expected one")
    stage = prim.GetStage()
    aimed_at = stage.GetPrimAtPath(named[0])
    if not aimed_at or not aimed_at.IsActive():
        message = f"{named[0]} does not exist or is inactive, so that the parameter 'target' counts; aim at another"
        return None, [EditFinding(str(prim.GetPath()), schema.TARGET, message)]
    bounds = UsdGeom.BBoxCache(schema.time_code(time), _ALL_PURPOSES, useExtentsHint=False, ignoreVisibility=True)
    box = bounds.ComputeWorldBound(aimed_at)
    if box.GetRange().IsEmpty():
        centre = to_metres(aimed_at, time)[:, 3]
    else:
        centre = np.array(box.ComputeCentroid()) * meters_per_unit(stage)
    if not np.isfinite(centre).all():
        raise EditError(f"{prim.GetPath()}: its target {named[0]} has no finite place; correct its transform")
    return _numbers(centre), []


def _numbers(vector: F64) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])
