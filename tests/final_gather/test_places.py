"""How near the next surface is to camera samples, and rays that are traced one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icheat_usd.final_gather.places import near_of, pixel_extent
from icheat_usd.final_gather.record_rays import HemisphereTracer
from icheat_usd.kernels.embree import TraceTable
from icheat_usd.samples import gather_samples, view_samples
from icheat_usd.samples.gather import pilot_pixels
from icheat_usd.tracing import build_tracer
from icheat_usd.tracing.embree import EmbreeTracer
from tests.scenes import cornell

SCENE = cornell(20, 16)
TRACER = build_tracer(SCENE)
VIEW = view_samples(SCENE, TRACER, samples_per_pixel=2, seed=3, centred=False)


class SingleRays(EmbreeTracer):
    """As in scenes of many instances, where packets are slower."""

    def compiled(self) -> TraceTable:
        return super().compiled()._replace(function=self.address_of("rtcIntersect1")[0], packets=False)


def test_rays_in_packets_and_one_by_one_meet_the_same() -> None:
    single = SingleRays(SCENE)
    gather = gather_samples(SCENE, TRACER, VIEW, n=64)
    stream = np.arange(VIEW.n)
    first, second = (
        HemisphereTracer(SCENE, tracer, gather, 4, 12, 5).trace(VIEW.points, stream) for tracer in (TRACER, single)
    )
    assert np.isfinite(first.distance).mean() > 0.5
    np.testing.assert_allclose(second.distance, first.distance, rtol=1e-4)
    np.testing.assert_allclose(near_of(SCENE, single, VIEW, 1), near_of(SCENE, TRACER, VIEW, 1), rtol=1e-4)


def test_a_tracer_that_kernels_cannot_call_finds_the_same() -> None:
    reference = build_tracer(SCENE, "reference")
    np.testing.assert_allclose(near_of(SCENE, reference, VIEW, 1), near_of(SCENE, TRACER, VIEW, 1), rtol=1e-4)


@pytest.mark.parametrize("reach", [2.0, 5.0])
def test_what_is_beyond_the_reach_of_records_is_not_looked_for(reach: float) -> None:
    view = view_samples(SCENE, TRACER, samples_per_pixel=1, seed=3)
    far, near = near_of(SCENE, TRACER, view, 1), near_of(SCENE, TRACER, view, 1, reach)
    limit = reach * pixel_extent(SCENE.camera, view)
    assert 0.05 < (far < limit).mean() < 0.95
    np.testing.assert_array_equal(near, np.where(far < limit, far, np.inf))


def test_samples_of_a_pixel_that_see_one_surface_share_what_is_near() -> None:
    near = near_of(SCENE, TRACER, VIEW, 1)
    for pixel in np.unique(VIEW.pixel):
        some = np.flatnonzero(VIEW.pixel == pixel)
        for instance in np.unique(VIEW.points.instance[some]):
            assert len(np.unique(near[some[VIEW.points.instance[some] == instance]])) == 1


def test_gather_samples_are_spread_by_the_pilots_pixels_alone() -> None:
    scene = replace(SCENE, camera=replace(SCENE.camera, width=160, height=160))
    whole, some = (view_samples(scene, TRACER, pixels=pixels) for pixels in (None, pilot_pixels(scene.camera)))
    assert some.n < 0.6 * whole.n
    first, second = (gather_samples(scene, TRACER, view, n=300) for view in (whole, some))
    np.testing.assert_array_equal(first.points.position, second.points.position)
