"""What a live session shows while its kernels are being compiled, and how it waits for them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

from icheat_usd.errors import IcheatError
from icheat_usd.resources import resource_path
from icheat_usd.scene import F32
from icheat_usd.session import GatherSettings, Session, document, first_look, first_use, live_frames, warming
from icheat_usd.session.first_look import rough_surfaces, surfaces_by_headlight
from icheat_usd.session.first_use import FirstUse, begin_use, end_use
from icheat_usd.session.live import LiveSession
from icheat_usd.session.live_events import LiveEvent
from icheat_usd.session.quality import DRAFT
from icheat_usd.session.warming import LIVE_PURPOSES, may_help

Report = Callable[[str, float], None]


# The rough look -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["cornell_box", "staircase"])
def test_the_rough_look_is_the_fine_one_but_for_borders(name: str) -> None:
    session = Session.open(resource_path(f"sample_stages/{name}/shot.usda"), width=64, height=48, quality=DRAFT)
    found, fine = rough_surfaces(session.rough_snapshot()), surfaces_by_headlight(session.view)
    assert found is not None and found.shape == fine.shape and found.dtype == fine.dtype
    apart = np.abs(found - fine).max(axis=-1) / np.maximum(fine.max(axis=-1), 0.02)
    assert np.median(apart) < 1e-6 and np.mean(apart > 0.1) < 0.03


def plates(*, orthographic: bool) -> Usd.Stage:
    """A red square of 2 m that faces a camera 5 m away, a blue instance of one half as wide beside it, tilted by 60
    degrees about its upright axis."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    for path, colour in (("/Red", (0.8, 0.1, 0.1)), ("/Many/Blue", (0.1, 0.2, 0.6))):
        mesh = UsdGeom.Mesh.Define(stage, path)
        mesh.CreatePointsAttr([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
        mesh.CreateFaceVertexCountsAttr([4])
        mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
        mesh.CreateDisplayColorAttr([colour])
    many = UsdGeom.PointInstancer.Define(stage, "/Many")
    many.CreatePrototypesRel().SetTargets([Sdf.Path("/Many/Blue")])
    many.CreateProtoIndicesAttr([0])
    many.CreatePositionsAttr([(2, 0, 0)])
    many.CreateScalesAttr([(0.5, 0.5, 0.5)])
    many.CreateOrientationsAttr([Gf.Quath(Gf.Rotation((0, 1, 0), 60).GetQuat())])
    camera = UsdGeom.Camera.Define(stage, "/Camera")
    UsdGeom.XformCommonAPI(camera).SetTranslate((0, 0, 5))
    camera.CreateProjectionAttr("orthographic" if orthographic else "perspective")
    size = 60.0 if orthographic else 24.0  # tenths of a metre: 6 m on the plane of the squares, or on that 2 m ahead
    camera.CreateHorizontalApertureAttr(size)
    camera.CreateVerticalApertureAttr(size)
    camera.CreateFocalLengthAttr(20.0)
    return stage


def rough(stage: Usd.Stage) -> F32:
    image = rough_surfaces(Session.open(stage, width=60, height=60, quality=DRAFT).rough_snapshot())
    assert image is not None
    return image


@pytest.mark.parametrize("orthographic", [True, False])
def test_colours_and_angles_of_the_rough_look_are_exact(orthographic: bool) -> None:
    image = rough(plates(orthographic=orthographic))
    if orthographic:
        # A pixel is 0.1 m: the square covers 20 of them, the tilted one 5 by 10.
        red, blue = np.zeros((60, 60), bool), np.zeros((60, 60), bool)
        red[20:40, 20:40] = True
        blue[25:35, 48:52] = True
        np.testing.assert_allclose(image[red], np.broadcast_to((0.8, 0.1, 0.1), (400, 3)), rtol=1e-6)
        shade = 0.25 + 0.75 * 0.5  # as well as the half precision of an instancer's orientation has it
        np.testing.assert_allclose(
            image[blue], np.broadcast_to((0.1 * shade, 0.2 * shade, 0.6 * shade), (40, 3)), rtol=2e-4
        )
        assert np.count_nonzero(image.any(axis=-1)) in range(440, 461)  # middles of pixels lie on its borders
        return
    # The middle of a pixel is 0.1 m further away from the next where they lie 5 m ahead.
    offset = (np.arange(60) - 29.5) * 0.1
    facing = 5 / np.sqrt(25 + offset[None] ** 2 + offset[:, None] ** 2)
    expected = np.float32([0.8, 0.1, 0.1]) * (0.25 + 0.75 * facing[20:40, 20:40, None])
    np.testing.assert_allclose(image[20:40, 20:40], expected, rtol=1e-5)
    assert not image[:20].any() and not image[40:].any()


def test_a_texture_counts_with_the_mean_of_what_is_not_see_through(tmp_path: Path) -> None:
    stage = plates(orthographic=True)
    texels = np.array([[(0.2, 0.4, 0.1, 1.0), (1.0, 1.0, 1.0, 0.0)]], np.float32)
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGBA": texels}).write(str(tmp_path / "leaf.exr"))
    material = UsdShade.Material.Define(stage, "/Leaf")
    shader = UsdShade.Shader.Define(stage, "/Leaf/Surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    image = UsdShade.Shader.Define(stage, "/Leaf/Image")
    image.CreateIdAttr("UsdUVTexture")
    image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(str(tmp_path / "leaf.exr"))
    image.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("raw")
    source = image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(source)
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    UsdShade.MaterialBindingAPI.Apply(stage.GetPrimAtPath("/Red")).Bind(material)
    np.testing.assert_allclose(rough(stage)[30, 30], (0.2, 0.4, 0.1), rtol=1e-3)


def test_what_lies_before_the_near_plane_is_not_seen() -> None:
    stage = plates(orthographic=False)
    mesh = UsdGeom.Mesh.Define(stage, "/Near")
    mesh.CreatePointsAttr([(-1, -1, 4.5), (1, -1, 4.5), (1, 1, 4.5), (-1, 1, 4.5)])
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    mesh.CreateDisplayColorAttr([(0.0, 1.0, 0.0)])
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/Camera"))
    camera.CreateClippingRangeAttr(Gf.Vec2f(1, 100))
    assert rough(stage)[30, 30, 0] > rough(stage)[30, 30, 1]
    camera.GetClippingRangeAttr().Set(Gf.Vec2f(0.1, 100))
    assert rough(stage)[30, 30, 0] < rough(stage)[30, 30, 1]


def test_what_has_too_many_triangles_is_not_looked_at_roughly(monkeypatch: pytest.MonkeyPatch) -> None:
    snapshot = Session.open(plates(orthographic=True), width=8, height=8, quality=DRAFT).rough_snapshot()
    assert rough_surfaces(snapshot) is not None
    monkeypatch.setattr(first_look, "_MOST_TRIANGLES", 3)
    assert rough_surfaces(snapshot) is None


# Waiting for kernels --------------------------------------------------------------------------------------------------


class Stopped(BaseException):
    """What a background raises to leave a piece of work."""


def compiling(monkeypatch: pytest.MonkeyPatch, compile_in_turn: Callable[[Sequence[str], Report], None]) -> None:
    """Have nothing compiled yet, and this do it."""
    monkeypatch.setattr(first_use, "may_help", lambda: True)
    monkeypatch.setattr(first_use, "are_compiled", lambda purposes: False)
    monkeypatch.setattr(first_use, "compile_in_turn", compile_in_turn)


def compiling_until_closed(monkeypatch: pytest.MonkeyPatch) -> tuple[list[Sequence[str]], threading.Event]:
    """Have compiling never come to an end by itself; what was begun, and whether it has ended."""
    begun, ended = list[Sequence[str]](), threading.Event()

    def compile_in_turn(purposes: Sequence[str], report: Report) -> None:
        begun.append(purposes)
        try:
            while True:
                report("look", 0.1)
                ended.wait(0.01)
        finally:
            ended.set()

    compiling(monkeypatch, compile_in_turn)
    return begun, ended


def test_each_purpose_is_waited_for_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    go_on = threading.Event()

    def compile_in_turn(purposes: Sequence[str], report: Report) -> None:
        assert tuple(purposes) == LIVE_PURPOSES
        report("look", 1.0)
        report("preview", 0.5)
        go_on.wait(60)
        report("preview", 1.0)

    compiling(monkeypatch, compile_in_turn)
    use = FirstUse()
    said: list[tuple[str, float]] = []
    use.wait("look", lambda step, share: None)
    assert use.is_done("look") and not use.is_done("preview")

    def progress(step: str, share: float) -> None:
        said.append((step, share))
        go_on.set()

    use.wait("preview", progress)
    assert set(said) <= {(warming.STEP, 0.0), (warming.STEP, 0.5)} and use.is_done("preview")
    use.wait("live", lambda step, share: None)  # nothing more comes
    use.close()


def test_what_waits_can_leave_and_what_compiles_ends_when_it_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    ended = compiling_until_closed(monkeypatch)[1]
    use = FirstUse()

    def stop(step: str, share: float) -> None:
        raise Stopped

    with pytest.raises(Stopped):
        use.wait("look", stop)
    assert not ended.is_set()
    use.close()
    assert ended.is_set() and use.is_done("live")
    use.close()


def test_sessions_of_a_process_share_it_and_the_last_one_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    begun, ended = compiling_until_closed(monkeypatch)
    first, second = object(), object()
    use = begin_use(first)
    assert begin_use(second) is use
    end_use(use, first)
    end_use(use, first)
    assert not ended.is_set() and not use.is_over
    end_use(use, second)
    assert ended.is_set() and use.is_over and len(begun) == 1
    end_use(use, second)
    another = begin_use(first)
    assert another is not use
    end_use(another, first)


def test_a_kernel_that_does_not_compile_ahead_is_told_and_left_to_whoever_calls_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def compile_in_turn(purposes: Sequence[str], report: Report) -> None:
        raise IcheatError("kernel a.broken does not compile: its reason")

    compiling(monkeypatch, compile_in_turn)
    with pytest.warns(UserWarning, match="a.broken does not compile: its reason; it is compiled when it is called"):
        use = FirstUse()
        use.wait("live", lambda step, share: None)
        use.close()


def test_processes_help_with_several_cores_an_interpreter_and_a_cache(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("ICHEAT_CACHE_DIR", str(tmp_path / "new"))
    monkeypatch.setattr(warming, "available_cores", lambda: 2)
    for program, is_one in (("python3.12", True), ("mayapy", True), ("hython", True), ("maya.bin", False), ("", False)):
        monkeypatch.setattr(warming.sys, "executable", f"/opt/{program}" if program else "")
        assert may_help() == is_one, program
    monkeypatch.setattr(warming.sys, "executable", "/usr/bin/python3")
    monkeypatch.setattr(warming.os, "access", lambda path, mode: Path(path) != tmp_path)
    assert not may_help()
    monkeypatch.undo()
    monkeypatch.setattr(warming, "available_cores", lambda: 1)
    assert not may_help()


def test_a_live_session_shows_surfaces_before_any_kernel_and_again_before_there_is_light(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    order: list[str] = []
    listens = threading.Event()

    class Slow(FirstUse):
        """Has nothing compiled until it is waited for."""

        def __init__(self) -> None:
            self._waited: set[str] = set()

        def is_done(self, purpose: str) -> bool:
            return listens.wait(60) and purpose in self._waited

        def wait(self, purpose: str, progress: object) -> None:
            order.append(purpose)
            self._waited.add(purpose)

    monkeypatch.setattr(live_frames, "begin_use", lambda user: Slow())
    monkeypatch.setattr(live_frames, "end_use", lambda use, user: None)
    images: list[LiveEvent] = []

    def heard(event: LiveEvent) -> None:
        if event.kind in ("surfaces", "better"):
            order.append(event.kind)
            images.append(event)

    with LiveSession.open(plates(orthographic=True), width=60, height=60, quality=DRAFT) as live:
        live.listen(heard)
        listens.set()
        live.wait("preview")
    assert order[:5] == ["surfaces", "look", "surfaces", "preview", "better"]
    first, second = images[0].image, images[1].image
    assert first is not None and second is not None
    np.testing.assert_allclose(first[30, 30], (0.8, 0.1, 0.1), rtol=1e-5)
    np.testing.assert_allclose(first[30, 30], second[30, 30], rtol=1e-5)


def test_an_image_has_its_kernels_compiled_first(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled: list[str] = []
    monkeypatch.setattr(document, "compile_first", lambda purpose, progress: compiled.append(purpose))
    session = Session.open(plates(orthographic=True), width=4, height=3, quality=replace(DRAFT, n_gather=64))
    session.relight()
    session.render(GatherSettings(samples_per_pixel=1, gather_rays=4, light_samples=1))
    assert compiled == ["relight", "render"]


def test_what_does_not_compile_first_is_told_and_does_no_harm(monkeypatch: pytest.MonkeyPatch) -> None:
    def compile_ahead(purposes: Sequence[str], progress: object) -> int:
        raise IcheatError(f"{purposes[0]} does not compile")

    monkeypatch.setattr(first_use, "compile_ahead", compile_ahead)
    monkeypatch.setattr(first_use, "may_help", lambda: True)
    told: list[str] = []
    first_use.compile_first("relight", print, told.append)
    assert told == ["relight does not compile; it is compiled when it is called"]
    monkeypatch.setattr(first_use, "may_help", lambda: False)
    first_use.compile_first("relight", print, told.append)
    assert len(told) == 1
