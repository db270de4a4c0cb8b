"""Writing what an edit is about: collections, limits, lights and target, and the prims that limits are made of."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom

from icheat_usd.edits.model import Rule, Shape
from icheat_usd.errors import EditError
from icheat_usd.stage import collections, schema
from icheat_usd.stage.layers import refuse_instances, writing
from icheat_usd.stage.selections import read_limits
from icheat_usd.stage.spaces import is_degenerate, meters_per_unit
from icheat_usd.stage.transforms import from_gf


@dataclass(frozen=True)
class Members:
    """What a collection includes and excludes: paths of prims or collections, absolute or below the default prim.

    `expression` is a membership expression of USD, such as ``//{isa:Mesh} - //Props//*``, and takes the place of
    both; relative patterns are below the default prim.
    """

    includes: tuple[str, ...] = ()
    excludes: tuple[str, ...] = ()
    expression: str = ""


#: Relationships of an edit that name prims alone, not collections.
_OF_PRIMS = (schema.LIGHTS, schema.TARGET, schema.OCCLUDERS)


# --------------------------------------------------------------------------- of an edit


def set_members(prim: Usd.Prim, name: str, members: Members | Sequence[str]) -> bool:
    """Make a collection include and exclude just `members`; False if stronger layers keep it otherwise.

    Raises
    ------
    EditError
        A path is not on the stage, or the expression is ill-formed or stands beside paths.
    """
    where = f"{prim.GetPath()} {name}"
    if isinstance(members, str):
        raise EditError(f"{where}: expected a list of paths, got the text '{members}'")
    wanted = members if isinstance(members, Members) else Members(tuple(members))
    if wanted.expression and (wanted.includes or wanted.excludes):
        raise EditError(f"{where}: a membership expression takes the place of paths; give one or the other")
    collection = Usd.CollectionAPI(prim, name)
    stage = prim.GetStage()
    as_wanted = [
        _author_difference(collection.GetIncludesRel(), collections.find_prims(stage, wanted.includes, where)),
        _author_difference(collection.GetExcludesRel(), collections.find_prims(stage, wanted.excludes, where)),
    ]
    expression = collections.parse_expression(stage, wanted.expression, where)
    attribute = collection.GetMembershipExpressionAttr()
    if expression != ((attribute.Get() if attribute else None) or Sdf.PathExpression()):
        attribute = collection.CreateMembershipExpressionAttr()
        attribute.Set(expression)
        as_wanted.append(attribute.Get() == expression)
    return all(as_wanted)


def set_targets(prim: Usd.Prim, wanted: Mapping[str, Sequence[str] | None]) -> list[str]:
    """Make relationships of an edit have just these targets; None leaves one as it is.

    They are authored as the difference from the composed ones.

    Returns
    -------
    list of str
        Relationships that stronger layers keep otherwise.

    Raises
    ------
    EditError
        A target is not on the stage, is a collection where a prim is needed, or there are several where one is.
    """
    kept = []
    for name, names in wanted.items():
        if names is None:
            continue
        where = f"{prim.GetPath()} {name}"
        if isinstance(names, str):
            raise EditError(f"{where}: expected a list of paths, got the text '{names}'")
        paths = collections.find_prims(prim.GetStage(), names, where)
        if name in _OF_PRIMS and not all(path.IsPrimPath() for path in paths):
            raise EditError(f"{where}: expected prims, got {', '.join(map(str, paths))}")
        # Built-in: creating it says nothing that the schema does not.
        relationship = prim.GetRelationship(name) or prim.CreateRelationship(name, custom=False)
        if not _author_difference(relationship, paths):
            kept.append(name)
    return kept


def _author_difference(relationship: Usd.Relationship, wanted: Sequence[Sdf.Path]) -> bool:
    """Make the composed targets `wanted`; False if stronger layers keep them otherwise."""
    composed = relationship.GetTargets()
    for path in composed:
        if path not in wanted:
            relationship.RemoveTarget(path)
    for path in wanted:
        if path not in composed:
            relationship.AddTarget(path, Usd.ListPositionBackOfAppendList)
    return set(relationship.GetTargets()) == set(wanted)


def apply_schema(prim: Usd.Prim, name: str) -> None:
    """Apply one of our schemas.

    Raises
    ------
    EditError
        The prim's type cannot take it.
    """
    allowed = prim.CanApplyAPI(name)
    if not allowed:
        raise EditError(f"{prim.GetPath()} ({prim.GetTypeName() or 'untyped'}) cannot take {name}: {allowed.whyNot}")
    if not schema.has_schema(prim, name):
        prim.ApplyAPI(name)


# --------------------------------------------------------------------------- prims that limits are made of


def path_below_default(stage: Usd.Stage, path: str, what: str) -> Sdf.Path:
    """Where a new prim may lie so that references keep it: absolute, or below the default prim.

    Raises
    ------
    EditError
        There is no default prim, or `path` is not below it or lies in an instance.
    """
    default = stage.GetDefaultPrim()
    if not default:
        raise EditError(
            f"{stage.GetRootLayer().identifier} has no default prim, so that references would lose the {what}; "
            f"set defaultPrim first"
        )
    if not Sdf.Path.IsValidPathString(path):
        raise EditError(f"'{path}' is not a prim path; give one such as {default.GetPath()}/indirect")
    absolute = Sdf.Path(path).MakeAbsolutePath(default.GetPath())
    if not absolute.IsPrimPath() or not absolute.HasPrefix(default.GetPath()) or absolute == default.GetPath():
        raise EditError(
            f"a {what} at {path} is lost when {stage.GetRootLayer().identifier} is referenced; place it below the "
            f"default prim, such as {default.GetPath()}/indirect"
        )
    refuse_instances(stage, absolute)
    return absolute


def define_ancestors(stage: Usd.Stage, path: Sdf.Path) -> None:
    """Make scopes of ancestors that do not exist yet."""
    for ancestor in path.GetPrefixes()[:-1]:
        if not stage.GetPrimAtPath(ancestor) or not stage.GetPrimAtPath(ancestor).IsDefined():
            stage.DefinePrim(ancestor, "Scope")


def add_region(
    stage: Usd.Stage,
    path: str,
    *,
    layer: str | Sdf.Layer,
    shape: Shape | str,
    centre: Sequence[float],
    size: Sequence[float],
    softness: float = 0.0,
    time: float | None = None,
) -> str:
    """Make a Cube or Sphere that limits of edits can name; a guide, so that it is not rendered.

    Parameters
    ----------
    path
        Where: absolute or below the default prim. Ancestors that do not exist become scopes.
    shape
        "box" or "sphere".
    centre : (3,) metres, stage axes
    size : metres
        Edges (x, y, z) of a box, radius (r,) of a sphere.
    softness
        Share of the way from the centre to the border over which weights fall: 0 to 1.
    time
        When the parents' transform counts, if it is animated.

    Returns
    -------
    str
        Path of the region.

    Raises
    ------
    EditError
        The place is taken or outside the default prim, or a number does not fit.
    """
    kind = _checked_shape(shape)
    n_sizes = 3 if kind is Shape.BOX else 1
    if len(centre) != 3 or not all(map(math.isfinite, centre)):
        raise EditError(f"{path}: the centre is {tuple(centre)}, expected three finite numbers in metres")
    if len(size) != n_sizes or not all(math.isfinite(s) and s > 0 for s in size):
        raise EditError(f"{path}: the size of a {kind.value} is {tuple(size)}, expected {n_sizes} above 0, in metres")
    if not 0 <= softness <= 1:
        raise EditError(f"{path}: softness is {softness}, expected 0 to 1")
    place = path_below_default(stage, path, "region")
    _refuse_taken(stage, place)
    with writing(stage, layer, place):
        define_ancestors(stage, place)
        prim = stage.DefinePrim(place, "Cube" if kind is Shape.BOX else "Sphere")
        apply_schema(prim, schema.REGION_API)
        if kind is Shape.BOX:
            UsdGeom.Cube(prim).CreateSizeAttr(1.0)
        else:
            UsdGeom.Sphere(prim).CreateRadiusAttr(1.0)
        reach = 0.5 if kind is Shape.BOX else 1.0
        UsdGeom.Boundable(prim).CreateExtentAttr([Gf.Vec3f(-reach), Gf.Vec3f(reach)])
        UsdGeom.Imageable(prim).CreatePurposeAttr(UsdGeom.Tokens.guide)
        _place(UsdGeom.Xformable(prim), centre, [*size] * (3 // n_sizes), time)
        if softness:
            prim.GetAttribute(schema.SOFTNESS).Set(float(softness))
    return str(place)


def _place(prim: UsdGeom.Xformable, centre: Sequence[float], scale: Sequence[float], time: float | None) -> None:
    """Author the transform that puts a unit shape at a place of the stage, both in metres."""
    per_metre = 1 / meters_per_unit(prim.GetPrim().GetStage())
    world = Gf.Matrix4d().SetScale(Gf.Vec3d(*(s * per_metre for s in scale)))
    world.SetTranslateOnly(Gf.Vec3d(*(c * per_metre for c in centre)))
    parent = prim.ComputeParentToWorldTransform(schema.time_code(time))
    if is_degenerate(from_gf(parent)):
        raise EditError(f"{prim.GetPath()}: the transform above it squashes space flat; choose another place")
    local = world * parent.GetInverse()
    linear = np.array(local)[:3, :3]
    if np.abs(linear - np.diag(np.diag(linear))).max() > 1e-9 * np.abs(linear).max():
        prim.AddTransformOp().Set(local)  # Of a turned parent: may shear, which no other operations say.
        return
    prim.AddTranslateOp().Set(local.ExtractTranslation())
    prim.AddScaleOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*np.diag(linear).tolist()))


def add_selection(
    stage: Usd.Stage, path: str, parts: Sequence[str], *, layer: str | Sdf.Layer, rule: Rule | str = Rule.INTERSECTION
) -> str:
    """Make a prim that combines several selections by set algebra; limits of edits can name it.

    Parameters
    ----------
    path
        Where: absolute or below the default prim. Ancestors that do not exist become scopes.
    parts
        Materials, regions, other selections, collections or prims, in order.

    Returns
    -------
    str
        Path of the selection.

    Raises
    ------
    EditError
        The place is taken or outside the default prim, a part does not exist, or the rule is unknown.
    """
    if rule not in list(Rule):
        raise EditError(f"no rule is called '{rule}'; there are {', '.join(r.value for r in Rule)}")
    place = path_below_default(stage, path, "selection")
    _refuse_taken(stage, place)
    with writing(stage, layer, place):
        define_ancestors(stage, place)
        prim = stage.DefinePrim(place, "Scope")
        apply_schema(prim, schema.SELECTION_API)
        prim.GetAttribute(schema.RULE).Set(Rule(rule).value)
        set_targets(prim, {schema.PARTS: parts})
        read_limits(prim, schema.PARTS, None, frozenset())  # Refuses circles and shapeless regions.
    return str(place)


def _checked_shape(shape: Any) -> Shape:
    if shape not in list(Shape):
        raise EditError(f"no shape is called '{shape}'; there are {', '.join(s.value for s in Shape)}")
    return Shape(shape)


def _refuse_taken(stage: Usd.Stage, path: Sdf.Path) -> None:
    existing = stage.GetPrimAtPath(path)
    if existing and existing.IsDefined():
        raise EditError(f"{path} exists already ({existing.GetTypeName() or 'untyped'}); choose another path")
