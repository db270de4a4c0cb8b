"""Out of focus, an edge is blurred by the circle of confusion that USD's camera attributes stand for."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from icheat_usd.samples import view_samples
from icheat_usd.scene import F64
from icheat_usd.stage import take_snapshot
from icheat_usd.tracing import build_tracer

F_STOP, FOCUS = 1.4, 1.2  # and a lens of 50 mm; focus in metres
WIDTH, HEIGHT = 64, 4


def stage_with_an_edge(unit: float, distance: float) -> Usd.Stage:
    """The left half of the view is a wall `distance` metres away; a scene unit is `unit` metres."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, unit)
    camera = UsdGeom.Camera.Define(stage, "/camera")
    camera.CreateFocalLengthAttr(0.050 / (0.1 * unit))
    camera.CreateHorizontalApertureAttr(0.032 / (0.1 * unit))
    camera.CreateVerticalApertureAttr(0.002 / (0.1 * unit))
    camera.CreateFStopAttr(F_STOP)
    camera.CreateFocusDistanceAttr(FOCUS / unit)
    camera.CreateClippingRangeAttr((0.1 / unit, 100.0 / unit))
    wall = UsdGeom.Mesh.Define(stage, "/wall")
    far = 50.0 / unit
    z = -distance / unit
    wall.CreatePointsAttr([(-far, -far, z), (0, -far, z), (0, far, z), (-far, far, z)])
    wall.CreateFaceVertexCountsAttr([4])
    wall.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    wall.CreateSubdivisionSchemeAttr("none")
    return stage


def share_of_a_disk(x: F64) -> F64:
    """Share of the unit disk's area left of `x`."""
    x = np.clip(x, -1, 1)
    return 0.5 + (x * np.sqrt(1 - x * x) + np.arcsin(x)) / np.pi


@pytest.mark.parametrize("unit", [0.01, 1.0])
@pytest.mark.parametrize("distance", [0.7, 1.2, 4.0])
def test_an_edge_is_blurred_by_the_circle_of_confusion(unit: float, distance: float) -> None:
    stage = stage_with_an_edge(unit, distance)
    snapshot = take_snapshot(stage, camera="/camera", time=None, width=WIDTH, height=HEIGHT)
    view = view_samples(snapshot, build_tracer(snapshot), samples_per_pixel=2048)
    seen = np.bincount(view.pixel, view.throughput[:, 0], WIDTH * HEIGHT).reshape(HEIGHT, WIDTH).mean(axis=0)
    # On the film: aperture f / N, magnified by the film's distance over the focus distance (a film at the focal
    # length, as USD's camera has it), and shrunk by how far the edge is out of focus.
    circle = (0.050 / F_STOP) * 0.050 / FOCUS * abs(distance - FOCUS) / distance
    radius = max(0.5 * circle * WIDTH / 0.032, 1e-6)  # pixels
    inside = (np.arange(64) + 0.5) / 64 - 0.5
    left = (WIDTH / 2 - (np.arange(WIDTH) + 0.5))[:, None] - inside
    expected = share_of_a_disk(left / radius).mean(axis=1)
    assert distance == FOCUS or ((expected > 0.02) & (expected < 0.98)).sum() >= 2
    np.testing.assert_allclose(seen, expected, atol=6e-3)
