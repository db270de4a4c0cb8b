"""The table of patches against dictionaries, over several growths."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.kernels.patch_table import PatchTable, add_light, ask, mean_light, move_patches


def table(room: int) -> PatchTable:
    return PatchTable(np.empty(room, np.uint64), np.full(room, -1, np.int32), np.zeros((room, 3)))


@pytest.mark.parametrize("n_keys", [1, 40, 3000])
def test_patches_are_asked_for_and_lit_as_in_a_dictionary(n_keys: int) -> None:
    """Keys whose last bits are the same, too, so that rows are searched for beyond the end of the table."""
    rng = np.random.default_rng(n_keys)
    keys = rng.integers(0, 1 << 63, n_keys).astype(np.uint64) << np.uint64(1)
    keys[: n_keys // 2] |= np.uint64(0xFFFF)
    patches, used, most = table(8), 0, 3
    number: dict[int, int] = {}
    total: dict[int, np.ndarray] = {}
    for _ in range(4):
        key = rng.choice(keys, 2000)
        is_wanted, first, turns = np.empty(len(key), np.bool_), 0, 0
        while True:
            first, used = ask(patches.key, patches.number, used, key, first, most, is_wanted)
            if first == len(key):
                break
            larger = table(2 * len(patches.key))
            move_patches(*patches, *larger)
            patches, turns = larger, turns + 1
        expected = []
        for one in key.tolist():
            expected.append(number.get(one, 0) < most)
            number[one] = number.get(one, 0) + expected[-1]
        assert is_wanted.tolist() == expected
        assert used == len(number) <= len(patches.key) // 2

        light = rng.random((int(is_wanted.sum()), 3)).astype(np.float32)
        add_light(*patches, key[is_wanted], light)
        for one, brought in zip(key[is_wanted].tolist(), light, strict=True):
            total[one] = total.get(one, np.zeros(3)) + brought
        found = np.empty((len(key), 3), np.float32)
        mean_light(*patches, key, found)
        np.testing.assert_array_equal(found, np.float32([total[one] / number[one] for one in key.tolist()]))
