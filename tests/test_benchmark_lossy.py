"""What interpolation and packing lose: nothing where they leave nothing out, and what a plain computation says."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.scene import F32
from icheat_usd.transport import PackedTransport, Transport, build_transport, lossless
from icheat_usd.transport.packed import PackedLobe, PackedRows
from tests.pipeline import Pipeline
from tests.scenes import cornell
from tools.benchmarking.converged import Probe, converged_products, lossy_errors, samples_of_noisy_pixels
from tools.benchmarking.errors import ErrorSettings

N_RAYS = 4096


def packed_of(parts: Pipeline, transport: Transport, root_alone: bool = False) -> PackedTransport:
    def rows_of(exact: PackedRows) -> PackedRows:
        return exact.of_large_terms(np.ones(parts.gather.n, np.float32), np.inf) if root_alone else exact

    lobes = (
        PackedLobe(lobe.name, rows_of(lossless(lobe.rows, parts.gather.tree)), lobe.tint) for lobe in transport.lobes
    )
    return PackedTransport(tuple(lobes), transport.row_view, transport.interpolation, transport)


@pytest.fixture(scope="module")
def parts() -> Pipeline:
    return Pipeline(cornell(20, 20), n_gather=256)


def transport_of(parts: Pipeline, rays_per_row: int) -> Transport:
    scene = parts.snapshot, parts.tracer, parts.view, parts.gather
    return build_transport(*scene, rays_per_row=rays_per_row, row_spacing=4)


@pytest.fixture(scope="module")
def transport(parts: Pipeline) -> Transport:
    """With so many rays that some row meets nearly every cell, of which all terms are kept then."""
    return transport_of(parts, 8192)


@pytest.fixture(scope="module")
def light(parts: Pipeline) -> F32:
    rng = np.random.default_rng(0)
    return rng.random((2, parts.gather.n, 3), np.float32) ** 4


def errors(parts: Pipeline, packed: PackedTransport, light: F32) -> tuple[F32, F32]:
    scene = parts.snapshot, parts.tracer, parts.gather, parts.view
    return lossy_errors(*scene, packed, np.arange(parts.view.n), N_RAYS, (5, 6), light)


def test_records_lose_nothing_where_all_terms_are_kept(parts: Pipeline, transport: Transport, light: F32) -> None:
    interpolated, with_packing = errors(parts, packed_of(parts, transport), light)
    assert not interpolated[:, :, transport.row_view].any() and interpolated.any()
    # A sliver of a cell that none of the transport's own rays met has no term.
    np.testing.assert_allclose(with_packing, interpolated, rtol=0, atol=1e-4)
    assert np.median(np.abs(with_packing - interpolated)) < 1e-6


def test_what_interpolation_loses_is_what_other_rays_say(parts: Pipeline, transport: Transport, light: F32) -> None:
    interpolated, _ = errors(parts, packed_of(parts, transport), light)
    scene = parts.snapshot, parts.tracer, parts.gather, parts.view
    own = converged_products(*scene, 4 * N_RAYS, 77, light)
    assert transport.interpolation is not None
    # The scene is diffuse: light before the albedo is what records hold.
    albedo = np.maximum(parts.view.points.albedo, 1e-6)
    between = [albedo * transport.interpolation.matmul((one / albedo)[transport.row_view]) - one for one in own]
    lost = np.sqrt(np.mean(np.square(between)))
    assert lost > 0.005
    for half in interpolated:
        assert np.sqrt(np.mean((half - between) ** 2)) < 0.15 * lost


def test_terms_left_out_are_lost_and_noise_of_the_rows_is_not(parts: Pipeline, light: F32) -> None:
    transport = transport_of(parts, 64)
    _, with_packing = errors(parts, packed_of(parts, transport, root_alone=True), light)
    # The root alone knows the light's mean over areas and how much of it a row gathers.
    area = parts.gather.tree.weight / parts.gather.tree.weight.sum()
    flat = np.repeat((light * area[:, None]).sum(axis=1, keepdims=True), parts.gather.n, axis=1).astype(np.float32)
    scene = parts.snapshot, parts.tracer, parts.gather, parts.view
    at = transport.row_view
    products = converged_products(*scene, 4 * N_RAYS, 78, np.concatenate([flat, light]))
    expected = (products[:2] - products[2:])[:, at]
    difference = with_packing[0][:, at] - expected
    assert np.sqrt(np.mean(difference**2)) < 0.1 * np.sqrt(np.mean(expected**2))


def test_noisy_pixels_are_those_with_most_noise_under_any_light() -> None:
    rng = np.random.default_rng(3)
    owner = np.repeat(np.arange(40), 2)
    probe = Probe(np.arange(40), np.arange(80), owner, np.full((80, 3), 0.5, np.float32), 40, (1, 40), 1)
    error = rng.random((2, 80, 3), np.float32)  # which is not noise, however large
    halves = np.stack([error, error])
    halves[1] += 1e-3 * rng.random((2, 80, 3), np.float32)
    halves[1, 0, 6] += 5  # one sample of pixel 3, under the first light
    halves[1, 1, 63] += 0.1  # and one of pixel 31 under the second, which is less bright
    noisy = samples_of_noisy_pixels(probe, (np.stack([error, error]), halves), 2)
    np.testing.assert_array_equal(noisy, [6, 7, 62, 63])


def test_more_pixels_have_as_many_again_that_are_measured_twice() -> None:
    settings = ErrorSettings(pixels=2000, noisy_pixels=100, rays=7)
    more = settings.of_pixels(6000)
    assert (more.pixels, more.record_pixels, more.noisy_pixels, more.rays) == (6000, 6000, 300, 7)
    assert settings.of_pixels(3).noisy_pixels == 1
