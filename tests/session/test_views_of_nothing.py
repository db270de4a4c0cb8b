"""Cameras that see no surface, and surfaces that see none: the sky, and no trouble."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from icheat_usd.final_gather.settings import METHODS
from icheat_usd.session import DRAFT, GatherSettings, Quality, Session
from icheat_usd.session.layer_names import FAMILIES, LAYERS
from icheat_usd.session.live import LiveSession
from icheat_usd.session.quality import LIVE
from tests.session.test_session import ROOM

#: A sky whose light is known.
SKY = """\
    def DomeLight "Sky"
    {
        color3f inputs:color = (0.2, 0.4, 0.8)
    }
    def Camera"""
RECORDS = Quality(n_gather=64, rays_per_bounce_row=16, light_samples=2, n_bounces=3, record_error=0.02, record_rays=512)
PACKED = replace(RECORDS, packing_error=LIVE.packing_error)


def image(text: str, quality: Quality, folder: Path) -> np.ndarray:
    stage = folder / "stage.usda"
    stage.write_text(text)
    with LiveSession.open(stage, width=12, height=9, quality=quality) as live:
        assert live.wait("rest")
        live.set_light("Sky", gain=2.0)
        live.wait("rest")
        return live.frame()


@pytest.mark.parametrize("quality", [RECORDS, PACKED], ids=["exact", "packed"])
def test_a_camera_that_sees_no_surface_shows_the_background(quality: Quality, tmp_path: Path) -> None:
    outside = ROOM.replace("(0, 0, 1.9)", "(0, 0, -9)").replace("    def Camera", SKY)
    found = image(outside, quality, tmp_path)
    np.testing.assert_allclose(found, np.broadcast_to(np.float32([0.4, 0.8, 1.6]), found.shape), rtol=1e-6)


def test_a_surface_that_sees_no_other_has_packed_rows_without_light(tmp_path: Path) -> None:
    world, _, rest = ROOM.partition('    def Cube "Room"')
    plane = '    def Mesh "Floor"\n    {\n        int[] faceVertexCounts = [4]\n'
    plane += "        int[] faceVertexIndices = [0, 1, 2, 3]\n"
    plane += "        point3f[] points = [(-9, -1, 9), (9, -1, 9), (9, -1, -9), (-9, -1, -9)]\n    }\n"
    alone = world + plane + SKY + rest.partition("    def Camera")[2]
    found = image(alone, PACKED, tmp_path)
    np.testing.assert_allclose(found[0, 0], [0.4, 0.8, 1.6], rtol=1e-6)
    np.testing.assert_allclose(found[-1, 6], 0.18 * np.float32([0.4, 0.8, 1.6]), rtol=0.02)


@pytest.mark.parametrize("method", METHODS)
def test_every_layer_of_a_camera_that_sees_no_surface(method: str, tmp_path: Path) -> None:
    stage = tmp_path / "stage.usda"
    stage.write_text(ROOM.replace("(0, 0, 1.9)", "(0, 0, -9)").replace("    def Camera", SKY))
    session = Session.open(stage, width=6, height=4, quality=DRAFT)
    names = [name for name in (*LAYERS, *FAMILIES) if method == "cached" or name != "records"]
    film = session.render(GatherSettings(samples_per_pixel=2, gather_rays=4, method=method), names)
    sky = np.broadcast_to(np.float32([0.2, 0.4, 0.8]), (4, 6, 3))
    shown = {"beauty", "direct", "background", "light.Sky", "light_direct.Sky"}
    for name, layer in film.layers.items():
        if name == "edit_ratio":
            assert (layer == 1).all()
        else:
            np.testing.assert_allclose(layer, sky if name in shown else 0, rtol=1e-6, err_msg=name)
    assert shown < film.layers.keys() and not film.mattes[0].ranks.any()
