"""Which camera looks, at what size, and its film window in metres."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdRender

from icheat_usd.errors import StageError
from icheat_usd.scene import F64, Camera, Finding
from icheat_usd.stage.transforms import Placement, from_gf

DEFAULT_WIDTH = 640


@dataclass(frozen=True)
class RenderChoices:
    """What the stage's render settings say about the image; None where they say nothing."""

    camera: str | None = None
    resolution: tuple[int, int] | None = None
    pixel_aspect: float = 1.0
    conform: str = "expandAperture"
    depth_of_field: bool = True
    motion_blur: bool = True
    material_purpose: str = "full"
    purposes: tuple[str, ...] = ("default", "render")


def read_render_choices(stage: Usd.Stage, time: Usd.TimeCode, product: str | None = None) -> RenderChoices:
    """The settings that the stage names as ``renderSettingsPrimPath``, and a product's overrides of them.

    Parameters
    ----------
    product
        Path of the product; the settings' first one by default.
    """
    settings = UsdRender.Settings.GetStageRenderSettings(stage)
    bases = [settings] if settings else []
    targets = settings.GetProductsRel().GetForwardedTargets()[:1] if settings else []
    for target in targets if product is None else [product]:
        if chosen := UsdRender.Product(stage.GetPrimAtPath(target)):
            bases.insert(0, chosen)
    if not bases:
        return RenderChoices()

    def first(name: str, fallback: object) -> object:
        for base in bases:
            attribute = base.GetPrim().GetAttribute(name)
            if attribute and attribute.HasAuthoredValue():
                return attribute.Get(time)
        return fallback

    cameras = [str(path) for base in bases for path in base.GetCameraRel().GetForwardedTargets()]
    resolution = first("resolution", None)
    purposes = first("materialBindingPurposes", ["full", ""])
    return RenderChoices(
        camera=cameras[0] if cameras else None,
        resolution=None if resolution is None else _pixels(bases[-1], resolution),
        pixel_aspect=_number(bases[-1], first("pixelAspectRatio", 1.0)),
        conform=str(first("aspectRatioConformPolicy", "expandAperture")),
        depth_of_field=not first("disableDepthOfField", False),
        # The second is the first one's name in older stages.
        motion_blur=not (first("disableMotionBlur", False) or first("instantaneousShutter", False)),
        material_purpose=next((str(purpose) for purpose in purposes if purpose), ""),  # type: ignore[attr-defined]
        purposes=tuple(map(str, first("includedPurposes", RenderChoices.purposes))),  # type: ignore[call-overload]
    )


def named_settings_findings(stage: Usd.Stage) -> tuple[Finding, ...]:
    """A finding where the stage names render settings that are none: nothing of them counts."""
    named = stage.GetMetadata("renderSettingsPrimPath")
    if not named:
        return ()
    if not isinstance(named, str):
        return (Finding("/", "renderSettingsPrimPath", "is no text; write the path of a RenderSettings in quotes."),)
    if UsdRender.Settings.GetStageRenderSettings(stage):
        return ()
    prim = stage.GetPrimAtPath(named) if Sdf.Path.IsValidPathString(named) else None
    what = f"is a {prim.GetTypeName() or 'typeless prim'} and no RenderSettings" if prim else "does not exist"
    message = f"{named} {what}, so camera, resolution and products are not taken from it."
    return (Finding("/", "renderSettingsPrimPath", message),)


def _pixels(settings: UsdRender.Settings, resolution: object) -> tuple[int, int]:
    try:
        width, height = (int(size) for size in resolution)  # type: ignore[attr-defined]
    except (TypeError, ValueError) as problem:
        raise StageError(f"{settings.GetPath()}: resolution is no int2; author a width and a height.") from problem
    if min(width, height) < 1:
        message = f"{settings.GetPath()}: resolution is {width} x {height}; author a width and a height of at least 1."
        raise StageError(message)
    return width, height


def _number(settings: UsdRender.Settings, value: object) -> float:
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError) as problem:
        raise StageError(f"{settings.GetPath()}: pixelAspectRatio is no number; author one above 0.") from problem


def find_camera(stage: Usd.Stage, camera: str | None, choices: RenderChoices) -> UsdGeom.Camera:
    """The named camera, else the render settings', else the stage's only one.

    Raises
    ------
    StageError
        The named prim is missing or no camera; or there is none, or more than one, to choose from.
    """
    where = stage.GetRootLayer().identifier
    wanted = camera if camera is not None else choices.camera
    if wanted is not None:
        prim = stage.GetPrimAtPath(wanted) if wanted.startswith("/") else None
        if prim and prim.IsA(UsdGeom.Camera):
            return UsdGeom.Camera(prim)
        said = "is named as camera" if camera is not None else "is the camera of the render settings"
        problem = f"is a {prim.GetTypeName() or 'typeless prim'}" if prim else "does not exist"
        raise StageError(f"{wanted} {said} but {problem} in {where}; {_candidates(_cameras(stage))}.")
    cameras = _cameras(stage)
    if len(cameras) == 1:
        return cameras[0]
    if not cameras:
        raise StageError(f"{where} has no camera; add one, or choose the camera 'auto' to frame all geometry.")
    raise StageError(f"{where} has several cameras and its render settings choose none; {_candidates(cameras)}.")


def _cameras(stage: Usd.Stage) -> list[UsdGeom.Camera]:
    prims = Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())
    return [UsdGeom.Camera(prim) for prim in prims if prim.IsA(UsdGeom.Camera)]


def _candidates(cameras: list[UsdGeom.Camera]) -> str:
    paths = [str(camera.GetPath()) for camera in cameras]
    if not paths:
        return "the stage has no camera; add one, or choose 'auto' to frame all geometry"
    shown = ", ".join(paths[:8]) + (f" and {len(paths) - 8} more" if len(paths) > 8 else "")
    return f"choose one of: {shown}"


def image_size(
    width: int | None, height: int | None, choices: RenderChoices, aperture_aspect: float
) -> tuple[int, int]:
    """Pixels of the image: as asked, else as the render settings say, else `DEFAULT_WIDTH` by the aperture's aspect."""
    for name, value in (("width", width), ("height", height)):
        if value is not None and value < 1:
            raise StageError(f"The image's {name} is {value}; give at least 1 pixel.")
    if width is None and height is None:
        if choices.resolution is not None:
            return choices.resolution
        return DEFAULT_WIDTH, max(1, round(DEFAULT_WIDTH / aperture_aspect))
    sizes = choices.resolution
    aspect = sizes[0] / sizes[1] if sizes else aperture_aspect
    if width is None:
        assert height is not None
        return max(1, round(height * aspect)), height
    return width, height if height is not None else max(1, round(width / aspect))


def conform(window: tuple[float, float, float, float], aspect: float, policy: str) -> tuple[float, float, float, float]:
    """Fit a window (left, right, bottom, top) to the image's aspect about its own centre, by USD's policy.

    Raises
    ------
    StageError
        The policy is none of UsdRenderSettingsBase's ``aspectRatioConformPolicy`` tokens.
    """
    left, right, bottom, top = window
    wide, high = right - left, top - bottom
    if not (0.0 < aspect < math.inf and 0.0 < wide < math.inf and 0.0 < high < math.inf):
        raise StageError(
            f"The camera's window is {wide:g} x {high:g} and the image's aspect {aspect:g}; "
            "give apertures, pixelAspectRatio and resolution positive numbers."
        )
    is_wider = aspect > wide / high
    if policy == "adjustPixelAspectRatio":
        return window
    if policy == "expandAperture":
        change_width = is_wider
    elif policy == "cropAperture":
        change_width = not is_wider
    elif policy in ("adjustApertureWidth", "adjustApertureHeight"):
        change_width = policy == "adjustApertureWidth"
    else:
        raise StageError(
            f"aspectRatioConformPolicy '{policy}' is unknown; use expandAperture, cropAperture, adjustApertureWidth, "
            "adjustApertureHeight or adjustPixelAspectRatio."
        )
    if change_width:
        centre, half = 0.5 * (left + right), 0.5 * high * aspect
        return (centre - half, centre + half, bottom, top)
    centre, half = 0.5 * (bottom + top), 0.5 * wide / aspect
    return (left, right, centre - half, centre + half)


def read_camera(
    camera: UsdGeom.Camera,
    time: Usd.TimeCode,
    placement: Placement,
    choices: RenderChoices,
    width: int | None = None,
    height: int | None = None,
) -> Camera:
    """A camera prim as the snapshot keeps it.

    Apertures and focal length are in tenths of a scene unit, the rest in scene
    units. Scale and mirroring of the camera's transform are dropped, as USD's
    own frustum does.

    Raises
    ------
    StageError
        Aperture or focal length are not positive.
    """
    view = camera.GetCamera(time)
    unit = placement.meters_per_unit
    path = str(camera.GetPath())
    orthographic = view.projection == Gf.Camera.Orthographic
    wide, high = view.horizontalAperture, view.verticalAperture
    if not (wide > 0.0 and high > 0.0 and (orthographic or view.focalLength > 0.0)):
        raise StageError(
            f"Camera {path} has aperture {wide:g} x {high:g} and focal length {view.focalLength:g}; "
            "give it positive ones."
        )
    # Tenths of scene units: metres on the film (orthographic), or their ratio to the focal length.
    scale = 0.1 * unit if orthographic else 1.0 / view.focalLength
    x, y = view.horizontalApertureOffset, view.verticalApertureOffset
    window = tuple(scale * side for side in (x - 0.5 * wide, x + 0.5 * wide, y - 0.5 * high, y + 0.5 * high))
    columns, rows = image_size(width, height, choices, wide / high)
    window = conform(window, choices.pixel_aspect * columns / rows, choices.conform)

    lens = 0.0
    if choices.depth_of_field and not orthographic and view.fStop > 0.0 and view.focusDistance > 0.0:
        lens = 0.5 * (0.1 * view.focalLength * unit) / view.fStop
    near, far = view.clippingRange.min * unit, view.clippingRange.max * unit
    opens, closes = camera.GetShutterOpenAttr().Get(time), camera.GetShutterCloseAttr().Get(time)
    shutter = (float(opens or 0.0), float(closes or 0.0)) if choices.motion_blur else (0.0, 0.0)
    return Camera(
        path=path,
        to_world=_rigid(view, placement),
        window=window,
        width=columns,
        height=rows,
        orthographic=orthographic,
        lens_radius=lens,
        focus_distance=view.focusDistance * unit,
        near=near,
        far=far,
        shutter=shutter,
        exposure_scale=float(camera.ComputeLinearExposureScale(time)),
    )


def _rigid(view: Gf.Camera, placement: Placement) -> F64:
    frustum = view.frustum
    rotation = Gf.Matrix4d().SetRotate(frustum.rotation)
    to_world = from_gf(rotation)
    to_world[:, 3] = np.array(frustum.position) * placement.meters_per_unit - placement.centre
    return to_world


def frame_camera(
    lower: F64, upper: F64, up_axis: str, width: int | None, height: int | None, choices: RenderChoices | None = None
) -> Camera:
    """A camera that stands off along a diagonal and sees a whole box.

    Parameters
    ----------
    lower, upper : (3,) float64, metres
        Corners of the box.
    up_axis
        "Y" or "Z".
    width, height
        Image size; by default as the render settings say, else 640 pixels wide, 16 to 9.
    """
    columns, rows = image_size(width, height, choices or RenderChoices(), 16.0 / 9.0)
    aspect = columns / rows
    centre, radius = 0.5 * (lower + upper), max(0.5 * float(np.linalg.norm(upper - lower)), 1e-9)
    up = np.array([0.0, 0.0, 1.0] if up_axis == "Z" else [0.0, 1.0, 0.0])
    backward = np.array([0.5, -0.8, 0.35] if up_axis == "Z" else [0.5, 0.35, 0.8])
    backward /= np.linalg.norm(backward)
    right = np.cross(up, backward)
    right /= np.linalg.norm(right)
    half = 0.4  # half of the shorter side of the window, one metre in front of the eye
    distance = radius * float(np.hypot(1.0, half)) / half
    wide, high = (half * aspect, half) if aspect >= 1.0 else (half, half / aspect)
    eye = centre + distance * backward
    return Camera(
        path="auto",
        to_world=np.stack([right, np.cross(backward, right), backward, eye], axis=1),
        window=(-wide, wide, -high, high),
        width=columns,
        height=rows,
        near=0.01 * radius,
        far=distance + 2.0 * radius,
        focus_distance=distance,
    )
