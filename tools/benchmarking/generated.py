"""Stages made for measuring: a room of as many triangles as one asks for, and a wall that is half hidden."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, Vt


def write_room(path: Path, n_triangles: int) -> Path:
    """Write a stage: a closed box of 8 x 3 x 8 m, a bumpy floor of about `n_triangles`, one rectangle of light."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    world = UsdGeom.Xform.Define(stage, "/World")
    stage.SetDefaultPrim(world.GetPrim())
    side = max(2, round((n_triangles / 2) ** 0.5))
    grid = np.linspace(-4, 4, side + 1)
    x, z = np.meshgrid(grid, grid)
    y = 0.15 * np.sin(3 * x) * np.cos(2 * z) + 0.02 * np.sin(31 * x + 17 * z)
    corner = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).reshape(-1)
    quads = np.stack([corner, corner + side + 1, corner + side + 2, corner + 1], axis=1)
    _mesh(stage, "Floor", np.stack([x, y, z], axis=2).reshape(-1, 3), quads, (0.6, 0.5, 0.4))
    for name, points, color in _walls():
        _mesh(stage, name, points, np.array([[0, 1, 2, 3]]), color)
    light = UsdLux.RectLight.Define(stage, "/World/Light")
    light.CreateWidthAttr(1.5)
    light.CreateHeightAttr(1.5)
    light.CreateIntensityAttr(20.0)
    light.AddTranslateOp().Set(Gf.Vec3d(1, 2.9, -1))
    light.AddRotateXOp().Set(-90)
    camera = UsdGeom.Camera.Define(stage, "/World/Camera")
    camera.AddTranslateOp().Set(Gf.Vec3d(0, 1.7, 3.6))
    camera.AddRotateXOp().Set(-12)
    camera.CreateFocalLengthAttr(18.0)
    camera.CreateClippingRangeAttr(Gf.Vec2f(0.01, 100))
    stage.GetRootLayer().Save()
    return path


def _walls() -> list[tuple[str, np.ndarray, tuple[float, float, float]]]:
    def quad(*corners: tuple[float, float, float]) -> np.ndarray:
        return np.array(corners, np.float64)

    return [
        ("Back", quad((-4, -0.5, -4), (4, -0.5, -4), (4, 3, -4), (-4, 3, -4)), (0.7, 0.7, 0.7)),
        ("Front", quad((4, -0.5, 4), (-4, -0.5, 4), (-4, 3, 4), (4, 3, 4)), (0.7, 0.7, 0.7)),
        ("Left", quad((-4, -0.5, 4), (-4, -0.5, -4), (-4, 3, -4), (-4, 3, 4)), (0.8, 0.2, 0.15)),
        ("Right", quad((4, -0.5, -4), (4, -0.5, 4), (4, 3, 4), (4, 3, -4)), (0.2, 0.6, 0.25)),
        ("Ceiling", quad((-4, 3, -4), (4, 3, -4), (4, 3, 4), (-4, 3, 4)), (0.8, 0.8, 0.8)),
    ]


def _mesh(
    stage: Usd.Stage, name: str, points: np.ndarray, quads: np.ndarray, color: tuple[float, float, float]
) -> None:
    mesh = UsdGeom.Mesh.Define(stage, Sdf.Path(f"/World/{name}"))
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(quads), 4, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(quads.reshape(-1).astype(np.int32)))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDisplayColorAttr([Gf.Vec3f(*color)])
    mesh.CreateDoubleSidedAttr(True)


#: Light that the wall of `write_screened` reflects, and its size: albedo, cosine of the sun, square metres.
WALL_ALBEDO, WALL_COSINE, WALL_AREA = 0.6, 1 / 5**0.5, 4.0


def write_screened(path: Path) -> Path:
    """Write a stage: a floor, a wall that a sun without an angle lights, and a black screen that hides half of it.

    The camera sees a part of the floor from where the lower half of the wall is out of sight everywhere.
    """
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    quad = np.array([[0, 1, 2, 3]])
    floor = np.array([(-1, 0, 1), (1, 0, 1), (1, 0, -1), (-1, 0, -1)])
    wall = np.array([(-2, 0, 1), (-2, 0, -1), (-2, 2, -1), (-2, 2, 1)])
    screen = np.array([(-1.2, 0, 1.5), (-1.2, 0, -1.5), (-1.2, 1, -1.5), (-1.2, 1, 1.5)])
    _mesh(stage, "Floor", floor, quad, (0.8, 0.8, 0.8))
    _mesh(stage, "Wall", wall, quad, (WALL_ALBEDO,) * 3)
    _mesh(stage, "Screen", screen, quad, (0.0, 0.0, 0.0))
    sun = UsdLux.DistantLight.Define(stage, "/World/Sun")
    sun.CreateAngleAttr(0.0)
    sun.CreateIntensityAttr(3.0)
    _look(sun, (1, 2, 0), (0, 0, 0), (0, 1, 0))
    camera = UsdGeom.Camera.Define(stage, "/World/Camera")
    camera.CreateFocalLengthAttr(60.0)
    camera.CreateClippingRangeAttr(Gf.Vec2f(0.01, 100))
    _look(camera, (0.2, 3, 0), (0.2, 0, 0), (0, 0, -1))
    stage.GetRootLayer().Save()
    return path


def _look(prim: UsdGeom.Xformable, eye: tuple[float, ...], target: tuple[float, ...], up: tuple[float, ...]) -> None:
    matrix = Gf.Matrix4d().SetLookAt(Gf.Vec3d(*eye), Gf.Vec3d(*target), Gf.Vec3d(*up)).GetInverse()
    UsdGeom.Xformable(prim).MakeMatrixXform().Set(matrix)
