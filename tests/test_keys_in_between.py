"""Keys at two frames, smooth in between: an object and the camera move, and the edit's image neither jumps nor swims.

The edit's image is what the edit adds, indirect_edited - indirect, of renders with one seed.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdLux

from icheat_usd.edits.painting import soft_sphere
from icheat_usd.final_gather import GatherSettings
from icheat_usd.image.film import Film
from icheat_usd.session import Session, keys
from icheat_usd.session.quality import Quality
from icheat_usd.stage import open_stage
from icheat_usd.stage.key_authoring import set_payload_key

FIRST, LAST = 1.0, 13.0
GLOW = "/World/Edits/glow"
SMALL = Quality(n_gather=2048, rays_per_row=256, rays_per_bounce_row=64, light_samples=16)
GATHER = GatherSettings(samples_per_pixel=2, gather_rays=64, light_samples=2)
Render = Callable[[Session], Film]
RENDERERS: dict[str, Render] = {"relighter": Session.relight, "final gather": lambda session: session.render(GATHER)}


def room(folder: Path) -> Path:
    """A room with a red ball that crosses it, a window's worth of light, and a camera that moves in and turns."""
    file = folder / "room.usda"
    stage = Usd.Stage.CreateNew(str(file))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetStartTimeCode(FIRST)
    stage.SetEndTimeCode(LAST)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    h = 1.0
    walls = {
        "Floor": ([(-h, 0, h), (h, 0, h), (h, 0, -h), (-h, 0, -h)], (0.7, 0.7, 0.7)),
        "Back": ([(-h, 0, -h), (h, 0, -h), (h, 2, -h), (-h, 2, -h)], (0.7, 0.7, 0.7)),
        "Left": ([(-h, 0, h), (-h, 0, -h), (-h, 2, -h), (-h, 2, h)], (0.3, 0.6, 0.3)),
        "Right": ([(h, 0, -h), (h, 0, h), (h, 2, h), (h, 2, -h)], (0.7, 0.7, 0.7)),
        "Top": ([(-h, 2, -h), (h, 2, -h), (h, 2, h), (-h, 2, h)], (0.7, 0.7, 0.7)),
    }
    for name, (points, color) in walls.items():
        mesh = UsdGeom.Mesh.Define(stage, f"/World/Room/{name}")
        mesh.CreatePointsAttr(points)
        mesh.CreateFaceVertexCountsAttr([4])
        mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
        mesh.CreateSubdivisionSchemeAttr("none")
        mesh.CreateDoubleSidedAttr(True)
        mesh.CreateDisplayColorAttr([color])
    ball = UsdGeom.Sphere.Define(stage, "/World/Ball")
    ball.CreateRadiusAttr(0.3)
    ball.CreateDisplayColorAttr([(0.8, 0.1, 0.1)])
    move = ball.AddTranslateOp()
    move.Set((-0.5, 0.35, -0.3), FIRST)
    move.Set((0.5, 0.35, 0.0), LAST)
    light = UsdLux.RectLight.Define(stage, "/World/Light")
    light.CreateIntensityAttr(15.0)
    light.CreateWidthAttr(0.8)
    light.CreateHeightAttr(0.8)
    light.AddTransformOp().Set(
        Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(1, 0, 0), -90)) * Gf.Matrix4d().SetTranslate((0, 1.95, 0.2))
    )
    camera = UsdGeom.Camera.Define(stage, "/World/Camera")
    camera.CreateFocalLengthAttr(20.0)
    place = camera.AddTransformOp()
    for frame, x, z, turn in ((FIRST, -0.2, 3.0, -4.0), (LAST, 0.2, 2.7, 4.0)):
        spin = Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(0, 1, 0), turn))
        place.Set(spin * Gf.Matrix4d().SetTranslate((x, 0.9, z)), frame)
    stage.Save()
    session = Session.open(open_stage(file), camera="/World/Camera", frame=FIRST)
    centre = np.array(session.snapshot.centre)
    session.add_edit("glow", layer=str(file), receivers=["Room", "Ball"], casters=["Room", "Ball"], frame=FIRST)
    for frame, spot, parameters in (
        (FIRST, (-0.5, 0, -0.3), {"gain": 2.0, "color": (1.4, 1.0, 0.6)}),
        (LAST, (0.5, 0, 0.0), {"gain": 1.5, "color": (0.5, 1.2, 2.0)}),
    ):
        brush = soft_sphere(tuple(np.array(spot) - centre), 0.2, 1.2)
        session.set_key(GLOW, layer=str(file), frame=frame, parameters=parameters, receiver_brush=brush)
    return file


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Callable[[float], Session]:
    file = room(tmp_path_factory.mktemp("between"))

    @cache
    def shot(frame: float) -> Session:
        return Session.open(open_stage(file), camera="/World/Camera", frame=frame, width=32, height=24, quality=SMALL)

    return shot


def layer(film: Film, name: str) -> np.ndarray:
    return np.asarray(film.layers[name], np.float64)


def unkeyed(session: Session, key_frame: float, render: Render) -> Film:
    """The shot with one key's payload at all times."""
    (key,) = [key for key in keys.list_keys(session.stage, GLOW).keys if key.time == key_frame]
    overriding = session.stage.GetSessionLayer()
    set_payload_key(session.stage, GLOW, layer=overriding, time=None, payload=(key.file, key.payload))
    try:
        return render(session)
    finally:
        overriding.Clear()


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize("frame", [FIRST, LAST])
def test_at_a_key_the_image_is_that_of_its_payload_alone(
    shots: Callable[[float], Session], renderer: str, frame: float
) -> None:
    render = RENDERERS[renderer]
    keyed, alone = render(shots(frame)), unkeyed(shots(frame), frame, render)
    np.testing.assert_array_equal(layer(keyed, "indirect_edited"), layer(alone, "indirect_edited"))
    assert np.abs(layer(keyed, "indirect_edited") - layer(keyed, "indirect")).max() > 0.05


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize(
    ("interpolation", "frame", "share"), [("linear", 4.0, 0.25), ("linear", 7.0, 0.5), ("smooth", 4.0, 0.15625)]
)
def test_between_keys_the_image_is_the_mean_of_what_either_key_makes_of_that_frame(
    shots: Callable[[float], Session], renderer: str, interpolation: str, frame: float, share: float
) -> None:
    render, session = RENDERERS[renderer], shots(frame)
    session.stage.GetPrimAtPath(GLOW).GetAttribute("icheat:keyInterpolation").Set(interpolation)
    keyed = layer(render(session), "indirect_edited")
    session.stage.GetPrimAtPath(GLOW).GetAttribute("icheat:keyInterpolation").Set("linear")
    first, last = (layer(unkeyed(session, key, render), "indirect_edited") for key in (FIRST, LAST))
    assert np.abs(first - last).max() > 0.02
    np.testing.assert_allclose(keyed, (1 - share) * first + share * last, atol=2e-6 * first.max(), rtol=2e-6)


@pytest.mark.parametrize("renderer", RENDERERS)
def test_nothing_pops_between_the_keys(shots: Callable[[float], Session], renderer: str) -> None:
    """Fig. 4 of the paper, measured: second differences over 13 frames, 11 of them between the keys."""
    render = RENDERERS[renderer]
    frames = np.linspace(FIRST, LAST, 13)
    films = [render(shots(frame)) for frame in frames]
    picture = np.array([layer(film, "indirect") for film in films])
    edit = np.array([layer(film, "indirect_edited") for film in films]) - picture
    held = [
        np.array([layer(unkeyed(shots(frame), key, render), "indirect_edited") for frame in frames]) - picture
        for key in (FIRST, LAST)
    ]

    def jerk(images: np.ndarray) -> np.ndarray:
        """Root mean square second difference about each frame."""
        second = images[2:] - 2 * images[1:-1] + images[:-2]
        return np.asarray(np.sqrt((second**2).mean(axis=(1, 2, 3))))

    def size(images: np.ndarray) -> np.ndarray:
        return np.asarray(np.sqrt((images**2).mean(axis=(1, 2, 3)))[1:-1])

    # Silhouettes that pass and noise make second differences. Keys that move add none to those that either payload
    # has when it holds all the time; one frame that jumps would.
    share = (frames[1:-1] - FIRST) / (LAST - FIRST)
    of_held = (1 - share) * jerk(held[0]) + share * jerk(held[1])
    assert (jerk(edit) < 1.15 * of_held).all()
    # The edit's image, as a share of itself, is no restless thing beside the picture's where the edit is.
    where = np.abs(edit).max(axis=(0, 3), keepdims=True)
    beside = where * picture
    assert (jerk(edit) / size(edit)).mean() < 1.5 * (jerk(beside) / size(beside)).mean()
    # The sum over the image is free of edges and nearly of noise: it goes from one key to the other steadily.
    total = edit.sum(axis=(1, 2))
    assert np.abs(np.diff(total, 2, axis=0)).max() < 0.05 * np.abs(total).max()


def test_both_renderers_agree_between_the_keys(shots: Callable[[float], Session]) -> None:
    session = shots(7.0)
    edits = []
    for render in (Session.relight, lambda s: s.render(GatherSettings(samples_per_pixel=8, gather_rays=256))):
        film = render(session)
        edits.append(layer(film, "indirect_edited") - layer(film, "indirect"))
    size = np.abs(edits[1]).mean(axis=(0, 1))
    np.testing.assert_allclose(edits[0].mean(axis=(0, 1)), edits[1].mean(axis=(0, 1)), atol=0.06 * size.max())
    assert np.sqrt(((edits[0] - edits[1]) ** 2).mean()) < 0.25 * np.sqrt((edits[1] ** 2).mean())
