"""CesiumMan, a skinned figure that this project did not make, walks through a region where the light is edited."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdLux

from icheat_usd.final_gather import GatherSettings
from icheat_usd.image.film import Film
from icheat_usd.session import Session, authoring
from icheat_usd.session.quality import Quality
from icheat_usd.stage import open_stage

FIRST, LAST = 1.0, 43.0
FRAMES = np.linspace(FIRST, LAST, 8)
CENTRE, RADIUS = (0.0, 0.8, 0.0), 0.75
SMALL = Quality(n_gather=2048, rays_per_row=128, rays_per_bounce_row=64, light_samples=16)


def walkway(folder: Path, figure: Path) -> Path:
    """He walks along a wall under a window's worth of light; inside a sphere, the light from floor and wall glows."""
    file = folder / "walk.usda"
    stage = Usd.Stage.CreateNew(str(file))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetStartTimeCode(FIRST)
    stage.SetEndTimeCode(LAST)
    stage.SetTimeCodesPerSecond(24)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    for name, points, color in (
        ("Floor", [(-3, 0, 2), (3, 0, 2), (3, 0, -1), (-3, 0, -1)], (0.75, 0.7, 0.6)),
        ("Wall", [(-3, 0, -1), (3, 0, -1), (3, 3, -1), (-3, 3, -1)], (0.6, 0.65, 0.75)),
    ):
        mesh = UsdGeom.Mesh.Define(stage, f"/World/Set/{name}")
        mesh.CreatePointsAttr(points)
        mesh.CreateFaceVertexCountsAttr([4])
        mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
        mesh.CreateSubdivisionSchemeAttr("none")
        mesh.CreateDisplayColorAttr([color])
    man = UsdGeom.Xform.Define(stage, "/World/Man")
    man.GetPrim().GetReferences().AddReference(str(figure))
    man.ClearXformOpOrder()
    walk = man.AddTranslateOp()
    walk.Set((-1.2, 0, 0), FIRST)
    walk.Set((1.2, 0, 0), LAST)
    man.AddRotateYOp().Set(90.0)
    light = UsdLux.RectLight.Define(stage, "/World/Light")
    light.CreateIntensityAttr(12.0)
    light.CreateWidthAttr(3.0)
    light.CreateHeightAttr(1.0)
    light.AddTransformOp().Set(
        Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(1, 0, 0), -70)) * Gf.Matrix4d().SetTranslate((0, 3.2, 1.0))
    )
    camera = UsdGeom.Camera.Define(stage, "/World/Camera")
    camera.CreateFocalLengthAttr(24.0)
    camera.AddTranslateOp().Set((0, 0.95, 3.6))
    stage.Save()
    stage = open_stage(file)
    region = authoring.add_region(
        stage, "Regions/glow", layer=str(file), shape="sphere", centre=CENTRE, size=(RADIUS,), softness=0.5
    )
    authoring.add_edit(
        stage,
        None,
        "glow",
        layer=str(file),
        receivers=["Man"],
        casters=["Set"],
        receiver_limits=[region],
        parameters={"gain": 5.0, "color": (1.5, 0.8, 0.4)},
    )
    return file


@pytest.fixture(scope="module")
def stage_file(tmp_path_factory: pytest.TempPathFactory, shared_scenes: Path) -> Path:
    figure = shared_scenes / "usdwg_anim/CesiumMan.usdz"
    if not figure.exists():
        pytest.skip(f"no {figure}")
    return walkway(tmp_path_factory.mktemp("walk"), figure)


@cache
def shot(file: Path, frame: float) -> Session:
    return Session.open(open_stage(file), camera="/World/Camera", frame=frame, width=96, height=54, quality=SMALL)


@cache
def preview(file: Path, frame: float) -> Film:
    return shot(file, frame).relight()


def added(film: Film) -> np.ndarray:
    return np.asarray(film.layers["indirect_edited"] - film.layers["indirect"], np.float64)


def on_man(session: Session, film: Film) -> np.ndarray:
    """Pixels whose view sample lies on him."""
    view, snapshot = session.view, session.snapshot
    surfaces = snapshot.geometry.instance_surface[np.maximum(view.points.instance, 0)]
    his = np.array([surface.path.startswith("/World/Man") for surface in snapshot.surfaces])
    seen = np.zeros(film.width * film.height, np.bool_)
    seen[view.pixel[his[surfaces] & (view.points.instance >= 0)]] = True
    return seen.reshape(film.height, film.width)


def test_the_figure_walks_and_is_read_without_findings(stage_file: Path) -> None:
    middles = []
    for frame in FRAMES:
        session = shot(stage_file, frame)
        assert not [f for f in session.findings if f.prim.startswith("/World/Man")]
        pixels = np.argwhere(on_man(session, preview(stage_file, frame)))
        middles.append(pixels[:, 1].mean())
    assert (np.diff(middles) > 2).all()


def test_what_is_edited_is_on_him_and_within_the_region_and_moves_with_him(stage_file: Path) -> None:
    sizes, centres = [], []
    for frame in FRAMES:
        session, film = shot(stage_file, frame), preview(stage_file, frame)
        glow = added(film).max(axis=2)
        man = on_man(session, film)
        assert not glow[~man].any()  # bit for bit the image without the edit, wherever he is not
        view = session.view
        position = view.points.position + session.snapshot.centre
        inside = np.linalg.norm(position - CENTRE, axis=1) <= RADIUS * (1 + 1e-4)
        far = np.ones(film.width * film.height, np.bool_)
        far[view.pixel[inside]] = False
        assert not glow[far.reshape(glow.shape)].any()
        sizes.append(glow.sum())
        if glow.any():
            centres.append((np.argwhere(glow > 0)[:, 1]).mean())
    assert np.argmax(sizes) in (3, 4) and sizes[0] < 0.1 * max(sizes) > 10 * sizes[-1]
    assert len(centres) >= 4 and (np.diff(centres) > 0).all()


def test_the_glow_rises_without_a_pop(stage_file: Path) -> None:
    """Frame by frame on his way in; per light that he has, as limbs of a pixel's width come and go in both."""
    shares = []
    for frame in np.arange(12.0, 24.0):
        session = shot(stage_file, frame)
        film = session.relight()
        shares.append(added(film).sum() / film.layers["indirect"][on_man(session, film)].sum())
    assert shares[0] < 0.5 * shares[-1]
    assert np.abs(np.diff(shares, 2)).max() < 0.12 * max(shares)  # 0.08 seen


def test_the_final_gather_adds_the_same_light(stage_file: Path) -> None:
    frame = float(FRAMES[4])
    final = added(shot(stage_file, frame).render(GatherSettings(samples_per_pixel=2, gather_rays=64)))
    quick = added(preview(stage_file, frame))
    np.testing.assert_allclose(quick.sum(axis=(0, 1)), final.sum(axis=(0, 1)), rtol=0.08)
