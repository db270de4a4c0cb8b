"""Rays to a dome with an image, found 16 at a time: the same, to the last bit, as one sample after another."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.kernels.direct import fill_analytic
from icheat_usd.kernels.guide import find_row, warp
from icheat_usd.kernels.lights import light_shape, sample_shape
from icheat_usd.kernels.random import hash_combine, sobol_pair
from icheat_usd.lighting import build_light_sampler
from icheat_usd.lighting.direct import own_draws
from icheat_usd.scene import LightKind
from icheat_usd.tracing import build_tracer
from tests.lighting import naive
from tests.lighting.test_guide import TURN, dome, floor, guided, hole
from tests.scenes import Image, Light, Mesh, make_snapshot, quad

SEED = 7


def odd_dome(width: int, height: int) -> Light:
    """An image of any size, with rows and columns that are black."""
    texels = np.random.default_rng(4).random((height, width, 3)) ** 5
    texels[0], texels[height // 2], texels[:, width // 3] = 0, 0, 0
    return Light(LightKind.DOME, (1.0, 2.0, 3.0), TURN, image=Image(texels, (0, 1)))


def one_after_another(snapshot, sampler, points, n_samples):
    """Direction, distance, density, radiance over density times samples, of every ray."""
    found = []
    tables = sampler.tables
    kind, m, inverse, size, image = light_shape(snapshot.lights, snapshot.textures, tables, 0)
    axis, split, child, rows, bands, columns = sampler.guide
    images = snapshot.textures.texels, tables.rows_cdf, tables.columns_cdf
    for i in range(len(points.instance)):
        place, about = (tuple(column[i]) for column in (points.position, points.shading_normal))
        row = find_row(axis, split, child, rows, 0, *place, *about)
        sequence = hash_combine(hash_combine(hash_combine(SEED, 0x11), i), 0)
        for k in range(n_samples):
            (u1, u2), factor = sobol_pair(k, sequence), 1.0
            if row >= 0:
                u1, u2, factor = warp(bands, columns, row, float(u1), float(u2))
            *ray, pdf, r, g, b = sample_shape(
                kind, m, inverse, size, image, *images, *place, *about, min(float(u1), 1.0), float(u2)
            )
            pdf *= factor
            if points.instance[i] < 0 or not pdf > 0 or np.dot(ray[:3], about) <= 0:
                found.append(np.zeros(8))
                continue
            found.append([*ray, pdf, *(np.array([r, g, b]) / (pdf * n_samples) * snapshot.lights.radiance[0])])
    return np.float32(found)


@pytest.mark.parametrize("n_samples", [1, 3, 16, 21])
@pytest.mark.parametrize("case", ["guided", "odd", "one texel"])
def test_rays_are_those_of_single_samples(case, n_samples):
    light = {
        "guided": dome("image"),
        "odd": odd_dome(37, 19),
        "one texel": Light(LightKind.DOME, 0.5, TURN, image=Image(np.full((1, 1, 3), 2.0), (0, 1))),
    }[case]
    snapshot = hole(light) if case == "guided" else make_snapshot([Mesh(quad())], lights=[light])
    tracer = build_tracer(snapshot)
    sampler = guided(snapshot, tracer) if case == "guided" else build_light_sampler(snapshot, tracer)
    points = (
        floor(300) if case == "guided" else naive.receivers(np.random.default_rng(1).normal(size=(300, 3)), (0, 1, 0))
    )
    points.instance[5:40] = -1
    n = 300 * n_samples
    direction, distance, pdf, radiance = (np.zeros((n, k), np.float32) for k in (3, 1, 1, 3))
    fill_analytic(
        snapshot.lights, snapshot.textures, sampler.tables, sampler.guide, 0, points.position, points.normal,
        points.shading_normal, points.instance, own_draws(0, 300), n_samples, SEED, False, direction, distance[:, 0],
        pdf[:, 0], radiance,
    )  # fmt: skip
    wanted = one_after_another(snapshot, sampler, points, n_samples)
    assert (pdf > 0).mean() > 0.05 and not pdf[5 * n_samples : 40 * n_samples].any()
    rays = np.hstack([direction, distance, pdf])
    np.testing.assert_array_equal(rays, wanted[:, :5])
    np.testing.assert_allclose(radiance, wanted[:, 5:], rtol=1e-6)
