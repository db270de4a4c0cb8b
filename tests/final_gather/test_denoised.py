"""A denoised final gather: edits keep their edges and their bits."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

from icheat_usd.edits.model import Edit, KeyedPayload, MaskedSurface, Payload, SurfaceMask
from icheat_usd.final_gather import NO_EXTRAS, Extras
from icheat_usd.final_gather.denoised import denoised, mask_image, with_denoising
from tests.pipeline import Pipeline, select
from tests.scenes import covered_cornell, look_at

pytestmark = pytest.mark.skipif(find_spec("pyoidn") is None, reason="needs the extra 'denoise'")

SCENE = replace(covered_cornell(), camera=look_at((0.11, 0.07, 3.9), (0.01, 0.02, 0), fov=40.7, width=32, height=32))
EVERYTHING = select(*(surface.path for surface in SCENE.surfaces))


def checkered(path: str) -> SurfaceMask:
    """A hard mask of squares on a surface."""
    surface = next(s for s in SCENE.surfaces if s.path == path)
    texels = np.zeros((surface.n_faces, 4, 4), np.float32)
    texels[:, :2, 1:] = 1
    return SurfaceMask((MaskedSurface(path, surface.n_faces, surface.instance_id),), texels)


def test_an_edit_multiplies_the_denoised_image_within_its_mask() -> None:
    payload = Payload("scale", {"gain": 4.0}, receiver_mask=checkered("/back"))
    edit = Edit(
        "/edit", "scale", {"gain": 4.0}, select("/back"), EVERYTHING, keys=(KeyedPayload(payload, 1.0),)
    )  # fmt: skip
    floor = Edit("/floor_edit", "scale", {"gain": 0.5}, select("/floor"), EVERYTHING)
    pipeline = Pipeline(SCENE, n_gather=1024, n_bounces=3)
    extras = with_denoising(Extras(light_groups={"lamp": SCENE.light_paths}), ["/edit", "/floor_edit"])
    result = pipeline.final(edit, floor, rays=8, samples=8, light_samples=2, extras=extras)
    found = denoised(result, ["/edit", "/resting", "/floor_edit"])
    masks = [mask_image(result, path) for path in ("/edit", "/floor_edit")]
    assert (masks[0] == 1).sum() > 30
    assert ((masks[0] > 0) & (masks[0] < 1)).sum() > 10
    nowhere = (masks[0] == 0) & (masks[1] == 0)
    np.testing.assert_array_equal(found.indirect_edited[nowhere], found.indirect[nowhere])
    unedited = denoised(pipeline.final(rays=8, samples=8, light_samples=2, extras=extras), [])
    np.testing.assert_array_equal(found.indirect, unedited.indirect)
    np.testing.assert_array_equal(found.direct, unedited.direct)
    ratio = (found.indirect_edited / np.maximum(found.indirect, 1e-6)).mean(axis=2)
    inside = masks[0] == 1
    assert abs(ratio[inside].mean() - 4) < 0.08
    assert abs(ratio[inside] / 4 - 1).max() < 0.25
    assert abs(ratio[masks[1] == 1].mean() - 0.5) < 0.02
    # There is less noise than there was.
    exact = pipeline.final(edit, floor, rays=32, samples=16, light_samples=4, seed=9)
    for name in ("indirect", "indirect_edited"):
        before, after = (np.abs(getattr(one, name) - getattr(exact, name)).mean() for one in (result, found))
        assert after < 0.7 * before
    changes = found.contributions["/edit"] + found.contributions["/floor_edit"]
    np.testing.assert_allclose(changes, found.indirect_edited - found.indirect, atol=1e-5)
    np.testing.assert_allclose(found.light_groups["direct", "lamp"], found.direct, atol=1e-6)


def test_a_gather_without_masks_is_refused() -> None:
    pipeline = Pipeline(SCENE, n_gather=64, n_bounces=1)
    result = pipeline.final(rays=1, samples=1, light_samples=1, extras=NO_EXTRAS)
    with pytest.raises(ValueError, match="with_denoising"):
        denoised(result, ["/edit"])
    assert with_denoising(NO_EXTRAS, []) is NO_EXTRAS
    assert denoised(result, []).indirect.any()
