"""What there is to read below a prim, sorted by how it is read."""

from __future__ import annotations

from dataclasses import dataclass, field

from pxr import Usd, UsdGeom, UsdLux, UsdVol

from icheat_usd.stage import implicit
from icheat_usd.stage.reporting import Reporter


@dataclass
class Walk:
    """Prims below a root, in scene order; contents of native instances as instance proxies."""

    gprims: list[Usd.Prim] = field(default_factory=list)  #: meshes and implicit shapes
    instancers: list[Usd.Prim] = field(default_factory=list)  #: outermost point instancers; what is below is not walked
    lights: list[Usd.Prim] = field(default_factory=list)


def walk(root: Usd.Prim, report: Reporter, *, prototypes: bool = False) -> Walk:
    """Sort the prims at and below `root`, whatever their visibility and purpose.

    Parameters
    ----------
    root
    report
        Receives one finding for each prim of a type that cannot be rendered.
    prototypes
        Also visit prims that are only ``over``: prototypes of point instancers may be kept like that.
    """
    predicate = Usd.PrimIsActive & Usd.PrimIsLoaded & ~Usd.PrimIsAbstract
    if not prototypes:
        predicate = predicate & Usd.PrimIsDefined
    found = Walk()
    kinds: dict[str, str] = {}
    prims = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies(predicate)))
    for prim in prims:
        name = str(prim.GetTypeName())
        kind = kinds.get(name)
        if kind is None:
            kind = kinds[name] = _kind(prim)
        if kind == "gprim":
            found.gprims.append(prim)
        elif kind == "instancer":
            found.instancers.append(prim)
            prims.PruneChildren()
        elif kind == "unsupported" and _is_shown(prim):
            report(prim, f"type {name}", f"{name} is not supported; left out.")
        if kind == "light" or (kind == "gprim" and prim.HasAPI(UsdLux.LightAPI)):
            found.lights.append(prim)
    return found


def _kind(prim: Usd.Prim) -> str:
    if prim.IsA(UsdGeom.Mesh) or str(prim.GetTypeName()) in implicit.TYPES:
        return "gprim"
    if prim.IsA(UsdGeom.PointInstancer):
        return "instancer"
    if prim.HasAPI(UsdLux.LightAPI):
        return "light"
    if prim.IsA(UsdGeom.Gprim) or prim.IsA(UsdVol.Volume):
        return "unsupported"
    return "other"


def _is_shown(prim: Usd.Prim) -> bool:
    imageable = UsdGeom.Imageable(prim)
    return bool(imageable.ComputePurpose() in ("default", "render")) and not (
        imageable.ComputeVisibility(Usd.TimeCode.EarliestTime()) == "invisible"
    )
