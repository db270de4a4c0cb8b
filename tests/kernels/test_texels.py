"""Texels near places of faces."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.kernels.texels import corner_texels, near_texels


@pytest.mark.parametrize("resolution", [1, 2, 3, 16])
def test_the_nearest_texel_is_a_corner_of_the_cell_around(resolution):
    centres = (np.arange(resolution) + 0.5) / resolution
    for s, t in np.random.default_rng(3).random((500, 2)).astype(np.float32):
        first, nearest = near_texels(resolution, s, t)
        corners = corner_texels(resolution, s, t)[:4]
        assert first == corners[0]
        assert nearest in corners
        x, y = np.abs(centres - s).argmin(), np.abs(centres - t).argmin()
        assert nearest == y * resolution + x
