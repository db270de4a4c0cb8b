"""How many hemispheres of rays records get, and how those of one record share its strata."""

from __future__ import annotations

import numpy as np

from icheat_usd.final_gather import CacheSettings, irradiance_cache
from icheat_usd.final_gather.irradiance_cache import IrradianceCache, overture
from icheat_usd.final_gather.record_rays import HemisphereTracer, take_rays
from icheat_usd.kernels.record_rays import hemisphere_directions, turn_of
from icheat_usd.kernels.samples import basis
from icheat_usd.materials import points_on_surface
from tests.final_gather.test_irradiance_cache import SCENE, Built, in_cornell

NEXT = 1 << 27  # between the streams of a record's hemispheres


def test_four_hemispheres_have_a_ray_in_each_quarter_of_every_stratum():
    n_theta, n_phi, seed = 4, 12, 9
    normal = np.array([0.6, 0.0, 0.8], np.float32)
    hemisphere, ray = np.divmod(np.arange(4 * n_theta * n_phi), n_theta * n_phi)
    stream = np.arange(4, dtype=np.int64) * NEXT + 77
    direction, counter = np.empty((len(ray), 3), np.float32), np.empty(len(ray), np.int32)
    normals = np.repeat(normal[None], 4, axis=0)
    hemisphere_directions(normals, hemisphere, ray, stream, seed, n_theta, n_phi, direction, counter)
    frame = np.array(basis(*normal), np.float64).reshape(2, 3)
    a, b = frame @ direction.T.astype(np.float64)
    outwards = (a * a + b * b) * n_theta - ray // n_phi
    around = (np.arctan2(b, a) / (2 * np.pi) - turn_of(seed, 77)) % 1 * n_phi - ray % n_phi
    assert ((outwards > -1e-5) & (outwards < 1 + 1e-5) & (around > -1e-4) & (around < 1 + 1e-4)).all()
    quarter = 2 * (outwards > 0.5) + (around > 0.5)
    assert (np.sort(quarter.reshape(4, -1), axis=0) == np.arange(4)[:, None]).all()
    assert len(np.unique(counter)) > 0.99 * len(counter)


def test_sixteen_hemispheres_are_worth_more_than_sixteen_of_others():
    """Errors of independent ones would be a quarter of that of one."""
    built = in_cornell()
    surface = next(i for i, surface in enumerate(SCENE.surfaces) if surface.path == "/floor")
    instance = int(np.flatnonzero(SCENE.geometry.instance_surface == surface)[0])
    first = SCENE.geometry.mesh_begin[SCENE.geometry.instance_mesh[instance]]
    n = 64
    points = points_on_surface(SCENE, [instance] * n, [first] * n, [[0.3, 0.4]] * n, 0)
    light = []
    for number in range(16):
        rays = built.hemispheres.trace(points, np.arange(n) + number * NEXT)
        light.append(built.cache.sums(rays, rays.radiance(built.cache.cells))[0].irradiance[:, 0].astype(np.float64))
    spread = [np.std(np.mean(light[:k], axis=0)) for k in (1, 16)]
    assert 0 < spread[1] < 0.8 * spread[0] / 4


def counts(noise: float) -> tuple[np.ndarray, IrradianceCache, np.ndarray]:
    """Hemispheres of each record of a box with blocks, as if its pixels were smaller; the cache, and pixels reached."""
    built: Built = in_cornell()
    settings = CacheSettings(n_theta=8, noise=noise, most_hemispheres=1000)
    tracer = HemisphereTracer(SCENE, built.tracer, built.gather, settings.n_theta, settings.n_phi, seed=5)
    cache = IrradianceCache(tracer, built.cache.cells, settings, is_kept=True)
    places = built.places._replace(extent=built.places.extent / 8)
    placed = overture(cache, places, built.view.pixel, SCENE.camera.width)
    return np.bincount(cache.owner, minlength=cache.n), cache, cache.table.reach / placed.extent


def test_records_that_reach_further_have_more_hemispheres():
    number, _, reach = counts(0.01)
    order = np.argsort(reach)
    quarter = len(order) // 4
    assert reach[order[-quarter:]].mean() > 3 * reach[order[:quarter]].mean()
    assert number[order[-quarter:]].mean() > 2 * number[order[:quarter]].mean()


def test_half_the_noise_asks_for_twice_the_hemispheres():
    coarse, fine = (counts(noise)[0] for noise in (0.004, 0.002))
    assert coarse.min() == 1 and coarse.mean() > 4
    assert 1.8 < fine.mean() / coarse.mean() < 2.1


def test_a_record_is_the_mean_of_its_hemispheres_however_many_are_traced_at_once(monkeypatch):
    number, cache, _ = counts(0.02)
    assert number.max() > 4 and (number == 1).any()
    streams, expected = cache.rays.stream, np.zeros_like(cache.values.irradiance)
    for k in range(int(number.max())):
        rows = np.flatnonzero(streams // NEXT == k)
        rays = take_rays(cache.rays, rows)
        expected[cache.owner[rows]] += cache.sums(rays, rays.radiance(cache.cells))[0].irradiance
    np.testing.assert_allclose(cache.values.irradiance, expected / number[:, None], rtol=1e-5)
    monkeypatch.setattr(irradiance_cache, "_RAYS_AT_ONCE", 7 * cache.settings.n_theta * cache.settings.n_phi)
    again, in_pieces, _ = counts(0.02)
    assert (again == number).all()
    for one, other in zip(in_pieces.values, cache.values, strict=True):
        np.testing.assert_array_equal(one, other)
