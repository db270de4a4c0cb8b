"""Keyframes: set, copied and removed through files, with parameters and masks that hold what they held elsewhere."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from icheat_usd.cli.program import run
from icheat_usd.edits.binding import bind
from icheat_usd.edits.model import Edit, Payload
from icheat_usd.edits.painting import paint_mask, soft_sphere
from icheat_usd.errors import EditError
from icheat_usd.session import Session, authoring, keys
from icheat_usd.stage import open_stage
from icheat_usd.stage.edit_stack import read_edit_stack
from icheat_usd.stage.layers import find_layer
from tests.stage.edit_stages import SURFACES, layer, shot_stage

STACK = "/World/Edits"
WARM = f"{STACK}/warm"


@pytest.fixture
def stage(tmp_path: Path) -> Usd.Stage:
    """A shot over a sequence; the sequence's edit has an authored gain and painted receivers, and no keys."""
    stage = shot_stage(tmp_path)
    session = Session.open(stage, camera="/World/camera", frame=1)
    session.add_edit(
        "warm",
        layer="seq.usda",
        receivers=["floor"],
        casters=["Room"],
        parameters={"gain": 0.5},
        receiver_brush=soft_sphere(tuple(-np.array(session.snapshot.centre)), 0.1, 0.8),
    )
    return stage


def edit_at(stage: Usd.Stage, time: float) -> Edit:
    stack, _ = read_edit_stack(stage, STACK, time, SURFACES, authoring.read_payload)
    return stack.edits[0]


def gains(stage: Usd.Stage, time: float) -> list[tuple[float, float]]:
    """(gain, weight) of each key that takes part."""
    return [(k.payload.parameters["gain"], k.weight) for k in edit_at(stage, time).keys if k.payload]


def payload_at(stage: Usd.Stage, time: float) -> Payload:
    (key,) = edit_at(stage, time).keys
    assert key.payload is not None
    return key.payload


def test_a_parameter_that_held_at_all_times_is_keyed_from_then_on(stage: Usd.Stage) -> None:
    before = payload_at(stage, 1)
    assert keys.set_key(stage, WARM, layer="seq.usda", frame=1) == ()
    assert keys.set_key(stage, WARM, layer="seq.usda", frame=11, parameters={"gain": 2.5}) == ()
    assert gains(stage, 1) == [(0.5, 1.0)]  # as it was authored, though the authored value is gone
    assert gains(stage, 11) == [(2.5, 1.0)]
    assert gains(stage, 6) == [(0.5, 0.5), (2.5, 0.5)]
    assert not stage.GetPrimAtPath(WARM).GetAttribute("icheat:scale:gain").HasAuthoredValue()
    for time in (1, 11):
        mask = payload_at(stage, time).receiver_mask
        assert mask is not None and before.receiver_mask is not None
        np.testing.assert_array_equal(mask.texels, before.receiver_mask.texels)
        assert mask.rest is not None
    # And all of it is in the files.
    assert gains(open_stage(stage.GetRootLayer().realPath), 11) == [(2.5, 1.0)]


def test_keys_hold_what_operations_would_bake_for_readers_that_do_not_know_them(stage: Usd.Stage) -> None:
    keys.set_key(stage, WARM, layer="seq.usda", frame=11, parameters={"gain": 2.5, "color": (1.0, 0.5, 0.0)})
    assert payload_at(stage, 11).scale_delta == (1.5, 0.25, -1.0)


def test_what_is_baked_of_other_keys_goes_where_it_no_longer_holds(stage: Usd.Stage) -> None:
    """As a factor, the colour is the same for all pairs; in place of the casters' own it is not."""
    session = Session.open(stage, camera="/World/camera", frame=1)
    edit = session.add_edit("other", layer="seq.usda", operation="albedo", receivers=["floor"], casters=["Room"])
    keys.set_key(stage, edit, layer="seq.usda", frame=1, parameters={"color": (0.5, 0.5, 0.5), "replace": False})

    def baked(time: float) -> tuple[float, float, float] | None:
        stack, _ = read_edit_stack(stage, STACK, time, SURFACES, authoring.read_payload)
        (key,) = stack.edits[1].keys
        assert key.payload is not None
        return key.payload.scale_delta

    assert baked(1) == (-0.5, -0.5, -0.5)
    session.set_edit(edit, layer="seq.usda", parameters={"replace": True})
    keys.set_key(stage, edit, layer="seq.usda", frame=11, parameters={"replace": True})
    assert baked(1) is None and baked(11) is None


def test_values_that_other_keys_held_follow_when_a_parameter_is_authored_and_keyed_again(stage: Usd.Stage) -> None:
    for frame, gain in ((1, 2.0), (21, 4.0)):
        keys.set_key(stage, WARM, layer="seq.usda", frame=frame, parameters={"gain": gain})
    authoring.set_edit(stage, WARM, layer="seq.usda", parameters={"gain": 3.0})
    assert gains(stage, 21) == [(3.0, 1.0)]
    keys.set_key(stage, WARM, layer="seq.usda", frame=11, parameters={"gain": 9.0})
    assert [gains(stage, time) for time in (1, 11, 21)] == [[(3.0, 1.0)], [(9.0, 1.0)], [(3.0, 1.0)]]


def test_a_shot_keys_what_the_sequence_authored_by_blocking_it(stage: Usd.Stage) -> None:
    before = layer(stage, "seq.usda").ExportToString()
    assert keys.set_key(stage, WARM, layer="shot.usda", frame=1) == ()
    assert keys.set_key(stage, WARM, layer="shot.usda", frame=5, parameters={"gain": 4.0}) == ()
    assert gains(stage, 1) == [(0.5, 1.0)] and gains(stage, 5) == [(4.0, 1.0)]
    assert layer(stage, "seq.usda").ExportToString() == before
    sidecars = {Path(key.file).name for key in keys.list_keys(stage, WARM).keys}
    assert sidecars and all(name.startswith("shot.v") for name in sidecars)


def test_a_stronger_layer_that_decides_the_parameter_is_a_finding(stage: Usd.Stage) -> None:
    authoring.set_edit(stage, WARM, layer="shot.usda", parameters={"gain": 7.0})
    findings = keys.set_key(stage, WARM, layer="seq.usda", frame=5, parameters={"gain": 4.0})
    assert len(findings) == 1 and "shot.usda decides it at all times" in findings[0].message


def test_a_key_between_two_others_is_as_the_edit_was_there(stage: Usd.Stage) -> None:
    session = Session.open(stage, camera="/World/camera", frame=1)
    for frame, radius in ((1, 0.5), (11, 1.2)):
        brush = soft_sphere(tuple(-np.array(session.snapshot.centre)), 0.1, radius)
        session.set_key(WARM, layer="seq.usda", frame=frame, receiver_brush=brush, parameters={"gain": 1.0 + frame})
    first, last = payload_at(stage, 1), payload_at(stage, 11)
    assert keys.set_key(stage, WARM, layer="seq.usda", frame=6) == ()
    middle = payload_at(stage, 6)
    assert middle.parameters["gain"] == 7.0
    assert first.receiver_mask and last.receiver_mask and middle.receiver_mask
    mean = 0.5 * (first.receiver_mask.texels + last.receiver_mask.texels)
    assert np.abs(first.receiver_mask.texels - last.receiver_mask.texels).max() > 0.5
    np.testing.assert_allclose(middle.receiver_mask.texels, mean, atol=0.51 / 255)


def test_a_key_beside_the_identity_is_at_full_strength_and_a_finding(stage: Usd.Stage) -> None:
    keys.set_key(stage, WARM, layer="seq.usda", frame=1)
    keys.set_key(stage, WARM, layer="seq.usda", frame=11, identity=True)
    (finding,) = keys.set_key(stage, WARM, layer="seq.usda", frame=6)
    assert "identity" in finding.message and gains(stage, 6) == gains(stage, 1)


def test_a_value_for_all_frames_says_which_keys_it_hides(stage: Usd.Stage) -> None:
    keys.set_key(stage, WARM, layer="seq.usda", frame=1, parameters={"gain": 1.0})
    keys.set_key(stage, WARM, layer="seq.usda", frame=11, parameters={"gain": 4.0})
    assert [key.parameters["gain"] for key in keys.list_keys(stage, WARM).keys] == [1.0, 4.0]
    assert authoring.set_edit(stage, WARM, layer="shot.usda", amount=0.5) == ()
    # The colour is the same at both keys, so that nothing is lost.
    assert authoring.set_edit(stage, WARM, layer="shot.usda", parameters={"color": (1.0, 0.5, 1.0)}) == ()
    (finding,) = authoring.set_edit(stage, WARM, layer="shot.usda", parameters={"gain": 2.0})
    assert finding.feature == "icheat:scale:gain" and "hides the keys at 1, 11" in finding.message
    assert [key.parameters["gain"] for key in keys.list_keys(stage, WARM).keys] == [2.0, 2.0]
    (told,) = keys.set_key(stage, WARM, layer="shot.usda", frame=1, parameters={"gain": 1.0})
    assert "was 2 at all frames, so the key at 11 has that now" in told.message
    assert [key.parameters["gain"] for key in keys.list_keys(stage, WARM).keys] == [1.0, 2.0]


def test_identity_keys_and_interpolations(stage: Usd.Stage) -> None:
    keys.set_key(stage, WARM, layer="seq.usda", frame=1)
    keys.set_key(stage, WARM, layer="seq.usda", frame=11, identity=True, interpolation="smooth")
    assert [key.weight for key in edit_at(stage, 3).keys] == pytest.approx([1 - 0.104, 0.104])
    keys.set_interpolation(stage, WARM, layer="shot.usda", interpolation="held")
    assert [key.weight for key in edit_at(stage, 3).keys] == [1.0]
    listed = keys.list_keys(stage, WARM)
    assert listed.interpolation == "held" and [key.payload == "" for key in listed.keys] == [False, True]
    with pytest.raises(EditError, match="identity key has no parameters"):
        keys.set_key(stage, WARM, layer="seq.usda", frame=1, identity=True, parameters={"gain": 1.0})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"parameters": {"gian": 1.0}}, "no parameter 'gian'"),
        ({"parameters": {"gain": float("nan")}}, "gain"),
        ({"interpolation": "bouncy"}, "linear, smooth, held"),
        ({"sidecar": "/nowhere/at/all"}, "nowhere"),
        ({"layer": "other.usda"}, "other.usda"),
    ],
)
def test_a_refused_key_leaves_layers_and_folder_as_they_were(
    stage: Usd.Stage, tmp_path: Path, values: dict[str, object], message: str
) -> None:
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    arguments = {"layer": "seq.usda", "frame": 3.0, "parameters": {"gain": 2.0}, **values}
    with pytest.raises((EditError, OSError, Exception), match=message) as error:
        keys.set_key(stage, WARM, **arguments)  # type: ignore[arg-type]
    assert type(error.value).__module__ == "icheat_usd.errors"
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    assert not find_layer(stage, "seq.usda").dirty


def test_a_layer_that_cannot_be_saved_says_what_it_said(stage: Usd.Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    for frame in (1, 11):
        keys.set_key(stage, WARM, layer="seq.usda", frame=frame)
    before = layer(stage, "seq.usda").ExportToString()

    def refuse(target: object) -> None:
        raise EditError("no space")

    monkeypatch.setattr("icheat_usd.stage.layers.save_layer", refuse)
    for change in (
        lambda: keys.set_key(stage, WARM, layer="seq.usda", frame=5, parameters={"gain": 4.0}),
        lambda: keys.set_key(stage, WARM, layer="seq.usda", frame=5, identity=True),
        lambda: keys.copy_key(stage, WARM, layer="seq.usda", frame=1, to=5),
        lambda: keys.remove_key(stage, WARM, layer="seq.usda", frame=1),
        lambda: keys.set_interpolation(stage, WARM, layer="seq.usda", interpolation="held"),
    ):
        with pytest.raises(EditError, match="no space"):
            change()
        assert layer(stage, "seq.usda").ExportToString() == before


def test_an_unchanged_payload_is_named_again_and_not_written_again(stage: Usd.Stage, tmp_path: Path) -> None:
    digest = edit_at(stage, 1).keys[0].digest
    files = sorted(tmp_path.glob("*.h5"))
    keys.set_key(stage, WARM, layer="seq.usda", frame=4)
    keys.copy_key(stage, WARM, layer="seq.usda", frame=4, to=9)
    assert [key.payload for key in keys.list_keys(stage, WARM).keys] == [digest, digest]
    assert sorted(tmp_path.glob("*.h5")) == files


def test_the_command_line_sets_lists_copies_and_removes_keys(
    stage: Usd.Stage, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shot = str(tmp_path / "shot.usda")

    def icheat(*words: str) -> dict[str, object]:
        status = run(["key", words[0], shot, "warm", *words[1:], "--json"])
        said = json.loads(capsys.readouterr().out)
        return {"status": status, **said}

    assert icheat("list")["keys"][0]["time"] is None  # type: ignore[index]
    sequence = ("--layer", "seq.usda")
    assert icheat("set", "--frame", "1", *sequence)["status"] == 0
    assert icheat("set", "--frame", "11", "--set", "gain=2.5", "--interpolation", "smooth", *sequence)["status"] == 0
    painted = icheat("set", "--frame", "21", "--receiver-sphere", "0,0,0,0.1,2.5", *sequence, "--why", "wider")
    assert painted["status"] == 0 and painted["version"] == 1
    assert icheat("copy", "--from", "11", "--frame", "15", *sequence)["status"] == 0
    assert icheat("remove", "--frame", "11", *sequence)["status"] == 0
    listed = icheat("list")
    assert [key["time"] for key in listed["keys"]] == [1.0, 15.0, 21.0]  # type: ignore[attr-defined]
    assert listed["interpolation"] == "smooth" and str(listed["layer"]).endswith("seq.usda")
    fresh = open_stage(shot)
    assert gains(fresh, 15) == [(2.5, 1.0)] and gains(fresh, 21) == [(2.5, 1.0)]
    narrow, wide = (payload_at(fresh, time).receiver_mask for time in (1, 21))
    assert narrow and wide and wide.texels.mean() > narrow.texels.mean()

    # The shot overrides one key: it copies all and notes where from.
    assert icheat("set", "--frame", "15", "--set", "gain=5")["status"] == 0
    listed = icheat("list")
    assert str(listed["copied_from"]).endswith("seq.usda") and listed["is_current"] is True
    assert icheat("remove", "--frame", "21", *sequence)["status"] == 1  # decided by the shot by now
    listed = icheat("list")
    assert listed["status"] == 1 and listed["is_current"] is False

    assert run(["key", "list", shot, "warm"]) == 1
    text = capsys.readouterr().out
    assert "smooth  decided by" in text and "which has other keys by now" in text and text.count(".icheat.h5") == 3
    assert run(["key", "remove", shot, "warm", "--frame", "2"]) == 2
    assert "no key at 2; it has keys at 1, 15, 21" in capsys.readouterr().err
    assert run(["key", "set", shot, "warm"]) == 2
    assert "give --frame" in capsys.readouterr().err
    assert run(["key", "set", shot, "warm", "--interpolation", "linear"]) == 0
    assert keys.list_keys(open_stage(shot), WARM).interpolation == "linear"


def test_splines_and_samples_of_amount_and_parameters_are_read_at_the_frame(stage: Usd.Stage) -> None:
    prim = stage.GetPrimAtPath(WARM)
    amount = prim.GetAttribute("icheat:amount")
    for time, value in ((1.0, 0.0), (11.0, 1.0)):
        amount.Set(value, time)
    gain = prim.GetAttribute("icheat:scale:gain")
    gain.Clear()
    for time, value in ((1.0, 2.0), (11.0, 4.0)):
        gain.Set(value, time)
    assert edit_at(stage, 6).amount == 0.5 and edit_at(stage, 8.5).parameters["gain"] == 3.5
    try:
        from pxr import Ts

        spline = Ts.Spline("float")
        for time, value in ((1.0, 0.0), (11.0, 1.0)):
            knot = Ts.Knot("float")
            knot.SetTime(time)
            knot.SetValue(value)
            knot.SetNextInterpolation(Ts.InterpCurve)
            knot.SetPreTanWidth(10.0 / 3)
            knot.SetPostTanWidth(10.0 / 3)
            spline.SetKnot(knot)
        amount.Clear()
        amount.SetSpline(spline)
    except (ImportError, AttributeError):
        pytest.skip("this USD has no splines, or another interface to them")
    eased = [edit_at(stage, time).amount for time in (1.0, 2.0, 6.0, 10.0, 11.0)]
    # Flat tangents of a third of the way: the curve is the smoothstep.
    smooth = [3 * x * x - 2 * x**3 for x in (0.0, 0.1, 0.5, 0.9, 1.0)]
    assert eased == pytest.approx(smooth, abs=1e-5)


def test_a_mesh_that_was_rebuilt_keeps_its_painted_edit_and_is_a_finding(stage: Usd.Stage) -> None:
    def painted() -> Session:
        return Session.open(stage, camera="/World/camera", frame=1, width=8, height=6)

    assert not [f for f in painted().findings if f.feature == "painted mask"]
    floor = UsdGeom.Mesh.Get(stage, SURFACES[0])
    floor.GetPointsAttr().Set([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0.5, 0.5, 0)])
    floor.GetFaceVertexCountsAttr().Set([3, 3])
    floor.GetFaceVertexIndicesAttr().Set([0, 1, 3, 0, 3, 2])
    session = painted()
    (finding,) = [f for f in session.findings if f.feature == "painted mask"]
    assert finding.prim == WARM and "another topology of /World/floor (1 faces then, 2 now)" in finding.message
    snapshot = session.snapshot
    carried = bind(session.stack, snapshot).edits[0].receivers[0].mask
    assert carried is not None
    anew = paint_mask(snapshot, [SURFACES[0]], soft_sphere(tuple(-np.array(snapshot.centre)), 0.1, 0.8)).texels
    # Texels lie 1/16 apart, and the weights fall by 2.1 a metre at most.
    np.testing.assert_allclose(carried.texels[-len(anew) :], anew, atol=0.5 * np.sqrt(2) / 16 * 2.2)
    assert anew.min() == 0.0 and anew.max() > 0.8


def test_keys_of_a_variant_are_written_into_it_and_leave_the_others(stage: Usd.Stage) -> None:
    sequence = layer(stage, "seq.usda")
    alone = Usd.Stage.Open(sequence)
    grades = alone.GetPrimAtPath(STACK).GetVariantSets().AddVariantSet("grade")
    for name in ("day", "dusk"):
        grades.AddVariant(name)
    grades.SetVariantSelection("day")
    sequence.Save()
    # Where opinions beside the variant exist they are stronger, so that the variant cannot decide.
    assert keys.set_key(stage, WARM, layer="seq.usda", frame=5, parameters={"gain": 3.0}, variant=("grade", "dusk"))
    fresh = open_stage(stage.GetRootLayer().realPath)
    authoring.add_edit(
        fresh, STACK, "cool", layer="seq.usda", receivers=["floor"], casters=["Room"], variant=("grade", "dusk")
    )
    cool, dusk = f"{STACK}/cool", ("grade", "dusk")
    for frame, gain in ((1.0, 2.0), (11.0, 4.0)):
        assert not keys.set_key(fresh, cool, layer="seq.usda", frame=frame, parameters={"gain": gain}, variant=dusk)
    assert not keys.copy_key(fresh, cool, layer="seq.usda", frame=11, to=21, variant=dusk)
    assert not keys.remove_key(fresh, cool, layer="seq.usda", frame=11, variant=dusk)
    assert not keys.set_interpolation(fresh, cool, layer="seq.usda", interpolation="smooth", variant=dusk)
    assert not fresh.GetPrimAtPath(cool)  # day is still selected
    fresh.GetPrimAtPath(STACK).GetVariantSets().SetSelection("grade", "dusk")
    listed = keys.list_keys(fresh, cool)
    assert [key.time for key in listed.keys] == [1.0, 21.0] and listed.interpolation == "smooth"
    assert not listed.copied_from


def test_masks_of_two_keys_that_cover_other_surfaces_mix_with_nothing_where_one_has_none(stage: Usd.Stage) -> None:
    session = Session.open(stage, camera="/World/camera", frame=1)
    masks = []
    for paths, value in ((SURFACES[:1], 1.0), (SURFACES[:2], 0.5)):
        mask = paint_mask(session.snapshot, paths, lambda p, v=value: np.full(len(p), v))  # type: ignore[misc]
        masks.append(mask)
        keys.set_key(stage, WARM, layer="seq.usda", frame=10.0 * len(masks), receiver_mask=mask)
    assert [len(mask.surfaces) for mask in masks] == [1, 2]
    assert keys.set_key(stage, WARM, layer="seq.usda", frame=14) == ()
    mixed = payload_at(stage, 14).receiver_mask
    assert mixed is not None and mixed.rest is not None and mixed.rest.shape == (2, 2, 2, 3)
    found = {surface.path: float(texels.mean()) for surface, texels in zip(mixed.surfaces, mixed.texels, strict=True)}
    half = np.round(0.5 * 255) / 255
    assert found == pytest.approx({SURFACES[0]: 0.6 + 0.4 * half, SURFACES[1]: 0.4 * half}, abs=0.51 / 255)


def test_a_shot_replaces_the_payload_for_all_times_and_keeps_its_masks(stage: Usd.Stage) -> None:
    keys.set_key(stage, WARM, layer="seq.usda", frame=1, parameters={"gain": 2.0})
    keys.set_key(stage, WARM, layer="seq.usda", frame=9, parameters={"gain": 4.0})
    painted = payload_at(stage, 1).receiver_mask
    keys.set_key(stage, WARM, layer="shot.usda", frame=None, parameters={"gain": 7.0})
    assert gains(stage, 1) == gains(stage, 5) == gains(stage, 9) == [(7.0, 1.0)]
    assert [key.time for key in keys.list_keys(stage, WARM).keys] == [None]
    kept = payload_at(stage, 5).receiver_mask
    assert kept is not None and painted is not None and np.array_equal(kept.texels, painted.texels)
    assert layer(stage, "seq.usda").GetNumTimeSamplesForPath(f"{WARM}.icheat:payload") == 2


def test_the_command_line_sets_one_payload_for_all_times(
    stage: Usd.Stage, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shot = str(tmp_path / "shot.usda")
    assert run(["key", "set", shot, "warm", "--always", "--set", "gain=6", "--layer", "shot.usda"]) == 0
    assert gains(open_stage(shot), 3) == [(6.0, 1.0)]
    assert run(["key", "set", shot, "warm", "--always", "--frame", "3", "--layer", "shot.usda"]) == 2
    assert "give one of them" in capsys.readouterr().err
