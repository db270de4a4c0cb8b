"""Published numbers: polygon lights with a closed form, and a Cornell box that another renderer has converged on."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.scene import LightKind, SceneSnapshot
from tests import naive
from tests.agreement import block_means
from tests.lighting.naive import polygon_irradiance
from tests.pipeline import Pipeline
from tests.scenes import Light, Material, Mesh, box, look_at, make_snapshot, quads, rotation, translation

#: Triangles above the origin, and the radiance that a floor of albedo 1/2 reflects under them where they emit 1:
#: the tests of direct light in Nori 2, https://github.com/wjakob/nori (scenes/pa5/tests/test-direct.xml).
POLYGON_LIGHTS = [
    ([[-0.443432, 0.596366, 0.495985], [-0.320397, 0.0677699, -0.229359], [0.0341197, 0.11415, -0.343049]], 0.0898394),
    ([[0.461963, 0.397843, 0.412747], [-0.0381582, 0.851323, -0.156872], [0.195443, 0.891957, -0.260672]], 0.02292),
    ([[0.100871, 0.289075, -0.422609], [-0.308386, 0.629587, 0.423966], [-0.373132, 0.237287, 0.351592]], 0.0534198),
    ([[-0.17575, 0.639397, 0.151268], [0.318604, 0.732996, 0.459771], [0.139095, 0.294498, 0.478556]], 0.0205314),
    ([[-0.17487, 0.447916, 0.367201], [-0.405259, 0.249607, -0.354079], [0.356029, 0.0918984, -0.132271]], 0.26174),
]


def under_a_triangle(triangle: list[list[float]], size: int = 4) -> SceneSnapshot:
    """A floor seen from close above, in a window of a micron, and the light."""
    floor = quads([[[-10, 0, 10], [10, 0, 10], [10, 0, -10], [-10, 0, -10]]])
    meshes = [
        Mesh(floor, Material(0.5), path="/floor"),
        Mesh(np.array([triangle]), Material(0.0, emission=1.0), path="/light"),
    ]
    camera = look_at((0, 0.01, 0), (0, 0, 0), up=(0, 0, 1), fov=1e-2, width=size, height=size)
    return make_snapshot(meshes, camera=camera)


@pytest.mark.parametrize(("triangle", "expected"), POLYGON_LIGHTS)
def test_polygon_lights_give_the_published_radiance(triangle, expected):
    closed_form = 0.5 / np.pi * abs(polygon_irradiance(triangle, (0, 0, 0), (0, 1, 0)))
    assert closed_form == pytest.approx(expected, rel=1e-5)
    snapshot = under_a_triangle(triangle)
    pipeline = Pipeline(snapshot, light_samples=1024)
    view = pipeline.view
    assert view.n == 16
    finals = [pipeline.final(samples=16, rays=1, light_samples=64, seed=seed).direct for seed in range(4)]
    assert np.mean(finals) == pytest.approx(expected, rel=2e-3)
    # Many pixels with few samples each: its loop is over samples, and pixels are as good, as light is even.
    plain = naive.render(under_a_triangle(triangle, 64), samples=8, n_bounces=1)["direct"]
    assert plain.mean() == pytest.approx(expected, rel=0.01)


def mitsuba_cornell_box() -> SceneSnapshot:
    """The scene of ``mitsuba.cornell_box()`` (3.9.1): places, reflectances and radiance as it states them.

    Its lamp is a rectangle that emits and reflects downwards only. An emissive
    mesh would shine upwards too, so a rect light gives its light, a white mesh
    a hair above reflects, and a black one above that takes what falls on its back.
    """
    white = Material((0.885809, 0.698859, 0.666422))
    red, green = Material((0.570068, 0.0430135, 0.0443706)), Material((0.105421, 0.37798, 0.076425))
    walls = box(2, inward=True)
    small = [[0.286891, 0, -0.0877115, 0.335], [0, 0.3, 0, -0.7], [0.0877115, 0, 0.286891, 0.38]]
    large = [[0.28491, 0, 0.0939491, -0.33], [0, 0.61, 0, -0.4], [-0.0939491, 0, 0.28491, -0.28]]
    low, high = np.array([-0.23, 0, -0.18]), np.array([0.23, 0, 0.2])
    sheet = quads([[[low[0], 0, low[2]], [high[0], 0, low[2]], [high[0], 0, high[2]], [low[0], 0, high[2]]]])
    meshes = [
        Mesh(walls[0:2], red, path="/red"),
        Mesh(walls[2:4], green, path="/green"),
        Mesh(walls[4:10], white, path="/white"),
        Mesh(box(2), white, transforms=[small], path="/small"),
        Mesh(box(2), white, transforms=[large], path="/large"),
        Mesh(sheet, white, transforms=[translation(0, 0.9901, 0)], path="/lamp"),
        Mesh(sheet, Material(0.0), transforms=[translation(0, 0.9903, 0)], path="/back_of_lamp"),
    ]
    place = translation(0, 0.99, 0.01) @ rotation((1, 0, 0), -90)
    lamp = Light(LightKind.RECT, (18.387, 13.9873, 6.75357), place, (0.46, 0.38))
    camera = look_at((0, 0, 3.9), (0, 0, 0), fov=39.3077, width=64, height=64)
    return make_snapshot(meshes, lights=[lamp], camera=camera)


def test_converged_images_of_the_cornell_box(shared_scenes):
    """Direct light, one bounce and all bounces of the images that Mitsuba 3.9.1 converged on.

    The lamp's pixels are left out: it shows itself there and not here, and its
    noise in the reference is larger than what else they hold.
    """
    reference = np.load(shared_scenes / "gi_reference" / "mitsuba391_cornell_box_64px.npz")
    images = {name: reference[name].astype(float) for name in reference}
    expected = {
        "direct": images["direct"] - images["emit"],
        "one": images["bounce1"] - images["direct"],
        "all": images["full"] - images["direct"],
    }
    lamp = images["emit"].any(axis=-1)
    for axis in (0, 1):  # its reconstruction filter reaches two pixels
        lamp = np.any([np.roll(lamp, shift, axis) for shift in range(-2, 3)], axis=0)
    assert lamp.mean() < 0.1
    pipeline = Pipeline(mitsuba_cornell_box())
    found: dict[str, list[np.ndarray]] = {layer: [] for layer in expected}
    for seed in range(3):
        for layer, bounces in (("one", 1), ("all", 64)):
            pipeline.n_bounces = bounces
            final = pipeline.final(samples=16, rays=4, light_samples=4, seed=seed)
            found[layer].append(final.indirect)
        found["direct"].append(final.direct)
    for layer, ours in found.items():
        means = np.array([image[~lamp].mean(axis=0) for image in ours])
        error = np.hypot(means.std(axis=0, ddof=1) / np.sqrt(len(means)), 2e-4)
        difference = means.mean(axis=0) - expected[layer][~lamp].mean(axis=0)
        assert (np.abs(difference) < 3 * error).all(), (layer, difference, error)
        blocks, theirs = (
            block_means(np.where(lamp[..., None], 0, image), 16) for image in (np.mean(ours, axis=0), expected[layer])
        )
        # Quarters of the picture's sides; the reference's noise there is four times that of the mean.
        np.testing.assert_allclose(blocks, theirs, atol=2e-3, rtol=0.02)
