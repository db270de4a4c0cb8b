"""Direct light of camera samples: more rays in penumbrae, all of a pixel's from one sequence."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from icheat_usd.final_gather import GatherSettings, direct_light
from icheat_usd.final_gather.camera_pass import CameraPass
from icheat_usd.final_gather.direct_light import DirectLight, _disagreeing
from icheat_usd.lighting import build_light_sampler, reflected_direct
from icheat_usd.samples.develop import develop
from icheat_usd.scene import F64, LightKind
from icheat_usd.tracing import build_tracer
from tests.scenes import Light, Material, Mesh, box, look_at, make_snapshot, quad, rotation, translation

SIZE = 24
SCENE = make_snapshot(
    [
        Mesh(quad(6.0), Material(0.6, roughness=0.4, ior=1.5)),
        Mesh(box((0.8, 0.8, 0.8)), Material(0.4), (translation(0, 0.4, 0),)),
    ],
    lights=[
        Light(LightKind.RECT, (3, 2, 1), translation(0.9, 2.2, 0.3) @ rotation((1, 0, 0), -90), (2, 2)),
        Light(LightKind.SPHERE, 2.0, translation(-1.5, 1.5, 1.0), (0.6, 0)),
        Light(LightKind.DISTANT, 1.0, rotation((1, 0, 0), -40), (0, 0)),
    ],
    camera=look_at((0.5, 2.5, 3.5), (0, 0.2, 0), fov=45, width=SIZE, height=SIZE),
)
TRACER = build_tracer(SCENE)
SAMPLER = build_light_sampler(SCENE)


def image(settings: GatherSettings, band: int = 1 << 20) -> F64:
    """(lights, pixels, 3) of direct light."""
    camera = CameraPass(SCENE, TRACER, settings, settings.edge_samples, band)
    for _ in camera.first():
        pass
    found = []
    for part, light in DirectLight(SCENE, TRACER, SAMPLER, settings).bands(camera.all()):
        found.append([develop(part.view, one, part.pixels) for one in light])
    return np.concatenate(found, axis=1)


def plain(settings: GatherSettings, n: int, seed: int) -> F64:
    """The same camera samples with `n` shadow rays each, all from sequences of their own."""
    camera = CameraPass(SCENE, TRACER, settings, settings.edge_samples, 1 << 20)
    for _ in camera.first():
        pass
    (band,) = camera.all()
    light = reflected_direct(SCENE, TRACER, SAMPLER, band.view.points, band.view.to_eye, seed, n)
    return np.stack([develop(band.view, one, band.pixels) for one in light])


def test_light_is_the_same_for_any_bands_and_threads() -> None:
    settings = GatherSettings(samples_per_pixel=2, edge_samples=3, light_samples=4)
    whole = image(settings)
    assert np.array_equal(image(settings, band=2 * SIZE), whole)
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        assert np.array_equal(image(settings, band=7 * SIZE), whole)
    finally:
        numba.set_num_threads(before)


def test_light_is_right_in_the_mean_and_only_pixels_in_doubt_take_many_rays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = GatherSettings(samples_per_pixel=4, edge_samples=0, light_samples=8)
    truth = plain(settings, 1024, 0)
    rays = [0]
    trace = direct_light.add_shadow_rays

    def counted(*arguments: object) -> None:
        points, count = arguments[3], arguments[8]
        rays[0] += len(points.instance) * count  # type: ignore[attr-defined,operator]
        trace(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(direct_light, "add_shadow_rays", counted)
    ours, usual = image(settings), plain(settings, 8, 1)
    error, usual_error = (((found - truth) ** 2).sum() for found in (ours, usual))
    assert error < 0.5 * usual_error
    n_samples = int((truth.sum(axis=0) > 0).any(axis=1).sum()) * 4
    assert rays[0] < 0.6 * n_samples * (32 + 32 + 1)  # what it is where every pixel is in doubt
    np.testing.assert_allclose(ours.mean(axis=(1, 2)), truth.mean(axis=(1, 2)), rtol=3e-3)


def test_parts_of_an_image_go_on_in_the_sequence() -> None:
    """Two images of two samples each are the halves of one of four."""
    whole = GatherSettings(samples_per_pixel=4, edge_samples=0, light_samples=4)
    first, second = (
        GatherSettings(samples_per_pixel=2, edge_samples=0, light_samples=4, first_sample=k) for k in (0, 2)
    )
    truth = plain(whole, 1024, 0)
    together = (image(first) + image(second)) / 2
    again = (image(first) + image(first)) / 2
    assert ((together - truth) ** 2).mean() < 0.7 * ((again - truth) ** 2).mean()
    assert not np.array_equal(together, again)


def test_a_pixel_is_in_doubt_where_one_beside_it_differs() -> None:
    """A shadow's border between columns 2 and 3, and none known below the last row but from the next band."""
    extremes = np.ones((1, 3, 6, 2), np.float32)
    extremes[:, :, 3:] = 0.0
    doubt = _disagreeing(extremes, None, None).reshape(3, 6)
    assert np.array_equal(doubt, np.tile([False, False, True, True, False, False], (3, 1)))
    extremes[...] = 1.0
    below = np.ones((1, 1, 6, 2), np.float32)
    below[:, :, 0, 0] = 0.0
    doubt = _disagreeing(extremes, None, below).reshape(3, 6)
    assert np.argwhere(doubt).tolist() == [[2, 0], [2, 1]]
