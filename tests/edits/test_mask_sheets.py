"""Sheets of painted masks hold the weights that masks have one by one."""

from __future__ import annotations

import numpy as np

from icheat_usd.edits.mask_sheets import mask_sheets, sheets_of_many
from icheat_usd.edits.mask_table import mask_table, weights_of
from icheat_usd.edits.model import Edit, KeyedPayload, MaskedSurface, Payload, SurfaceMask
from icheat_usd.kernels.mask_sheets import weights_in_sheets
from icheat_usd.kernels.simd import address_of
from tests.final_gather.test_edits import BLEED, EVERYTHING, SCENE, previews

WALLS = ("/red", "/back")


def rough(seed: int, size: int) -> Edit:
    """From random texels on two walls to everything."""
    surfaces = [surface for surface in SCENE.surfaces if surface.path in WALLS]
    n_faces = sum(surface.n_faces for surface in surfaces)
    texels = np.random.default_rng(seed).uniform(0, 1, (n_faces, size, size)).astype(np.float32)
    mask = SurfaceMask(tuple(MaskedSurface(s.path, s.n_faces, s.instance_id) for s in surfaces), texels)
    payload = Payload("scale", {"gain": 2.0}, caster_mask=mask)
    return Edit(f"/rough{seed}", "scale", {}, EVERYTHING, EVERYTHING, keys=(KeyedPayload(payload, 1.0),))


def test_sheets_hold_scaled_weights_of_masks_of_any_resolution_and_their_sums():
    parts = previews()[0]
    edits = [rough(seed, size) for seed, size in enumerate((4, 2, 4, 1, 4, 4, 4))]
    field = parts.field(*edits[:3], BLEED, *edits[3:])
    selections = [casters for bound in field.edits for casters in bound.casters]
    table = mask_table(selections, SCENE.n_instances)
    on_walls = np.isin([SCENE.surfaces[s].path for s in SCENE.geometry.instance_surface], WALLS)
    rng = np.random.default_rng(3)
    scale = rng.uniform(0.5, 2, len(table.row)).astype(np.float32)
    lines = rng.uniform(-1, 1, (len(table.row), 4)).astype(np.float32)
    sheets, column = mask_sheets(table, on_walls, scale, lines)
    assert ((column >= 0) == ((table.mask >= 0) & np.repeat(on_walls, np.diff(table.begin)))).all()

    points = parts.view.points
    expected = np.stack([selection.at(points) for selection in selections], axis=1)
    here, looked_at = np.zeros(64, np.float32), 0
    for p in np.flatnonzero(on_walls[points.instance])[::17].tolist():
        i = int(points.instance[p])
        s, t = points.face_uv[p]
        n = weights_in_sheets(
            *sheets[:4], i, np.int64(points.face[p]), s, t, address_of(sheets.texels), address_of(here)
        )
        assert n == sheets.width[sheets.begin[i] : sheets.begin[i + 1]].sum()
        own = [e for e in range(table.begin[i], table.begin[i + 1]) if column[e] >= 0]
        weight = expected[p, table.row[own]]
        np.testing.assert_allclose(here[column[own]], scale[own] * weight, rtol=1e-5)
        ends = np.cumsum(sheets.width[sheets.begin[i] : sheets.begin[i + 1]])
        sums = sum(here[end : end + 4] for end in (0, *ends[:-1]))
        np.testing.assert_allclose(sums, weight @ lines[own], rtol=1e-4, atol=1e-5)
        looked_at += 1
    assert looked_at > 20


def test_weights_of_many_masks_have_the_bits_of_masks_one_by_one():
    parts = previews()[0]
    field = parts.field(*(rough(seed, size) for seed, size in enumerate((4, 2, 4, 3, 8))), BLEED)
    selections = [casters for bound in field.edits for casters in bound.casters]
    table = mask_table(selections, SCENE.n_instances)
    sheets = sheets_of_many(table)
    assert 0 < (sheets.column >= 0).sum() < len(table.row)
    expected = np.stack([selection.at(parts.view.points) for selection in selections], axis=1)
    np.testing.assert_array_equal(weights_of(table, sheets, len(selections), parts.view.points), expected)
