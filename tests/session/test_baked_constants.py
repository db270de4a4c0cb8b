"""What a new edit's payload holds for readers that do not know its operation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from icheat_usd.edits import operations
from icheat_usd.edits.binding import bind
from icheat_usd.edits.bound import Ends
from icheat_usd.edits.model import Value
from icheat_usd.session import Session

STAGE = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Y"
)
def Xform "World"
{
    def Sphere "Ball" {}
    def Cube "Room"
    {
        double size = 8
    }
    def Camera "Camera" {}
}
"""


@pytest.mark.parametrize(
    ("operation", "parameters"),
    [
        ("emit", {"color": (1.0, 0.5, 0.25), "intensity": 2.0}),
        ("paint", {"color": (1.0, -0.5, 0.25), "relative": False}),
        ("albedo", {"color": (0.1, 0.2, 0.3), "replace": False}),
        ("scale", {"gain": 0.25}),
    ],
)
def test_a_reader_without_the_operation_gets_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, operation: str, parameters: dict[str, Value]
) -> None:
    path = tmp_path / "shot.usda"
    path.write_text(STAGE)
    Session.open(str(path)).add_edit(
        "one", layer="shot.usda", operation=operation, parameters=parameters, receivers=["Ball"], casters=["Room"]
    )

    def evaluated() -> list[np.ndarray]:
        session = Session.open(str(path))
        ends = Ends(np.ones((1, 1), np.float32), None, ())
        field = bind(session.stack, session.snapshot)
        found = field.evaluate(np.full((1, 1, 3), 0.5, np.float32), ends, ends)
        zero = np.zeros((1, 1, 3), np.float32)
        return [zero if a is None else a for a in (found.scale, found.emission, found.offset_paint)]

    known = evaluated()
    kept = {name: found for name, found in operations._OPERATIONS.items() if name != operation}
    monkeypatch.setattr(operations, "_OPERATIONS", kept)
    assert operations.find(operation) is None
    for a, b in zip(known, evaluated(), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7)
