"""Stacks of masks as lines, and selections as tables: against what composes pairs one edit after another."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.edits.bound import Ends
from icheat_usd.edits.mask_sheets import sheets_of_many
from icheat_usd.edits.mask_stack import is_of_masks, looks_at_hits, mask_stack
from icheat_usd.edits.mask_table import mask_table, weights_of
from icheat_usd.edits.model import Blend, Edit
from tests.final_gather.test_edits import BLEED, EVERYTHING, GREY, SIDES, TURN, WHITE, painted, previews

EMIT = Edit("/emit", "emit", {"color": (0.2, 0.1, 0.3)}, WHITE, SIDES, amount=0.6)
FADE = Edit("/fade", "scale", {"gain": 0.25, "color": (1.0, 0.5, 2.0)}, EVERYTHING, EVERYTHING, amount=0.8)


def blended(edit: Edit, blend: Blend) -> Edit:
    return Edit(f"{edit.path}_{blend}", edit.operation, edit.parameters, edit.receivers, edit.casters, 0.7, blend)


STACKS = {
    "scales": (BLEED, FADE),
    "added light": (EMIT, FADE, EMIT),
    "over": (BLEED, blended(FADE, Blend.OVER), blended(EMIT, Blend.OVER), FADE),
    "add": (BLEED, blended(FADE, Blend.ADD), blended(EMIT, Blend.ADD), FADE),
    "view": (BLEED, Edit("/view", "receive", {"scale": (2.0, 2.0, 2.0)}, WHITE, EVERYTHING), FADE),
}


@pytest.mark.parametrize("name", STACKS)
def test_lines_are_what_edits_make_of_pairs(name):
    field = previews()[0].field(*STACKS[name])
    assert is_of_masks(field)
    n, rng = 50, np.random.default_rng(7)
    u, w = (rng.uniform(0, 1, (field.n_rows, n)).astype(np.float32) for _ in range(2))
    b = rng.uniform(0.1, 2, (field.n_groups, n, 3)).astype(np.float32)
    expected = field.evaluate(b, Ends(u, None, ()), Ends(w, None, ()))
    table = mask_stack(field, with_emission=True)
    x = np.repeat(table.start[:, None], n, axis=1)
    for row in range(field.n_rows):
        weight = (u * w)[row][None, :, None]
        x = (1 + table.slope[row][:, None] * weight) * x + table.shift[row][:, None] * weight
    np.testing.assert_allclose(x[: field.n_groups, :, :3], expected.scale, rtol=1e-5)
    assert (expected.scale != 1).any()
    if len(x) > field.n_groups:
        np.testing.assert_allclose(x[field.n_groups, :, :3], expected.emission, rtol=1e-5, atol=1e-7)
    assert (len(x) > field.n_groups) == expected.emission.any()


def test_emission_can_be_left_out():
    field = previews()[0].field(EMIT, FADE)
    assert len(mask_stack(field, with_emission=True).start) == 2
    assert len(mask_stack(field, with_emission=False).start) == 1


def test_tables_hold_the_weights_of_selections():
    parts = previews()[0]
    field = parts.field(BLEED, painted("scale", {"gain": 4.0}), FADE)
    for side in ("receivers", "casters"):
        selections = [selection for bound in field.edits for selection in getattr(bound, side)]
        table = mask_table(selections, parts.snapshot.n_instances)
        found = weights_of(table, sheets_of_many(table), len(selections), parts.view.points)
        expected = np.stack([selection.at(parts.view.points) for selection in selections], axis=1)
        np.testing.assert_array_equal(found, expected)
        assert 0 < (found > 0).mean() < 1


def test_what_looks_at_colours_is_not_of_masks_and_painted_casters_are_looked_at_where_rays_end():
    field = previews()[0].field
    assert not is_of_masks(field(BLEED, GREY)) and not is_of_masks(field(TURN))
    assert looks_at_hits(field(TURN)) and looks_at_hits(field(painted("scale", {"gain": 4.0})))
    assert not looks_at_hits(field(BLEED, EMIT))
