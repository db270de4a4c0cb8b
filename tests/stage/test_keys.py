"""Keyframes: from the layer that wins, at exact times, whatever the layer offset."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pxr import Sdf, Usd

from icheat_usd.errors import EditError
from icheat_usd.stage import schema
from icheat_usd.stage.authoring import add_edit, create_stack, set_payload_key
from icheat_usd.stage.key_authoring import (
    copied_keys_are_current,
    copy_payload_key,
    remove_payload_key,
    set_key_interpolation,
)
from icheat_usd.stage.keys import Interpolation, Key, KeyTrack, read_keys, strongest_opinion
from tests.stage.edit_stages import DIGEST, OTHER, THIRD, layer, shot_stage

FILE = "./edits.v001.icheat.h5"


def keyed_edit(stage: Usd.Stage, samples: dict[float, str | None], name: str = "seq.usda") -> Usd.Prim:
    """An edit whose keys are authored at *layer* times, past all of our own authoring."""
    if not stage.GetPrimAtPath("/World/indirect"):
        create_stack(stage, "indirect", layer="seq.usda")
        add_edit(stage, "/World/indirect", "warm", layer="seq.usda", receivers=["floor"], casters=["Room"])
    path = Sdf.Path("/World/indirect/warm")
    target = layer(stage, name)
    prim_spec = Sdf.CreatePrimInLayer(target, path)
    for attribute, type_name in (
        (schema.FILE_PATH, Sdf.ValueTypeNames.Asset),
        (schema.PAYLOAD, Sdf.ValueTypeNames.Token),
    ):
        spec = prim_spec.attributes.get(attribute) or Sdf.AttributeSpec(prim_spec, attribute, type_name)
        for time, digest in samples.items():
            value = Sdf.AssetPath(FILE) if attribute == schema.FILE_PATH else digest
            target.SetTimeSample(spec.path, time, Sdf.ValueBlock() if digest is None else value)
    return stage.GetPrimAtPath(path)


def test_key_times_under_offset_and_scale_are_the_mapped_sample_times(tmp_path: Path) -> None:
    stage = shot_stage(tmp_path, offset=100, scale=2)
    prim = keyed_edit(stage, {1: DIGEST, 11: OTHER})
    track = read_keys(prim)
    assert track is not None
    assert [(key.time, key.digest) for key in track.keys] == [(102.0, DIGEST), (122.0, OTHER)]
    assert all(key.resolved == str(tmp_path / "edits.v001.icheat.h5") for key in track.keys)


@pytest.mark.parametrize(("offset", "scale"), [(100, 2), (1001, 24 / 25), (0, 1 / 3), (-7.1, 0.1)])
def test_a_key_holds_alone_at_its_own_time_for_any_layer_offset(tmp_path: Path, offset: float, scale: float) -> None:
    stage = shot_stage(tmp_path, offset, scale)
    layer_times = [i / 24 for i in range(0, 48, 5)]
    digests = [f"{i:064x}" for i in range(1, len(layer_times) + 1)]
    prim = keyed_edit(stage, dict(zip(layer_times, digests, strict=True)))
    track = read_keys(prim)
    assert track is not None
    assert track.times == tuple(offset + scale * time for time in layer_times)
    for time, digest in zip(layer_times, digests, strict=True):
        for asked in (scale * time + offset, (time + offset / scale) * scale):  # the second rounds otherwise
            assert [(key.digest, weight) for key, weight in track.at(asked)] == [(digest, 1.0)]


def test_each_key_finds_its_own_file_between_neighbours_that_are_close(tmp_path: Path) -> None:
    stage = shot_stage(tmp_path, offset=1000.1, scale=0.1)
    times = [1 + i / 24 for i in range(6)]
    prim = keyed_edit(stage, {time: f"{i:064x}" for i, time in enumerate(times, 1)})
    target = layer(stage, "seq.usda")
    for i, time in enumerate(times):
        (tmp_path / f"{i}.h5").write_bytes(b"x")
        target.SetTimeSample("/World/indirect/warm.icheat:filePath", time, Sdf.AssetPath(f"./{i}.h5"))
    track = read_keys(prim)
    assert track is not None
    assert [key.file for key in track.keys] == [f"./{i}.h5" for i in range(6)]
    assert [key.resolved for key in track.keys] == [str(tmp_path / f"{i}.h5") for i in range(6)]


def test_frame_rates_that_differ_between_layers_scale_key_times(tmp_path: Path) -> None:
    stage = shot_stage(tmp_path, offset=10)
    prim = keyed_edit(stage, {25: DIGEST, 50: OTHER})
    layer(stage, "seq.usda").timeCodesPerSecond = 25
    stage.GetRootLayer().timeCodesPerSecond = 24
    track = read_keys(prim)
    assert track is not None
    assert track.times == pytest.approx((34.0, 58.0), abs=1e-12)
    assert [prim.GetAttribute(schema.PAYLOAD).Get(t) for t in (57.99, 58.01)] == [DIGEST, OTHER]
    set_payload_key(
        stage, "/World/indirect/warm", layer="seq.usda", time=58, payload=(tmp_path / "edits.v001.icheat.h5", THIRD)
    )
    track = read_keys(prim)
    assert track is not None
    assert [key.digest for key in track.keys] == [DIGEST, THIRD]


def test_keys_interpolate_linearly_inside_and_hold_outside(tmp_path: Path) -> None:
    stage = shot_stage(tmp_path)
    prim = keyed_edit(stage, {10: DIGEST, 20: OTHER})
    track = read_keys(prim)
    assert track is not None

    def at(time: float | None) -> list[tuple[str, float]]:
        return [(key.digest, weight) for key, weight in track.at(time)]

    assert at(12.5) == [(DIGEST, 0.75), (OTHER, 0.25)]
    assert at(-100) == at(10) == at(None) == [(DIGEST, 1.0)]
    assert at(20) == at(1e6) == [(OTHER, 1.0)]


def test_held_keys_change_at_the_key(tmp_path: Path) -> None:
    stage = shot_stage(tmp_path)
    prim = keyed_edit(stage, {10: DIGEST, 20: OTHER})
    prim.GetAttribute(schema.KEY_INTERPOLATION).Set("held")
    track = read_keys(prim)
    assert track is not None
    assert [track.at(t)[0][0].digest for t in (10, 19.999, 20, 21)] == [DIGEST, DIGEST, OTHER, OTHER]


def test_a_blocked_sample_is_the_identity_at_its_time(tmp_path: Path) -> None:
    stage = shot_stage(tmp_path)
    prim = keyed_edit(stage, {10: DIGEST, 20: None, 30: OTHER})
    track = read_keys(prim)
    assert track is not None
    assert [(key.digest, weight) for key, weight in track.at(15)] == [(DIGEST, 0.5), ("", 0.5)]
    assert [(key.digest, weight) for key, weight in track.at(20)] == [("", 1.0)]


def test_a_blocked_default_in_a_stronger_layer_is_the_identity_at_all_times(tmp_path: Path) -> None:
    stage = shot_stage(tmp_path)
    prim = keyed_edit(stage, {10: DIGEST, 20: OTHER})
    prim.GetAttribute(schema.PAYLOAD).Block()
    track = read_keys(prim)
    assert track is not None and track.layer == stage.GetRootLayer().identifier
    assert [(key.digest, weight) for key, weight in track.at(15)] == [("", 1.0)]


def test_a_default_alone_is_one_key_for_all_times(tmp_path: Path) -> None:
    stage = shot_stage(tmp_path)
    prim = keyed_edit(stage, {})
    prim.GetAttribute(schema.PAYLOAD).Set(DIGEST)
    prim.GetAttribute(schema.FILE_PATH).Set(Sdf.AssetPath(FILE))
    track = read_keys(prim)
    assert track is not None and track.times == ()
    assert [(key.digest, weight) for key, weight in track.at(1234)] == [(DIGEST, 1.0)]


def test_an_edit_without_a_payload_has_no_keys(tmp_path: Path) -> None:
    stage = shot_stage(tmp_path)
    assert read_keys(keyed_edit(stage, {})) is None


def test_keys_of_a_stronger_layer_replace_all_of_a_weaker_one(tmp_path: Path) -> None:
    stage = shot_stage(tmp_path, offset=100, scale=2)
    keyed_edit(stage, {1: DIGEST, 11: OTHER})
    prim = keyed_edit(stage, {5: THIRD}, "shot.usda")
    track = read_keys(prim)
    assert track is not None
    assert [(key.time, key.digest) for key in track.keys] == [(5.0, THIRD)]


def test_file_and_payload_of_two_layers_are_an_error_that_names_both(tmp_path: Path) -> None:
    stage = shot_stage(tmp_path)
    prim = keyed_edit(stage, {1: DIGEST})
    prim.GetAttribute(schema.PAYLOAD).Set(OTHER)
    with pytest.raises(EditError, match=r"(?s)shot\.usda.*seq\.usda"):
        read_keys(prim)


def test_a_payload_without_a_file_is_an_error(tmp_path: Path) -> None:
    stage = shot_stage(tmp_path)
    prim = keyed_edit(stage, {})
    prim.GetAttribute(schema.PAYLOAD).Set(DIGEST)
    with pytest.raises(EditError, match="without icheat:filePath"):
        read_keys(prim)


def test_metadata_alone_does_not_win(tmp_path: Path) -> None:
    stage = shot_stage(tmp_path)
    prim = keyed_edit(stage, {1: DIGEST})
    prim.GetAttribute(schema.PAYLOAD).SetCustomDataByKey("note", "a comment in the shot")
    opinion = strongest_opinion(prim.GetAttribute(schema.PAYLOAD))
    assert opinion is not None and opinion.layer == layer(stage, "seq.usda")


def test_relative_files_anchor_to_the_layer_that_says_them(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    inner = shot_stage(tmp_path / "sub")
    keyed_edit(inner, {1: DIGEST})
    for each in inner.GetLayerStack(includeSessionLayers=False):
        each.Save()
    outer = Usd.Stage.CreateNew(str(tmp_path / "outer.usda"))
    outer.DefinePrim("/Set/shot").GetReferences().AddReference("./sub/shot.usda")
    track = read_keys(outer.GetPrimAtPath("/Set/shot/indirect/warm"))
    assert track is not None
    assert track.keys[0].resolved == str(tmp_path / "sub" / "edits.v001.icheat.h5")


def test_expression_variables_in_a_file_name_are_evaluated(tmp_path: Path) -> None:
    stage = shot_stage(tmp_path)
    prim = keyed_edit(stage, {1: DIGEST})
    stage.GetRootLayer().expressionVariables = {"VERSION": "v001"}
    target = layer(stage, "seq.usda")
    target.SetTimeSample("/World/indirect/warm.icheat:filePath", 1, Sdf.AssetPath('`"./edits.${VERSION}.icheat.h5"`'))
    track = read_keys(prim)
    assert track is not None
    assert track.keys[0].resolved == str(tmp_path / "edits.v001.icheat.h5")


@settings(max_examples=200, deadline=None)
@given(
    times=st.lists(st.integers(-1000, 1000), min_size=1, max_size=8, unique=True),
    asked=st.floats(-1100, 1100),
    interpolation=st.sampled_from(Interpolation),
)
def test_weights_are_a_partition_and_reproduce_a_line(
    times: list[int], asked: float, interpolation: Interpolation
) -> None:
    ordered = sorted(times)
    track = KeyTrack(tuple(Key(float(t), f"{i}") for i, t in enumerate(ordered)), interpolation, "layer")
    share = track.at(asked)
    assert abs(sum(weight for _, weight in share) - 1.0) < 1e-12 and all(weight > 0 for _, weight in share)
    if interpolation is Interpolation.LINEAR:
        value = sum(weight * float(key.time or 0.0) for key, weight in share)
        assert abs(value - min(max(asked, ordered[0]), ordered[-1])) < 1e-5


def test_smooth_keys_ease_at_both_ends_and_meet_the_line_half_way() -> None:
    keys = (Key(10.0, "a"), Key(20.0, "b"))
    smooth = KeyTrack(keys, Interpolation.SMOOTH, "layer")
    share = [{key.digest: weight for key, weight in smooth.at(t)}.get("b", 0.0) for t in range(10, 21)]
    assert share[0] == 0.0 and share[10] == 1.0 and share[5] == 0.5
    assert share == pytest.approx([3 * x**2 - 2 * x**3 for x in (i / 10 for i in range(11))], abs=1e-12)
    assert share[1] < 0.03 and share[9] > 0.97


def test_the_digest_of_a_track_tells_interpolations_apart_and_stays_what_layers_have_noted() -> None:
    keys = (Key(1.0, DIGEST), Key(11.0, OTHER))
    digests = {kind: KeyTrack(keys, kind, "layer").digest for kind in Interpolation}
    assert len(set(digests.values())) == 3
    text = repr([(1.0, DIGEST), (11.0, OTHER)])
    assert digests[Interpolation.LINEAR] == hashlib.sha256(f"{text}False".encode()).hexdigest()
    assert digests[Interpolation.HELD] == hashlib.sha256(f"{text}True".encode()).hexdigest()


def test_an_unknown_interpolation_is_one_clear_error(tmp_path: Path) -> None:
    stage = shot_stage(tmp_path)
    prim = keyed_edit(stage, {1: DIGEST})
    prim.GetAttribute(schema.KEY_INTERPOLATION).Set("bouncy")
    with pytest.raises(EditError, match="is 'bouncy', expected one of linear, smooth, held"):
        read_keys(prim)


def test_a_key_is_copied_and_removed_and_the_last_one_stays(tmp_path: Path) -> None:
    stage = shot_stage(tmp_path, offset=100, scale=2)
    prim = keyed_edit(stage, {1: DIGEST, 11: OTHER})
    copy_payload_key(stage, str(prim.GetPath()), layer="seq.usda", time=102, to=112)
    assert key_list(prim) == [(102.0, DIGEST), (112.0, DIGEST), (122.0, OTHER)]
    remove_payload_key(stage, str(prim.GetPath()), layer="seq.usda", time=122)
    assert key_list(prim) == [(102.0, DIGEST), (112.0, DIGEST)]
    with pytest.raises(EditError, match="no key at 122; it has keys at 102, 112"):
        remove_payload_key(stage, str(prim.GetPath()), layer="seq.usda", time=122)
    remove_payload_key(stage, str(prim.GetPath()), layer="seq.usda", time=102)
    with pytest.raises(EditError, match="its only key is at 112"):
        remove_payload_key(stage, str(prim.GetPath()), layer="seq.usda", time=112)


def test_a_shot_that_removes_a_key_copies_the_others_and_notes_where_from(tmp_path: Path) -> None:
    stage = shot_stage(tmp_path, offset=100, scale=2)
    prim = keyed_edit(stage, {1: DIGEST, 11: OTHER, 21: THIRD})
    before = layer(stage, "seq.usda").ExportToString()
    remove_payload_key(stage, str(prim.GetPath()), layer="shot.usda", time=122)
    assert key_list(prim) == [(102.0, DIGEST), (142.0, THIRD)]
    assert layer(stage, "seq.usda").ExportToString() == before
    assert copied_keys_are_current(prim) == (layer(stage, "seq.usda").identifier, True)
    set_key_interpolation(stage, str(prim.GetPath()), layer="shot.usda", interpolation="smooth")
    track = read_keys(prim)
    assert track is not None and track.interpolation is Interpolation.SMOOTH
    assert copied_keys_are_current(prim) == (layer(stage, "seq.usda").identifier, True)  # its keys did not change
    layer(stage, "seq.usda").SetTimeSample(f"{prim.GetPath()}.icheat:payload", 1, THIRD)
    assert copied_keys_are_current(prim) == (layer(stage, "seq.usda").identifier, False)


def key_list(prim: Usd.Prim) -> list[tuple[float | None, str]]:
    track = read_keys(prim)
    return [(key.time, key.digest) for key in track.keys] if track else []
