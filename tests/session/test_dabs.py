"""Dabs touch the faces near the brush alone, and these as if all had been looked at."""

from __future__ import annotations

import numpy as np

from icheat_usd.edits.painting import soft_sphere, surface_texel_positions
from icheat_usd.session import dabs
from tests.edits.test_masks import grid, scene


def test_a_dab_moves_every_texel_under_the_brush_and_no_other(monkeypatch) -> None:
    monkeypatch.setattr(dabs, "_FACES_AT_ONCE", 7)
    snapshot = scene(grid(6, 5, lambda corners: 0.2 * np.sin(3 * corners[..., 0]), turn=3), "a")
    places = dabs.TexelPlaces(snapshot)
    rng = np.random.default_rng(0)
    mask = dabs.filled_mask(places, ["/cloth"], 0.5)
    texels = surface_texel_positions(snapshot, 0, dabs.RESOLUTION)
    n_near = 0
    for _ in range(12):
        centre, radius = rng.uniform([0, -0.2, -1], [1, 0.2, 0]).astype(np.float32), float(rng.uniform(0.02, 0.4))
        strength = float(rng.uniform(-1, 1))
        weight = soft_sphere(tuple(centre.tolist()), 0.0, radius)(texels.reshape(-1, 3)).reshape(texels.shape[:3])
        goal = np.float32(strength > 0)
        moved = mask.texels + (goal - mask.texels) * (weight * np.float32(abs(strength)))
        expected = (np.round(moved * 255) / np.float32(255)).astype(np.float32)
        n_near += len(places.near(0, dabs.RESOLUTION, centre, radius)[0])
        mask = dabs.dabbed(places, ["/cloth"], mask, centre, radius, strength)
        np.testing.assert_array_equal(mask.texels, expected)
    assert 0 < n_near < 12 * 30 // 2
