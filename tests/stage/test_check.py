"""Each rule finds what it is for, and a good stage has no findings."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdLux

from icheat_usd.edits.facts import facts
from icheat_usd.edits.model import MaskedSurface, Payload, SurfaceMask
from icheat_usd.errors import SidecarError
from icheat_usd.resources import resource_path
from icheat_usd.stage import schema, take_snapshot
from icheat_usd.stage.authoring import add_edit, create_stack, remove_edit, set_payload_key
from icheat_usd.stage.check import RULES, check_stage
from icheat_usd.stage.edit_stack import read_edit_stack
from icheat_usd.stage.meshes import topology_digest
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


def selection(stage: Usd.Stage, name: str, *parts: str) -> str:
    prim = stage.DefinePrim(f"/World/indirect/{name}", "Scope")
    prim.ApplyAPI(schema.SELECTION_API)
    prim.CreateRelationship(schema.PARTS, False).SetTargets(list(parts))
    return str(prim.GetPath())


def limited_by(stage: Usd.Stage, path: str) -> None:
    warm(stage).CreateRelationship(schema.RECEIVER_LIMITS, False).SetTargets([path])


def selections_in_a_circle(stage: Usd.Stage) -> None:
    limited_by(stage, selection(stage, "a", "/World/indirect/b"))
    selection(stage, "b", "/World/floor", "/World/indirect/a")


def limit_missing(stage: Usd.Stage) -> None:
    limited_by(stage, "/World/nowhere")


def part_missing(stage: Usd.Stage) -> None:
    limited_by(stage, selection(stage, "a", "/World/nothing"))


def unknown_selection_rule(stage: Usd.Stage) -> None:
    path = selection(stage, "a", "/World/floor")
    stage.GetPrimAtPath(path).GetAttribute(schema.RULE).Set("minus")


def rendered_region(stage: Usd.Stage) -> None:
    stage.DefinePrim("/World/indirect/ball", "Sphere")
    limited_by(stage, "/World/indirect/ball")


def flat_region(stage: Usd.Stage) -> None:
    ball = UsdGeom.Sphere.Define(stage, "/World/indirect/ball")
    ball.CreatePurposeAttr("guide")
    ball.CreateRadiusAttr(0.0)
    limited_by(stage, "/World/indirect/ball")


def unshadow_alone(stage: Usd.Stage) -> None:
    prim = stage.GetPrimAtPath("/World/indirect/cool")
    prim.GetAttribute(schema.OPERATION).Set("unshadow")


def receive_of_one_light(stage: Usd.Stage) -> None:
    prim = stage.GetPrimAtPath("/World/indirect/cool")
    prim.GetAttribute(schema.OPERATION).Set("receive")
    UsdLux.SphereLight.Define(stage, "/World/bulb")
    prim.CreateRelationship(schema.LIGHTS, False).SetTargets(["/World/bulb"])


def two_targets(stage: Usd.Stage) -> None:
    warm(stage).CreateRelationship(schema.TARGET, False).SetTargets(["/World/floor", "/World/Room"])


def light_is_a_camera(stage: Usd.Stage) -> None:
    warm(stage).CreateRelationship(schema.LIGHTS, False).SetTargets(["/World/camera"])


def baked_without_payload(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/World/indirect/cool").GetAttribute(schema.OPERATION).Set("baked")


@pytest.mark.parametrize(
    ("break_it", "rule", "message"),
    [
        (selections_in_a_circle, "SelectionInCircle", "leads in a circle"),
        (limit_missing, "SelectedPrimMissing", "/World/nowhere does not exist"),
        (part_missing, "SelectedPrimMissing", "/World/nothing does not exist"),
        (unknown_selection_rule, "UnknownToken", "'minus' is not one of intersection, union, difference"),
        (rendered_region, "RegionIsRendered", "set its purpose to guide"),
        (flat_region, "RegionWithoutSpace", "selects no space"),
        (unshadow_alone, "UnshadowWithoutOccluders", "has none; name some"),
        (receive_of_one_light, "LightsWithoutEffect", "acts on all light of its receivers"),
        (two_targets, "SeveralTargets", "has 2 targets"),
        (light_is_a_camera, "LightIsNoLight", "/World/camera is no light"),
        (baked_without_payload, "BakedWithoutPayload", "there is no payload"),
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
        (unknown_operation, "UnknownOperation", "'studioThing' is unknown.*hsv.*scale"),
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


def payloads(**given: Payload) -> Callable[..., Payload]:
    """A reader that knows the payload of frame 1 and that of frame 11."""

    def read(file: str, source: str | bytes, digest: str, anchor: str) -> Payload:
        return given["first" if digest == DIGEST else "second"]

    return read


PLAIN = Payload("scale", {})


def found(stage: Usd.Stage, **given: Payload) -> list[tuple[str, str]]:
    reader = payloads(**({"first": PLAIN, "second": PLAIN} | given))
    return [(f.rule, f.message) for f in check_stage(stage, read_payload=reader)]


def test_a_baked_edit_needs_a_baked_form(stage: Usd.Stage) -> None:
    warm(stage).GetAttribute(schema.OPERATION).Set("baked")
    good = Payload("scale", {}, scale_delta=(1.0, 0.0, 0.0))
    ((rule, message),) = found(stage, first=good)
    assert rule == "BakedWithoutPayload" and OTHER[:12] in message
    assert found(stage, first=good, second=good) == []


def test_parameters_that_moved_on_make_rows_stale_and_not_the_constants_that_authoring_stores(
    stage: Usd.Stage,
) -> None:
    constants = Payload("scale", {"gain": 0.5}, scale_delta=(-0.5, -0.5, -0.5))
    rows = replace(constants, rows=cast(Any, "what rows hold does not matter here"))
    assert found(stage, first=constants) == found(stage, first=rows) == []
    warm(stage).GetAttribute("icheat:scale:gain").Set(1.6)
    assert found(stage, first=constants) == []
    ((rule, message),) = found(stage, first=rows)
    assert rule == "BakedParametersChanged" and "at 1 is stale: gain is 1.6" in message
    warm(stage).GetAttribute(schema.OPERATION).Set("hsv")
    rules = dict(found(stage, first=rows))
    assert "the operation is 'hsv', and was 'scale'" in rules["BakedParametersChanged"]


def test_a_repainted_topology_and_a_lost_surface_are_found(stage: Usd.Stage) -> None:
    mesh = UsdGeom.Mesh.Get(stage, "/World/floor")
    now = topology_digest(np.array([3]), np.array([0, 1, 2]))
    surfaces = (MaskedSurface("/World/floor", 1, topology_digest=now), MaskedSurface("/World/camera", 1))
    painted = Payload("scale", {}, receiver_mask=SurfaceMask(surfaces, np.ones((2, 1, 1), np.float32)))
    assert found(stage, first=painted) == []
    mesh.GetFaceVertexIndicesAttr().Set([0, 2, 1])
    stage.GetPrimAtPath("/World/camera").SetActive(False)
    messages = [message for rule, message in found(stage, first=painted) if rule == "PaintedSurfaceChanged"]
    assert [m.partition(";")[0] for m in messages] == [
        "painted surface /World/floor has other faces",
        "painted surface /World/camera is gone",
    ]


def test_rows_are_stale_once_the_scene_has_changed_and_say_what(stage: Usd.Stage) -> None:
    UsdLux.SphereLight.Define(stage, "/World/key").CreateIntensityAttr(2.0)
    made = facts(take_snapshot(stage, camera="auto", time=1.0), "/World")
    for prim in (warm(stage),):
        prim.GetRelationship(schema.ANCHOR).SetTargets(["/World"])
    rows: Any = object()
    plain, non_linear = (Payload(name, {}, rows=rows, made_against=made) for name in ("scale", "gamma"))
    warm(stage).GetAttribute(schema.OPERATION).Set("baked")
    assert found(stage, first=plain, second=non_linear) == []

    stage.GetPrimAtPath("/World/key").GetAttribute("inputs:intensity").Set(3.0)
    ((rule, message),) = found(stage, first=plain, second=non_linear)
    assert (rule, message) == (
        "BakedStale",
        "what is baked at 11 is stale: light key got brighter (1.5 times); bake it again",
    )
    UsdGeom.Xformable(stage.GetPrimAtPath("/World/floor")).AddTranslateOp().Set((0, 0, 1.0))
    first, second = (message for _, message in found(stage, first=plain, second=non_linear))
    assert first == "what is baked at 1 is stale: surface floor moved; bake it again"
    assert "surface floor moved; light key got brighter" in second


def test_rows_of_a_camera_that_moved_or_went_are_noted(stage: Usd.Stage) -> None:
    made = facts(take_snapshot(stage, camera="/World/camera", time=1.0, width=64, height=48), "/World")
    warm(stage).GetRelationship(schema.ANCHOR).SetTargets(["/World"])
    warm(stage).GetAttribute(schema.OPERATION).Set("baked")
    rows: Any = object()
    payload = Payload("scale", {}, rows=rows, made_against=made)
    assert found(stage, first=payload, second=payload) == []
    camera = UsdGeom.Camera.Get(stage, "/World/camera")
    camera.AddTranslateOp().Set((0, 0, 0.5))
    rules = found(stage, first=payload, second=payload)
    assert {rule for rule, _ in rules} == {"BakedForOtherCamera"} and "camera camera moved" in rules[0][1]
    camera.GetPrim().SetActive(False)
    messages = [message for rule, message in found(stage, first=payload, second=payload) if rule.startswith("Baked")]
    assert len(messages) == 2 and all("camera camera is gone;" in message for message in messages)


def test_rows_of_another_selection_are_stale(stage: Usd.Stage) -> None:
    snapshot = take_snapshot(stage, camera="auto", time=1.0)
    warm(stage).GetRelationship(schema.ANCHOR).SetTargets(["/World"])
    warm(stage).GetAttribute(schema.OPERATION).Set("baked")
    read, _ = read_edit_stack(stage, "/World/indirect", 1.0, {s.path for s in snapshot.surfaces}, payloads(first=PLAIN))
    edit = next(edit for edit in read.edits if edit.path == WARM)
    rows: Any = object()
    payload = Payload("scale", {}, rows=rows, made_against=facts(snapshot, "/World", edit=edit))
    assert found(stage, first=payload, second=payload) == []
    Usd.CollectionAPI(warm(stage), schema.RECEIVERS).GetIncludesRel().AddTarget("/World/Room")
    messages = [message for _, message in found(stage, first=payload, second=payload)]
    assert len(messages) == 2 and "the edit has other receivers" in messages[0]


def test_rows_stay_fresh_under_another_name(stage: Usd.Stage) -> None:
    made = facts(take_snapshot(stage, camera="auto", time=1.0), "/World")
    warm(stage).GetRelationship(schema.ANCHOR).SetTargets(["/World"])
    rows: Any = object()
    payload = Payload("gamma", {}, rows=rows, made_against=made)
    warm(stage).GetAttribute(schema.OPERATION).Set("baked")
    outer = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(outer, 1.0)
    outer.SetDefaultPrim(outer.DefinePrim("/Show"))
    outer.DefinePrim("/Show/set").GetReferences().AddReference(stage.GetRootLayer().identifier)
    assert [rule for rule, _ in found(outer, first=payload, second=payload)] == []
    outer.OverridePrim("/Show/set/floor").GetAttribute("points").Set([(0, 0, 0), (2, 0, 0), (0, 1, 0)])
    assert {rule for rule, _ in found(outer, first=payload, second=payload)} == {"BakedStale"}


def test_hosts_find_the_rules_as_validators(stage: Usd.Stage, tmp_path: Path) -> None:
    if Usd.GetVersion() < (0, 26, 5):
        pytest.skip("this USD takes no validators from Python")
    rendered_region(stage)
    two_targets(stage)
    for name in ("seq.usda", "shot.usda"):
        layer(stage, name).Save()
    code = (
        "import sys\nfrom pxr import Usd, UsdValidation as V\n"
        "stage = Usd.Stage.Open(sys.argv[1])\n"
        "context = V.ValidationContext(keywords=['icheat'], includeAllAncestors=False)\n"
        "for e in context.Validate(stage):\n"
        "    places = [(s.GetProperty() or s.GetPrim()).GetPath() for s in e.GetSites()]\n"
        "    print(e.GetName(), e.GetType().name, *places)\n"
    )
    from icheat_usd.plugin_path import search_path

    told = python(code, str(tmp_path / "shot.usda"), environment={"PXR_PLUGINPATH_NAME": search_path()})
    ours = sorted(line for line in told.splitlines() if "Missing" not in line)
    assert ours == [
        "RegionIsRendered Warn /World/indirect/ball.purpose",
        f"SeveralTargets Error {WARM}.{schema.TARGET}",
    ]


def test_the_plug_in_announces_every_rule() -> None:
    from icheat_usd.session.validators import PLUGIN, plugin_text

    assert resource_path(PLUGIN).read_text() == plugin_text(), "run python -m icheat_usd.session.validators"


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
