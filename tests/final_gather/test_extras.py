"""What a final gather tells beside its layers: contributions of edits, light groups, and what each pixel shows."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from icheat_usd.edits.model import Edit, KeyedPayload, MaskedSurface, Payload, SurfaceMask
from icheat_usd.final_gather import Extras
from icheat_usd.image.cryptomatte import Coverage, name_id
from icheat_usd.scene import LightKind
from tests.pipeline import Pipeline, select
from tests.scenes import Light, Material, Mesh, cornell_meshes, look_at, make_snapshot, quad

SIZE = 12
CAMERA = look_at((0.11, 0.07, 3.9), (0.01, 0.02, 0), fov=40.7, width=SIZE, height=SIZE)
LAMPS = [
    Light(
        LightKind.SPHERE,
        radiance=(20, 18, 15),
        size=(0.1, 0.0),
        to_world=((1, 0, 0, 0.3), (0, 1, 0, 0.6), (0, 0, 1, 0)),
    ),
    Light(
        LightKind.SPHERE, radiance=(3, 5, 20), size=(0.1, 0.0), to_world=((1, 0, 0, -0.4), (0, 1, 0, 0), (0, 0, 1, 0.6))
    ),
]
ROOM = make_snapshot(cornell_meshes(), lights=LAMPS, camera=CAMERA)
EVERYTHING = select(*(surface.path for surface in ROOM.surfaces))
BLEED = Edit("/bleed", "scale", {"color": (3.0, 2.0, 0.5)}, select("/floor", "/back"), select("/red", "/green"))
GREY = Edit("/grey", "hsv", {"saturation": 0.2}, select("/back", "/tall"), EVERYTHING)
DIM = Edit("/dim", "scale", {"gain": 0.3}, EVERYTHING, select("/floor"))
QUICK = {"samples": 2, "rays": 8, "light_samples": 1}


def by_name(covered: Coverage, path: str) -> np.ndarray:
    image = np.zeros(SIZE * SIZE)
    some = covered.id == name_id(path)
    image[covered.pixel[some]] = covered.share[some]
    return image.reshape(SIZE, SIZE)


def test_contributions_are_differences_of_the_first_edits_and_add_up() -> None:
    pipeline = Pipeline(ROOM, n_gather=256, bounce_rays=32, light_samples=4, n_bounces=2)
    stack = (BLEED, GREY, DIM)
    whole = pipeline.final(*stack, **QUICK, extras=Extras(contributions=True))
    assert list(whole.contributions) == ["/bleed", "/grey", "/dim"]
    total = sum(whole.contributions.values())
    np.testing.assert_allclose(total, whole.indirect_edited - whole.indirect, rtol=1e-12, atol=1e-14)
    before = whole.indirect
    for count, edit in enumerate(stack, 1):
        first = pipeline.final(*stack[:count], **QUICK).indirect_edited
        found = whole.contributions[edit.path]
        assert np.abs(found).max() > 1e-3
        np.testing.assert_allclose(found, first - before, rtol=1e-5, atol=1e-7)
        before = first


def test_extras_leave_the_usual_layers_as_they_are_and_are_absent_unless_asked_for() -> None:
    pipeline = Pipeline(ROOM, n_gather=256, bounce_rays=32, light_samples=4, n_bounces=2)
    everything = Extras(True, {"key": (ROOM.light_paths[0],)}, objects=True, edits=True)
    plain, rich = (pipeline.final(BLEED, GREY, **QUICK, extras=extras) for extras in (Extras(), everything))
    for column in fields(plain):
        if isinstance(getattr(plain, column.name), np.ndarray):
            np.testing.assert_array_equal(getattr(plain, column.name), getattr(rich, column.name), column.name)
    assert not plain.contributions and not plain.light_groups and not plain.coverage


def test_light_groups_add_up_to_the_direct_light() -> None:
    key, fill = ROOM.light_paths
    pipeline = Pipeline(ROOM, n_bounces=1)
    found = pipeline.final(**QUICK, extras=Extras(light_groups={"key": (key,), "fill": (fill,), "both": (key, fill)}))
    groups = found.light_groups
    np.testing.assert_allclose(groups["direct", "key"] + groups["direct", "fill"], found.direct, rtol=1e-5, atol=1e-7)
    np.testing.assert_array_equal(groups["direct", "both"], found.direct)
    assert groups["direct", "key"][..., 0].mean() > 2 * groups["direct", "fill"][..., 0].mean() > 0


def test_without_edits_there_is_nothing_to_contribute() -> None:
    found = Pipeline(ROOM, n_bounces=1).final(**QUICK, extras=Extras(contributions=True, edits=True))
    assert not found.contributions and not len(found.coverage["edit"].pixel)


def test_objects_cover_what_camera_samples_see_and_the_sky_has_the_rest() -> None:
    near = Mesh(quad(1.0)[:, :, [0, 2, 1]], path="/near", material=Material(opacity=0.25))
    far = Mesh(quad(2.0)[:, :, [0, 2, 1]], path="/far", transforms=[((1, 0, 0, 1.0), (0, 1, 0, 0), (0, 0, 1, -0.5))])
    camera = look_at((0, 0, 4), (0, 0, 0), fov=40, width=SIZE, height=SIZE)
    pipeline = Pipeline(make_snapshot([near, far], camera=camera), n_bounces=1)
    found = pipeline.final(samples=64, rays=1, extras=Extras(objects=True)).coverage["object"]
    window = 8 * np.tan(np.radians(20))
    areas = {"/near": 0.25, "/far": 0.75}
    for path, share in areas.items():
        assert by_name(found, path).max() == pytest.approx(share if path == "/near" else 1.0, abs=0.13)
    # The near pane is a square of one metre; a quarter of it stops the eye.
    assert by_name(found, "/near").sum() / SIZE**2 == pytest.approx(0.25 / window**2, rel=0.08)
    total = by_name(found, "/near") + by_name(found, "/far")
    assert total.max() <= 1 + 1e-6 and total[0, 0] == 0


def test_edits_cover_their_receivers_by_their_masks() -> None:
    surface = next(s for s in ROOM.surfaces if s.path == "/back")
    texels = np.full((surface.n_faces, 2, 2), 0.4, np.float32)
    mask = SurfaceMask((MaskedSurface("/back", surface.n_faces),), texels)
    soft = replace(
        BLEED, receivers=select("/back"), keys=(KeyedPayload(Payload("scale", BLEED.parameters, mask), 1.0),)
    )
    extras = Extras(objects=True, edits=True)
    found = Pipeline(ROOM, n_bounces=1).final(soft, DIM, **QUICK, extras=extras).coverage
    back = by_name(found["object"], "/back")
    assert 0.1 < back.mean() < 0.9
    np.testing.assert_allclose(by_name(found["edit"], "/bleed"), 0.4 * back, rtol=1e-6)
    everything = sum(by_name(found["object"], path) for path in EVERYTHING.paths)
    np.testing.assert_allclose(by_name(found["edit"], "/dim"), everything, rtol=1e-6)
