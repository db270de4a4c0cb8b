"""Groups of lights that layers tell apart, as pipelines author them on the prims.

No schema of USD's own has such a group. Karma's and RenderMan's attributes are read, which light path expressions
name as ``<L.'tag'>``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from pxr import Usd, UsdGeom

from icheat_usd.stage.shading import time_code

#: By strength: of lights, then of meshes that glow, which may inherit them.
ATTRIBUTES = (
    "inputs:karma:light:lpetag",
    "karma:light:lpetag",
    "inputs:ri:light:lightGroup",
    "ri:light:lightGroup",
)
PRIMVARS = ("karma:object:lpetag", "ri:attributes:identifier:lpegroup")


def read_light_tags(
    prims: Iterable[Usd.Prim], time: Usd.TimeCode | float | None, light_paths: Sequence[str]
) -> tuple[str, ...]:
    """The group of each light, "" for none.

    Parameters
    ----------
    prims
        Those that may be lights, and all shapes.
    light_paths
        Scene path of each light.

    Returns
    -------
    tuple of str
        One per light; none at all where no light has a group.
    """
    wanted, when = set(light_paths), time_code(time)
    known = {str(prim.GetPath()): _tag(prim, when) for prim in prims if str(prim.GetPath()) in wanted}
    found = tuple(known.get(path, "") for path in light_paths)
    return found if any(found) else ()


def _tag(prim: Usd.Prim, when: Usd.TimeCode) -> str:
    primvars = UsdGeom.PrimvarsAPI(prim)
    attributes = [prim.GetAttribute(name) for name in ATTRIBUTES]
    attributes += [primvars.FindPrimvarWithInheritance(name).GetAttr() for name in PRIMVARS]
    for attribute in attributes:
        value = attribute.Get(when) if attribute and attribute.HasAuthoredValue() else None
        if isinstance(value, str) and value:
            return value
    return ""
