"""Stages that were packed into one file or gathered in one folder: edits, library and sidecars come along."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
from pxr import Usd, UsdUtils

from icheat_usd.errors import EditError
from icheat_usd.stage.authoring import set_edit
from icheat_usd.stage.opening import quiet_usd
from tests.composition.cases_of_arcs import borrowed, library
from tests.composition.cases_of_layers import BLOCK, ROOM, keyed, shot, warm
from tests.composition.reading import read_case
from tests.composition.stages import (
    SIDECAR,
    STACK,
    Case,
    amount,
    edit,
    keys,
    layer,
    over,
    select,
    stack,
    values,
    write_case,
    write_flat,
)
from tests.composition.test_images import assert_equal, films

SHOW = Case(
    "a shot over a sequence with a library and two sidecars",
    {
        "library/edits.usda": library(
            edit("rosy", keys({1: "half", 9: "tint"}, f"@./{SIDECAR}@").replace("</World>", "</Library/Set>"))
        ),
        "sequence.usda": layer(
            stack(
                keyed(keys({1: "half", 11: "double"})),
                borrowed("rosy", "rel icheat:anchor = </World>", select("Casters", ROOM, BLOCK)),
                warm(),
                listed=["keyed", "rosy", "warm"],
            ),
            weaker=["scene.usda"],
        ),
        "shot.usda": shot(
            over("keyed", amount({1: 0.5, 9: 1})), over("rosy", select("Receivers", ROOM)), over("warm", values(gain=2))
        ),
    },
    flat=stack(
        keyed(keys({1: "half", 11: "double"}), amount({1: 0.5, 9: 1})),
        edit("rosy", keys({1: "half", 9: "tint"}), receivers=[ROOM], casters=[ROOM, BLOCK]),
        warm(gain=2),
        listed=["keyed", "rosy", "warm"],
    ),
)


@pytest.fixture(scope="module")
def show(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], dict[str, Any]]:
    """How to open the show, and what one layer by hand shows."""
    folder = tmp_path_factory.mktemp("show")
    opened = write_case(SHOW, folder / "show")
    shutil.copy(folder / "show" / SIDECAR, folder / "show" / "library" / SIDECAR)
    return opened, write_flat(SHOW, folder / "flat")


@pytest.fixture(scope="module")
def expected(show: tuple[dict[str, Any], dict[str, Any]]) -> Any:
    return films(show[1])


def packed(opened: dict[str, Any], package: Path) -> dict[str, Any]:
    with quiet_usd():
        assert UsdUtils.CreateNewUsdzPackage(opened["root"], str(package))
    return opened | {"root": str(package)}


def localised(opened: dict[str, Any], folder: Path) -> dict[str, Any]:
    with quiet_usd():
        assert UsdUtils.LocalizeAsset(opened["root"], str(folder))
    return opened | {"root": str(folder / "shot.usda")}


@pytest.mark.parametrize("how", ["packed", "localised"])
def test_a_show_that_moved_shows_what_it_showed(
    show: tuple[dict[str, Any], dict[str, Any]], expected: Any, tmp_path: Path, how: str
) -> None:
    composed, flat = show
    away = packed(composed, tmp_path / "show.usdz") if how == "packed" else localised(composed, tmp_path / "away")
    original = Path(composed["root"]).parent
    hidden = original.rename(original.with_name("hidden"))  # What it reads must be in the package alone.
    try:
        told = read_case(away)
        assert told["edits"] == read_case(flat)["edits"] and told["digest"] == read_case(flat)["digest"]
        assert told["checked"] == []
        root = Path(away["root"]).name
        assert (told["winners"]["keyed.amount"], told["winners"]["warm.color"]) == (root, "sequence.usda")
        assert_equal(films(away), expected)
    finally:
        hidden.rename(original)


def test_a_package_cannot_be_written_to(show: tuple[dict[str, Any], dict[str, Any]], tmp_path: Path) -> None:
    stage = Usd.Stage.Open(packed(show[0], tmp_path / "show.usdz")["root"])
    with pytest.raises(EditError, match="show.usdz.* lies in a package, which is read-only"):
        set_edit(stage, f"{STACK}/warm", layer=stage.GetRootLayer().identifier, amount=0.5)
    assert not set_edit(stage, f"{STACK}/warm", layer="session", amount=0.5)


def test_a_shot_over_a_package_overrides_its_edits(show: tuple[dict[str, Any], dict[str, Any]], tmp_path: Path) -> None:
    packed(show[0], tmp_path / "show.usdz")
    timing = "(offset = 10; scale = 2)"
    text = stack(over("warm", values(gain=5)), over=True)
    (tmp_path / "over.usda").write_text(layer(text, weaker=[f"@./show.usdz@ {timing}"]))
    opened = show[0] | {"root": str(tmp_path / "over.usda"), "time": 18.0}
    told, original = read_case(opened), read_case(show[0])
    assert told["winners"]["warm.gain"] == "over.usda"
    assert told["edits"][:2] == original["edits"][:2] and told["edits"][2][2]["gain"] == 5
