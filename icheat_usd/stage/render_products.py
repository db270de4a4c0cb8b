"""What the stage's render settings want written: products, and the variables that each holds."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pxr import Sdf, Usd, UsdRender

from icheat_usd.errors import StageError
from icheat_usd.scene import Finding
from icheat_usd.stage.camera import named_settings_findings
from icheat_usd.stage.refusals import named_refusals
from icheat_usd.stage.reporting import Reporter

#: The name that a Hydra render delegate gives a variable in the product, where it is authored.
AOV_NAME = "driver:parameters:aov:name"

#: Names of the colour space that light is computed in.
_COLOR_SPACES = ("lin_rec709_scene", "lin_rec709", "lin_srgb")

_DRIVER = "driver:parameters:"
_SCALARS = ("half", "float", "double")
_SEVERAL = re.compile(r"(?:(?:color|vector|normal|point)([34])[hfd])|(?:(?:half|float|double)([34]))")


@dataclass(frozen=True)
class RenderVariable:
    """A RenderVar prim."""

    path: str
    source: str  #: sourceName; the prim's name where none is authored
    source_type: str  #: raw, primvar, lpe or intrinsic
    name: str  #: in the product: the aov name if authored, else the prim's; "" for that of what `source` means
    n_channels: int  #: that dataType has
    is_half: bool  #: dataType has 16 bits a channel


@dataclass(frozen=True)
class RenderProduct:
    """A RenderProduct prim at one time."""

    path: str
    file: str  #: productName, a relative one resolved against the folder of the stage; may hold #### for the frame
    variables: tuple[RenderVariable, ...]
    camera: str | None  #: that the product itself names, not its settings
    views: tuple[object, ...]  #: what decides the camera's rays: products that are equal here share them


@named_refusals
def read_render_products(
    stage: Usd.Stage, time: float | None = None, only: str | None = None
) -> tuple[tuple[RenderProduct, ...], tuple[Finding, ...]]:
    """Products of the stage's render settings at one time, and what they ask for that is not supported.

    Parameters
    ----------
    only : str, optional
        Path of one product, which need not be one of the settings'.

    Raises
    ------
    StageError
        There is no such product, or there are none; the message says what there is.
    """
    if time is None and stage.HasAuthoredMetadata("startTimeCode"):
        time = stage.GetStartTimeCode()
    when = Usd.TimeCode.EarliestTime() if time is None else Usd.TimeCode(time)
    report = Reporter()
    settings = UsdRender.Settings.GetStageRenderSettings(stage)
    paths = list(settings.GetProductsRel().GetForwardedTargets()) if settings else []
    if only is not None:
        paths = [_product_path(stage, only)]
    space = settings.GetRenderingColorSpaceAttr() if settings else None
    if space and space.HasAuthoredValue() and space.Get(when) not in (None, "", *_COLOR_SPACES):
        report(settings, "renderingColorSpace", f"'{space.Get(when)}' is not supported; light is linear Rec.709.")
    products = []
    for path in paths:
        product = UsdRender.Product(stage.GetPrimAtPath(path))
        if not product:
            report(path, "products", "is listed by the render settings and is no RenderProduct; it is not written.")
        elif (kind := product.GetProductTypeAttr().Get(when)) != "raster":
            report(path, "productType", f"'{kind}' is not supported, only raster; it is not written.")
        else:
            products.append(_read_product(stage, settings, product, when, report))
    if not products:
        raise StageError(_nothing_to_write(stage, settings, report))
    return tuple(products), report.findings()


def names_products(stage: Usd.Stage) -> bool:
    """Whether the stage has render settings and these list products."""
    if named_settings_findings(stage):
        return False
    settings = UsdRender.Settings.GetStageRenderSettings(stage)
    return bool(settings and settings.GetProductsRel().GetForwardedTargets())


def _product_path(stage: Usd.Stage, text: str) -> Sdf.Path:
    if Sdf.Path.IsValidPathString(text) and UsdRender.Product(stage.GetPrimAtPath(Sdf.Path(text))):
        return Sdf.Path(text)
    known = [str(prim.GetPath()) for prim in stage.Traverse() if prim.IsA(UsdRender.Product)]
    there = f"there are {', '.join(known)}" if known else "the stage has none, so add one or give -o FILE alone"
    raise StageError(f"{stage.GetRootLayer().identifier}: no RenderProduct {text}; {there}.")


def _nothing_to_write(stage: Usd.Stage, settings: UsdRender.Settings, report: Reporter) -> str:
    where = stage.GetRootLayer().identifier
    if not settings:
        return f"{where}: the stage names no render settings, so nothing says what to write; give -o FILE."
    refused = "".join(f" ({finding.prim}: {finding.message})" for finding in report.findings())
    return f"{where}: render settings {settings.GetPath()} have no product to write{refused}; give -o FILE."


def _read_product(
    stage: Usd.Stage, settings: UsdRender.Settings, product: UsdRender.Product, when: Usd.TimeCode, report: Reporter
) -> RenderProduct:
    path = product.GetPath()
    # A token, of which Get(default) may know nothing where only time samples are authored.
    name = product.GetProductNameAttr().Get(when)
    if not name:
        raise StageError(f"{path}: productName is not authored at this time; name a file, such as beauty.####.exr.")
    file = Path(str(name))
    if not file.is_absolute():
        root = stage.GetRootLayer()
        if not root.realPath:
            raise StageError(f"{path}: productName '{name}' is relative, but the stage has no folder; give -o FILE.")
        file = Path(root.realPath).parent / file
    variables = []
    for target in product.GetOrderedVarsRel().GetForwardedTargets():
        if variable := UsdRender.Var(stage.GetPrimAtPath(target)):
            variables.append(_read_variable(variable, when, report))
        else:
            report(target, "orderedVars", f"is listed by {path} and is no RenderVar; it is left out.")
    bases = [product, settings] if settings else [product]
    window = _first(bases, "dataWindowNDC", when)
    if window is not None and tuple(window) != (0, 0, 1, 1):
        report(path, "dataWindowNDC", f"{tuple(window)} is not supported; the whole image is rendered.")
    cameras = product.GetCameraRel().GetForwardedTargets()
    own = str(cameras[0]) if cameras else None
    return RenderProduct(str(path), str(file), tuple(variables), own, _views(bases, when))


def _read_variable(variable: UsdRender.Var, when: Usd.TimeCode, report: Reporter) -> RenderVariable:
    prim = variable.GetPrim()
    authored = variable.GetSourceNameAttr().Get(when)
    aov = prim.GetAttribute(AOV_NAME)
    name = str(aov.Get(when) or "") if aov else ""
    for attribute in prim.GetAuthoredAttributes():
        if attribute.GetName().startswith(_DRIVER) and attribute.GetName() != AOV_NAME:
            report(prim, attribute.GetName(), "is not supported and ignored.")
    kind = str(variable.GetDataTypeAttr().Get(when))
    several = _SEVERAL.fullmatch(kind)
    if several is None and kind not in _SCALARS:
        report(prim, "dataType", f"'{kind}' is not supported; what the source has is written as float.")
    n_channels = int(several[1] or several[2]) if several else 1 if kind in _SCALARS else 0
    is_half = kind.startswith("half") or (several is not None and kind.endswith("h"))
    return RenderVariable(
        str(prim.GetPath()),
        str(authored or prim.GetName()),
        str(variable.GetSourceTypeAttr().Get(when)),
        name,
        n_channels,
        is_half,
    )


def _views(bases: list[Any], when: Usd.TimeCode) -> tuple[object, ...]:
    cameras: list[Any] = next((found for base in bases if (found := base.GetCameraRel().GetForwardedTargets())), [])
    names = (
        "resolution",
        "pixelAspectRatio",
        "aspectRatioConformPolicy",
        "disableDepthOfField",
        "disableMotionBlur",
        "instantaneousShutter",
    )
    return (tuple(map(str, cameras)), *(str(_first(bases, name, when)) for name in names))


def _first(bases: list[Any], name: str, when: Usd.TimeCode) -> Any:
    """The strongest opinion of a product and its settings; None if neither has one."""
    for base in bases:
        attribute = base.GetPrim().GetAttribute(name)
        if attribute and attribute.HasAuthoredValue():
            return attribute.Get(when)
    return None
