"""How much cells move the image: against images of single cells, one after the other."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.scene import F64
from icheat_usd.steps import all_steps
from icheat_usd.transport import Transport, influence
from icheat_usd.transport.influence import influence_on_view
from tests.pipeline import Pipeline
from tests.scenes import cornell


def of_single_cells(transport: Transport, cells: np.ndarray) -> F64:
    """Root mean square of the image of each cell alone."""
    found = []
    for cell in cells:
        alone = np.zeros((transport.lobes[0].rows.n_columns, 3), np.float32)
        alone[cell] = 1.0
        found.append(np.sqrt(np.square(transport.to_view(alone), dtype=np.float64).mean()))
    return np.array(found)


@pytest.mark.parametrize(("row_spacing", "off"), [(1, 1e-5), (2, 0.25)])
def test_influence_is_what_an_image_of_one_cell_has(
    row_spacing: int, off: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exactly where every sample has its row, and nearly where rows are mixed."""
    monkeypatch.setattr(influence, "_TOGETHER", 1000)  # so that there are several steps
    transport = Pipeline(cornell(), n_gather=512, row_spacing=row_spacing).transport
    assert (transport.interpolation is None) == (row_spacing == 1)
    nothing = np.zeros(transport.lobes[0].rows.n_columns, np.float32)
    found = all_steps(influence_on_view(transport, nothing)).astype(np.float64)
    assert found.sum() == pytest.approx(1.0, rel=1e-5)
    cells = np.arange(0, len(found), 7)
    expected = of_single_cells(transport, cells)
    assert np.count_nonzero(expected) > 50 and (found[cells][expected == 0.0] == 0.0).all()
    bright = expected > 0.1 * expected.max()
    ratio = found[cells][bright] / expected[bright]
    assert np.abs(ratio / np.median(ratio) - 1.0).max() < off


def test_cells_out_of_sight_count_by_what_comes_of_them_over_reflections() -> None:
    """As if every sample got the same of it: those in sight count at least as much as that."""
    transport = Pipeline(cornell(), n_gather=512).transport
    even = np.full(512, 1.0 / 512.0, np.float32)
    nothing, some = (all_steps(influence_on_view(transport, part)).astype(np.float64) for part in (0 * even, even))
    is_hidden = nothing == 0.0
    assert 20 < np.count_nonzero(is_hidden) < 400
    of_hidden, of_others = some[is_hidden], some[~is_hidden]
    assert of_hidden.max() == pytest.approx(of_hidden.min(), rel=1e-6) and 0.0 < of_hidden.max() < of_others.min()
    squares = np.square(some) - of_hidden.max() ** 2
    np.testing.assert_allclose(
        np.sqrt(squares / squares.sum())[~is_hidden], (nothing / np.linalg.norm(nothing))[~is_hidden], rtol=0.02
    )
