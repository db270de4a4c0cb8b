"""Values as scripts have them at hand: lists, and numbers and vectors of NumPy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from icheat_usd.errors import EditError
from icheat_usd.session import add_edit, set_edit, set_key
from icheat_usd.stage import open_stage

STAGE = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Y"
)
def Xform "World"
{
    def Sphere "Ball" {}
    def Cube "Room" {}
}
"""


@pytest.fixture
def stage(tmp_path: Path) -> Any:
    path = tmp_path / "shot.usda"
    path.write_text(STAGE)
    return open_stage(path)


def add(stage: Any, name: str, parameters: dict[str, Any]) -> str:
    return add_edit(stage, None, name, layer="shot.usda", parameters=parameters, receivers=["Ball"], casters=["Room"])


@pytest.mark.parametrize("color", [[1, 2, 3], (1.0, 2.0, 3.0), np.array([1, 2, 3]), np.array([1, 2, 3], np.float32)])
def test_vectors_of_any_kind_are_taken(stage: Any, color: Any) -> None:
    edit = stage.GetPrimAtPath(add(stage, "warm", {"color": color, "gain": np.float32(2)}))
    assert tuple(edit.GetAttribute("icheat:scale:color").Get()) == (1, 2, 3)
    assert edit.GetAttribute("icheat:scale:gain").Get() == 2
    set_edit(stage, str(edit.GetPath()), layer="shot.usda", parameters={"color": color[::-1]})
    assert tuple(edit.GetAttribute("icheat:scale:color").Get()) == (3, 2, 1)
    assert set_key(stage, str(edit.GetPath()), layer="shot.usda", frame=4, parameters={"color": color}) == ()


@pytest.mark.parametrize("color", [[1, 2], np.ones((2, 2)), [1, "2", 3], np.array([1, np.nan, 2])])
def test_what_is_no_colour_is_refused(stage: Any, color: Any, tmp_path: Path) -> None:
    with pytest.raises(EditError, match="parameter 'color' is"):
        add(stage, "warm", {"color": color})
    assert [path.name for path in tmp_path.iterdir()] == ["shot.usda"]
