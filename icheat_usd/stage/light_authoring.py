"""Writing lights into one layer of a stage, so that `lights.read_lights` reads them as they were wanted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux

from icheat_usd.errors import EditError
from icheat_usd.scene import F64, LightKind
from icheat_usd.stage.layers import asset_path, overridden_opinions, writing
from icheat_usd.stage.lights import POLE_TURN, pole_axis, read_light_radiance
from icheat_usd.stage.selection_authoring import define_ancestors
from icheat_usd.stage.spaces import meters_per_unit
from icheat_usd.stage.stacks import EditFinding

_TYPES = {
    LightKind.SPHERE: "SphereLight",
    LightKind.DISK: "DiskLight",
    LightKind.RECT: "RectLight",
    LightKind.CYLINDER: "CylinderLight",
    LightKind.DISTANT: "DistantLight",
    LightKind.DOME: "DomeLight",
}
_SIZES = {
    "SphereLight": ("radius",),
    "DiskLight": ("radius",),
    "RectLight": ("width", "height"),
    "CylinderLight": ("radius", "length"),
    "DistantLight": ("angle",),
}
_DOMES = ("DomeLight", "DomeLight_1")


@dataclass(frozen=True, eq=False)
class LightValues:
    """What a light is to be; None leaves what the stage says."""

    kind: LightKind | None = None  #: of a light that the stage does not have
    to_world: F64 | None = None  #: (3, 4) metres, stage axes
    radiance: tuple[float, float, float] | None = None
    size: tuple[float, float] | None = None  #: as in `scene.Lights`
    texture_file: str | None = None  #: "" takes the image away
    removed: bool = False


def write_light(
    stage: Usd.Stage,
    path: str,
    values: LightValues,
    *,
    layer: str | Sdf.Layer,
    time: float | None = None,
    about: Mapping[str, str] | None = None,
) -> tuple[EditFinding, ...]:
    """Write one light: a matrix for its place, color and intensity for its radiance; a removed one is deactivated.

    Parameters
    ----------
    time
        Stage time of the values; None authors defaults.
    about
        Who, when and why: kept in the prim's custom data under "icheat".

    Returns
    -------
    tuple of EditFinding
        What has no effect, because a stronger layer decides it.

    Raises
    ------
    EditError
        The light lies in an instance, glows as a mesh, moves while no time is given, or cannot be written so.
    """
    target = Sdf.Path(path)
    if not target.IsAbsolutePath() or not target.IsPrimPath():
        raise EditError(f"'{path}' is no path for a light, such as /World/Lights/Key")
    _refuse(stage, target, values)
    names: list[str] = []
    with writing(stage, layer, target) as written_to:
        if values.kind is not None:
            define_ancestors(stage, target)
            prim = stage.DefinePrim(target, _TYPES[values.kind])
        else:
            prim = stage.GetPrimAtPath(target)
        if about:
            prim.SetCustomDataByKey("icheat", dict(about))
        if values.removed:
            prim.SetActive(False)
            if prim.IsActive():
                message = f"deactivated in {written_to.identifier}, but a stronger layer activates it"
                return (EditFinding(path, "active", message),)
            return ()
        code = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
        if values.size is not None:
            names += _write_size(prim, values.size, code)
        if values.to_world is not None:
            names += _write_place(prim, values.to_world, code)
        if values.texture_file is not None:
            names += _write_image(prim, values.texture_file, written_to, code)
        if values.radiance is not None:
            names += _write_radiance(prim, np.asarray(values.radiance, np.float64), code)
        return overridden_opinions(prim, written_to, names, time)


def _refuse(stage: Usd.Stage, path: Sdf.Path, values: LightValues) -> None:
    """Raise an error for what can be seen before anything is written."""
    for ancestor in path.GetPrefixes():
        prim = stage.GetPrimAtPath(ancestor)
        if prim and (prim.IsInstance() or prim.IsInstanceProxy() or prim.IsInPrototype()):
            raise EditError(
                f"{path} lies in the instance {ancestor}, whose lights are shared by all its placements;"
                " change it in the asset, or switch off `instanceable` there"
            )
    prim = stage.GetPrimAtPath(path)
    if values.kind is not None:
        if prim and prim.IsDefined():
            raise EditError(f"{path} exists already as a {prim.GetTypeName() or 'prim'}; add the light elsewhere")
        return
    kind = str(prim.GetTypeName()) if prim else ""
    if kind not in (*_SIZES, *_DOMES):
        what = "a mesh that glows: change its material" if prim and prim.IsA(UsdGeom.Mesh) else "no light of the stage"
        raise EditError(f"{path} is {what}")
    if values.removed and prim.GetAllChildren():
        first = prim.GetAllChildren()[0].GetPath()
        raise EditError(f"{path} cannot be removed alone, as {first} lies below it; move that first")


def _write_size(prim: Usd.Prim, size: tuple[float, float], code: Usd.TimeCode) -> list[str]:
    kind = str(prim.GetTypeName())
    if kind == "DistantLight":
        size = (float(np.degrees(2.0 * size[0])), 0.0)
    names = []
    for name, value in zip(_SIZES.get(kind, ()), size, strict=False):
        names.append(_set(prim, f"inputs:{name}", Sdf.ValueTypeNames.Float, float(value), code))
    as_point = prim.GetAttribute("treatAsPoint")
    if kind == "SphereLight" and as_point and as_point.Get(code) and size[0] > 0:
        names.append(_set(prim, "treatAsPoint", Sdf.ValueTypeNames.Bool, False, code))
    return names


def _write_place(prim: Usd.Prim, to_world: F64, code: Usd.TimeCode) -> list[str]:
    """One matrix in place of whatever ops there are."""
    xformable = UsdGeom.Xformable(prim)
    ancestors = [stage_prim for stage_prim in _upwards(prim) if UsdGeom.Xformable(stage_prim)]
    moving = next((p for p in ancestors if UsdGeom.Xformable(p).TransformMightBeTimeVarying()), None)
    if moving is not None and code.IsDefault():
        raise EditError(
            f"{prim.GetPath()} moves over time with {moving.GetPath()}; give the frame that its place is written at"
        )
    matrix = np.eye(4)
    matrix[:3] = to_world / meters_per_unit(prim.GetStage())
    if prim.GetTypeName() == "DomeLight_1" and pole_axis(prim) == "Z":
        matrix[:3, :3] = matrix[:3, :3] @ POLE_TURN.T
    parent = UsdGeom.XformCache(_readable(code)).GetParentToWorldTransform(prim)
    if abs(parent.GetDeterminant()) < 1e-30:
        raise EditError(f"{prim.GetPath()} lies below a transform that is flat, so it cannot be placed")
    local = Gf.Matrix4d(*matrix.T.reshape(-1).tolist()) * parent.GetInverse()
    ops = xformable.GetOrderedXformOps()
    is_matrix = len(ops) == 1 and ops[0].GetOpType() == UsdGeom.XformOp.TypeTransform and not ops[0].IsInverseOp()
    op = ops[0] if is_matrix and not xformable.GetResetXformStack() else xformable.MakeMatrixXform()
    op.Set(local, code)
    return [op.GetName(), "xformOpOrder"] if not is_matrix else [op.GetName()]


def _write_image(prim: Usd.Prim, file: str, layer: Sdf.Layer, code: Usd.TimeCode) -> list[str]:
    asset = Sdf.AssetPath(asset_path(layer, file) if file else "")
    names = [_set(prim, "inputs:texture:file", Sdf.ValueTypeNames.Asset, asset, code)]
    layout = prim.GetAttribute("inputs:texture:format")
    if file and layout and layout.Get(code) not in (None, "automatic", "latlong"):
        names.append(_set(prim, "inputs:texture:format", Sdf.ValueTypeNames.Token, "latlong", code))
    return names


def _write_radiance(prim: Usd.Prim, wanted: F64, code: Usd.TimeCode) -> list[str]:
    """Intensity alone where the hue stays; exposure, colour temperature and `normalize` stay as they are."""
    light = UsdLux.LightAPI(prim)
    names = []
    inputs = (light.GetColorAttr(), light.GetIntensityAttr(), light.GetExposureAttr())
    moving = next((attribute for attribute in inputs if attribute.ValueMightBeTimeVarying()), None)
    now = read_light_radiance(prim, _readable(code))
    if np.allclose(now, wanted, rtol=1e-6, atol=0.0):
        return []
    if moving is not None and code.IsDefault():
        raise EditError(f"{prim.GetPath()}: {moving.GetName()} changes over time; give the frame to write it at")
    if not now.all():
        names = [_color(light, np.ones(3), code), _intensity(light, 1.0, code)]
        now = read_light_radiance(prim, _readable(code))
        if not now.all():
            raise EditError(f"{prim.GetPath()} gives no light whatever its color and intensity; look at its exposure")
    ratio = wanted / now
    intensity = float(light.GetIntensityAttr().Get(_readable(code)))
    if np.ptp(ratio) <= 1e-6 * ratio.max():
        return [*names, _intensity(light, intensity * float(ratio.mean()), code)]
    color = np.array(light.GetColorAttr().Get(_readable(code)), np.float64) * ratio
    largest = color.max()
    return [*names, _color(light, color / largest, code), _intensity(light, intensity * largest, code)]


def _color(light: UsdLux.LightAPI, color: F64, code: Usd.TimeCode) -> str:
    attribute = light.CreateColorAttr()
    attribute.Set(Gf.Vec3f(*(float(c) for c in color)), code)
    return str(attribute.GetName())


def _intensity(light: UsdLux.LightAPI, intensity: float, code: Usd.TimeCode) -> str:
    attribute = light.CreateIntensityAttr()
    attribute.Set(intensity, code)
    return str(attribute.GetName())


def _set(prim: Usd.Prim, name: str, kind: Sdf.ValueTypeName, value: object, code: Usd.TimeCode) -> str:
    attribute = prim.CreateAttribute(name, kind, False)
    attribute.Set(value, code)
    return name


def _readable(code: Usd.TimeCode) -> Usd.TimeCode:
    """Defaults are hidden by time samples, as they are for who reads the scene."""
    return Usd.TimeCode.EarliestTime() if code.IsDefault() else code


def _upwards(prim: Usd.Prim) -> list[Usd.Prim]:
    found = []
    while prim and not prim.IsPseudoRoot():
        found.append(prim)
        prim = prim.GetParent()
    return found
