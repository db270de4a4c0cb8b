"""Images of moments laid over each other."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.final_gather import FinalGather, weighted_gather
from icheat_usd.image.cryptomatte import coverage


def image(value: float, depth: float, **more: object) -> FinalGather:
    light = np.full((1, 2, 3), value)
    far = np.full((1, 2, 1), depth)
    far[0, 1] = 0.0
    seen = np.where(far > 0, 0.5 * value, 0.0) * np.ones(3)
    return FinalGather(light, light, light, light, 2 * light, seen, seen, far, (far > 0).astype(float), **more)  # type: ignore[arg-type]


def test_light_is_the_weighted_mean_and_surfaces_count_where_they_are_seen() -> None:
    here = {"contributions": {"/a": np.full((1, 2, 3), 8.0)}, "light_groups": {("direct", "key"): np.ones((1, 2, 3))}}
    covered = coverage(np.array([0]), np.array([7], np.uint32), np.array([1.0]))
    parts = [(0.25, image(4.0, 2.0, coverage={"object": covered}, **here)), (0.75, image(8.0, 0.0))]
    found = weighted_gather(iter(parts))
    np.testing.assert_allclose(found.direct, 7.0)
    np.testing.assert_allclose(found.indirect_edited, 14.0)
    # At the second moment nothing is in sight, at either pixel; at the first one, at the first pixel.
    np.testing.assert_allclose(found.depth[..., 0], [[2.0, 0.0]])
    np.testing.assert_allclose(found.albedo[..., 0], [[2.0, 0.0]])
    # An edit and a light that are there for a part of the time.
    np.testing.assert_allclose(found.contributions["/a"], 2.0)
    np.testing.assert_allclose(found.light_groups["direct", "key"], 0.25)
    assert found.coverage["object"].share.tolist() == [0.25]


def test_a_single_moment_is_the_image() -> None:
    only = image(1.0, 1.0)
    assert weighted_gather([(1.0, only)]) is only
    with pytest.raises(ValueError, match="no moment"):
        weighted_gather([])
