"""Light in lanes against the same in NumPy: rays added one by one, changes by colour, and places that look at it."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels.record_lanes import LANES, add_change, add_ray, frames_of
from icheat_usd.kernels.record_slots import mix_slots
from icheat_usd.kernels.samples import basis
from icheat_usd.kernels.simd import address_of, load_color

RNG = np.random.default_rng(3)


def directions(n: int) -> np.ndarray:
    found = RNG.normal(size=(n, 3))
    return (found / np.linalg.norm(found, axis=1)[:, None]).astype(np.float32)


def floats(*shape: int) -> np.ndarray:
    return RNG.uniform(-1, 1, shape).astype(np.float32)


def in_lanes(by_channel: np.ndarray) -> np.ndarray:
    """(..., 3, 5) as lanes."""
    found = np.zeros((*by_channel.shape[:-2], LANES), np.float32)
    found[..., :15] = by_channel.reshape(*by_channel.shape[:-2], 15)
    return found


def test_a_ray_is_added_by_channel_with_its_share_and_its_weights():
    from numba import njit

    @njit
    def added(out, light, share, weights, ray):
        add_ray(address_of(out), load_color(address_of(light)), share, address_of(weights), ray)

    before, light, weights = floats(LANES), floats(4), floats(3, 4)
    found = before.copy()
    added(found, light, np.float32(0.25), weights, 2)
    expected = before[:15].reshape(3, 5) + light[:3, None] * np.append(np.float32(0.25), weights[2])
    assert np.allclose(found[:15].reshape(3, 5), expected, rtol=1e-6, atol=1e-7)
    assert found[15] == before[15]


def test_a_change_multiplies_channels():
    from numba import njit

    @njit
    def changed(out, change, light):
        add_change(address_of(out), load_color(address_of(change)), address_of(light))

    before, light, change = floats(LANES), in_lanes(floats(3, 5)), np.append(floats(3), np.float32(0))
    found = before.copy()
    changed(found, change, light)
    expected = before[:15].reshape(3, 5) + change[:3, None] * light[:15].reshape(3, 5)
    assert np.allclose(found[:15].reshape(3, 5), expected, rtol=1e-6, atol=1e-7) and found[15] == before[15]


def test_places_mix_the_light_of_records_with_turns_moves_and_masks():
    n_records, n_places, n_rows = 6, 9, 5
    at, facing, shrink = floats(n_records, 3), directions(n_records), RNG.uniform(0.2, 1, n_records).astype(np.float32)
    position, normal = floats(n_places, 3), directions(n_places)
    frame = np.empty((n_records, LANES), np.float32)
    frames_of(at, facing, shrink, frame)
    # Slots of two patterns: derivatives by rows 1 and 4, and by none.
    soft_begin, soft_row = np.array([0, 2, 2]), np.array([1, 4])
    pattern = np.array([0, 1, 0, 0, 1, 0, 0], np.int32)
    derived = np.cumsum(np.append(0, np.where(pattern == 0, 2, 0)))
    values, derivative = floats(len(pattern), 3, 5), floats(int(derived[-1]), 3, 5)
    slot_masks, masks = floats(len(pattern), n_rows), floats(4, n_rows)
    where = np.array([0, 2, 3, 7, 8])
    which = RNG.integers(0, len(masks), len(where))
    count = RNG.integers(0, 4, n_places).astype(np.int32)
    record, weight = RNG.integers(0, n_records, (n_places, 8)).astype(np.int32), floats(n_places, 8)
    first = np.cumsum(count[where]) - count[where]
    slot = RNG.integers(0, len(pattern), int(count[where].sum()))
    out = np.empty((len(where), 3), np.float32)
    mix_slots(
        frame, in_lanes(values), in_lanes(derivative), derived, slot_masks, pattern, soft_begin, soft_row, slot,
        position, normal, count, record, weight, where, which, masks, first.astype(np.int64), out,
    )  # fmt: skip
    for q, p in enumerate(where):
        expected = np.zeros(3)
        for k in range(count[p]):
            r, s = record[p, k], slot[first[q] + k]
            light = values[s].astype(np.float64)
            for e, row in enumerate(soft_row if pattern[s] == 0 else []):
                light += (masks[which[q], row] - slot_masks[s, row]) * derivative[derived[s] + e]
            tangents = np.array(basis(*facing[r])).reshape(2, 3)
            turn, move = np.cross(facing[r], normal[p]), shrink[r] * (position[p] - at[r])
            expected += weight[p, k] * (light @ np.concatenate([[1], tangents @ turn, tangents @ move]))
        assert np.allclose(out[q], expected, rtol=1e-5, atol=1e-5)
