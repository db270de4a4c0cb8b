"""Domes: which way the image faces, lookup, and probabilities."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from icheat_usd.kernels.environment import dome_image_pdf, sample_dome_image
from icheat_usd.lighting import build_light_sampler, environment_radiance, environment_radiance_per_light
from icheat_usd.scene import LightKind
from tests.scenes import Image, Light, Mesh, make_snapshot, quad, rotation, scaling, translation

WIDTH, HEIGHT = 16, 8


def dome(texels: np.ndarray, to_world: np.ndarray | None = None, radiance: float = 1.0) -> Light:
    return Light(LightKind.DOME, radiance, np.eye(4) if to_world is None else to_world, image=Image(texels, (0, 1)))


def hot(row: int, column: int) -> np.ndarray:
    texels = np.zeros((HEIGHT, WIDTH, 3))
    texels[row, column] = 1.0
    return texels


# OpenEXR: longitude +pi at the left edge, -pi at the right; longitude 0 is +Z, +pi/2 is +X; the top row is +Y.
@pytest.mark.parametrize(
    "row, column, towards",
    [
        (0, 5, (0, 1, 0)),
        (HEIGHT - 1, 3, (0, -1, 0)),
        (HEIGHT // 2, WIDTH // 2, (0, 0, 1)),
        (HEIGHT // 2, WIDTH // 4, (1, 0, 0)),
        (HEIGHT // 2, 3 * WIDTH // 4, (-1, 0, 0)),
        (HEIGHT // 2, 0, (0, 0, -1)),
    ],
)
def test_one_hot_texel_shines_from_where_openexr_puts_it(row: int, column: int, towards: tuple) -> None:
    snapshot = make_snapshot([Mesh(quad())], lights=[dome(hot(row, column))])
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(20000, 3)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    light = environment_radiance(snapshot, directions)[:, 0]
    mean = (directions * light[:, None]).sum(0)
    # the texel's centre is half a texel off the axis: 11 degrees
    assert mean @ np.asarray(towards) / np.linalg.norm(mean) > np.cos(np.radians(20))


def test_texel_centres_return_the_texels_themselves_whatever_the_length_of_the_ray() -> None:
    texels = np.random.default_rng(1).random((HEIGHT, WIDTH, 3)).astype(np.float32)
    turn = rotation((1, 2, 3), 50) @ translation(1, 2, 3)
    snapshot = make_snapshot([Mesh(quad())], lights=[dome(texels, turn, 2.0)])
    theta = np.pi * (np.arange(HEIGHT)[:, None] + 0.5) / HEIGHT
    longitude = np.pi - 2 * np.pi * (np.arange(WIDTH)[None] + 0.5) / WIDTH
    local = np.stack(
        [np.sin(theta) * np.sin(longitude), np.cos(theta) + 0 * longitude, np.sin(theta) * np.cos(longitude)], -1
    ).reshape(-1, 3)
    world = np.ascontiguousarray(7 * local @ turn[:3, :3].T, dtype=np.float32)
    np.testing.assert_allclose(environment_radiance(snapshot, world), 2 * texels.reshape(-1, 3), atol=2e-5)


def test_each_dome_is_its_own_light_and_only_domes_are_seen() -> None:
    lights = [
        Light(LightKind.DISTANT, 9.0, np.eye(4), (0.5, 0)),
        Light(LightKind.DOME, (1, 2, 3)),
        Light(LightKind.SPHERE, 9.0, np.eye(4), (0.5, 0)),
        Light(LightKind.DOME, 0.5),
    ]
    snapshot = make_snapshot([Mesh(quad())], lights=lights)
    directions = np.eye(3, dtype=np.float32)
    per_light = environment_radiance_per_light(snapshot, directions)
    assert per_light.shape == (4, 3, 3)
    np.testing.assert_array_equal(per_light[0], 0)
    np.testing.assert_array_equal(per_light[1], np.broadcast_to([1, 2, 3], (3, 3)))
    np.testing.assert_array_equal(environment_radiance(snapshot, directions), per_light.sum(0))


def sampler_arguments(texels: np.ndarray) -> tuple:
    snapshot = make_snapshot([Mesh(quad())], lights=[dome(texels)])
    tables = build_light_sampler(snapshot).tables
    return tables.rows_cdf, 0, tables.columns_cdf, 0, texels.shape[1], texels.shape[0]


def test_dome_directions_come_with_the_probability_they_are_drawn_with() -> None:
    texels = np.random.default_rng(2).random((HEIGHT, WIDTH, 3)) ** 6
    texels[:, :5] = 0.0
    tables = sampler_arguments(texels)
    u = (np.stack(np.meshgrid(np.arange(256), np.arange(256)), -1).reshape(-1, 2) + 0.5) / 256
    drawn = np.array([sample_dome_image(*tables, float(a), float(b)) for a, b in u])
    asked = np.array([dome_image_pdf(*tables, *row[:3]) for row in drawn])
    near_border = np.abs(asked / drawn[:, 3] - 1) > 1e-6
    assert near_border.mean() < 1e-3
    np.testing.assert_allclose((drawn[:, :3] ** 2).sum(1), 1, rtol=1e-12)

    h, w = 400, 800
    theta = np.pi * (np.arange(h) + 0.5) / h
    phi = np.pi - 2 * np.pi * (np.arange(w) + 0.5) / w
    total = 0.0
    share_up = 0.0
    for t in theta:
        row = sum(dome_image_pdf(*tables, np.sin(t) * np.sin(p), np.cos(t), np.sin(t) * np.cos(p)) for p in phi)
        weight = row * np.sin(t) * (np.pi / h) * (2 * np.pi / w)
        total += weight
        share_up += weight * (np.cos(t) > 0)
    assert total == pytest.approx(1, abs=1e-3)
    assert (drawn[:, 1] > 0).mean() == pytest.approx(share_up, abs=5e-3)


def test_every_direction_that_shines_can_be_drawn() -> None:
    """A lone texel spreads over its neighbours in the bilinear image; those must not have probability zero."""
    texels = hot(3, 0)
    snapshot = make_snapshot([Mesh(quad())], lights=[dome(texels)])
    tables = sampler_arguments(texels)
    directions = np.random.default_rng(3).normal(size=(5000, 3)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    shines = environment_radiance(snapshot, directions)[:, 0] > 0
    pdf = np.array([dome_image_pdf(*tables, *(float(x) for x in row)) for row in directions])
    assert shines.sum() > 50
    assert (pdf[shines] > 0).all()


def read_rgb(path: Path) -> np.ndarray:
    channels = OpenEXR.File(str(path)).channels()
    together = channels.get("RGB") or channels.get("RGBA")
    if together is not None:
        return together.pixels[..., :3]
    return np.stack([channels[name].pixels for name in "RGB"], -1)


def test_the_sky_behind_the_windows_of_an_outside_renderers_picture_is_where_it_is(shared_scenes: Path) -> None:
    """The living room's published picture (Tungsten) shows its sky: found only if image and frame face right."""
    folder = shared_scenes / "bitterli_living-room"
    sky = read_rgb(folder / "textures" / "Sky_19.exr")
    picture = read_rgb(folder / "reference_TungstenRender.exr")
    # rows of the stage's matrices, as USD writes them
    dome_rows = np.array(((0, 0, -1), (0, 1, 0), (1, 0, 0)))
    camera_rows = np.array(
        (
            (-0.26420911, 0.0, -0.96446542),
            (0.07176300, 0.99722796, -0.01965900),
            (0.96179207, -0.07440701, -0.26347603),
        )
    )
    h, w = picture.shape[:2]
    x = (np.arange(w) + 0.5) / w * 2 - 1  # focal length is half the aperture
    y = (1 - (np.arange(h) + 0.5) / h * 2) * h / w
    rays = np.stack(np.broadcast_arrays(x[None], y[:, None], -1.0), -1).reshape(-1, 3) @ camera_rows

    def share_seen(rows: np.ndarray) -> float:
        to_world = np.eye(4)
        to_world[:3, :3] = rows.T
        snapshot = make_snapshot([Mesh(quad())], lights=[dome(sky, to_world)])
        image = environment_radiance(snapshot, rays.astype(np.float32)).reshape(h, w, 3)
        return float((np.abs(image - picture) < 0.05 * image).all(-1).mean())

    assert share_seen(dome_rows) > 0.05
    for wrong in (scaling(-1, 1, 1), scaling(1, 1, -1), rotation((0, 1, 0), 180), rotation((0, 1, 0), 90)):
        assert share_seen(wrong[:3, :3] @ dome_rows) < 0.01
