"""Authoring: into the named layer alone, appended, checked before anything is left behind."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pxr import Sdf, Usd, UsdGeom

from icheat_usd.edits.model import Blend
from icheat_usd.errors import EditError
from icheat_usd.stage import schema
from icheat_usd.stage.authoring import (
    Members,
    add_edit,
    create_stack,
    find_layer,
    move_edit,
    mute_edit,
    reload_layer,
    remember_layer,
    remove_edit,
    save_layer,
    set_edit,
    set_payload_key,
)
from icheat_usd.stage.check import check_stage
from icheat_usd.stage.description import describe_edit
from icheat_usd.stage.edit_stack import read_edit_stack
from icheat_usd.stage.keys import read_keys
from tests.stage.edit_stages import DIGEST, OTHER, SURFACES, THIRD, RecordingReader, layer, shot_stage, stock_findings

STACK = "/World/indirect"


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Usd.Stage]:
    """A shot over a sequence; whatever a test authors must please USD's own validators, and ours."""
    made = shot_stage(tmp_path, offset=100, scale=2)
    create_stack(made, "indirect", layer="seq.usda")
    yield made
    assert not stock_findings(made)
    assert not [finding for finding in check_stage(made) if finding.severity == "error"]


def targets(stage: Usd.Stage) -> list[str]:
    return [path.name for path in stage.GetPrimAtPath(STACK).GetRelationship(schema.EDITS).GetTargets()]


def add(stage: Usd.Stage, name: str, where: str = "seq.usda", **more: object) -> str:
    return add_edit(stage, STACK, name, layer=where, receivers=["floor"], casters=["Room"], **more)  # type: ignore[arg-type]


def text(stage: Usd.Stage, name: str) -> str:
    return str(layer(stage, name).ExportToString())


# --------------------------------------------------------------------------- stacks


def test_a_stack_is_a_scope_below_the_default_prim_in_the_named_layer(stage: Usd.Stage) -> None:
    prim = stage.GetPrimAtPath(STACK)
    assert (prim.GetTypeName(), prim.HasAPI(schema.STACK_API)) == ("Scope", True)
    assert [spec.layer for spec in prim.GetPrimStack()] == [layer(stage, "seq.usda")]


def test_a_stack_can_be_a_render_settings_prim_and_name_a_camera(stage: Usd.Stage) -> None:
    stage.DefinePrim("/World/settings", "RenderSettings")
    assert create_stack(stage, "settings", layer="shot.usda", camera="camera") == "/World/settings"
    assert stage.GetPrimAtPath("/World/settings").GetTypeName() == "RenderSettings"
    relationship = stage.GetPrimAtPath("/World/settings").GetRelationship(schema.CAMERA)
    assert relationship.GetTargets() == [Sdf.Path("/World/camera")]


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("/Elsewhere/stack", "below the default prim"),
        ("/World", "below the default prim"),
        ("indirect", "is a stack already"),
        ("floor", "Mesh"),
        ("not a path", "not a prim path"),
    ],
)
def test_a_stack_is_refused_where_it_cannot_work(stage: Usd.Stage, path: str, message: str) -> None:
    before = text(stage, "shot.usda")
    with pytest.raises(EditError, match=message):
        create_stack(stage, path, layer="shot.usda")
    assert text(stage, "shot.usda") == before


def test_a_stack_needs_a_default_prim(tmp_path: Path) -> None:
    bare = Usd.Stage.CreateNew(str(tmp_path / "bare.usda"))
    with pytest.raises(EditError, match="default prim"):
        create_stack(bare, "/indirect", layer="bare.usda")


def test_nothing_is_authored_inside_instances(stage: Usd.Stage) -> None:
    UsdGeom.Mesh.Define(stage, "/World/Source/mesh")
    instance = stage.DefinePrim("/World/instance")
    instance.GetReferences().AddInternalReference("/World/Source")
    instance.SetInstanceable(True)
    with pytest.raises(EditError, match="instance"):
        create_stack(stage, "/World/instance/stack", layer="shot.usda")


# --------------------------------------------------------------------------- adding


def test_an_added_edit_reads_back_as_it_was_given(stage: Usd.Stage) -> None:
    path = add_edit(
        stage,
        STACK,
        "warm",
        layer="shot.usda",
        operation="scale",
        parameters={"gain": 2, "color": (1.0, 0.5, 0.25)},
        receivers=["floor", "/World/Room"],
        casters=Members(("Room",), ("Room/ceiling",)),
        amount=0.5,
        blend="over",
        occluders=["floor"],
    )
    stack, findings = read_edit_stack(stage, STACK, None, SURFACES)
    assert path == "/World/indirect/warm" and findings == ()
    (edit,) = stack.edits
    assert (edit.operation, edit.amount, edit.blend, edit.enabled) == ("scale", 0.5, Blend.OVER, True)
    assert dict(edit.parameters) == {"gain": 2.0, "color": (1.0, 0.5, 0.25)}
    assert edit.receivers.paths == frozenset(SURFACES)
    assert edit.casters.paths == {"/World/Room/wall"}
    assert edit.occluders == ("/World/floor",) and edit.keys == ()


def test_edits_of_a_stronger_layer_come_after_those_of_a_weaker_one(stage: Usd.Stage) -> None:
    add(stage, "shot_fix", "shot.usda")
    add(stage, "warm")
    add(stage, "cool")
    assert targets(stage) == ["warm", "cool", "shot_fix"]
    add(stage, "late", "session")
    assert targets(stage) == ["warm", "cool", "shot_fix", "late"]


def test_an_edit_can_be_added_before_or_after_another(stage: Usd.Stage) -> None:
    for name in ("a", "b", "c"):
        add(stage, name)
    add(stage, "d", "shot.usda", before="b")
    add(stage, "e", "shot.usda", after="a")
    assert targets(stage) == ["a", "e", "d", "b", "c"]


def test_a_layer_is_found_by_identifier_path_and_file_name(stage: Usd.Stage) -> None:
    sequence = layer(stage, "seq.usda")
    for name in (sequence, sequence.identifier, sequence.realPath, "seq.usda"):
        assert find_layer(stage, name) == sequence
    assert find_layer(stage, "session") == stage.GetSessionLayer()


def test_layers_outside_the_stage_and_locked_ones_are_refused(stage: Usd.Stage, tmp_path: Path) -> None:
    stranger = Sdf.Layer.CreateNew(str(tmp_path / "stranger.usda"))
    for name in ("stranger.usda", stranger, "nothing.usda"):
        with pytest.raises(EditError, match="seq.usda"):
            add(stage, "warm", name)
    sequence = layer(stage, "seq.usda")
    sequence.SetPermissionToEdit(False)
    try:
        with pytest.raises(EditError, match="may not be edited"):
            add(stage, "warm")
    finally:
        sequence.SetPermissionToEdit(True)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"operation": "sale"}, "no operation is called 'sale'.*hsv, .*scale"),
        ({"parameters": {"gian": 2.0}}, "no parameter 'gian'.*color, gain"),
        ({"parameters": {"gain": (1.0, 1.0, 1.0)}}, "expected float"),
        ({"parameters": {"gain": "2"}}, "expected float"),
        ({"parameters": {"gain": True}}, "expected float"),
        ({"parameters": {"gain": float("nan")}}, "expected float"),
        ({"parameters": {"gain": -1.0}}, "expected at least 0"),
        ({"parameters": {"color": 1.0}}, "expected color3f"),
        ({"parameters": {"color": (1.0, 1.0)}}, "expected color3f"),
        ({"amount": float("inf")}, "expected a finite number"),
        ({"blend": "multiply"}, "compose, over, add"),
        ({"receivers": ["flor"]}, "did you mean /World/floor"),
        ({"receivers": ["/World/wall"]}, "did you mean /World/Room/wall"),
        ({"casters": "Room"}, "a list of paths"),
        ({"anchor": "nowhere"}, "no prim /World/nowhere"),
        ({"before": "nothing"}, "has no edit 'nothing'"),
        ({"name": "2 words"}, "cannot name an edit"),
        ({"stack": "/World/Room"}, "is no stack"),
    ],
)
def test_a_refused_edit_leaves_the_layer_as_it_was(
    stage: Usd.Stage, arguments: dict[str, object], message: str
) -> None:
    add(stage, "other", "shot.usda")
    before = text(stage, "shot.usda")
    given = {"stack": STACK, "name": "warm", "receivers": ["floor"], "casters": ["Room"], **arguments}
    with pytest.raises(EditError, match=message):
        add_edit(stage, given.pop("stack"), given.pop("name"), layer="shot.usda", **given)  # type: ignore[arg-type]
    assert text(stage, "shot.usda") == before


def test_an_unknown_operation_is_allowed_with_a_baked_payload(stage: Usd.Stage, tmp_path: Path) -> None:
    add(stage, "baked", operation="studioThing", payload=(tmp_path / "edits.v001.icheat.h5", DIGEST))
    assert describe_edit(stage, "/World/indirect/baked").operation.value == "studioThing"


def test_a_payload_is_written_relative_to_the_layer(stage: Usd.Stage, tmp_path: Path) -> None:
    add(stage, "warm", payload=(tmp_path / "edits.v001.icheat.h5", DIGEST))
    assert "@./edits.v001.icheat.h5@" in text(stage, "seq.usda")
    assert str(tmp_path) not in text(stage, "seq.usda").replace(str(tmp_path / "seq.usda"), "")
    add(stage, "mine", "session", payload=(tmp_path / "edits.v001.icheat.h5", DIGEST))
    assert f"@{tmp_path}/edits.v001.icheat.h5@" in stage.GetSessionLayer().ExportToString()


def test_times_are_mapped_into_the_layer(stage: Usd.Stage, tmp_path: Path) -> None:
    add(stage, "warm", parameters={"gain": 3.0}, payload=(tmp_path / "edits.v001.icheat.h5", DIGEST), time=102)
    samples = layer(stage, "seq.usda").ListTimeSamplesForPath("/World/indirect/warm.icheat:payload")
    assert list(samples) == [1.0]
    assert layer(stage, "seq.usda").ListTimeSamplesForPath("/World/indirect/warm.icheat:scale:gain") == [1.0]


# --------------------------------------------------------------------------- changing


def test_a_shot_overrides_one_value_and_leaves_the_sequence_alone(stage: Usd.Stage) -> None:
    path = add(stage, "warm", parameters={"gain": 2.0})
    before = text(stage, "seq.usda")
    assert set_edit(stage, path, layer="shot.usda", amount=0.25, parameters={"gain": 4.0}) == ()
    assert text(stage, "seq.usda") == before
    described = describe_edit(stage, path)
    assert (described.amount.value, described.amount.layer) == (0.25, stage.GetRootLayer().identifier)
    assert described.parameters["gain"].layer == stage.GetRootLayer().identifier
    assert described.parameters["color"].layer == ""
    assert described.operation.layer == layer(stage, "seq.usda").identifier


def test_a_value_that_a_stronger_layer_decides_is_reported(stage: Usd.Stage) -> None:
    path = add(stage, "warm")
    set_edit(stage, path, layer="shot.usda", amount=0.25)
    (finding,) = set_edit(stage, path, layer="seq.usda", amount=0.5)
    assert finding.feature == schema.AMOUNT and "shot.usda is stronger" in finding.message


def test_muting_and_unmuting_writes_only_the_flag(stage: Usd.Stage) -> None:
    path = add(stage, "warm")
    mute_edit(stage, path, layer="session")
    assert not read_edit_stack(stage, STACK, None, SURFACES)[0].active
    session = stage.GetSessionLayer().GetPrimAtPath(path)
    assert [p.name for p in session.properties] == [schema.ENABLED]
    mute_edit(stage, path, layer="session", muted=False)
    assert read_edit_stack(stage, STACK, None, SURFACES)[0].active


def test_changing_the_operation_applies_its_schema(stage: Usd.Stage) -> None:
    path = add(stage, "warm")
    set_edit(stage, path, layer="shot.usda", operation="hsv", parameters={"hue": 30.0})
    (edit,) = read_edit_stack(stage, STACK, None, SURFACES)[0].edits
    assert edit.operation == "hsv" and dict(edit.parameters) == {"hue": 30.0, "saturation": 1.0, "value": 1.0}
    assert stage.GetPrimAtPath(path).HasAPI("IcheatHsvAPI")


def test_a_new_selection_is_a_difference_that_later_sequence_changes_still_join(stage: Usd.Stage) -> None:
    path = add(stage, "warm")
    set_edit(stage, path, layer="shot.usda", receivers=["Room/wall"])
    assert describe_edit(stage, path).receivers == ("/World/Room/wall",)
    (finding,) = set_edit(stage, path, layer="seq.usda", receivers=["floor", "Room/ceiling"])
    assert finding.feature == schema.RECEIVERS and "stronger" in finding.message
    assert set(describe_edit(stage, path).receivers) == {"/World/Room/wall", "/World/Room/ceiling"}


def test_moving_keeps_edits_that_a_weaker_layer_adds_later(stage: Usd.Stage) -> None:
    for name in ("a", "b", "c", "d"):
        add(stage, name)
    sequence = text(stage, "seq.usda")
    move_edit(stage, STACK, "d", layer="shot.usda", before="b")
    assert targets(stage) == ["a", "d", "b", "c"]
    move_edit(stage, STACK, "a", layer="shot.usda")
    assert targets(stage) == ["d", "b", "c", "a"]
    assert text(stage, "seq.usda") == sequence
    add(stage, "e")
    assert sorted(targets(stage)) == ["a", "b", "c", "d", "e"]
    assert [name for name in targets(stage) if name != "e"] == ["d", "b", "c", "a"]


@settings(max_examples=40, deadline=None)
@given(
    n_sequence=st.integers(0, 4),
    n_shot=st.integers(0, 4),
    moves=st.lists(st.tuples(st.integers(0, 7), st.integers(0, 7), st.booleans()), max_size=5),
)
def test_any_moves_in_a_shot_give_the_order_asked_for(
    n_sequence: int, n_shot: int, moves: list[tuple[int, int, bool]]
) -> None:
    stage = Usd.Stage.CreateInMemory()
    sequence = Sdf.Layer.CreateAnonymous("sequence")
    stage.GetRootLayer().subLayerPaths.append(sequence.identifier)
    stage.SetDefaultPrim(stage.DefinePrim("/World"))
    create_stack(stage, "indirect", layer=sequence)
    for i in range(n_sequence):
        add_edit(stage, STACK, f"e{i}", layer=sequence)
    for i in range(n_sequence, n_sequence + n_shot):
        add_edit(stage, STACK, f"e{i}", layer=stage.GetRootLayer())
    wanted = [f"e{i}" for i in range(n_sequence + n_shot)]
    for moved, other, is_before in moves:
        if max(moved, other) >= len(wanted) or moved == other:
            continue
        name, place = f"e{moved}", f"e{other}"
        move_edit(stage, STACK, name, layer=stage.GetRootLayer(), **{"before" if is_before else "after": place})
        wanted.remove(name)
        wanted.insert(wanted.index(place) + (not is_before), name)
        assert targets(stage) == wanted


def test_moving_against_a_stronger_layer_is_refused(stage: Usd.Stage) -> None:
    for name in ("a", "b"):
        add(stage, name)
    move_edit(stage, STACK, "b", layer="shot.usda", before="a")
    before = text(stage, "seq.usda")
    with pytest.raises(EditError, match="stronger"):
        move_edit(stage, STACK, "a", layer="seq.usda", before="b")
    assert text(stage, "seq.usda") == before and targets(stage) == ["b", "a"]


def test_removing_an_own_edit_leaves_no_trace(stage: Usd.Stage) -> None:
    add(stage, "warm")
    add(stage, "keep", "shot.usda")
    before = text(stage, "shot.usda")
    add(stage, "gone", "shot.usda")
    remove_edit(stage, STACK, "gone", layer="shot.usda")
    assert text(stage, "shot.usda") == before and targets(stage) == ["warm", "keep"]


def test_removing_a_weaker_layers_edit_deletes_it_for_this_layer_alone(stage: Usd.Stage) -> None:
    path = add(stage, "warm")
    set_edit(stage, path, layer="shot.usda", amount=0.5)
    remove_edit(stage, STACK, path, layer="shot.usda")
    assert targets(stage) == [] and not layer(stage, "shot.usda").GetPrimAtPath(path)
    assert layer(stage, "seq.usda").GetPrimAtPath(path)
    sequence = Usd.Stage.Open(layer(stage, "seq.usda"))
    assert [edit.name for edit in read_edit_stack(sequence, STACK, None, SURFACES)[0].active] == ["warm"]


def test_removing_what_a_stronger_layer_lists_is_refused(stage: Usd.Stage) -> None:
    add(stage, "warm", "shot.usda")
    with pytest.raises(EditError, match="shot.usda"):
        remove_edit(stage, STACK, "warm", layer="seq.usda")
    assert targets(stage) == ["warm"]


# --------------------------------------------------------------------------- keys


def test_overriding_one_key_copies_all_composed_keys_and_says_where_from(stage: Usd.Stage, tmp_path: Path) -> None:
    sidecar = tmp_path / "edits.v001.icheat.h5"
    path = add(stage, "warm", payload=(sidecar, DIGEST), time=102)
    set_payload_key(stage, path, layer="seq.usda", time=122, payload=(sidecar, OTHER))
    (tmp_path / "shot.v001.icheat.h5").write_bytes(b"x")
    set_payload_key(stage, path, layer="shot.usda", time=122, payload=(tmp_path / "shot.v001.icheat.h5", THIRD))
    prim = stage.GetPrimAtPath(path)
    track = read_keys(prim)
    assert track is not None and track.layer == stage.GetRootLayer().identifier
    assert [(key.time, key.digest, key.file) for key in track.keys] == [
        (102.0, DIGEST, "./edits.v001.icheat.h5"),
        (122.0, THIRD, "./shot.v001.icheat.h5"),
    ]
    assert not [f for f in check_stage(stage) if f.rule == "CopiedKeysOutdated"]
    set_payload_key(stage, path, layer="seq.usda", time=112, payload=(sidecar, THIRD))
    (outdated,) = [f for f in check_stage(stage) if f.rule == "CopiedKeysOutdated"]
    assert "seq.usda" in outdated.message


def test_a_key_is_replaced_not_doubled_at_a_time_that_rounds(stage: Usd.Stage, tmp_path: Path) -> None:
    sidecar = tmp_path / "edits.v001.icheat.h5"
    stage.GetRootLayer().subLayerOffsets[0] = Sdf.LayerOffset(100.1, 1 / 3)
    path = add(stage, "warm", payload=(sidecar, DIGEST), time=100.3)
    for _ in range(3):
        track = read_keys(stage.GetPrimAtPath(path))
        assert track is not None and len(track.keys) == 1
        set_payload_key(stage, path, layer="seq.usda", time=track.keys[0].time, payload=(sidecar, OTHER))


def test_a_key_without_a_payload_is_the_identity(stage: Usd.Stage, tmp_path: Path) -> None:
    sidecar = tmp_path / "edits.v001.icheat.h5"
    path = add(stage, "warm", payload=(sidecar, DIGEST), time=102)
    set_payload_key(stage, path, layer="seq.usda", time=110, payload=None, interpolation="held")
    edit = read_edit_stack(stage, STACK, 115, SURFACES, RecordingReader())[0].edits[0]
    assert [(key.payload, key.weight) for key in edit.keys] == [(None, 1.0)]


def test_a_payload_for_all_times_replaces_the_keys(stage: Usd.Stage, tmp_path: Path) -> None:
    sidecar = tmp_path / "edits.v001.icheat.h5"
    path = add(stage, "warm", payload=(sidecar, DIGEST), time=102)
    set_payload_key(stage, path, layer="seq.usda", time=None, payload=(sidecar, OTHER))
    track = read_keys(stage.GetPrimAtPath(path))
    assert track is not None and [(key.time, key.digest) for key in track.keys] == [(None, OTHER)]


def test_a_shot_edits_what_it_references(stage: Usd.Stage, tmp_path: Path) -> None:
    sidecar = tmp_path / "edits.v001.icheat.h5"
    add(stage, "warm", payload=(sidecar, DIGEST), time=102)
    add(stage, "cool")
    for name in ("seq.usda", "shot.usda"):
        save_layer(layer(stage, name))
    (tmp_path / "show").mkdir()
    outer = Usd.Stage.CreateNew(str(tmp_path / "show" / "outer.usda"))
    UsdGeom.SetStageUpAxis(outer, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(outer, 1.0)
    outer.SetDefaultPrim(UsdGeom.Xform.Define(outer, "/Show").GetPrim())
    reference = Sdf.Reference("../shot.usda", layerOffset=Sdf.LayerOffset(1000, 1))
    UsdGeom.Xform.Define(outer, "/Show/set").GetPrim().GetReferences().AddReference(reference)
    stack, edit = "/Show/set/indirect", "/Show/set/indirect/warm"
    move_edit(outer, stack, "cool", layer="outer.usda", before="warm")
    set_payload_key(outer, edit, layer="outer.usda", time=1122, payload=(sidecar, OTHER))
    track = read_keys(outer.GetPrimAtPath(edit))
    assert track is not None
    assert [(key.time, key.digest, key.file) for key in track.keys] == [
        (1102.0, DIGEST, "../edits.v001.icheat.h5"),
        (1122.0, OTHER, "../edits.v001.icheat.h5"),
    ]
    assert [finding.rule for finding in check_stage(outer)] == []
    composed = outer.GetPrimAtPath(stack).GetRelationship(schema.EDITS)
    assert [path.name for path in composed.GetTargets()] == ["cool", "warm"]
    remove_edit(outer, stack, "cool", layer="outer.usda")
    assert [path.name for path in composed.GetTargets()] == ["warm"]
    assert not stock_findings(outer)


# --------------------------------------------------------------------------- saving


def test_saving_refuses_to_lose_what_someone_else_wrote(stage: Usd.Stage, tmp_path: Path) -> None:
    add(stage, "warm")
    save_layer(layer(stage, "seq.usda"))
    add(stage, "cool")
    file = tmp_path / "seq.usda"
    other = file.read_text().replace('"warm"', '"warmer"')
    file.write_text(other)
    with pytest.raises(EditError, match="changed on disk"):
        save_layer(layer(stage, "seq.usda"))
    assert file.read_text() == other
    reload_layer(layer(stage, "seq.usda"))
    add(stage, "again")
    save_layer(layer(stage, "seq.usda"))
    file_text = file.read_text()
    assert '"warmer"' in file_text and '"again"' in file_text
    file.write_text(file_text.replace('"warmer"', '"warm"'))
    reload_layer(layer(stage, "seq.usda"))


def test_a_file_that_changed_between_opening_and_the_first_edit_is_noticed(stage: Usd.Stage, tmp_path: Path) -> None:
    shot = layer(stage, "shot.usda")
    file = tmp_path / "shot.usda"
    before = file.read_text()
    file.write_text(before.replace("#usda 1.0", "#usda 1.0\n# touched"))
    remember_layer(shot)  # says the same, so that nothing would be lost
    file.write_text(before.replace('defaultPrim = "World"', 'defaultPrim = "World"\n    doc = "someone"'))
    os.utime(file, ns=(1, 1))
    with pytest.raises(EditError, match="changed on disk"):
        add(stage, "warm", "shot.usda")


def test_a_layer_without_a_file_cannot_be_saved(stage: Usd.Stage) -> None:
    with pytest.raises(EditError, match="no file"):
        save_layer(stage.GetSessionLayer())


def test_what_was_saved_opens_again_the_same(stage: Usd.Stage, tmp_path: Path) -> None:
    add(stage, "warm", parameters={"gain": 2.0})
    add(stage, "mine", "shot.usda", operation="hsv", parameters={"hue": 90.0}, before="warm")
    digest = read_edit_stack(stage, STACK, 102, SURFACES)[0].digest
    for name in ("seq.usda", "shot.usda"):
        save_layer(layer(stage, name))
    copy = tmp_path / "elsewhere"
    copy.mkdir()
    for name in ("seq.usda", "shot.usda"):
        (copy / name).write_text((tmp_path / name).read_text())
    opened = Usd.Stage.Open(str(copy / "shot.usda"))
    assert read_edit_stack(opened, STACK, 102, SURFACES)[0].digest == digest
