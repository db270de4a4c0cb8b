"""Composed opinions become an edit stack, the same in every host."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from pxr import Sdf, Usd, UsdGeom, UsdUtils

from icheat_usd.errors import EditError, SidecarError
from icheat_usd.stage import schema
from icheat_usd.stage.authoring import (
    Members,
    add_edit,
    create_stack,
    mute_edit,
    save_layer,
    set_edit,
    set_payload_key,
)
from icheat_usd.stage.description import describe_edit
from icheat_usd.stage.edit_stack import read_edit_stack
from icheat_usd.stage.stacks import find_stack
from tests.stage.edit_stages import DIGEST, OTHER, SURFACES, RecordingReader, layer, python, shot_stage

STACK = "/World/indirect"


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Usd.Stage]:
    made = shot_stage(tmp_path, offset=100, scale=2)
    create_stack(made, "indirect", layer="seq.usda")
    yield made


def add(stage: Usd.Stage, name: str, where: str = "seq.usda", **more: object) -> str:
    given: dict[str, object] = {"receivers": ["floor"], "casters": ["Room"], **more}
    return add_edit(stage, STACK, name, layer=where, **given)  # type: ignore[arg-type]


def digest(stage: Usd.Stage, time: float | None = None) -> str:
    return read_edit_stack(stage, STACK, time, SURFACES, RecordingReader())[0].digest


# --------------------------------------------------------------------------- composition


def test_layers_compose_as_usd_says(stage: Usd.Stage) -> None:
    for name in ("warm", "kitchen", "floor"):
        add(stage, name)
    add(stage, "fix", "shot.usda")
    relationship = stage.GetPrimAtPath(STACK).GetRelationship(schema.EDITS)
    set_edit(stage, f"{STACK}/warm", layer="shot.usda", amount=0.9)
    stage.SetEditTarget(stage.GetRootLayer())
    relationship.RemoveTarget(f"{STACK}/kitchen")
    mute_edit(stage, f"{STACK}/floor", layer="session")
    stack, findings = read_edit_stack(stage, STACK, None, SURFACES)
    assert [(e.name, round(e.amount, 6), e.enabled) for e in stack.edits] == [
        ("warm", 0.9, True),
        ("floor", 1.0, False),
        ("fix", 1.0, True),
    ]
    assert [edit.name for edit in stack.active] == ["warm", "fix"] and findings == ()


def test_muting_the_shot_layer_gives_the_sequence_back(tmp_path: Path) -> None:
    inner = shot_stage(tmp_path)
    create_stack(inner, "indirect", layer="seq.usda")
    add(inner, "warm")
    add(inner, "fix", "shot.usda")
    set_edit(inner, f"{STACK}/warm", layer="shot.usda", amount=0.5)
    outer = Usd.Stage.CreateInMemory()
    outer.GetRootLayer().subLayerPaths = [layer(inner, "shot.usda").identifier, layer(inner, "seq.usda").identifier]
    assert [(e.name, e.amount) for e in read_edit_stack(outer, STACK, None, SURFACES)[0].edits] == [
        ("warm", 0.5),
        ("fix", 1.0),
    ]
    outer.MuteLayer(layer(inner, "shot.usda").identifier)
    assert [(e.name, e.amount) for e in read_edit_stack(outer, STACK, None, SURFACES)[0].edits] == [("warm", 1.0)]


def test_inactive_edits_are_skipped_and_missing_ones_reported(stage: Usd.Stage) -> None:
    for name in ("a", "b"):
        add(stage, name)
    stage.GetPrimAtPath(f"{STACK}/a").SetActive(False)
    relationship = stage.GetPrimAtPath(STACK).GetRelationship(schema.EDITS)
    relationship.AddTarget("/World/floor", Usd.ListPositionBackOfAppendList)
    relationship.AddTarget("/World/gone", Usd.ListPositionBackOfAppendList)
    stack, findings = read_edit_stack(stage, STACK, None, SURFACES)
    assert [edit.name for edit in stack.edits] == ["b"]
    assert [
        "/World/floor has no IcheatEditAPI" in findings[0].message,
        "/World/gone does not exist" in findings[1].message,
    ]
    assert len(findings) == 2
    assert describe_edit(stage, f"{STACK}/a").is_active is False


def test_variants_change_an_edit(stage: Usd.Stage) -> None:
    prim = stage.GetPrimAtPath(add(stage, "warm"))
    variants = prim.GetVariantSets().AddVariantSet("look")
    for name, amount in (("soft", 0.25), ("hard", 2.0)):
        variants.AddVariant(name)
        variants.SetVariantSelection(name)
        with variants.GetVariantEditContext():
            prim.GetAttribute(schema.AMOUNT).Set(amount)
    for name, amount in (("soft", 0.25), ("hard", 2.0)):
        variants.SetVariantSelection(name)
        assert read_edit_stack(stage, STACK, None, SURFACES)[0].edits[0].amount == amount


def test_values_are_read_at_the_time_asked_for(stage: Usd.Stage) -> None:
    path = add(stage, "warm")
    for time, amount in ((102, 0.0), (122, 1.0)):
        set_edit(stage, path, layer="seq.usda", amount=amount, time=time)
    amounts = [read_edit_stack(stage, STACK, t, SURFACES)[0].edits[0].amount for t in (None, 102, 107, 122, 999)]
    assert amounts == [0.0, 0.0, 0.25, 1.0, 1.0]
    stage.GetRootLayer().startTimeCode = 107  # what a snapshot without a time is taken at, too
    assert read_edit_stack(stage, STACK, None, SURFACES)[0].edits[0].amount == 0.25
    assert describe_edit(stage, path).amount.value == 0.25


# --------------------------------------------------------------------------- selection


def test_a_selection_takes_descendants_along_and_excludes_within(stage: Usd.Stage) -> None:
    add(stage, "warm", receivers=Members(("/World",), ("Room/wall",)))
    (edit,) = read_edit_stack(stage, STACK, None, SURFACES)[0].edits
    assert edit.receivers.paths == {"/World/floor", "/World/Room/ceiling"}


def test_an_empty_selection_selects_nothing_and_says_so(stage: Usd.Stage) -> None:
    add(stage, "warm", receivers=[])
    stack, findings = read_edit_stack(stage, STACK, None, SURFACES)
    assert stack.edits[0].receivers.paths == frozenset()
    assert [(f.prim, f.feature, f.severity) for f in findings] == [(f"{STACK}/warm", schema.RECEIVERS, "warning")]


def test_surfaces_in_instances_are_selected_by_their_scene_paths(stage: Usd.Stage) -> None:
    UsdGeom.Mesh.Define(stage, "/World/Chair/seat")
    for name in ("a", "b"):
        instance = stage.DefinePrim(f"/World/Chairs/{name}")
        instance.GetReferences().AddInternalReference("/World/Chair")
        instance.SetInstanceable(True)
    add(stage, "warm", receivers=["Chairs/a"], casters=["/World/Chairs/b/seat"])
    surfaces = ["/World/Chairs/a/seat", "/World/Chairs/b/seat", "/World/Chair/seat"]
    (edit,) = read_edit_stack(stage, STACK, None, surfaces)[0].edits
    assert edit.receivers.paths == {"/World/Chairs/a/seat"}
    assert edit.casters.paths == {"/World/Chairs/b/seat"}


def test_membership_expressions_and_nested_collections_select(stage: Usd.Stage) -> None:
    add(stage, "warm", receivers=[], casters=[])
    prim = stage.GetPrimAtPath(f"{STACK}/warm")
    api = Usd.CollectionAPI(prim, schema.RECEIVERS)
    api.CreateMembershipExpressionAttr().Set(Sdf.PathExpression("/World/Room//"))
    group = Usd.CollectionAPI.Apply(stage.GetPrimAtPath("/World"), "bright")
    group.CreateIncludesRel().AddTarget("/World/floor")
    set_edit(stage, f"{STACK}/warm", layer="shot.usda", casters=["/World.collection:bright"])
    (edit,) = read_edit_stack(stage, STACK, None, SURFACES)[0].edits
    assert edit.receivers.paths == {"/World/Room/wall", "/World/Room/ceiling"}
    assert edit.casters.paths == {"/World/floor"}


def test_a_reference_remaps_selections_and_the_anchor(stage: Usd.Stage) -> None:
    add(stage, "warm", payload=(Path(stage.GetRootLayer().realPath).parent / "edits.v001.icheat.h5", DIGEST))
    outer = Usd.Stage.CreateInMemory()
    outer.SetDefaultPrim(outer.DefinePrim("/Show"))
    outer.DefinePrim("/Show/set").GetReferences().AddReference(stage.GetRootLayer().identifier)
    reader = RecordingReader()
    surfaces = [path.replace("/World", "/Show/set") for path in SURFACES]
    (edit,) = read_edit_stack(outer, "/Show/set/indirect", None, surfaces, reader)[0].edits
    assert edit.receivers.paths == {"/Show/set/floor"}
    assert [anchor for _, _, _, anchor in reader.calls] == ["/Show/set"]


# --------------------------------------------------------------------------- payloads


def test_payloads_are_read_with_their_file_digest_and_anchor(stage: Usd.Stage, tmp_path: Path) -> None:
    sidecar = str(tmp_path / "edits.v001.icheat.h5")
    path = add(stage, "warm", payload=(sidecar, DIGEST), time=102)
    set_payload_key(stage, path, layer="seq.usda", time=122, payload=(sidecar, OTHER))
    reader = RecordingReader(gain=3.0)
    (edit,) = read_edit_stack(stage, STACK, 107, SURFACES, reader)[0].edits
    assert reader.calls == [(sidecar, sidecar, DIGEST, "/World"), (sidecar, sidecar, OTHER, "/World")]
    assert [(key.digest, key.weight, key.file) for key in edit.keys] == [
        (DIGEST, 0.75, sidecar),
        (OTHER, 0.25, sidecar),
    ]


def test_authored_parameters_win_over_the_recipe_and_that_over_fallbacks(stage: Usd.Stage, tmp_path: Path) -> None:
    path = add(stage, "warm", payload=(tmp_path / "edits.v001.icheat.h5", DIGEST))
    reader = RecordingReader(gain=3.0)
    (edit,) = read_edit_stack(stage, STACK, None, SURFACES, reader)[0].edits
    assert dict(edit.parameters) == {"gain": 3.0, "color": (1.0, 1.0, 1.0)}
    assert edit.keys[0].payload is not None and edit.keys[0].payload.parameters == edit.parameters
    set_edit(stage, path, layer="shot.usda", parameters={"gain": 5.0})
    (edit,) = read_edit_stack(stage, STACK, None, SURFACES, reader)[0].edits
    assert edit.parameters["gain"] == 5.0 and edit.keys[0].payload.parameters["gain"] == 5.0  # type: ignore[union-attr]


def test_recipes_of_two_keys_mix_by_their_weights(stage: Usd.Stage, tmp_path: Path) -> None:
    path = add(stage, "warm", payload=(tmp_path / "edits.v001.icheat.h5", DIGEST), time=102)
    set_payload_key(stage, path, layer="seq.usda", time=122, payload=(tmp_path / "edits.v001.icheat.h5", OTHER))

    def read(file: str, source: str | bytes, name: str, anchor: str) -> object:
        return RecordingReader(gain=1.0 if name == DIGEST else 5.0)(file, source, name, anchor)

    (edit,) = read_edit_stack(stage, STACK, 107, SURFACES, read)[0].edits  # type: ignore[arg-type]
    assert edit.parameters["gain"] == 2.0
    assert [key.payload.parameters["gain"] for key in edit.keys if key.payload] == [1.0, 5.0]


def test_an_edit_that_was_given_another_operation_forgets_the_recipe_of_the_first(
    stage: Usd.Stage, tmp_path: Path
) -> None:
    path = add(stage, "warm", payload=(tmp_path / "edits.v001.icheat.h5", DIGEST))
    set_edit(stage, path, layer="shot.usda", operation="hsv", parameters={"hue": 30.0})
    (edit,) = read_edit_stack(stage, STACK, None, SURFACES, RecordingReader(gain=3.0))[0].edits
    (key,) = edit.keys
    assert key.payload is not None and key.payload.operation == "hsv"
    assert dict(key.payload.parameters) == dict(edit.parameters) == {"hue": 30.0, "saturation": 1.0, "value": 1.0}


def test_the_edits_of_a_stack_that_is_off_need_no_sidecar(stage: Usd.Stage, tmp_path: Path) -> None:
    add(stage, "warm", payload=(tmp_path / "gone.icheat.h5", DIGEST))
    stage.GetPrimAtPath(STACK).GetAttribute(schema.STACK_ENABLED).Set(False)
    reader = RecordingReader()
    found, findings = read_edit_stack(stage, STACK, None, SURFACES, reader)
    assert not found.enabled and not found.active and not findings and reader.calls == []


def test_a_muted_edit_needs_no_sidecar_and_an_active_one_names_what_is_missing(
    stage: Usd.Stage, tmp_path: Path
) -> None:
    path = add(stage, "warm", payload=(tmp_path / "gone.icheat.h5", DIGEST))
    with pytest.raises(SidecarError, match=r"gone\.icheat\.h5.*/World/indirect/warm"):
        read_edit_stack(stage, STACK, None, SURFACES, RecordingReader())
    mute_edit(stage, path, layer="session")
    reader = RecordingReader()
    assert read_edit_stack(stage, STACK, None, SURFACES, reader)[0].edits[0].keys == ()
    assert reader.calls == []


def test_a_payload_in_a_package_is_handed_over_as_bytes(stage: Usd.Stage, tmp_path: Path) -> None:
    add(stage, "warm", payload=(tmp_path / "edits.v001.icheat.h5", DIGEST))
    for name in ("seq.usda", "shot.usda"):
        save_layer(layer(stage, name))
    package = tmp_path / "shot.usdz"
    assert UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(tmp_path / "shot.usda")), str(package))
    reader = RecordingReader()
    packed = Usd.Stage.Open(str(package))
    read_edit_stack(packed, STACK, None, SURFACES, reader)
    ((file, source, name, _),) = reader.calls
    assert source == b"payloads" and name == DIGEST and file.startswith(str(package))


@pytest.mark.parametrize("name", [schema.AMOUNT, "icheat:scale:gain"])
def test_numbers_that_are_not_finite_are_errors(stage: Usd.Stage, name: str) -> None:
    prim = stage.GetPrimAtPath(add(stage, "warm"))
    prim.GetAttribute(name).Set(float("nan"))
    with pytest.raises(EditError, match=f"{STACK}/warm: {name}"):
        read_edit_stack(stage, STACK, None, SURFACES)


@pytest.mark.parametrize(
    ("name", "kind", "value", "message"),
    [
        (schema.AMOUNT, "string", "much", "amount is 'much', expected a number"),
        (schema.ENABLED, "string", "false", "enabled is 'false', expected true or false"),
        (schema.FILE_PATH, "string", "x.h5", "filePath names no file"),
    ],
)
def test_a_value_of_another_type_is_one_clear_error(
    stage: Usd.Stage, name: str, kind: str, value: str, message: str
) -> None:
    path = add(stage, "warm")
    spec = layer(stage, "shot.usda")
    over = Sdf.CreatePrimInLayer(spec, path)
    Sdf.AttributeSpec(over, name, Sdf.ValueTypeNames.Find(kind)).default = value
    if name == schema.FILE_PATH:
        Sdf.AttributeSpec(over, schema.PAYLOAD, Sdf.ValueTypeNames.Token).default = DIGEST
    with pytest.raises(EditError, match=message):
        read_edit_stack(stage, STACK, None, SURFACES)


def test_a_mistyped_parameter_means_nothing(stage: Usd.Stage) -> None:
    prim = stage.GetPrimAtPath(add(stage, "warm"))
    prim.CreateAttribute("icheat:scale:gian", Sdf.ValueTypeNames.Float).Set(3.0)
    (edit,) = read_edit_stack(stage, STACK, None, SURFACES)[0].edits
    assert dict(edit.parameters) == {"gain": 1.0, "color": (1.0, 1.0, 1.0)}


# --------------------------------------------------------------------------- digest


def test_the_digest_changes_with_what_decides_the_image_and_with_nothing_else(stage: Usd.Stage, tmp_path: Path) -> None:
    empty = digest(stage)
    path = add(stage, "a", parameters={"gain": 2.0})
    add(stage, "b", operation="hsv", parameters={"hue": 30.0})
    seen = [empty, digest(stage)]

    def changed() -> None:
        assert digest(stage) not in seen
        seen.append(digest(stage))

    set_edit(stage, path, layer="shot.usda", amount=0.5)
    changed()
    set_edit(stage, path, layer="shot.usda", parameters={"color": (1.0, 0.5, 1.0)})
    changed()
    set_edit(stage, path, layer="shot.usda", receivers=["Room/wall"])
    changed()
    set_edit(stage, path, layer="shot.usda", blend="add")
    changed()
    set_payload_key(stage, path, layer="shot.usda", time=None, payload=(tmp_path / "edits.v001.icheat.h5", DIGEST))
    changed()
    last = digest(stage)
    (tmp_path / "copy.icheat.h5").write_bytes(b"x")
    set_payload_key(stage, path, layer="shot.usda", time=None, payload=(tmp_path / "copy.icheat.h5", DIGEST))
    stage.GetPrimAtPath(path).SetCustomDataByKey("note", "x")
    assert digest(stage) == last
    for edit in ("a", "b"):
        mute_edit(stage, f"{STACK}/{edit}", layer="session")
    assert digest(stage) == empty


def test_order_decides_the_digest(stage: Usd.Stage) -> None:
    add(stage, "a", parameters={"gain": 2.0})
    add(stage, "b", operation="hsv", parameters={"hue": 30.0})
    before = digest(stage)
    relationship = stage.GetPrimAtPath(STACK).GetRelationship(schema.EDITS)
    relationship.AddTarget(f"{STACK}/a", Usd.ListPositionBackOfAppendList)
    assert digest(stage) != before


# --------------------------------------------------------------------------- which stack


def test_a_stage_without_a_stack_has_none(tmp_path: Path) -> None:
    assert find_stack(shot_stage(tmp_path)) is None


def test_the_only_stack_is_found_and_a_named_one_wins(stage: Usd.Stage) -> None:
    assert find_stack(stage) == STACK
    create_stack(stage, "other", layer="shot.usda")
    assert find_stack(stage, "other") == find_stack(stage, "/World/other") == "/World/other"
    with pytest.raises(EditError, match="/World/indirect, /World/other"):
        find_stack(stage)
    with pytest.raises(EditError, match="no stack 'nope'.*/World/indirect"):
        find_stack(stage, "nope")


def test_render_settings_decide_before_the_camera_does(stage: Usd.Stage) -> None:
    create_stack(stage, "for_camera", layer="shot.usda", camera="camera")
    stage.DefinePrim("/World/settings", "RenderSettings")
    create_stack(stage, "settings", layer="shot.usda")
    stage.SetMetadata("renderSettingsPrimPath", "/World/settings")
    assert find_stack(stage, camera="/World/camera") == "/World/settings"


def test_a_camera_finds_its_own_stack_before_one_for_any_camera(stage: Usd.Stage) -> None:
    UsdGeom.Camera.Define(stage, "/World/other_camera")
    create_stack(stage, "for_camera", layer="shot.usda", camera="camera")
    assert find_stack(stage, camera="/World/camera") == "/World/for_camera"
    assert find_stack(stage, camera="/World/other_camera") == STACK
    with pytest.raises(EditError, match="2 of the stacks"):
        find_stack(stage, camera="auto")
    create_stack(stage, "again", layer="shot.usda", camera="camera")
    with pytest.raises(EditError, match="2 of the stacks"):
        find_stack(stage, camera="/World/camera")


# --------------------------------------------------------------------------- provenance


def test_a_description_names_the_layer_of_each_value(stage: Usd.Stage, tmp_path: Path) -> None:
    sidecar = tmp_path / "edits.v001.icheat.h5"
    path = add(
        stage,
        "warm",
        parameters={"gain": 2.0},
        casters=Members(("Room",), ("Room/wall",)),
        payload=(sidecar, DIGEST),
        time=102,
    )
    set_payload_key(stage, path, layer="seq.usda", time=122, payload=(sidecar, OTHER))
    mute_edit(stage, path, layer="session")
    shot, sequence = stage.GetRootLayer().identifier, layer(stage, "seq.usda").identifier
    set_edit(stage, path, layer="shot.usda", amount=0.5)
    told = describe_edit(stage, path, 120)
    assert (told.amount.value, told.amount.layer) == (0.5, shot)
    assert (told.parameters["gain"].value, told.parameters["gain"].layer) == (2.0, sequence)
    assert (told.parameters["color"].value, told.parameters["color"].layer) == ((1.0, 1.0, 1.0), "")
    assert (told.enabled.value, told.enabled.layer) == (False, stage.GetSessionLayer().identifier)
    assert (told.receivers, told.casters, told.casters_excluded) == (
        ("/World/floor",),
        ("/World/Room",),
        ("/World/Room/wall",),
    )
    assert (told.key_times, told.payload_digest, told.file) == ((102.0, 122.0), OTHER, str(sidecar))
    assert told.layers == (stage.GetSessionLayer().identifier, shot, sequence) and told.problem == ""


# --------------------------------------------------------------------------- hosts without our schemas

READ = """
import json, sys
from icheat_usd.edits.model import Payload
from icheat_usd.stage import schema
from icheat_usd.stage.check import check_stage
from icheat_usd.stage.description import describe_edit
from icheat_usd.stage.edit_stack import read_edit_stack
from icheat_usd.stage.stacks import find_stack
stage = Usd.Stage.Open(sys.argv[1])
path = find_stack(stage)
read = lambda file, source, digest, anchor: Payload("scale", {"gain": 3.0})
stack, findings = read_edit_stack(stage, path, 107, sys.argv[2:], read)
told = [describe_edit(stage, edit.path, 107) for edit in stack.edits]
print(json.dumps({
    "registered": schema.is_registered(), "digest": stack.digest, "path": path,
    "edits": [[e.path, e.operation, dict(e.parameters), sorted(e.receivers.paths), sorted(e.casters.paths), e.amount,
               e.blend, e.enabled, [[k.digest, k.weight, k.file] for k in e.keys]] for e in stack.edits],
    "findings": [[f.prim, f.feature, f.message] for f in findings],
    "checked": [[f.prim, f.feature, f.message] for f in check_stage(stage) if f.rule != "SchemasNotRegistered"],
    "told": [repr((t.amount, t.enabled, dict(t.parameters), t.receivers, t.casters, t.key_times)) for t in told],
}))
"""
LATE = 'from pxr import Usd\nUsd.Stage.CreateInMemory().DefinePrim("/composed/before", "Scope")\nimport icheat_usd\n'


def strip_to_bare_opinions(sequence: Sdf.Layer) -> None:
    """As another tool may write it: nothing that equals a fallback."""
    for edit in sequence.GetPrimAtPath(STACK).nameChildren:
        for name in (schema.RECEIVERS, schema.CASTERS):
            for attribute in ("includeRoot", "expansionRule"):
                del edit.properties[f"collection:{name}:{attribute}"]


def test_a_host_that_composed_first_reads_the_same(stage: Usd.Stage, tmp_path: Path) -> None:
    sidecar = tmp_path / "edits.v001.icheat.h5"
    path = add(stage, "warm", parameters={"color": (1.0, 0.5, 0.25)}, payload=(sidecar, DIGEST), time=102)
    set_payload_key(stage, path, layer="seq.usda", time=122, payload=(sidecar, OTHER))
    add(stage, "cool", operation="hsv", parameters={"hue": 30.0}, receivers=Members(("/World",), ("Room/wall",)))
    add(stage, "nothing", receivers=[])
    strip_to_bare_opinions(layer(stage, "seq.usda"))
    for name in ("seq.usda", "shot.usda"):
        save_layer(layer(stage, name))
    arguments = (str(tmp_path / "shot.usda"), *SURFACES)
    early = json.loads(python("import icheat_usd\nfrom pxr import Usd\n" + READ, *arguments))
    late = json.loads(python(LATE + READ, *arguments))
    assert (early.pop("registered"), late.pop("registered")) == (True, False)
    assert early == late
    here = read_edit_stack(stage, STACK, 107, SURFACES, RecordingReader(gain=3.0))[0]
    assert early["digest"] == here.digest and len(early["edits"]) == 3
    assert early["edits"][1][3] == ["/World/Room/ceiling", "/World/floor"] and len(early["findings"]) == 1


def test_a_host_that_composed_first_is_told_how_to_author(stage: Usd.Stage, tmp_path: Path) -> None:
    save_layer(layer(stage, "seq.usda"))
    code = LATE + (
        "import sys\nfrom icheat_usd.errors import EditError\nfrom icheat_usd.stage.authoring import add_edit\n"
        "stage = Usd.Stage.Open(sys.argv[1])\nbefore = stage.GetRootLayer().ExportToString()\n"
        "try:\n    add_edit(stage, '/World/indirect', 'x', layer='shot.usda')\n"
        "except EditError as error:\n    print(error)\n"
        "assert stage.GetRootLayer().ExportToString() == before\n"
    )
    told = python(code, str(tmp_path / "shot.usda"))
    assert "icheat plugin-path" in told and "PXR_PLUGINPATH_NAME" in told
