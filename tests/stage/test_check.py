"""Each rule finds what it is for, and a good stage has no findings."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from pxr import Sdf, Usd

from icheat_usd.errors import SidecarError
from icheat_usd.stage import schema
from icheat_usd.stage.authoring import add_edit, create_stack, remove_edit, set_payload_key
from icheat_usd.stage.check import RULES, check_stage
from icheat_usd.stage.stacks import Severity
from tests.stage.edit_stages import DIGEST, OTHER, RecordingReader, layer, python, shot_stage

WARM = "/World/indirect/warm"


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Usd.Stage]:
    made = shot_stage(tmp_path)
    create_stack(made, "indirect", layer="seq.usda", camera="camera")
    sidecar = tmp_path / "edits.v001.icheat.h5"
    given = {"layer": "seq.usda", "receivers": ["floor"], "casters": ["Room"], "payload": (sidecar, DIGEST)}
    add_edit(made, "/World/indirect", "warm", time=1, **given)  # type: ignore[arg-type]
    set_payload_key(made, WARM, layer="seq.usda", time=11, payload=(sidecar, OTHER))
    add_edit(made, "/World/indirect", "cool", layer="shot.usda", operation="hsv", receivers=["floor"], casters=["Room"])
    made.SetEditTarget(made.GetRootLayer())
    yield made


def test_a_good_stage_has_no_findings(stage: Usd.Stage) -> None:
    assert check_stage(stage, read_payload=RecordingReader()) == []
    remove_edit(stage, "/World/indirect", "warm", layer="shot.usda")
    assert check_stage(stage) == []


def test_a_stage_without_edits_has_no_findings(tmp_path: Path) -> None:
    assert check_stage(shot_stage(tmp_path)) == []


def warm(stage: Usd.Stage) -> Usd.Prim:
    return stage.GetPrimAtPath(WARM)


def edits(stage: Usd.Stage) -> Usd.Relationship:
    return stage.GetPrimAtPath("/World/indirect").GetRelationship(schema.EDITS)


def on_a_mesh(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/World/floor").AddAppliedSchema(schema.EDIT_API)
    edits(stage).AddTarget("/World/floor", Usd.ListPositionBackOfAppendList)
    for name in (schema.RECEIVERS, schema.CASTERS):
        Usd.CollectionAPI(stage.GetPrimAtPath("/World/floor"), name).CreateIncludesRel().AddTarget("/World/Room")


def mistyped_name(stage: Usd.Stage) -> None:
    warm(stage).CreateAttribute("icheat:amuont", Sdf.ValueTypeNames.Float).Set(0.5)


def mistyped_collection(stage: Usd.Stage) -> None:
    warm(stage).CreateRelationship("collection:icheatReceiver:includes").AddTarget("/World/floor")


def wrong_type(stage: Usd.Stage) -> None:
    Sdf.AttributeSpec(
        Sdf.CreatePrimInLayer(stage.GetRootLayer(), WARM), schema.AMOUNT, Sdf.ValueTypeNames.Int
    ).default = 1


def outside_default_prim(stage: Usd.Stage) -> None:
    stage.DefinePrim("/Elsewhere", "Scope").ApplyAPI(schema.STACK_API)


def in_an_instance(stage: Usd.Stage) -> None:
    stage.DefinePrim("/World/Source/stack", "Scope").ApplyAPI(schema.STACK_API)
    instance = stage.DefinePrim("/World/instance")
    instance.GetReferences().AddInternalReference("/World/Source")
    instance.SetInstanceable(True)


def missing_target(stage: Usd.Stage) -> None:
    edits(stage).AddTarget("/World/indirect/gone", Usd.ListPositionBackOfAppendList)


def two_stacks(stage: Usd.Stage) -> None:
    create_stack(stage, "second", layer="shot.usda")
    stage.GetPrimAtPath("/World/second").GetRelationship(schema.EDITS).AddTarget(WARM)


def listed_twice_in_a_layer(stage: Usd.Stage) -> None:
    edits(stage).AddTarget(f"{WARM[:-4]}cool", Usd.ListPositionBackOfAppendList)
    items = stage.GetRootLayer().GetRelationshipAtPath(edits(stage).GetPath()).targetPathList
    items.prependedItems = [Sdf.Path("/World/indirect/cool")]
    items.appendedItems = [Sdf.Path("/World/indirect/cool")]


def unlisted(stage: Usd.Stage) -> None:
    prim = stage.DefinePrim("/World/indirect/loose", "Scope")
    prim.ApplyAPI(schema.EDIT_API)
    for name in (schema.RECEIVERS, schema.CASTERS):
        Usd.CollectionAPI(prim, name).CreateIncludesRel().AddTarget("/World/floor")


def camera_is_a_mesh(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/World/indirect").GetRelationship(schema.CAMERA).SetTargets(["/World/floor"])


def unknown_operation(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/World/indirect/cool").GetAttribute(schema.OPERATION).Set("studioThing")


def operation_without_schema(stage: Usd.Stage) -> None:
    warm(stage).GetAttribute(schema.OPERATION).Set("hsv")
    warm(stage).CreateAttribute("icheat:hsv:hue", Sdf.ValueTypeNames.Float, False).Set(30.0)


def unknown_blend(stage: Usd.Stage) -> None:
    warm(stage).GetAttribute(schema.BLEND).Set("multiply")


def not_finite_at_one_time(stage: Usd.Stage) -> None:
    warm(stage).GetAttribute("icheat:scale:gain").Set(1.0, 1)
    warm(stage).GetAttribute("icheat:scale:gain").Set(float("inf"), 50)


def empty_selection(stage: Usd.Stage) -> None:
    Usd.CollectionAPI(warm(stage), schema.CASTERS).GetIncludesRel().SetTargets([])


def selected_prim_missing(stage: Usd.Stage) -> None:
    Usd.CollectionAPI(warm(stage), schema.CASTERS).GetIncludesRel().AddTarget("/World/removed")


def two_anchors(stage: Usd.Stage) -> None:
    warm(stage).GetRelationship(schema.ANCHOR).SetTargets(["/World", "/World/Room"])


def payload_without_file(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/World/indirect/cool").GetAttribute(schema.PAYLOAD).Set(DIGEST)


def file_without_payload(stage: Usd.Stage) -> None:
    prim = stage.GetPrimAtPath("/World/indirect/cool")
    prim.GetAttribute(schema.FILE_PATH).Set(Sdf.AssetPath("./edits.v001.icheat.h5"))


def keys_from_two_layers(stage: Usd.Stage) -> None:
    warm(stage).GetAttribute(schema.PAYLOAD).Set(OTHER, 1)


def key_times_differ(stage: Usd.Stage) -> None:
    layer(stage, "seq.usda").EraseTimeSample(f"{WARM}.{schema.FILE_PATH}", 11)


def missing_file(stage: Usd.Stage) -> None:
    path = Sdf.AssetPath("./gone.icheat.h5")
    layer(stage, "seq.usda").SetTimeSample(f"{WARM}.{schema.FILE_PATH}", 11, path)


def unanchored(stage: Usd.Stage) -> None:
    stage.SetEditTarget(stage.GetSessionLayer())
    warm(stage).GetAttribute(schema.FILE_PATH).Set(Sdf.AssetPath("./edits.v001.icheat.h5"))
    warm(stage).GetAttribute(schema.PAYLOAD).Set(OTHER)


def outdated_copy(stage: Usd.Stage) -> None:
    sidecar = Path(stage.GetRootLayer().realPath).parent / "edits.v001.icheat.h5"
    set_payload_key(stage, WARM, layer="shot.usda", time=11, payload=(sidecar, DIGEST))
    layer(stage, "seq.usda").SetTimeSample(f"{WARM}.{schema.PAYLOAD}", 1, OTHER)


@pytest.mark.parametrize(
    ("break_it", "rule", "message"),
    [
        (on_a_mesh, "SchemaOnWrongType", "prim of Mesh, expected Scope"),
        (mistyped_name, "UnknownAttribute", "did you mean icheat:amount"),
        (mistyped_collection, "UnknownAttribute", "no schema declares"),
        (wrong_type, "WrongAttributeType", "of type int in .*shot.usda, expected float"),
        (outside_default_prim, "StackOutsideDefaultPrim", "outside the default prim /World"),
        (in_an_instance, "StackInInstance", "lies in an instance"),
        (missing_target, "UnusableTarget", "/World/indirect/gone does not exist"),
        (two_stacks, "EditListedTwice", "listed by /World/indirect too"),
        (listed_twice_in_a_layer, "EditListedTwice", "listed twice in .*shot.usda"),
        (unlisted, "EditInNoStack", "no stack lists it"),
        (camera_is_a_mesh, "CameraIsNoCamera", "/World/floor is no camera"),
        (unknown_operation, "UnknownOperation", "'studioThing' is unknown.*hsv, scale"),
        (operation_without_schema, "OperationSchemaNotApplied", "without IcheatHsvAPI"),
        (unknown_blend, "UnknownToken", "'multiply' is not one of compose, over, add"),
        (not_finite_at_one_time, "NotFinite", "inf in .*shot.usda at time 50"),
        (empty_selection, "EmptySelection", "selects nothing"),
        (selected_prim_missing, "SelectedPrimMissing", "/World/removed does not exist"),
        (two_anchors, "SeveralAnchors", "2 targets"),
        (payload_without_file, "PayloadWithoutFile", "without icheat:filePath"),
        (file_without_payload, "FileWithoutPayload", "no effect without icheat:payload"),
        (keys_from_two_layers, "KeysFromTwoLayers", "shot.usda but icheat:filePath by .*seq.usda"),
        (key_times_differ, "KeyTimesDiffer", "other sample times"),
        (missing_file, "MissingSidecar", r"gone\.icheat\.h5.*not found"),
        (unanchored, "UnanchoredFile", "which has no place"),
        (outdated_copy, "CopiedKeysOutdated", "copied from .*seq.usda"),
    ],
)
def test_a_rule_finds_its_mistake_and_no_other_rule_does(
    stage: Usd.Stage, break_it: Callable[[Usd.Stage], None], rule: str, message: str
) -> None:
    break_it(stage)
    findings = check_stage(stage)
    assert {finding.rule for finding in findings} == {rule}
    assert re.search(message, findings[0].message), findings[0].message
    severity = next(r.severity for r in RULES if type(r).__name__ == rule)
    assert all(finding.severity == severity for finding in findings)


def test_targets_that_a_reference_drops_are_found(stage: Usd.Stage, capfd: pytest.CaptureFixture[str]) -> None:
    includes = f"{WARM}.collection:{schema.CASTERS}:includes"
    layer(stage, "seq.usda").GetRelationshipAtPath(includes).targetPathList.appendedItems.append(
        Sdf.Path("/Other/prim")
    )
    outer = Usd.Stage.CreateInMemory()
    outer.SetDefaultPrim(outer.DefinePrim("/Show"))
    outer.DefinePrim("/Show/set").GetReferences().AddReference(stage.GetRootLayer().identifier)
    dropped = [finding for finding in check_stage(outer) if finding.rule == "TargetDropped"]
    assert [(f.prim, f.feature) for f in dropped] == [
        ("/Show/set/indirect/warm", f"collection:{schema.CASTERS}:includes")
    ]
    assert "/Other/prim in" in dropped[0].message and dropped[0].severity == Severity.ERROR
    assert capfd.readouterr().err == ""


def test_a_reader_that_refuses_a_payload_is_quoted(stage: Usd.Stage) -> None:
    def refuse(file: str, source: str | bytes, digest: str, anchor: str) -> object:
        raise SidecarError(f"{file}: payload {digest[:8]} is damaged; restore the file")

    found = [f.message for f in check_stage(stage, read_payload=refuse)]  # type: ignore[arg-type]
    assert len(found) == 2 and all("is damaged" in message for message in found)


def test_every_rule_says_what_it_wants() -> None:
    assert all(rule.doc.endswith(".") for rule in RULES)
    assert len({type(rule).__name__ for rule in RULES}) == len(RULES)


def test_a_host_without_the_schemas_is_told_so(stage: Usd.Stage, tmp_path: Path) -> None:
    for name in ("seq.usda", "shot.usda"):
        layer(stage, name).Save()
    code = (
        'from pxr import Usd\nUsd.Stage.CreateInMemory().DefinePrim("/composed/before", "Scope")\n'
        "import icheat_usd, sys\nfrom icheat_usd.stage.check import check_stage\n"
        "print([f.rule for f in check_stage(Usd.Stage.Open(sys.argv[1]))])"
    )
    assert python(code, str(tmp_path / "shot.usda")).strip() == "['SchemasNotRegistered']"
