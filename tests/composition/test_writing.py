"""Writing into one layer or one variant: what composes is what was asked for, and no other layer changes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pxr import Usd

from icheat_usd.errors import EditError
from icheat_usd.stage import schema
from icheat_usd.stage.authoring import add_edit, find_layer, move_edit, mute_edit, remove_edit, set_edit
from icheat_usd.stage.check import check_stage
from icheat_usd.stage.description import describe_edit
from icheat_usd.stage.edit_stack import read_edit_stack
from icheat_usd.stage.key_authoring import set_payload_key
from icheat_usd.stage.keys import read_keys
from tests.composition.cases_of_arcs import LOOK, ROSY, library
from tests.composition.cases_of_layers import SEQUENCE, keyed, shot
from tests.composition.cases_of_variants import GRADED, selecting, variants
from tests.composition.stages import (
    DIGESTS,
    SCENE,
    SIDECAR,
    STACK,
    SURFACES,
    amount,
    edit,
    keys,
    layer,
    over,
    stack,
    values,
)

ORDER = ("warm", "dim", "hue")


def write(folder: Path, sequence: str, shot_layer: str, offset: str = "") -> Usd.Stage:
    (folder / "scene.usda").write_text(layer(SCENE))
    (folder / "sequence.usda").write_text(sequence)
    (folder / "shot.usda").write_text(shot_layer.replace("@./sequence.usda@", f"@./sequence.usda@ {offset}"))
    return Usd.Stage.Open(str(folder / "shot.usda"))


def names(stage: Usd.Stage) -> list[str]:
    return [path.name for path in stage.GetPrimAtPath(STACK).GetRelationship(schema.EDITS).GetTargets()]


def texts(stage: Usd.Stage) -> dict[str, str]:
    layers = stage.GetLayerStack(includeSessionLayers=True)
    return {layer.identifier: layer.ExportToString() for layer in layers}


def changed(stage: Usd.Stage, before: dict[str, str]) -> list[str]:
    return [Path(name).name for name, text in texts(stage).items() if before[name] != text]


# --------------------------------------------------------------------------- any sequence of changes

LAYERS = ("sequence.usda", "shot.usda", "session")
STEPS = st.lists(
    st.tuples(
        st.sampled_from(["add", "move", "mute", "remove", "set"]),
        st.sampled_from(LAYERS),
        st.integers(0, 7),
        st.integers(0, 7),
        st.sampled_from(["before", "after", "end"]),
    ),
    max_size=8,
)


@settings(max_examples=60, deadline=None)
@given(STEPS)
def test_any_changes_in_any_layers_give_just_what_was_asked_for(
    tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[str, str, int, int, str]]
) -> None:
    """A model keeps the order and, per layer, the opinions; a step that is refused must change nothing at all."""
    stage = write(tmp_path_factory.mktemp("any"), SEQUENCE, shot(), "(offset = 10; scale = 2)")
    order = [f"{STACK}/{name}" for name in ORDER]
    opinions: dict[tuple[str, str], dict[str, float | bool]] = {}
    for number, (step, where, first, second, place) in enumerate(steps):
        before = texts(stage)
        target = find_layer(stage, where)
        chosen = order[first % len(order)] if order else f"{STACK}/none"
        other = order[second % len(order)] if order else f"{STACK}/none"
        beside = {place: other} if place != "end" else {}
        wanted = [path for path in order if path != chosen]
        try:
            if step == "add":
                path = add_edit(stage, STACK, f"new{number}", layer=where, receivers=["Room"], casters=["Block"])
                wanted = [*order, path]
            elif step == "move":
                move_edit(stage, STACK, chosen, layer=where, **beside)
                index = wanted.index(other) + (place == "after") if place != "end" and other != chosen else len(wanted)
                wanted = (
                    list(order) if place != "end" and other == chosen else [*wanted[:index], chosen, *wanted[index:]]
                )
            elif step == "mute":
                mute_edit(stage, chosen, layer=where, muted=bool(second % 2))
                opinions.setdefault((chosen, where), {})["enabled"] = not second % 2
                wanted = list(order)
            elif step == "set":
                set_edit(stage, chosen, layer=where, amount=second / 8)
                opinions.setdefault((chosen, where), {})["amount"] = second / 8
                wanted = list(order)
            else:
                remove_edit(stage, STACK, chosen, layer=where)
                opinions.pop((chosen, where), None)
        except EditError as error:
            assert order == [] or any(word in str(error) for word in ("stronger", "exists already"))
            assert texts(stage) == before
            continue
        assert set(changed(stage, before)) <= {Path(target.identifier).name}
        spec = target.GetRelationshipAtPath(f"{STACK}.{schema.EDITS}")
        assert not spec or not (spec.targetPathList.isExplicit or spec.targetPathList.prependedItems)
        composed = [str(path) for path in stage.GetPrimAtPath(STACK).GetRelationship(schema.EDITS).GetTargets()]
        if step == "add":
            # A stronger layer may have put its edits behind all that weaker ones append.
            assert sorted(composed) == sorted(wanted) and [p for p in composed if p != wanted[-1]] == order
        else:
            assert composed == wanted
        order = composed
        for path in order:
            for name, fallback in (("amount", 1.0), ("enabled", True)):
                said = [opinions.get((path, each), {}).get(name) for each in reversed(LAYERS)]
                value = getattr(describe_edit(stage, path), name).value
                assert value == next((one for one in said if one is not None), fallback)


# --------------------------------------------------------------------------- variants


@pytest.fixture
def graded(tmp_path: Path) -> Iterator[Usd.Stage]:
    """A stack with grades dusk (selected) and day, under a shot and a layer offset; the session stays as it was."""
    stage = write(tmp_path, GRADED, shot(), "(offset = 10; scale = 2)")
    stage.GetSessionLayer().ImportFromString(layer("", metadata='doc = "of the user"'))
    before = stage.GetSessionLayer().ExportToString()
    yield stage
    assert stage.GetSessionLayer().ExportToString() == before


def select(stage: Usd.Stage, name: str) -> None:
    stage.GetPrimAtPath(STACK).GetVariantSet("grade").SetVariantSelection(name)


@pytest.mark.parametrize("where", ["sequence.usda", "shot.usda"])
def test_an_edit_is_added_to_one_grade_alone(graded: Usd.Stage, where: str) -> None:
    before = texts(graded)
    outside = names(graded)
    path = add_edit(
        graded,
        STACK,
        "rim",
        layer=where,
        receivers=["Room"],
        casters=["Block"],
        amount=0.5,
        time=30,
        before="warm",
        variant=("grade", "day"),
    )
    assert changed(graded, before) == [where] and names(graded) == outside == ["dim", "warm"]
    assert not graded.GetPrimAtPath(path)
    select(graded, "day")
    assert names(graded) == (["hue", "rim", "warm"])
    told = describe_edit(graded, path, 30)
    assert (told.amount.value, Path(told.amount.layer).name) == (0.5, where)
    spec = find_layer(graded, where).GetAttributeAtPath(f"{STACK}{{grade=day}}rim.icheat:amount")
    assert find_layer(graded, where).ListTimeSamplesForPath(spec.path) == [10.0 if where == "sequence.usda" else 30.0]
    assert graded.GetPrimAtPath(STACK).GetVariantSets().GetNames() == ["grade"]


def test_a_grade_is_set_moved_muted_and_removed_in(graded: Usd.Stage) -> None:
    day = ("grade", "day")
    assert not set_edit(graded, f"{STACK}/hue", layer="shot.usda", parameters={"hue": 45.0}, variant=day)
    assert not set_edit(graded, f"{STACK}/warm", layer="shot.usda", amount=0.25, variant=day)
    assert not mute_edit(graded, f"{STACK}/warm", layer="shot.usda", variant=day)
    with pytest.raises(EditError, match="beside the variant decides the order"):
        move_edit(graded, STACK, "warm", layer="shot.usda", before="hue", variant=day)
    add_edit(graded, STACK, "rim", layer="shot.usda", receivers=["Room"], casters=["Block"], variant=day)
    move_edit(graded, STACK, "rim", layer="shot.usda", before="hue", variant=day)
    assert names(graded) == ["dim", "warm"]
    assert describe_edit(graded, f"{STACK}/warm").enabled.value is True
    select(graded, "day")
    assert names(graded) == ["rim", "hue", "warm"]
    assert describe_edit(graded, f"{STACK}/hue").parameters["hue"].value == 45
    told = describe_edit(graded, f"{STACK}/warm")
    assert (told.amount.value, told.enabled.value, Path(told.amount.layer).name) == (0.25, False, "shot.usda")
    remove_edit(graded, STACK, "hue", layer="shot.usda", variant=day)
    assert names(graded) == ["rim", "warm"]
    select(graded, "dusk")
    assert names(graded) == ["dim", "warm"]


def test_what_is_listed_beside_a_variant_is_not_removed_in_it(graded: Usd.Stage) -> None:
    before = texts(graded)
    for where, message in (
        ("shot.usda", "sequence.usda, which"),
        ("sequence.usda", f"sequence.usda at {STACK}.icheat"),
    ):
        with pytest.raises(EditError, match=f"warm is listed by .*{message}.* is stronger; remove it there"):
            remove_edit(graded, STACK, "warm", layer=where, variant=("grade", "dusk"))
    assert texts(graded) == before


def test_a_move_in_a_layer_with_a_reorder_statement_takes_effect(tmp_path: Path) -> None:
    stage = write(tmp_path, SEQUENCE, shot(listed=["hue", "dim", "warm"], how="reorder"))
    assert names(stage) == ["hue", "dim", "warm"]
    move_edit(stage, STACK, "warm", layer="shot.usda", before="dim")
    assert names(stage) == ["hue", "warm", "dim"]
    move_edit(stage, STACK, "hue", layer="shot.usda")
    assert names(stage) == ["warm", "dim", "hue"]


def test_what_is_said_beside_a_variant_is_stronger_and_reported(graded: Usd.Stage) -> None:
    values = {"color": (9.0, 9.0, 9.0)}
    (finding,) = set_edit(graded, f"{STACK}/warm", layer="shot.usda", parameters=values, variant=("grade", "dusk"))
    assert finding.feature == "icheat:scale:color" and "sequence.usda is stronger" in finding.message
    (finding,) = set_edit(graded, f"{STACK}/warm", layer="sequence.usda", parameters=values, variant=("grade", "dusk"))
    assert f"sequence.usda at {STACK}/warm.icheat:scale:color is stronger" in finding.message


def test_a_variant_of_an_edit_is_found_before_that_of_its_stack(tmp_path: Path) -> None:
    edit = keyed(variants("look", soft="", hard=""), metadata=selecting("look", "soft", declare=True))
    stage = write(tmp_path, layer(stack(edit, listed=["keyed"]), weaker=["scene.usda"]), shot())
    set_edit(stage, f"{STACK}/keyed", layer="shot.usda", amount=0.5, variant=("look", "hard"))
    assert stage.GetRootLayer().GetAttributeAtPath(f"{STACK}/keyed{{look=hard}}.icheat:amount").default == 0.5


def test_a_shot_writes_into_a_grade_of_a_library_it_references(tmp_path: Path) -> None:
    (tmp_path / "library").mkdir()
    grades = variants("grade", dusk=over("rosy", amount(0.5)), day=over("rosy", values(gain=3)))
    schemas = 'prepend apiSchemas = ["IcheatStackAPI"]\n' + selecting("grade", "dusk", declare=True)
    body = "append rel icheat:edits = </Library/rosy>\n" + grades
    (tmp_path / "library" / "edits.usda").write_text(library(edit("rosy", ROSY), body=body, metadata=schemas))
    sequence = 'def "Edits" (\nprepend references = @./library/edits.usda@\n)\n{\n}'
    stage = write(tmp_path, layer(sequence, weaker=["scene.usda"]), shot(), "(offset = 10; scale = 2)")
    for where, value in (("sequence.usda", 0.25), ("shot.usda", 0.75)):
        before = texts(stage)
        assert not set_edit(stage, f"{STACK}/rosy", layer=where, amount=value, time=30, variant=("grade", "day"))
        assert changed(stage, before) == [where]
    assert describe_edit(stage, f"{STACK}/rosy").amount.value == 0.5
    select(stage, "day")
    told = describe_edit(stage, f"{STACK}/rosy", 30)
    assert (told.amount.value, Path(told.amount.layer).name) == (0.75, "shot.usda")
    assert told.parameters["gain"].value == 3


@pytest.mark.parametrize(
    ("variant", "message"),
    [
        (("season", "dusk"), f"no.* prim above it has a variant set 'season'; {STACK} has grade"),
        (("grade", "noon"), "variant set 'grade' has no variant 'noon'; it has day, dusk"),
    ],
)
def test_a_missing_variant_is_refused(graded: Usd.Stage, variant: tuple[str, str], message: str) -> None:
    before = texts(graded)
    with pytest.raises(EditError, match=message):
        add_edit(graded, STACK, "rim", layer="shot.usda", receivers=["Room"], casters=["Block"], variant=variant)
    with pytest.raises(EditError, match=message):
        set_edit(graded, f"{STACK}/warm", layer="shot.usda", amount=0.5, variant=variant)
    assert texts(graded) == before


@pytest.mark.parametrize("where", ["sequence.usda", "shot.usda", "session"])
def test_a_refused_edit_leaves_no_variant_behind(tmp_path: Path, where: str) -> None:
    stage = write(tmp_path, GRADED, shot())
    before = texts(stage)
    for name, receiver, message in (("rim", "Nowhere", "no prim"), ("hue", "Room", "exists already")):
        with pytest.raises(EditError, match=message):
            add_edit(stage, STACK, name, layer=where, receivers=[receiver], casters=["Block"], variant=("grade", "day"))
    assert texts(stage) == before


def test_the_session_holds_a_variant_of_its_own(tmp_path: Path) -> None:
    stage = write(tmp_path, GRADED, shot())
    before = texts(stage)
    set_edit(stage, f"{STACK}/warm", layer="session", amount=0.125, variant=("grade", "day"))
    assert changed(stage, before) == [Path(stage.GetSessionLayer().identifier).name]
    assert stage.GetPrimAtPath(STACK).GetVariantSet("grade").GetVariantSelection() == "dusk"
    select(stage, "day")
    assert describe_edit(stage, f"{STACK}/warm").amount.value == 0.125


# --------------------------------------------------------------------------- keys of a class


def test_overriding_one_key_of_a_class_in_the_same_layer_keeps_the_others(tmp_path: Path) -> None:
    look = LOOK.replace("float icheat:amount = 0.5", keys({1: "half", 11: "double"}))
    edit = keyed(metadata="prepend inherits = </World/_look>")
    stage = write(tmp_path, layer(look + stack(edit, listed=["keyed"]), weaker=["scene.usda"]), shot())
    (tmp_path / SIDECAR).write_bytes(b"")
    set_payload_key(
        stage, f"{STACK}/keyed", layer="sequence.usda", time=11, payload=(tmp_path / SIDECAR, DIGESTS["tint"])
    )
    track = read_keys(stage.GetPrimAtPath(f"{STACK}/keyed"))
    assert track is not None
    assert [(key.time, key.digest) for key in track.keys] == [(1, DIGESTS["half"]), (11, DIGESTS["tint"])]


# --------------------------------------------------------------------------- value clips

CLIPS = """clips = {
    dictionary default = {
        double2[] active = [(0, 0)]
        asset[] assetPaths = [@./clip.usda@]
        asset manifestAssetPath = @./manifest.usda@
        string primPath = "/clip"
        double2[] times = [(0, 0), (20, 20)]
    }
}"""


def clipped(folder: Path, attribute: str, value: str) -> Usd.Stage:
    (folder / "manifest.usda").write_text(f'#usda 1.0\nover "clip" {{\n{attribute}\n}}\n')
    (folder / "clip.usda").write_text(f'#usda 1.0\nover "clip" {{\n{attribute}.timeSamples = {{ 0: {value} }}\n}}\n')
    edit = keyed(metadata=CLIPS)
    return write(folder, layer(stack(edit, listed=["keyed"]), weaker=["scene.usda"]), shot())


def test_keys_from_value_clips_are_one_clear_error(tmp_path: Path) -> None:
    stage = clipped(tmp_path, "token icheat:payload", f'"{DIGESTS["half"]}"')
    with pytest.raises(EditError, match=r"keyed: icheat:payload comes from value clips; author its keys in a layer"):
        read_edit_stack(stage, STACK, 4, SURFACES)
    assert "value clips" in describe_edit(stage, f"{STACK}/keyed", 4).problem
    assert ("KeysFromClips", "icheat:payload") in [(found.rule, found.feature) for found in check_stage(stage)]


def test_an_amount_from_value_clips_is_read_and_told(tmp_path: Path) -> None:
    stage = clipped(tmp_path, "float icheat:amount", "0.375")
    assert read_edit_stack(stage, STACK, 4, SURFACES)[0].edits[0].amount == 0.375
    told = describe_edit(stage, f"{STACK}/keyed", 4).amount
    assert (told.value, Path(told.layer).name, told.source) == (0.375, "clip.usda", "valueClips")
