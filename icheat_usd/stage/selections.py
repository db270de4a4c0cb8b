"""What narrows the two sides of an edit: surfaces, materials, regions of space and set algebra on them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade

from icheat_usd.edits.model import Combination, Edit, Limit, Region, Rule, Shape, SurfacesAt, SurfacesOf
from icheat_usd.errors import EditError
from icheat_usd.stage import collections, schema
from icheat_usd.stage.parameters import read_number
from icheat_usd.stage.spaces import is_degenerate, to_metres
from icheat_usd.stage.stacks import EditFinding, targets
from icheat_usd.stage.transforms import inverse

#: More parts than any person makes; parts may share parts, so that a few prims could stand for very many.
_MAX_PARTS = 10_000

_NOTHING = SurfacesAt(frozenset())


def read_limits(
    edit: Usd.Prim, relationship: str, time: float | None, surface_paths: frozenset[str]
) -> tuple[tuple[Limit, ...], list[EditFinding]]:
    """The limits that one side of an edit names; a missing target selects nothing, an inactive one is no limit.

    Parameters
    ----------
    relationship
        ``icheat:receiverLimits`` or ``icheat:casterLimits``.
    surface_paths
        Scene paths of all surfaces.

    Raises
    ------
    EditError
        A region has no usable shape, or parts of a selection contain each other.
    """
    reader = _LimitReader(edit, relationship, time, surface_paths)
    read = [reader.read(Sdf.Path(target), ()) for target in targets(edit, relationship)]
    return tuple(limit for limit in read if limit is not None), reader.findings


def with_limits(
    prim: Usd.Prim, edit: Edit, time: float | None, surface_paths: frozenset[str]
) -> tuple[Edit, list[EditFinding]]:
    """Narrow both sides of an edit, and name the lights it is about; see `read_limits`."""
    receivers, findings = read_limits(prim, schema.RECEIVER_LIMITS, time, surface_paths)
    casters, more = read_limits(prim, schema.CASTER_LIMITS, time, surface_paths)
    lights = targets(prim, schema.LIGHTS)
    missing = [
        EditFinding(str(prim.GetPath()), schema.LIGHTS, f"{light} does not exist, so that it sends nothing; remove it")
        for light in lights
        if not prim.GetStage().GetPrimAtPath(light)
    ]
    narrowed = replace(
        edit,
        receivers=replace(edit.receivers, limits=receivers),
        casters=replace(edit.casters, limits=casters),
        lights=lights,
    )
    return narrowed, [*findings, *more, *missing]


def limit_content(limit: Limit) -> object:
    """What a limit says, as plain lists and texts; equal for limits that select the same in the same way."""
    if isinstance(limit, SurfacesAt):
        return ["surfaces", sorted(limit.paths)]
    if isinstance(limit, SurfacesOf):
        return ["materials", sorted(limit.materials)]
    if isinstance(limit, Region):
        return [limit.shape.value, [value.hex() for value in limit.to_shape], float(limit.softness).hex()]
    return [limit.rule.value, [limit_content(part) for part in limit.parts]]


class _LimitReader:
    """Reads the targets of one relationship and what they are made of."""

    def __init__(self, edit: Usd.Prim, relationship: str, time: float | None, surface_paths: frozenset[str]) -> None:
        self.edit = edit
        self.stage = edit.GetStage()
        self.relationship = relationship
        self.time = time
        self.surface_paths = surface_paths
        self.findings: list[EditFinding] = []
        self._n_parts = 0

    def read(self, path: Sdf.Path, within: tuple[Sdf.Path, ...]) -> Limit | None:
        """The limit at `path`, None for an inactive one; `within` are the selections that it is a part of."""
        self._n_parts += 1
        if self._n_parts > _MAX_PARTS:
            raise EditError(f"{self.edit.GetPath()}: {self.relationship} has over {_MAX_PARTS} parts; use collections")
        prim = self.stage.GetPrimAtPath(path.GetPrimPath())
        if not prim:
            if not _is_below_inactive(self.stage, path):
                self._find(path, "does not exist, so that it selects nothing; remove it or correct the path")
                return _NOTHING
            return None
        if not prim.IsActive():
            return None
        if not path.IsPrimPath():
            return self._read_collection(prim, path)
        if schema.has_schema(prim, schema.SELECTION_API):
            return self._read_combination(prim, within)
        if prim.IsA(UsdShade.Material):
            return SurfacesOf(frozenset(shared_paths(prim)))
        if prim.IsA(UsdGeom.Cube) or prim.IsA(UsdGeom.Sphere):
            return read_region(prim, self.time)
        below = str(path) + "/"
        return self._surfaces(path, frozenset(p for p in self.surface_paths if p == str(path) or p.startswith(below)))

    def _read_collection(self, prim: Usd.Prim, path: Sdf.Path) -> Limit:
        namespace, _, name = path.name.partition(":")
        if namespace != "collection" or not name or not prim.GetPropertiesInNamespace(path.name):
            self._find(path, "is no collection, so that it selects nothing; name a prim or a collection")
            return _NOTHING
        return self._surfaces(path, collections.select(prim, name, self.surface_paths).paths)

    def _surfaces(self, path: Sdf.Path, paths: frozenset[str]) -> SurfacesAt:
        if not paths:
            self._find(path, "holds no surface that is shown, so that it selects nothing; name another")
        return SurfacesAt(paths)

    def _read_combination(self, prim: Usd.Prim, within: tuple[Sdf.Path, ...]) -> Combination:
        path = prim.GetPath()
        if path in within:
            circle = [*within[within.index(path) :], path]
            raise EditError(
                f"{self.edit.GetPath()}: {self.relationship} leads in a circle: {' -> '.join(map(str, circle))};"
                f" take one of these out of {schema.PARTS}"
            )
        token = schema.read_attribute(prim, schema.RULE, self.time)
        if token not in list(Rule):
            known = ", ".join(rule.value for rule in Rule)
            raise EditError(f"{path}: {schema.RULE} is '{token}', expected one of {known}")
        rule = Rule(token)
        parts = [self.read(Sdf.Path(target), (*within, path)) for target in targets(prim, schema.PARTS)]
        if rule is Rule.DIFFERENCE and parts and parts[0] is None:
            parts[0] = _NOTHING  # Left out, it would make the next part the one that is selected.
        return Combination(rule, tuple(part for part in parts if part is not None))

    def _find(self, path: Sdf.Path, message: str) -> None:
        self.findings.append(EditFinding(str(self.edit.GetPath()), self.relationship, f"{path} {message}"))


def read_region(prim: Usd.Prim, time: float | None) -> Region:
    """The space within a Cube or Sphere at a time, with what `IcheatRegionAPI` says about its border.

    Raises
    ------
    EditError
        Its size or transform leaves no space, or its softness is not in [0, 1].
    """
    is_box = prim.IsA(UsdGeom.Cube)
    attribute = UsdGeom.Cube(prim).GetSizeAttr() if is_box else UsdGeom.Sphere(prim).GetRadiusAttr()
    size = float(attribute.Get(schema.time_code(time)) or 0) * (0.5 if is_box else 1)
    to_world = to_metres(prim, time)
    to_world[:, :3] *= size
    if is_degenerate(to_world):
        raise EditError(
            f"{prim.GetPath()}: selects no space, because its {attribute.GetName()} or its transform is zero, flat or"
            " not finite; give it a volume"
        )
    softness = read_number(prim, schema.SOFTNESS, time)
    if not 0 <= softness <= 1:
        raise EditError(f"{prim.GetPath()}: {schema.SOFTNESS} is {softness}, expected 0 to 1")
    to_shape = inverse(to_world[None])[0]
    return Region(Shape.BOX if is_box else Shape.SPHERE, tuple(float(v) for v in np.ravel(to_shape)), softness)


def shared_paths(prim: Usd.Prim) -> list[str]:
    """Every scene path by which one can name a prim: one inside an instance is in all instances of its prototype."""
    if not prim.IsInstanceProxy() and not prim.IsInPrototype():
        return [str(prim.GetPath())]
    inside = prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim
    root = inside
    while not root.IsPrototype():
        root = root.GetParent()
    found = []
    for instance in root.GetInstances():
        for outer in shared_paths(instance):
            found.append(str(inside.GetPath().ReplacePrefix(root.GetPath(), Sdf.Path(outer))))
    return found


def _is_below_inactive(stage: Usd.Stage, path: Sdf.Path) -> bool:
    for ancestor in reversed(path.GetPrimPath().GetPrefixes()):
        prim = stage.GetPrimAtPath(ancestor)
        if prim:
            return not prim.IsActive()
    return False
