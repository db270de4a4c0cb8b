"""Where the irradiance cache has its records, as a layer and as a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from icheat_usd.errors import ImageError
from icheat_usd.final_gather import GatherSettings, final_gather
from icheat_usd.final_gather.irradiance_cache import IrradianceCache
from icheat_usd.image.record_map import PANEL, record_map
from icheat_usd.resources import resource_path
from icheat_usd.scene import LightKind
from icheat_usd.session import DRAFT, Session
from tests.pipeline import TINY, Pipeline
from tests.scenes import Light, cornell_meshes, look_at, make_snapshot

WIDTH, HEIGHT = 48, 36
CAMERA = look_at((0.11, 0.07, 3.9), (0.01, 0.02, 0), fov=40.7, width=WIDTH, height=HEIGHT)
LAMP = Light(
    LightKind.RECT, radiance=(20, 18, 15), size=(0.5, 0.5), to_world=((1, 0, 0, 0), (0, 0, 1, 0.98), (0, -1, 0, 0))
)


def test_they_are_those_of_the_cache_where_it_was_asked_for_them() -> None:
    scene = make_snapshot(cornell_meshes(), lights=[LAMP], camera=CAMERA)
    parts = Pipeline(scene, n_gather=256, bounce_rays=32, light_samples=4, n_bounces=2)
    settings = GatherSettings(samples_per_pixel=2, light_samples=1, edge_samples=0, cache=TINY)
    found = final_gather(
        scene,
        parts.tracer,
        parts.field(),
        settings=settings,
        gather=parts.gather,
        gather_radiance=parts.cell_light.radiance,
        is_kept=True,
    )
    assert found.records is not None and found.replay is not None
    cache: IrradianceCache = found.replay._cached.cache
    pixel, reach, spacing = found.records
    assert len(pixel) == len(reach) == len(spacing) == cache.n > 20
    assert set(spacing.tolist()) <= {32, 16, 8, 4, 2, 1} and spacing[0] == 32 and len(set(spacing.tolist())) > 2
    assert (np.diff(spacing) <= 0).all()
    # Where a pinhole sees the records.
    to_eye = CAMERA.to_world[:, :3].T @ (cache.table.position - CAMERA.to_world[:, 3]).T
    left, right, bottom, top = CAMERA.window
    x = ((to_eye[0] / -to_eye[2] - left) / (right - left) * WIDTH).astype(np.int64)
    y = ((top - to_eye[1] / -to_eye[2]) / (top - bottom) * HEIGHT).astype(np.int64)
    np.testing.assert_array_equal(pixel, y * WIDTH + x)
    across = (right - left) / WIDTH * -to_eye[2]
    np.testing.assert_allclose(reach, cache.table.reach / across, rtol=0.35)


def test_the_layer_and_the_picture_show_every_record(tmp_path: Path) -> None:
    shot = resource_path("sample_stages/cornell_box/shot.usda")
    session = Session.open(shot, width=WIDTH, height=HEIGHT, quality=DRAFT)
    film = session.render(GatherSettings(samples_per_pixel=1, edge_samples=0), ["records", "indirect"])
    layer = film.layer("records")
    is_there = layer[..., 0] > 0
    assert 20 < is_there.sum() < 0.9 * is_there.size
    assert ((layer[..., 1] > 0) == is_there).all() and ((layer[..., 2] > 0) == is_there).all()
    picture = record_map(layer, film.layer("indirect"))
    scale = -(-PANEL // WIDTH)
    for left in (0, WIDTH * scale + 8):
        middle = picture[scale // 2 : HEIGHT * scale : scale, left + scale // 2 : left + WIDTH * scale : scale]
        grey = (middle == middle[..., :1]).all(axis=2) & (middle[..., 0] < 255)
        np.testing.assert_array_equal(~grey, is_there)


def test_brute_force_has_none() -> None:
    session = Session.open(resource_path("sample_stages/cornell_box/shot.usda"), width=4, height=4, quality=DRAFT)
    with pytest.raises(ImageError, match="the brute method places no records"):
        session.render(GatherSettings(method="brute"), ["records"])


def test_a_picture_of_nothing_is_the_frame_in_grey() -> None:
    picture = record_map(np.zeros((2, 3, 3), np.float32), np.ones((2, 3, 3), np.float32))
    assert (picture[:-28] == picture[:-28, :, :1]).all()
