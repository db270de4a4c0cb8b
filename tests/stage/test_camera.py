"""Cameras look where USD's own frustum looks, at the size the settings ask for."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdRender

from icheat_usd.errors import StageError
from icheat_usd.scene import Camera
from icheat_usd.stage.camera import (
    RenderChoices,
    conform,
    find_camera,
    frame_camera,
    named_settings_findings,
    read_camera,
    read_render_choices,
)
from icheat_usd.stage.transforms import Placement

NOW = Usd.TimeCode.EarliestTime()


def stage_with(*names: str) -> Usd.Stage:
    stage = Usd.Stage.CreateInMemory()
    for name in names:
        UsdGeom.Camera.Define(stage, f"/{name}")
    return stage


def taken(
    camera: UsdGeom.Camera,
    width: int | None = None,
    height: int | None = None,
    *,
    unit: float = 1.0,
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
    choices: RenderChoices | None = None,
) -> Camera:
    return read_camera(camera, NOW, Placement(unit, np.array(centre)), choices or RenderChoices(), width, height)


def test_the_window_is_usds_own_frustum_with_offsets() -> None:
    stage = stage_with("cam")
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/cam"))
    camera.GetHorizontalApertureAttr().Set(36.0)
    camera.GetVerticalApertureAttr().Set(24.0)
    camera.GetHorizontalApertureOffsetAttr().Set(3.0)
    camera.GetVerticalApertureOffsetAttr().Set(-1.5)
    camera.GetFocalLengthAttr().Set(35.0)
    view = taken(camera, 360, 240, unit=0.01)
    window = camera.GetCamera(NOW).frustum.window
    assert view.window == pytest.approx((window.min[0], window.max[0], window.min[1], window.max[1]), rel=1e-6)
    assert (view.width, view.height) == (360, 240)


@pytest.mark.parametrize("scale", [(1, 1, 1), (3, 3, 3), (0.5, 2, 7), (-1, 1, 1)])
def test_the_pose_is_rigid_and_matches_usds_rays(scale: tuple[float, float, float]) -> None:
    stage = stage_with("cam")
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/cam"))
    camera.AddTranslateOp().Set(Gf.Vec3d(100, 200, 300))
    camera.AddRotateXYZOp().Set(Gf.Vec3f(20, 130, -40))
    camera.AddScaleOp().Set(Gf.Vec3f(*scale))
    view = taken(camera, 64, 48, unit=0.01, centre=(1.0, 2.0, 3.5))
    rotation = view.to_world[:, :3]
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert np.allclose(view.to_world[:, 3], (0.0, 0.0, -0.5))
    frustum = camera.GetCamera(NOW).frustum
    corners = [np.array(corner) for corner in frustum.ComputeCorners()]
    forward = np.mean(corners[4:], axis=0) - np.array(frustum.position)
    assert np.allclose(rotation @ [0, 0, -1], forward / np.linalg.norm(forward), atol=1e-6)
    up = corners[2] - corners[0]
    assert np.allclose(rotation @ [0, 1, 0], up / np.linalg.norm(up), atol=1e-6)


def test_lens_focus_and_clipping_are_metres() -> None:
    stage = stage_with("cam")
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/cam"))
    camera.GetFocalLengthAttr().Set(50.0)
    camera.GetFStopAttr().Set(2.0)
    camera.GetFocusDistanceAttr().Set(250.0)
    camera.GetClippingRangeAttr().Set(Gf.Vec2f(10, 5000))
    camera.GetShutterOpenAttr().Set(-0.25)
    camera.GetShutterCloseAttr().Set(0.25)
    view = taken(camera, unit=0.01)
    assert view.lens_radius == pytest.approx(0.0125)  # a 50 mm lens at f/2 is 25 mm across
    assert view.focus_distance == pytest.approx(2.5)
    assert (view.near, view.far) == pytest.approx((0.1, 50.0))
    assert view.shutter == (-0.25, 0.25)
    assert taken(camera, choices=RenderChoices(depth_of_field=False)).lens_radius == 0.0
    camera.GetFStopAttr().Set(0.0)
    assert taken(camera).lens_radius == 0.0


def test_an_orthographic_window_is_in_metres() -> None:
    stage = stage_with("cam")
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/cam"))
    camera.GetProjectionAttr().Set("orthographic")
    camera.GetHorizontalApertureAttr().Set(400.0)
    camera.GetVerticalApertureAttr().Set(200.0)
    view = taken(camera, 200, 100, unit=0.01)
    assert view.orthographic
    assert view.window == pytest.approx((-0.2, 0.2, -0.1, 0.1))  # 40 x 20 units of 1 cm


def test_exposure_is_recorded() -> None:
    stage = stage_with("cam")
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/cam"))
    assert taken(camera).exposure_scale == pytest.approx(1.0)
    camera.GetPrim().GetAttribute("exposure").Set(2.0)
    assert taken(camera).exposure_scale == pytest.approx(4.0)


@pytest.mark.parametrize(
    ("policy", "aspect", "expected"),
    [
        ("expandAperture", 4.0, (-3, 5, -1, 1)),
        ("expandAperture", 1.0, (-1, 3, -2, 2)),
        ("cropAperture", 4.0, (-1, 3, -0.5, 0.5)),
        ("cropAperture", 1.0, (0, 2, -1, 1)),
        ("adjustApertureWidth", 1.0, (0, 2, -1, 1)),
        ("adjustApertureHeight", 1.0, (-1, 3, -2, 2)),
        ("adjustPixelAspectRatio", 1.0, (-1, 3, -1, 1)),
    ],
)
def test_aspect_policies_keep_the_windows_centre(
    policy: str, aspect: float, expected: tuple[float, float, float, float]
) -> None:
    assert conform((-1, 3, -1, 1), aspect, policy) == pytest.approx(expected)


def test_an_unknown_policy_lists_the_known_ones() -> None:
    with pytest.raises(StageError, match="expandAperture"):
        conform((-1, 1, -1, 1), 2.0, "stretch")


def test_the_only_camera_is_taken_and_several_are_listed() -> None:
    assert str(find_camera(stage_with("one"), None, RenderChoices()).GetPath()) == "/one"
    with pytest.raises(StageError, match="several cameras.*/one, /two"):
        find_camera(stage_with("one", "two"), None, RenderChoices())
    with pytest.raises(StageError, match="no camera"):
        find_camera(stage_with(), None, RenderChoices())
    assert str(find_camera(stage_with("one", "two"), "/two", RenderChoices()).GetPath()) == "/two"


@pytest.mark.parametrize("wanted", ["/nowhere", "two", "/box", ""])
def test_a_name_that_is_no_camera_lists_those_there_are(wanted: str) -> None:
    stage = stage_with("one", "two")
    stage.DefinePrim("/box", "Cube")
    with pytest.raises(StageError, match="/one, /two"):
        find_camera(stage, wanted, RenderChoices())


def test_render_settings_choose_camera_size_and_policy_and_a_product_overrides_them() -> None:
    stage = stage_with("one", "two")
    settings = UsdRender.Settings.Define(stage, "/Render/settings")
    settings.CreateCameraRel().SetTargets(["/two"])
    settings.CreateResolutionAttr().Set(Gf.Vec2i(320, 200))
    settings.CreateAspectRatioConformPolicyAttr().Set("cropAperture")
    assert read_render_choices(stage, NOW) == RenderChoices()
    stage.SetMetadata("renderSettingsPrimPath", "/Render/settings")
    choices = read_render_choices(stage, NOW)
    camera = find_camera(stage, None, choices)
    assert str(camera.GetPath()) == "/two"
    view = taken(camera, choices=choices)
    assert (view.width, view.height) == (320, 200) and choices.conform == "cropAperture"
    assert taken(camera, 160, choices=choices).height == 100
    product = UsdRender.Product.Define(stage, "/Render/product")
    product.CreateResolutionAttr().Set(Gf.Vec2i(64, 32))
    product.CreateCameraRel().SetTargets(["/one"])
    settings.CreateProductsRel().SetTargets([Sdf.Path("/Render/product")])
    choices = read_render_choices(stage, NOW)
    assert choices.camera == "/one" and choices.resolution == (64, 32) and choices.conform == "cropAperture"


def test_settings_that_the_stage_names_and_that_are_none_are_found() -> None:
    stage = stage_with("one")
    assert named_settings_findings(stage) == ()
    for named, problem in (("/Render/gone", "does not exist"), ("/one", "is a Camera")):
        stage.SetMetadata("renderSettingsPrimPath", named)
        (finding,) = named_settings_findings(stage)
        assert finding.feature == "renderSettingsPrimPath" and f"{named} {problem}" in finding.message
    typed = Sdf.Layer.CreateAnonymous(".usda")
    typed.ImportFromString("#usda 1.0\n(\n    renderSettingsPrimPath = </Render/gone>\n)\n")
    (finding,) = named_settings_findings(Usd.Stage.Open(typed))
    assert "is no text" in finding.message
    UsdRender.Settings.Define(stage, "/Render/gone")
    stage.SetMetadata("renderSettingsPrimPath", "/Render/gone")
    assert named_settings_findings(stage) == ()


@pytest.mark.parametrize("resolution", [(0, 100), (320, -3)])
def test_a_resolution_without_pixels_is_an_error(resolution: tuple[int, int]) -> None:
    stage = stage_with("one")
    settings = UsdRender.Settings.Define(stage, "/Render/settings")
    settings.CreateResolutionAttr().Set(Gf.Vec2i(*resolution))
    stage.SetMetadata("renderSettingsPrimPath", "/Render/settings")
    with pytest.raises(StageError, match=f"/Render/settings: resolution is {resolution[0]} x {resolution[1]}"):
        read_render_choices(stage, NOW)


def test_the_default_size_follows_the_aperture() -> None:
    stage = stage_with("cam")
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/cam"))
    camera.GetHorizontalApertureAttr().Set(40.0)
    camera.GetVerticalApertureAttr().Set(20.0)
    assert (taken(camera).width, taken(camera).height) == (640, 320)
    assert (taken(camera, height=100).width, taken(camera, width=50).height) == (200, 25)
    with pytest.raises(StageError, match="at least 1 pixel"):
        taken(camera, width=0)


def test_a_camera_without_aperture_is_an_error() -> None:
    stage = stage_with("cam")
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/cam"))
    camera.GetFocalLengthAttr().Set(0.0)
    with pytest.raises(StageError, match="/cam.*focal length 0"):
        taken(camera)


@pytest.mark.parametrize("up", ["Y", "Z"])
@pytest.mark.parametrize("size", [(64, 36), (36, 64)])
def test_the_framing_camera_sees_every_corner_of_the_box(up: str, size: tuple[int, int]) -> None:
    lower, upper = np.array([-1.0, -5.0, -0.5]), np.array([3.0, 1.0, 0.5])
    view = frame_camera(lower, upper, up, *size)
    corners = np.array([(x, y, z) for x in (-1.0, 3.0) for y in (-5.0, 1.0) for z in (-0.5, 0.5)])
    local = (corners - view.to_world[:, 3]) @ view.to_world[:, :3]
    assert (-local[:, 2] > view.near).all() and (-local[:, 2] < view.far).all()
    film = local[:, :2] / -local[:, 2:]
    left, right, bottom, top = view.window
    assert (film[:, 0] > left).all() and (film[:, 0] < right).all()
    assert (film[:, 1] > bottom).all() and (film[:, 1] < top).all()
    assert (right - left) / (top - bottom) == pytest.approx(size[0] / size[1])
    rotation = view.to_world[:, :3]
    assert np.allclose(rotation @ rotation.T, np.eye(3)) and np.linalg.det(rotation) == pytest.approx(1.0)
    assert rotation["XYZ".index(up), 1] > 0.5
