"""Light that is laid where it is seen."""

from __future__ import annotations

import numpy as np

from icheat_usd.edits.field import EditField
from icheat_usd.kernels.record_mixtures import lay_positive


def test_light_is_laid_as_it_is_seen():
    rng = np.random.default_rng(5)
    light = rng.normal(size=(300, 3)).astype(np.float32)
    light[7, 1] = np.nan
    where = np.sort(rng.choice(1000, 300, replace=False))
    base = rng.random((1000, 3)).astype(np.float32)
    expected, found = base.copy(), base.copy()
    expected[where] = EditField.seen(light, None)
    lay_positive(light, where, found)
    assert (light < 0).any()
    np.testing.assert_array_equal(found, expected)
