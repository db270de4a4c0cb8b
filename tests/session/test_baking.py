"""Baking through layers and sidecars: payloads gain rows, opinions stay live, stacks freeze into one edit."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from icheat_usd.cli.program import run
from icheat_usd.errors import EditError
from icheat_usd.session import Quality, Session
from icheat_usd.session.baking import Shot, bake_edits, bakeable_edits
from icheat_usd.session.flattening import flatten_stack
from icheat_usd.session.keys import list_keys, set_key
from icheat_usd.sidecar import read_payload
from icheat_usd.stage import open_stage

SAMPLES = Path(__file__).parents[2] / "sample_stages"
QUALITY = Quality(n_gather=256, rays_per_row=64, rays_per_bounce_row=32, light_samples=4, n_bounces=4)
SHOT = Shot(width=24, height=18, quality=QUALITY)
FALLOFF, SCALE = "/World/Edits/falloff", "/World/Edits/scale"


@pytest.fixture
def operations(tmp_path):
    shutil.copytree(SAMPLES, tmp_path / "stages")
    return tmp_path / "stages" / "operations"


def session(stage, frame=None) -> Session:
    return Session.open(stage, frame=frame, width=24, height=18, quality=QUALITY)


def indirect(film, name="indirect_edited"):
    return film.layers[name].astype(np.float64)


def test_payloads_keep_the_recipe_and_gain_rows(operations):
    stage = open_stage(operations / "falloff.usda")
    before = session(stage).relight()
    (key,) = bake_edits(stage, [FALLOFF], layer="falloff.usda", shot=SHOT, why="for the farm").keys
    payload = read_payload(key.file, key.payload, anchor="/World")
    assert payload.operation == "falloff" and payload.rows is not None
    assert payload.parameters["exponent"] == session(stage).stack.edits[0].parameters["exponent"]
    assert payload.made_against["width"] == 24 and "surfaces" in payload.made_against
    assert key.cheapest == "recipe" and key.time is None and 0 < key.epsilon_scale <= 0.0101
    # The recipe is still what is evaluated.
    assert np.array_equal(indirect(session(stage).relight()), indirect(before))


def test_rows_alone_give_the_image_of_the_recipe_within_their_bound(operations):
    stage = open_stage(operations / "falloff.usda")
    before = session(stage).relight()
    (key,) = bake_edits(stage, [FALLOFF], layer="falloff.usda", shot=SHOT, epsilon=0.05, forget_recipe=True).keys
    assert session(open_stage(operations / "falloff.usda")).stack.edits[0].operation == "baked"
    after = session(stage).relight()
    unedited = indirect(before, "indirect")
    assert np.abs(indirect(before) - unedited).max() > 0.05
    bound = max(key.epsilon_scale, key.measured_error) + 1e-4
    assert (np.abs(indirect(after) - indirect(before)) <= bound * unedited + 1e-5).all()
    # Amount stays live.
    session(stage).set_edit(FALLOFF, layer="falloff.usda", amount=0.5)
    half = session(stage).relight()
    change = 0.5 * (indirect(after) - unedited)
    assert np.allclose(indirect(half) - unedited, change, atol=2e-4 + 1e-3 * np.abs(change).max())


def test_every_key_is_baked_at_its_own_time(operations):
    stage = open_stage(operations / "scale.usda")
    for frame, gain in ((1.0, 2.0), (11.0, 0.0)):
        set_key(stage, SCALE, layer="scale.usda", frame=frame, parameters={"gain": gain})
    before = [session(stage, frame).relight() for frame in (1.0, 6.0, 11.0)]
    done = bake_edits(stage, [SCALE], layer="scale.usda", shot=SHOT, forget_recipe=True)
    assert [key.time for key in done.keys] == [1.0, 11.0]
    assert len({key.file for key in done.keys}) == 1
    for frame, film in zip((1.0, 6.0, 11.0), before, strict=True):
        assert np.allclose(indirect(session(stage, frame).relight()), indirect(film), atol=1e-4)
    assert [key.time for key in list_keys(stage, SCALE).keys] == [1.0, 11.0]


def test_a_stack_freezes_into_one_edit(operations):
    stage = open_stage(operations / "scale.usda")
    room = session(stage)
    room.add_edit(
        "second",
        layer="scale.usda",
        operation="scale",
        parameters={"gain": 3.0},
        receivers=list(room.stack.edits[0].receivers.paths),
        casters=list(room.stack.edits[0].casters.paths),
        amount=0.5,
    )
    before = session(stage).relight()
    (key,) = flatten_stack(stage, "Frozen", layer="scale.usda", shot=SHOT).keys
    stack = session(stage).stack
    assert [edit.name for edit in stack.active] == ["Frozen"]
    assert stack.active[0].operation == "baked"
    assert np.abs(indirect(before) - indirect(before, "indirect")).max() > 0.01
    allowed = key.measured_error + 1e-4
    after = session(stage).relight()
    assert (np.abs(indirect(after) - indirect(before)) <= allowed * indirect(before, "indirect") + 1e-5).all()


def test_freezing_puts_keys_only_where_they_are_needed(operations):
    """The amount falls along a straight line to 0 at frame 5 and stays: keys at 1, 5 and 9, and none between."""
    stage = open_stage(operations / "scale.usda")
    for frame, amount in ((1.0, 1.0), (5.0, 0.0)):
        session(stage).set_edit(SCALE, layer="scale.usda", amount=amount, time=frame)
    session(stage).set_edit(SCALE, layer="scale.usda", amount=0.0, time=9.0)
    done = flatten_stack(stage, "Frozen", layer="scale.usda", shot=SHOT, frames=[1.0, 3.0, 5.0, 7.0, 9.0])
    assert [key.time for key in done.keys] == [1.0]
    keys = list_keys(stage, "/World/Edits/Frozen").keys
    assert [(key.time, bool(key.payload)) for key in keys] == [(1.0, True), (5.0, False), (9.0, False)]


def test_what_cannot_be_baked_is_refused_and_nothing_is_left_behind(operations):
    stage = open_stage(operations / "unshadow.usda")
    files = sorted(p.name for p in operations.iterdir())
    with pytest.raises(EditError, match="no edit that rows could hold"):
        bakeable_edits(stage, "/World/Edits")
    with pytest.raises(EditError, match="behind occluders"):
        bake_edits(stage, ["/World/Edits/unshadow"], layer="unshadow.usda", shot=SHOT)
    with pytest.raises(EditError, match="no edit"):
        bake_edits(stage, ["/World/Edits/nothing"], layer="unshadow.usda", shot=SHOT)
    assert sorted(p.name for p in operations.iterdir()) == files


def test_what_is_half_way_to_the_identity_has_no_recipe_to_keep(operations):
    stage = open_stage(operations / "falloff.usda")
    set_key(stage, FALLOFF, layer="falloff.usda", frame=1, parameters={"exponent": 1.0})
    set_key(stage, FALLOFF, layer="falloff.usda", frame=9, identity=True)
    with pytest.raises(EditError, match="half way to the identity at frame 5"):
        bake_edits(stage, [FALLOFF], layer="falloff.usda", shot=SHOT, frames=[5])


def test_light_and_blend_are_warned_about(operations):
    stage = open_stage(operations / "hsv.usda")
    done = bake_edits(stage, ["/World/Edits/hsv"], layer="hsv.usda", shot=SHOT)
    (finding,) = done.findings
    assert "lights as they are now" in finding.message and "weaker" not in finding.message
    session(stage).add_edit("weaker", layer="hsv.usda", receivers=["Geometry"], casters=["Geometry"], before="hsv")
    (finding,) = bake_edits(stage, ["/World/Edits/hsv"], layer="hsv.usda", shot=SHOT).findings
    assert "flatten the stack" in finding.message


def test_rows_of_an_edit_of_some_lights_look_at_these_alone(operations):
    """The sun's light turned blue stays what it was when the rows were made from it, not from all lights together."""
    stage = open_stage(operations / "one_light.usda")
    edit = "/World/Edits/one_light"
    session(stage).set_edit(edit, layer="one_light.usda", operation="hsv", parameters={"hue": 90.0})
    before = session(stage).relight()
    (key,) = bake_edits(stage, [edit], layer="one_light.usda", shot=SHOT, forget_recipe=True).keys
    after = session(stage).relight()
    change = indirect(before) - indirect(before, "indirect")
    assert np.abs(change).max() > 0.05
    assert np.abs(indirect(after) - indirect(before)).mean() < 0.05 * np.abs(change).mean()


def test_a_layer_that_cannot_be_saved_is_as_before(operations, monkeypatch):
    stage = open_stage(operations / "scale.usda")
    text = stage.GetRootLayer().ExportToString()
    files = sorted(p.name for p in operations.iterdir())

    def refuse(layer):
        raise EditError("no space")

    monkeypatch.setattr("icheat_usd.stage.layers.save_layer", refuse)
    for bake in (
        lambda: bake_edits(stage, [SCALE], layer="scale.usda", shot=SHOT, forget_recipe=True),
        lambda: flatten_stack(stage, "Frozen", layer="scale.usda", shot=SHOT),
    ):
        with pytest.raises(EditError, match="no space"):
            bake()
        assert stage.GetRootLayer().ExportToString() == text
        assert sorted(p.name for p in operations.iterdir()) == files


def test_the_command_line_bakes_and_says_what_it_costs(operations, capsys):
    stage = str(operations / "falloff.usda")
    size = ["--width", "24", "--height", "18", "--gather", "256"]
    assert run(["bake", stage, "falloff", "--coefficients", "20", *size]) == 0
    text = capsys.readouterr().out
    assert "MB" in text and "scale within" in text and "cheapest exact form: recipe" in text
    assert run(["bake", stage, "--epsilon", "0.1", "--forget-recipe", "--json", *size]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["version"] == 1
    (key,) = report["keys"]
    assert key["epsilon_scale"] <= 0.0501 and key["stored_bytes"] > 0 and key["sites"] >= key["rows"] > 0
    assert run(["bake", stage, "nothing", *size]) == 2
    assert "has no edit 'nothing'" in capsys.readouterr().err
    # The operation is "baked" now: nothing to bake it from.
    assert run(["bake", stage, "falloff", *size]) == 2
    assert "not known here" in capsys.readouterr().err


def test_a_bound_must_be_above_0(operations, capsys):
    assert run(["bake", str(operations / "falloff.usda"), "--epsilon", "0"]) == 2
    assert "not above 0" in capsys.readouterr().err
