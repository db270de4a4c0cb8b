"""Which masks are near enough to share a slot, beside the sums written out."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.kernels.irradiance_cache import MAX_ENTRIES
from icheat_usd.kernels.record_slots import served_by_own

MOST_CHANGE, MOST_BEND = 0.25, 0.01
RNG = np.random.default_rng(7)


def served(masks: np.ndarray, own: np.ndarray, bend: np.ndarray) -> np.ndarray:
    """Whether row k of `masks` is served by row k of `own`."""
    n = len(masks)
    record = np.zeros((n, MAX_ENTRIES), np.int32)
    record[:, 0] = np.arange(n)
    slot, used = np.zeros(n, np.int64), np.zeros(n, np.uint8)
    one_each, same = np.ones(n, np.int32), np.zeros(n, np.int32)
    rows = np.arange(n)
    served_by_own(one_each, record, rows, rows, masks, same, own, same, bend, MOST_CHANGE, MOST_BEND, rows, slot, used)
    assert np.array_equal(used, slot == -1)
    return slot == -1


@pytest.mark.parametrize("n_rows", [1, 3, 4, 8, 9, 64])
def test_masks_share_a_slot_where_they_change_light_little_and_bend_it_less(n_rows):
    masks, own = RNG.random((2, 4000, n_rows)).astype(np.float32)
    own = (masks + (own - 0.5) * RNG.random((4000, 1)) ** 2).astype(np.float32)
    bend = (RNG.random(n_rows) / np.sqrt(n_rows)).astype(np.float32)
    each = np.abs(masks.astype(np.float64) - own) * bend
    change = each.sum(axis=1)
    bent = sum(each[:, i] * each[:, j] for i in range(n_rows) for j in range(i)) + np.zeros(4000)
    clear = (np.abs(change - MOST_CHANGE) > 1e-5) & (np.abs(bent - MOST_BEND) > 1e-5)
    expected = (change <= MOST_CHANGE) & (bent <= MOST_BEND)
    assert np.array_equal(served(masks, own, bend)[clear], expected[clear])
    assert 200 < expected.sum() < 3800
    if n_rows > 1:
        assert (change[expected] ** 2 / 2 > MOST_BEND).any(), "some that only the exact sum allows"


def test_masks_that_differ_in_what_does_not_bend_share_a_slot():
    masks = RNG.random((100, 6)).astype(np.float32)
    own = np.ascontiguousarray(masks[::-1])
    assert served(masks, own, np.zeros(6, np.float32)).all()
