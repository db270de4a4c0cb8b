"""Patches hold places where painted masks weigh alike, and all such places that lie together."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.edits.mask_patches import mask_patches
from icheat_usd.kernels.mask_sheets import MaskSheets, weights_in_sheets
from icheat_usd.kernels.simd import address_of

FACES = 3


def sheets(*texels: np.ndarray) -> MaskSheets:
    """Sheets (FACES, size, size, width) of the second of three instances, by resolution."""
    first = np.cumsum([0, *(one.size for one in texels[:-1])])
    return MaskSheets(
        np.array([0, 0, len(texels), len(texels)]),
        np.array([one.shape[1] for one in texels]),
        first.astype(np.int64),
        np.array([one.shape[3] for one in texels]),
        np.concatenate([one.reshape(-1) for one in texels]).astype(np.float32),
    )


def ramp(size: int, step: float) -> np.ndarray:
    """A column that grows by so much from texel to texel, and a jump of another on the last face."""
    found = np.zeros((FACES, size, size, 4))
    found[..., 0] = step * np.arange(size)
    found[-1, 2:, :, 1] = 5.0
    return found


@pytest.mark.parametrize("sizes", [(8,), (2, 8), (1, 4)])
def test_cells_of_a_patch_are_within_the_distance_of_its_first_and_even_themselves(sizes):
    rng = np.random.default_rng(7)
    made = sheets(*(rng.uniform(0, 1, (FACES, size, size, 4)) ** 3 for size in sizes))
    least_apart, size = 0.5, sizes[-1]
    patches = mask_patches(made, least_apart)
    here = np.zeros(4 * len(sizes), np.float32)
    of_patch: dict[int, list[np.ndarray]] = {}
    for face in range(FACES):
        for y, x in np.ndindex(size - 1, size - 1):
            corners = []
            for dy, dx in ((0, 0), (0, 1), (1, 0), (1, 1)):
                s, t = (np.float32((at + 0.5) / size) for at in (x + dx, y + dy))
                weights_in_sheets(*made[:4], 1, face, s, t, address_of(made.texels), address_of(here))
                corners.append(here.copy())
            patch = int(patches.patch[(face * size + y) * size + x])
            of_patch.setdefault(patch, []).append(np.array(corners))
    assert patches.number == len(of_patch) - (-1 in of_patch) > 1
    for patch, found in of_patch.items():
        middles = np.array(found).mean(axis=1)
        from_middle = np.linalg.norm(np.array(found) - middles[:, None], axis=2).max(axis=1)
        assert patch < 0 or np.linalg.norm(middles - middles[0], axis=1).max() <= least_apart + 1e-5
        assert (from_middle > least_apart).all() if patch < 0 else (from_middle <= least_apart + 1e-5).all()


def test_a_ramp_is_cut_where_it_has_changed_enough_and_jumps_are_in_no_patch():
    patches = mask_patches(sheets(ramp(9, 0.1)), 0.21)
    found = patches.patch.reshape(FACES, 9, 9)[:, :8, :8]
    # Two steps from the cell that a patch began with; later rows may take the next patch.
    assert found[0, 0].tolist() == [0, 0, 0, 1, 1, 1, 2, 2]
    later = found[:2] - found[0, 0]
    assert later.min() == 0 and later.max() == 1
    assert (found[2, 1] == -1).all() and (found[2, 2:] >= 3).all()


def test_plateaus_are_patches_of_their_own():
    texels = np.zeros((FACES, 8, 8, 4))
    texels[1, :, :4, 2], texels[2, 3, 3, 0] = 0.5, 1e-3
    patches = mask_patches(sheets(texels), 0.0)
    found = patches.patch.reshape(FACES, 8, 8)[:, :7, :7]
    assert patches.number == 2 and (found[0] == found[1, 0, 6]).all()
    assert (found[1, :, :3] == found[1, 0, 0]).all() and (found[1, :, 3] == -1).all()
    assert (found[2, 2:4, 2:4] == -1).all() and (found[2] == -1).sum() == 4
