"""What whole lights bring, by closed forms: against sums over many points of them, and where there is none."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.kernels._jit import kernel
from icheat_usd.kernels.clear_light import clear_light
from icheat_usd.kernels.place_columns import COLUMNS, NORMAL, ORIGIN, RUN, SHADING
from icheat_usd.kernels.simd import address_of, store
from icheat_usd.lighting.points import light_form
from icheat_usd.scene import F32, F64, LightKind
from tests.scenes import Image, Light, make_snapshot, quad, rotation, scaling, translation
from tests.scenes import Mesh as SceneMesh

TURNED = (translation(0.3, 1.0, -0.2) @ rotation((1, 0.4, 0), -50) @ scaling(1.5, 1.5, 1.5))[:3].astype(np.float32)
MIRRORED = (translation(0.3, 1.0, -0.2) @ rotation((1, 0.4, 0), -50) @ scaling(-1.5, 1.5, 1.5))[:3].astype(np.float32)
BALL = Light(LightKind.SPHERE, (3, 2, 1), TURNED, (0.2, 0.0))
RECT = Light(LightKind.RECT, (3, 2, 1), TURNED, (0.9, 0.2))


@kernel
def _run_of(form, columns, at, out):  # type: ignore[no-untyped-def]
    for c in range(len(at)):
        at[c] = address_of(columns) + c * RUN * 4
    for lane in range(0, RUN, 16):
        store(address_of(out) + lane * 4, clear_light(form, at, lane))
    columns[0, 0] += np.float32(0.0)  # kept until here


def form_of(light: Light) -> F32:
    return light_form(make_snapshot([SceneMesh(quad(1.0))], lights=[light]))


def found(light: Light, position: F64, normal: F64, shading: F64 | None = None) -> F64:
    """At places (n, 3), n at most `RUN`."""
    columns, out = np.ones((COLUMNS, RUN), np.float32), np.empty(RUN, np.float32)
    for first, values in ((ORIGIN, position), (NORMAL, normal), (SHADING, normal if shading is None else shading)):
        columns[first : first + 3, : len(values)] = values.T
    _run_of(form_of(light), columns, np.empty(COLUMNS, np.int64), out)
    return out[: len(position)].astype(np.float64)


def points_of(light: Light, n: int = 700) -> tuple[F64, F64, float]:
    """Places and outward normals of many points of equal area, (n * n, 3), and the whole area."""
    u, v = ((values.ravel() + 0.5) / n for values in np.meshgrid(np.arange(n), np.arange(n)))
    linear, origin = light.to_world[:, :3].astype(np.float64), light.to_world[:, 3].astype(np.float64)
    if light.kind == LightKind.RECT:
        across = np.cross(linear[:, 0], linear[:, 1])
        flat = np.stack([(u - 0.5) * light.size[0], (v - 0.5) * light.size[1], 0 * u], axis=1)
        out = np.sign(-across @ linear[:, 2]) * across
        normal = np.broadcast_to(out / np.linalg.norm(across), flat.shape)
        return flat @ linear.T + origin, normal, float(np.linalg.norm(across) * light.size[0] * light.size[1])
    z, phi = 1 - 2 * u, 2 * np.pi * v
    r = np.sqrt(1 - z * z)
    normal = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)
    radius = light.size[0] * np.linalg.norm(linear[:, 0])
    return origin + radius * normal, normal, 4 * np.pi * float(radius) ** 2


def summed(light: Light, position: F64, normal: F64) -> tuple[F64, F64]:
    """The same by points, and how far the lowest of them is above the horizon."""
    place, outward, area = points_of(light)
    light_of, lowest = np.empty(len(position)), np.empty(len(position))
    for k in range(len(position)):
        way = place - position[k]
        here, away = way @ normal[k], -np.einsum("ij,ij->i", way, outward)
        weight = np.maximum(here, 0) * np.maximum(away, 0) / np.square(np.einsum("ij,ij->i", way, way))
        light_of[k], lowest[k] = weight.mean() * area * np.mean(light.radiance), here.min()
    return light_of, lowest


def size(light: Light, position: F64) -> F64:
    """Angle of a rectangle's diagonal at places, or of a ball."""
    if light.kind == LightKind.SPHERE:
        return np.ones(len(position))
    place = points_of(light)[0]
    a, b = (place[k] - position for k in (0, -1))
    cosine = (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    return np.arccos(cosine)


def places(light: Light, least: float, most: float, seed: int = 0) -> tuple[F64, F64]:
    """Places at such distances all around a light, with any normals."""
    rng = np.random.default_rng(seed)
    way, normal = rng.normal(size=(2, RUN, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    distance = np.exp(rng.uniform(np.log(least), np.log(most), (RUN, 1)))
    return light.to_world[:, 3] + distance * way, np.where((normal * way).sum(1, keepdims=True) > 0, -normal, normal)


@pytest.mark.parametrize("light", [BALL, RECT, Light(LightKind.RECT, (3, 2, 1), MIRRORED, (0.9, 0.2))])
@pytest.mark.parametrize(("least", "most"), [(0.4, 1.0), (1.0, 20.0)])
def test_places_that_have_all_of_a_light_above_their_horizon_get_what_its_points_add_up_to(
    light: Light, least: float, most: float
) -> None:
    position, normal = places(light, least, most)
    expected, lowest = summed(light, position, normal)
    light_at = found(light, position, normal)
    whole = (lowest > 0.01) & (expected > 0) & (size(light, position) > 0.033)
    assert whole.sum() > 6
    np.testing.assert_allclose(light_at[whole], expected[whole], rtol=2e-3)
    assert (light_at[expected == 0] == 0).all()
    if light is BALL:
        assert (light_at[lowest < -0.01] == 0).all()


@pytest.mark.parametrize("to_world", [TURNED, MIRRORED])
@pytest.mark.parametrize("size", [(0.9, 0.2), (0.3, 1.4)])
def test_places_whose_horizon_cuts_a_rectangle_get_what_the_points_above_it_add_up_to(
    to_world: F32, size: tuple[float, float]
) -> None:
    light = Light(LightKind.RECT, (3, 2, 1), to_world, size)
    n_corners_above = set()
    for seed in range(3):
        position, normal = places(light, 0.2, 1.5, seed)
        normal[::2] *= -1  # the middle of the light is below their horizon
        expected, lowest = summed(light, position, normal)
        corners = points_of(light, 2)[0] - to_world[:, 3]
        heights = (to_world[:, 3] + 2 * corners - position[:, None]) @ normal[:, :, None]
        is_cut = (lowest < -0.02) & (heights.max(axis=(1, 2)) > 0.02) & (expected > 0.01)
        light_at = found(light, position, normal)[is_cut]
        n_corners_above.update(np.sum(heights[is_cut] > 0, axis=(1, 2)))
        # Next to an edge there is none.
        assert np.mean(light_at > 0) > 0.9
        np.testing.assert_allclose(light_at[light_at > 0], expected[is_cut][light_at > 0], rtol=1e-2)
    assert n_corners_above >= {1, 2, 3}


def test_where_the_horizon_of_one_normal_alone_cuts_a_rectangle_there_is_none() -> None:
    position = RECT.to_world[:, 3] + np.array([[0.0, -1.5, 0.0]])
    up, flat = np.array([[0.0, 1.0, 0.0]]), np.array([[1.0, 0.0, 0.0]])
    assert found(RECT, position, flat) > 0 and found(RECT, position, up) > 0
    for normal, shading in ((up, flat), (flat, up)):
        assert found(RECT, position, normal, shading) == 0


def test_next_to_a_long_edge_of_which_it_sees_nearly_half_a_turn_a_place_gets_as_much() -> None:
    light = Light(LightKind.RECT, (3, 3, 3), np.eye(3, 4, dtype=np.float32), (4.0, 0.1))  # shines to -Z
    x = np.linspace(-1.5, 1.5, 16)
    position = np.stack([x, 0 * x + 0.2, np.linspace(-0.4, -0.1, 16)], axis=1)
    normal = np.broadcast_to([0.0, -1.0, 0.0], position.shape)
    expected, lowest = summed(light, position, normal)
    assert (lowest > 0).all()
    np.testing.assert_allclose(found(light, position, normal), expected, rtol=2e-3)


@pytest.mark.parametrize("light", [BALL, RECT])
def test_both_normals_have_a_horizon(light: Light) -> None:
    position = light.to_world[:, 3] + np.array([[0.0, -1.5, 0.0], [0.4, -1.5, 0.1]])
    up, away = np.tile([0.0, 1.0, 0.0], (2, 1)), np.tile([0.0, -1.0, 0.0], (2, 1))
    assert (found(light, position, up) > 0).all()
    for normal, shading in ((up, away), (away, up)):
        assert (found(light, position, normal, shading) == 0).all()


def test_far_from_a_rectangle_where_float32_has_no_digits_left_there_is_none() -> None:
    towards = -RECT.to_world[:, 2] / np.linalg.norm(RECT.to_world[:, 2])
    distance = np.array([10.0, 30.0, 60.0, 1000.0])
    position = RECT.to_world[:, 3] + distance[:, None] * towards
    light_at = found(RECT, position, np.tile(-towards, (4, 1)))
    assert (light_at[:2] > 0).all() and (light_at[2:] == 0).all()


@pytest.mark.parametrize(
    "light",
    [
        Light(LightKind.SPHERE, (3, 2, 1), (TURNED[:, :3] @ np.diag([1, 1.01, 1, 0])[:3]).astype(np.float32), (0.2, 0)),
        Light(LightKind.RECT, (3, 2, 1), TURNED, (0.9, 0.2), Image(np.ones((2, 2, 3), np.float32))),
        Light(LightKind.DISK, (3, 2, 1), TURNED, (0.2, 0)),
        Light(LightKind.CYLINDER, (3, 2, 1), TURNED, (0.2, 0.4)),
        Light(LightKind.DISTANT, (3, 2, 1), TURNED, (0.2, 0)),
    ],
)
def test_other_lights_have_none(light: Light) -> None:
    assert form_of(light).shape == (0,)
    assert (found(light, *places(BALL, 0.5, 5.0)) == 0).all()
