"""Where a layer cannot be saved, an edit verb leaves the open layer as it was."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pxr import Usd

from icheat_usd.errors import EditError
from icheat_usd.session import authoring
from icheat_usd.stage import layers
from tests.stage.edit_stages import layer, shot_stage

STACK = "/World/Edits"
VERBS: dict[str, Callable[[Usd.Stage], Any]] = {
    "create": lambda stage: authoring.create_stack(stage, "/World/Other", layer="shot.usda"),
    "add": lambda stage: authoring.add_edit(stage, STACK, "new", layer="shot.usda", receivers=["floor"]),
    "set": lambda stage: authoring.set_edit(stage, f"{STACK}/one", layer="shot.usda", amount=0.5),
    "mute": lambda stage: authoring.mute_edit(stage, f"{STACK}/one", layer="shot.usda"),
    "move": lambda stage: authoring.move_edit(stage, STACK, "one", layer="shot.usda", after="two"),
    "remove": lambda stage: authoring.remove_edit(stage, STACK, "two", layer="shot.usda"),
    "region": lambda stage: authoring.add_region(
        stage, "Limits/ball", layer="shot.usda", shape="sphere", centre=(0, 0, 0), size=(1,)
    ),
    "selection": lambda stage: authoring.add_selection(
        stage, "Limits/both", ["floor"], layer="shot.usda", rule="union"
    ),
}


@pytest.fixture
def stage(tmp_path: Path) -> Usd.Stage:
    stage = shot_stage(tmp_path)
    authoring.create_stack(stage, STACK, layer="seq.usda")
    authoring.add_edit(stage, STACK, "one", layer="seq.usda", receivers=["floor"], casters=["Room"])
    authoring.add_edit(stage, STACK, "two", layer="shot.usda", receivers=["floor"], casters=["Room"])
    return stage


@pytest.mark.parametrize("verb", VERBS)
def test_a_refused_save_leaves_layer_file_and_folder_as_they_were(
    stage: Usd.Stage, verb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(layer: Any) -> None:
        raise EditError(f"{layer.realPath} cannot be saved; check its permissions")

    before = layer(stage, "shot.usda").ExportToString()
    files = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with monkeypatch.context() as patch:
        patch.setattr(layers, "save_layer", refuse)
        with pytest.raises(EditError, match="cannot be saved"):
            VERBS[verb](stage)
    assert layer(stage, "shot.usda").ExportToString() == before
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == files
    VERBS[verb](stage)
    assert layer(stage, "shot.usda").ExportToString() != before
