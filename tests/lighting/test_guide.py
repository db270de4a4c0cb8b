"""Guided sampling of domes: as right as plain sampling everywhere, and far less noisy behind windows."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from icheat_usd.kernels.direct import fill_analytic, meet_analytic
from icheat_usd.lighting import LightSampler, build_light_sampler, irradiance, reflected_direct, samples_per_light
from icheat_usd.lighting.direct import own_draws
from icheat_usd.scene import LightKind, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, build_tracer
from tests.lighting import naive
from tests.scenes import Image, Light, Mesh, box, make_snapshot, quad, rotation, scaling, translation

F64 = NDArray[np.float64]
TURN = rotation((1, 0.4, 0.2), 35)
KINDS = ("plain", "image")


def dome(kind: str, *, black: bool = False) -> Light:
    texels = np.random.default_rng(0).random((16, 32, 3)) ** 4
    texels[4, 9] = 40.0
    if black:
        texels[:, 16:] = 0.0
    return Light(LightKind.DOME, (1.0, 2.0, 3.0), TURN, image=Image(texels, (0, 1)) if kind == "image" else None)


def hole(light: Light) -> SceneSnapshot:
    """A floor below a wide ceiling of tiles, one of which is missing."""
    places = [(x, z) for x in range(-8, 9, 2) for z in range(-8, 9, 2) if (x, z) != (0, 0)]
    ceiling = Mesh(quad(2.0, y=1.0), transforms=[translation(x, 0, z) for x, z in places])
    return make_snapshot([Mesh(quad(16.0)), ceiling], lights=[light])


def floor(n: int, *, low: float = -2.0, high: float = 2.0, **kwargs: object) -> SurfacePoints:
    place = np.random.default_rng(1).uniform(low, high, (n, 3))
    place[:, 1] = 1e-3
    return naive.receivers(place, (0, 1, 0), **kwargs)  # type: ignore[arg-type]


def guided(snapshot: SceneSnapshot, tracer: Tracer) -> LightSampler:
    sampler = build_light_sampler(snapshot, tracer, floor(4000), 5)
    assert (sampler.guide.row >= 0).sum() > 20
    return sampler


def many(points: SurfacePoints, n: int) -> SurfacePoints:
    return SurfacePoints._make(np.repeat(column, n, axis=0) for column in points)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "place, normal",
    [
        ((0.2, 0.001, -0.3), (0, 1, 0)),
        ((1.7, 0.001, 1.2), (0, 1, 0)),
        ((-1.0, 0.5, 0.0), (0.6, 0.8, 0.0)),  # a normal of which the guide saw no like
        ((0.3, 3.0, 0.2), (0, 1, 0)),  # above the ceiling: the guide only knows the floor
        ((20.0, -1.0, 3.0), (-1, 0, 0)),  # far outside, turned aside
    ],
)
def test_the_mean_is_that_of_plain_samples_wherever_the_guide_has_been(
    kind: str, place: tuple[float, ...], normal: tuple[float, ...]
) -> None:
    snapshot = hole(dome(kind))
    tracer = build_tracer(snapshot)
    points = many(naive.receivers(place, normal), 64)
    plain = irradiance(snapshot, tracer, build_light_sampler(snapshot), points, 2, 1024)[0, :, 0].astype(np.float64)
    learnt = irradiance(snapshot, tracer, guided(snapshot, tracer), points, 3, 256)[0, :, 0].astype(np.float64)
    error = np.hypot(plain.std(), learnt.std()) / 8.0
    assert plain.mean() > 0.0
    assert abs(plain.mean() - learnt.mean()) < 4.0 * error + 1e-6
    assert error < 0.05 * plain.mean()


@pytest.mark.parametrize("kind", KINDS)
def test_a_window_costs_a_fraction_of_the_noise(kind: str) -> None:
    snapshot = hole(dome(kind))
    tracer = build_tracer(snapshot)
    points = floor(800)
    sampler = guided(snapshot, tracer)
    truth = irradiance(snapshot, tracer, sampler, points, 9, 1024)[0, :, 0]
    limit = 0.3 if kind == "image" else 0.7
    for n in (1, 16):
        plain = irradiance(snapshot, tracer, build_light_sampler(snapshot), points, 2, n)[0, :, 0]
        learnt = irradiance(snapshot, tracer, sampler, points, 2, n)[0, :, 0]
        assert ((learnt - truth) ** 2).mean() < limit * ((plain - truth) ** 2).mean()


@pytest.mark.parametrize("kind", KINDS)
def test_densities_of_directions_sum_to_one_over_the_sphere(kind: str) -> None:
    snapshot = hole(dome(kind))
    sampler = guided(snapshot, build_tracer(snapshot))
    h, w = 1200, 2400
    theta = np.pi * (np.arange(h)[:, None] + 0.5) / h
    phi = 2 * np.pi * (np.arange(w)[None] + 0.5) / w
    directions = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta) + 0 * phi, np.sin(theta) * np.sin(phi)], -1)
    weight = np.broadcast_to(np.sin(theta) * (np.pi / h) * (2 * np.pi / w), (h, w)).ravel()
    for x in (0.2, 1.5):
        pdf = met(snapshot, sampler, (x, 0.001, 0.1), directions.reshape(-1, 3).astype(np.float32))
        assert (pdf * weight).sum() == pytest.approx(1.0, abs=5e-3)


def met(snapshot: SceneSnapshot, sampler: LightSampler, place: tuple[float, ...], directions: np.ndarray) -> F64:
    n = len(directions)
    distance, pdf, radiance = np.zeros(n, np.float32), np.zeros(n), np.zeros((n, 3), np.float32)
    at, normal = np.tile(np.float32(place), (n, 1)), np.tile(np.float32((0, 1, 0)), (n, 1))
    tables = snapshot.lights, snapshot.textures, sampler.tables, sampler.guide
    meet_analytic(*tables, 0, at, normal, np.ascontiguousarray(directions), distance, pdf, radiance)
    return pdf


@pytest.mark.parametrize("kind", KINDS)
def test_specular_rays_know_how_probably_shadow_rays_go_their_way(kind: str) -> None:
    snapshot = hole(dome(kind))
    sampler = guided(snapshot, build_tracer(snapshot))
    n = 2000
    place = (0.2, 0.001, 0.1)
    p = naive.receivers(place, (0, 1, 0))
    direction, distance = np.zeros((n, 3), np.float32), np.zeros(n, np.float32)
    pdf, radiance = np.zeros(n, np.float32), np.zeros((n, 3), np.float32)
    tables = snapshot.lights, snapshot.textures, sampler.tables, sampler.guide
    surface = (p.position, p.normal, p.shading_normal, p.instance)
    fill_analytic(*tables, 0, *surface, own_draws(0, 1), n, 1, True, direction, distance, pdf, radiance)
    drawn = np.flatnonzero(pdf > 0)
    assert len(drawn) > n / 4
    asked = met(snapshot, sampler, place, direction[drawn])
    # directions on the border of two cells may be rounded to the other side
    assert (np.abs(asked / pdf[drawn] - 1) < 2e-3).mean() > 0.98


@pytest.mark.parametrize("roughness", [0.15, 0.5])
def test_a_glossy_floor_behind_a_window_reflects_what_plain_samples_say(roughness: float) -> None:
    snapshot = hole(dome("image"))
    tracer = build_tracer(snapshot)
    points = many(naive.receivers((0.5, 0.001, 0.0), (0, 1, 0), specular=0.5, roughness=roughness), 64)
    eye = np.tile(np.float32((0.3, 0.9, 0.3162)), (64, 1))
    plain = reflected_direct(snapshot, tracer, build_light_sampler(snapshot), points, eye, 2, 1024)[0, :, 0]
    learnt = reflected_direct(snapshot, tracer, guided(snapshot, tracer), points, eye, 3, 256)[0, :, 0]
    assert abs(learnt.mean() - plain.mean()) < 4.0 * np.hypot(plain.std(), learnt.std()) / 8.0


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_learnt_has_the_same_bits_for_any_number_of_threads(kind: str) -> None:
    snapshot = hole(dome(kind))
    tracer = build_tracer(snapshot)
    together = guided(snapshot, tracer).guide
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        alone = guided(snapshot, tracer).guide
    finally:
        numba.set_num_threads(before)
    for one, other in zip(together, alone, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_what_is_learnt_does_not_depend_on_the_size_of_the_scene(factor: float) -> None:
    tile = [translation(factor * x, 0, factor * z) @ scaling(factor) for x in range(-4, 5, 2) for z in (-2, 2)]
    snapshot = make_snapshot(
        [Mesh(quad(16.0 * factor)), Mesh(quad(2.0, y=1.0), transforms=tile)], lights=[dome("image")]
    )
    points = floor(2000)
    points.position[:] *= np.float32(factor)
    sampler = build_light_sampler(snapshot, build_tracer(snapshot), points, 5)
    assert sampler.guide.row.shape[1] > 300
    assert (sampler.guide.row >= 0).sum() > 20


def test_under_an_open_sky_without_an_image_nothing_is_guided_and_one_sample_is_exact() -> None:
    snapshot = make_snapshot([Mesh(quad(4.0))], lights=[Light(LightKind.DOME, 1.0)])
    tracer = build_tracer(snapshot)
    sampler = build_light_sampler(snapshot, tracer, floor(1000), 0)
    assert (sampler.guide.row == -1).all()
    np.testing.assert_allclose(irradiance(snapshot, tracer, sampler, floor(50), 0, 1), np.pi, rtol=1e-5)


def test_a_dome_that_no_pilot_ray_reaches_and_points_that_are_no_hits_leave_the_sampler_plain() -> None:
    closed = make_snapshot([Mesh(box(6.0, inward=True))], lights=[dome("image")])
    assert (build_light_sampler(closed, build_tracer(closed), floor(500), 0).guide.row == -1).all()
    none = floor(3)._replace(instance=np.full(3, -1, np.int32))
    assert build_light_sampler(closed, build_tracer(closed), none, 0).guide.row.size == 0


def test_texels_that_are_no_number_count_as_black() -> None:
    texels = np.random.default_rng(0).random((8, 16, 3))
    broken, black = texels.copy(), texels.copy()
    broken[2, 3], broken[3, 8, 1], broken[1, 12] = np.nan, np.inf, -np.inf
    black[2, 3] = black[3, 8] = black[1, 12] = 0.0
    results = []
    for image in (broken, black):
        snapshot = make_snapshot(
            [Mesh(quad(0.01, y=-20.0))], lights=[Light(LightKind.DOME, 1.0, image=Image(image, (0, 1)))]
        )
        points = naive.receivers((0, 0, 0), (0, 1, 0))
        results.append(irradiance(snapshot, build_tracer(snapshot), build_light_sampler(snapshot), points, 0, 4096))
    assert np.isfinite(results[0]).all()
    np.testing.assert_allclose(results[0], results[1], rtol=1e-5)


def test_each_light_may_have_its_own_number_of_samples() -> None:
    snapshot = make_snapshot(
        [Mesh(quad(0.01, y=-20.0))],
        lights=[Light(LightKind.SPHERE, 1.0, translation(0, 2, 0), (0.5, 0)), dome("image")],
    )
    assert samples_per_light(snapshot, 4, None) == [4, 16]
    assert samples_per_light(snapshot, 4, 6) == [4, 6]
    tracer, sampler, points = build_tracer(snapshot), build_light_sampler(snapshot), floor(20)
    both = irradiance(snapshot, tracer, sampler, points, 1, [4, 16])
    np.testing.assert_array_equal(both[0], irradiance(snapshot, tracer, sampler, points, 1, 4)[0])
    np.testing.assert_array_equal(both[1], irradiance(snapshot, tracer, sampler, points, 1, 16)[1])
    with pytest.raises(ValueError, match="3 sample counts for 2 lights"):
        irradiance(snapshot, tracer, sampler, points, 1, [1, 2, 3])
