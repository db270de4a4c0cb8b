"""While the shutter is open, what moves leaves a ramp; what does not move is as it was."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdRender

from icheat_usd.final_gather import GatherSettings
from icheat_usd.samples import view_samples
from icheat_usd.scene import F64
from icheat_usd.session import Session
from icheat_usd.session.quality import DRAFT
from icheat_usd.session.shutter import moments

WIDTH, HEIGHT = 32, 4
HALF = 2.0  # of the picture's width, metres; a pixel is an eighth of one
SHUTTER = (-0.25, 0.5)
SPEED = 2.0  # metres per frame


def moving_stage(how: str, shutter: tuple[float, float] = SHUTTER) -> Usd.Stage:
    """A half plane whose right edge is at x = SPEED * (frame - 5), seen by an orthographic camera at frame 5."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetStartTimeCode(5)
    camera = UsdGeom.Camera.Define(stage, "/camera")
    camera.CreateProjectionAttr("orthographic")
    camera.CreateHorizontalApertureAttr(2 * HALF * 10)
    camera.CreateVerticalApertureAttr(2 * HALF * 10 * HEIGHT / WIDTH)
    camera.CreateClippingRangeAttr((0.1, 100.0))
    camera.CreateShutterOpenAttr(shutter[0])
    camera.CreateShutterCloseAttr(shutter[1])
    wall = UsdGeom.Mesh.Define(stage, "/wall")
    points = np.array([(-50, -9, -3), (0, -9, -3), (0, 9, -3), (-50, 9, -3)], np.float32)
    wall.CreatePointsAttr(points)
    wall.CreateFaceVertexCountsAttr([4])
    wall.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    wall.CreateSubdivisionSchemeAttr("none")
    place = None
    if how == "xform":
        place = wall.AddTranslateOp()
    elif how == "camera":
        place = camera.AddTranslateOp()
    for frame in (0, 10):
        moved = Gf.Vec3d(SPEED * (frame - 5), 0, 0)
        if how == "points":
            wall.GetPointsAttr().Set(points + np.array(moved, np.float32), frame)
        elif place is not None:
            place.Set(-moved if how == "camera" else moved, frame)
    return stage


def opened(stage: Usd.Stage, frame: float = 5.0) -> Session:
    quality = replace(DRAFT, n_gather=256, rays_per_bounce_row=16)
    return Session.open(stage, camera="/camera", frame=frame, width=WIDTH, height=HEIGHT, quality=quality)


def coverage(session: Session, samples_per_pixel: int, most: int = 8) -> F64:
    """Share of the wall in each column, as the moments together see it."""
    total = np.zeros(WIDTH * HEIGHT)
    for moment in moments(session, samples_per_pixel, most=most):
        shot = moment.session
        view = view_samples(
            shot.snapshot,
            shot.tracer,
            samples_per_pixel=moment.samples_per_pixel,
            first_sample=moment.first_sample or 0,
            centred=False,
        )
        total += moment.weight * np.bincount(view.pixel, view.throughput[:, 0], WIDTH * HEIGHT)
    return total.reshape(HEIGHT, WIDTH).mean(axis=0)


def ramp() -> F64:
    """Share of the wall in each column, meant over the pixel and the time that the shutter is open."""
    x = -HALF + 2 * HALF / WIDTH * (np.arange(WIDTH * 64) + 0.5) / 64
    begin, end = (SPEED * t for t in SHUTTER)
    share: F64 = np.clip((end - x) / (end - begin), 0, 1).reshape(WIDTH, 64).mean(axis=1)
    return share


@pytest.mark.parametrize("how", ["xform", "points", "camera"])
def test_a_moving_edge_covers_pixels_by_the_time_it_is_before_them(how: str) -> None:
    seen = coverage(opened(moving_stage(how)), 64, most=32)
    expected = ramp()
    assert ((expected > 0) & (expected < 1)).sum() == 12  # three eighths of the picture
    np.testing.assert_allclose(seen, expected, atol=0.02)


def test_a_render_of_what_moves_is_the_mean_over_the_shutter() -> None:
    stage = moving_stage("xform")
    UsdLux.DomeLight.Define(stage, "/sky").CreateIntensityAttr(1.0)
    UsdGeom.Mesh(stage.GetPrimAtPath("/wall")).CreateDisplayColorAttr([(0.5, 0.5, 0.5)])
    for method in ("brute", "cached"):
        effort = GatherSettings(samples_per_pixel=64, edge_samples=16, gather_rays=1, light_samples=8, method=method)
        film = opened(stage).render(effort)
        # White sky behind the wall, which sees all of it and reflects half: a pixel tells how much wall is in it.
        seen = 2 * (1 - film.layers["beauty"][..., 0].astype(np.float64).mean(axis=0))
        assert np.abs(np.diff(seen)).max() < 0.2
        np.testing.assert_allclose(seen, ramp(), atol=0.07)


def test_a_render_without_motion_is_bit_for_bit_that_of_a_closed_shutter() -> None:
    effort = GatherSettings(samples_per_pixel=4, gather_rays=1, light_samples=1, method="brute")
    films = []
    for stage in (moving_stage("nothing"), moving_stage("nothing", (0.0, 0.0)), moving_stage("xform", (0.0, 0.0))):
        UsdLux.DomeLight.Define(stage, "/sky")
        films.append(opened(stage).render(effort))
    for name, values in films[0].layers.items():
        for other in films[1:]:
            assert np.array_equal(values, other.layers[name]), name


def test_samples_are_divided_among_the_moments_and_all_are_used() -> None:
    session = opened(moving_stage("xform"))
    for total, edges, n in ((10, 7, 8), (3, 0, 3), (2, 5, 2), (16, 4, 8)):
        parts = list(moments(session, total, edges))
        assert len(parts) == n
        assert sum(part.weight for part in parts) == pytest.approx(1)
        assert sum(part.samples_per_pixel for part in parts) == total
        assert sum(part.edge_samples for part in parts) == edges
        assert [part.weight for part in parts] == [part.samples_per_pixel / total for part in parts]
        numbers = [
            n
            for part in parts
            for n in range(part.first_sample or 0, (part.first_sample or 0) + part.samples_per_pixel)
        ]
        for part in parts:
            assert part.first_edge_sample is not None
            numbers += range(part.first_edge_sample, part.first_edge_sample + part.edge_samples)
        assert numbers == list(range(total + edges))
        # Each looks at the middle of as much of the time as it has of the samples.
        before = np.cumsum([0, *(part.samples_per_pixel for part in parts)])
        middle = (before[1:] + before[:-1]) / (2 * total)
        frames = [part.session.snapshot.time_code for part in parts]
        np.testing.assert_allclose(frames, 5 + SHUTTER[0] + (SHUTTER[1] - SHUTTER[0]) * middle)


def test_without_motion_there_is_one_moment_the_session_itself() -> None:
    resting = moving_stage("nothing")
    same_keys = moving_stage("nothing")
    lift = UsdGeom.Mesh(same_keys.GetPrimAtPath("/wall")).AddTranslateOp()
    for frame in range(10):
        lift.Set(Gf.Vec3d(0, 0.1, 0), frame)
    beyond = moving_stage("nothing")
    lift = UsdGeom.Mesh(beyond.GetPrimAtPath("/wall")).AddTranslateOp()
    lift.Set(Gf.Vec3d(0), 6)
    lift.Set(Gf.Vec3d(1), 7)
    closed = moving_stage("xform", (0.0, 0.0))
    refused = moving_stage("xform")
    settings = UsdRender.Settings.Define(refused, "/Render/settings")
    settings.GetPrim().CreateAttribute("disableMotionBlur", Sdf.ValueTypeNames.Bool, False).Set(True)
    refused.SetMetadata("renderSettingsPrimPath", "/Render/settings")
    for stage in (resting, same_keys, beyond, closed, refused):
        session = opened(stage)
        (only,) = moments(session, 8, 4)
        assert only.session is session
        assert only == (session, 1.0, None, 8, None, 4)
    (only,) = moments(opened(moving_stage("xform")), 1)
    assert only.first_sample is None


def test_what_rests_while_the_shutter_is_open_is_seen_where_it_is_then() -> None:
    stage = moving_stage("nothing", (0.5, 0.75))
    place = UsdGeom.Mesh(stage.GetPrimAtPath("/wall")).AddTranslateOp()
    for frame, x in ((5.0, 0.0), (5.4, 1.0), (5.6, 1.0), (5.65, 1.0), (5.9, 1.0)):
        place.Set(Gf.Vec3d(x, 0, 0), frame)
    session = opened(stage)
    (only,) = moments(session, 8)
    assert only.session is not session and only.session.quality == session.quality
    assert coverage(session, 8).sum() == pytest.approx(24, abs=0.2)  # of 32 columns; 16 at the frame itself


def test_moments_that_are_the_same_are_one_and_share_what_they_can() -> None:
    stage = moving_stage("nothing", (0.0, 1.0))
    aperture = UsdGeom.Camera(stage.GetPrimAtPath("/camera")).GetHorizontalApertureAttr()
    for frame, width in ((5.0, 40.0), (5.5, 40.0), (6.0, 80.0)):
        aperture.Set(width, frame)
    session = opened(stage)
    parts = []
    tracers = []
    for part in moments(session, 8):
        parts.append(part)
        tracers.append(part.session.tracer)
    # Half of the time nothing happens; then the camera zooms, and the wall is the same in all of it.
    assert [part.samples_per_pixel for part in parts] == [4, 1, 1, 1, 1]
    assert all(tracer is tracers[0] for tracer in tracers)


def test_edits_are_those_of_each_moment(tmp_path: Path) -> None:
    stage = moving_stage("nothing", (0.0, 1.0))
    UsdGeom.Xform.Define(stage, "/shot")
    stage.SetDefaultPrim(stage.GetPrimAtPath("/shot"))
    path = tmp_path / "shot.usda"
    stage.GetRootLayer().Export(str(path))
    session = Session.open(str(path), camera="/camera", frame=5.0, width=WIDTH, height=HEIGHT)
    edit = session.add_edit("warm", layer=str(path), receivers=["/wall"], casters=["/wall"])
    amount = session.stage.GetPrimAtPath(edit).GetAttribute("icheat:amount")
    amount.Set(0.0, 5.0)
    amount.Set(1.0, 6.0)
    found = [part.session.stack.edits[0].amount for part in moments(session, 4)]
    np.testing.assert_allclose(found, [0.125, 0.375, 0.625, 0.875], atol=1e-6)
