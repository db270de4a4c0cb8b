"""The gathered method: a few rays of every camera sample, and features of more samples for the denoiser."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest

from icheat_usd.final_gather import Extras, FinalGather, GatherSettings
from icheat_usd.final_gather.camera_pass import CameraPass
from icheat_usd.samples.develop import average
from icheat_usd.scene import F64, LightKind
from icheat_usd.tracing import build_tracer
from tests.agreement import compare
from tests.final_gather.test_edits import EVERYTHING, WHITE, previews
from tests.final_gather.test_irradiance_cache import SCENE, in_cornell
from tests.final_gather.test_operations import edit
from tests.pipeline import Pipeline
from tests.scenes import Light, Material, Mesh, cornell, look_at, make_snapshot, quad, rotation

STRATA = [(2, 2), (2, 4), (4, 4), (4, 8)]


@pytest.mark.parametrize("strata", STRATA)
def test_rays_that_share_a_packet_end_where_each_alone_does(strata: tuple[int, int]) -> None:
    """Seven points, so that packets of several have room left in the last one."""
    built = in_cornell()
    points = built.places.take(np.arange(0, 7 * 20, 20)).points
    rays = built.hemispheres.trace(points, np.arange(7, dtype=np.int64) + 40, strata)
    row, ray = np.divmod(np.arange(7 * rays.n_rays), rays.n_rays)
    directions, _ = rays._directions(row, ray)
    hits = built.tracer.intersect(rays.position[row], directions)
    is_above = (directions * points.normal[row]).sum(axis=1) > 0
    assert is_above.mean() > 0.99
    flat = np.flatnonzero(is_above)
    np.testing.assert_allclose(rays.distance.reshape(-1)[flat], hits.distance[flat], rtol=1e-5)
    np.testing.assert_array_equal(rays.instance.reshape(-1)[flat], hits.instance[flat])
    ends = rays.ends(SCENE, flat)
    np.testing.assert_array_equal(rays.cell.reshape(-1)[flat], built.gather.locate(ends))
    # One ray in each ring of as many shares of the cosine.
    cosine = (directions * rays.shading_normal[row]).sum(axis=1)
    ring = np.minimum((1 - cosine**2) * strata[0], strata[0] - 1e-3).astype(int)
    np.testing.assert_array_equal(ring, ray // strata[1])


def test_the_mean_of_rays_is_that_of_what_each_brings() -> None:
    built = in_cornell()
    rays = built.hemispheres.trace(built.places.points, np.arange(built.view.n, dtype=np.int64), (2, 4))
    some = np.arange(0, rays.cell.size, 37)
    tints = np.random.default_rng(2).uniform(0.2, 2.0, (len(some), 3)).astype(np.float32)
    rays = rays._replace(adjusted=some, throughput=tints)
    for cells in (built.cache.cells, np.concatenate([built.cache.cells, 3 * built.cache.cells], axis=1)):
        np.testing.assert_allclose(rays.mean_radiance(cells), rays.radiance(cells).mean(axis=1), rtol=2e-6)


def test_rays_of_a_camera_sample_are_as_many_as_asked_for() -> None:
    for n, strata in {1: (2, 2), 4: (2, 2), 8: (2, 4), 16: (4, 4), 64: (4, 16), 192: (8, 24)}.items():
        assert GatherSettings(method="gathered", gather_rays=n).own_strata == strata


def test_the_picture_is_that_of_brute_force() -> None:
    """Cells are 5 cm across in a box of 2 m: 3 % of tolerance for the light of a place, 2 % in the mean."""
    parts = previews()[0]
    gathered = [
        parts.final(method="gathered", samples=16, rays=16, light_samples=1, seed=seed).indirect for seed in range(3)
    ]
    brute = [parts.final(samples=16, rays=16, light_samples=1, seed=seed).indirect for seed in range(4)]
    found = compare(gathered, brute, tolerance=0.03)
    assert (np.abs(found.ratio - 1) < 4 * found.error + 0.02).all(), found
    assert found.pixels < 1.4 and found.blocks < 2.4, found


def test_the_picture_has_the_same_bits_with_one_thread() -> None:
    parts = Pipeline(cornell(24, 24), n_gather=512, n_bounces=2)
    effort = {"method": "gathered", "samples": 1, "rays": 8, "light_samples": 1, "edge_samples": 2}
    stack = edit("scale", WHITE, EVERYTHING)
    before = numba.get_num_threads()
    both = parts.final(stack, **effort)
    try:
        numba.set_num_threads(1)
        alone = parts.final(stack, **effort)
    finally:
        numba.set_num_threads(before)
    assert (both.indirect != both.indirect_edited).any()
    for layer in ("direct", "indirect", "indirect_edited", "albedo", "normal"):
        np.testing.assert_array_equal(getattr(both, layer), getattr(alone, layer))


@pytest.mark.parametrize("edge_samples", [0, 2])
def test_silhouettes_are_those_of_all_samples(edge_samples: int) -> None:
    """A block before a sky: what is seen of either, and light that is the same everywhere on the block."""
    scene = make_snapshot(
        [Mesh(quad(1.0), Material(0.5), (rotation((0, 0, 1), 30) @ rotation((1, 0, 0), 90),))],
        lights=[Light(LightKind.DOME, 1.0)],
        camera=look_at((0, 0, 3), (0, 0, 0), fov=40, width=24, height=24),
    )
    parts = Pipeline(scene, n_gather=64, n_bounces=1)

    def render(**effort: int) -> FinalGather:
        extras = Extras(objects=True)
        return parts.final(method="gathered", samples=2, rays=4, light_samples=64, extras=extras, **effort)

    apart = render(edge_samples=edge_samples, feature_samples=6)
    together = render(edge_samples=edge_samples + 6)
    assert ((together.seen > 0) & (together.seen < 1)).sum() > 20
    np.testing.assert_allclose(apart.seen, together.seen, atol=1e-6)
    np.testing.assert_allclose(apart.background, together.background, atol=1e-6)
    lit = render(edge_samples=edge_samples).seen > 0
    np.testing.assert_allclose(*((one.direct * lit).sum() for one in (apart, together)), rtol=0.02)
    shares = [
        np.bincount(one.coverage["object"].pixel, one.coverage["object"].share, 24 * 24) for one in (apart, together)
    ]
    np.testing.assert_allclose(*(one * lit.ravel() for one in shares), atol=1e-6)


@pytest.mark.parametrize("edge_samples", [0, 2])
def test_features_are_means_of_all_samples_that_look_at_them(edge_samples: int) -> None:
    scene = cornell(24, 24)
    tracer = build_tracer(scene)

    def features(settings: GatherSettings) -> tuple[list[F64], list[F64], int]:
        camera = CameraPass(scene, tracer, settings, settings.edge_samples, band=200)
        for _ in camera.first():
            pass
        albedo, normal, n_edges = [], [], 0
        for band in camera.all():
            for layer, found in zip((albedo, normal), camera.features(band), strict=True):
                layer.append(found)
            if not settings.feature_samples:
                np.testing.assert_array_equal(albedo[-1], average(band.view, band.view.points.albedo, band.pixels))
            n_edges += len(band.edges)
        return albedo, normal, n_edges

    settings = GatherSettings(samples_per_pixel=2, edge_samples=edge_samples, feature_samples=4)
    apart = features(settings)
    # The same samples of the sequence, all of which light is found at.
    together = features(replace(settings, edge_samples=edge_samples + 4, feature_samples=0))
    assert apart[2] == together[2] > 50
    for mine, its in zip(apart[:2], together[:2], strict=True):
        np.testing.assert_allclose(np.concatenate(mine), np.concatenate(its), atol=1e-6)
