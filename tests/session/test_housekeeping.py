"""Pack, publish, upgrade, collect and history, on files as artists have them."""

from __future__ import annotations

import json
import os
import shutil
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from pxr import Sdf, Usd

from icheat_usd.cli.program import CLEAN, FAILURE, FINDINGS, run
from icheat_usd.edits.model import Payload
from icheat_usd.errors import EditError, IcheatError
from icheat_usd.session import authoring, housekeeping, inspection, payload_history, publishing
from icheat_usd.sidecar import is_published, list_aliases, list_payloads, read_history, read_payload, write_payloads
from icheat_usd.stage import authoring as stage_authoring
from icheat_usd.stage.locking import locked
from icheat_usd.stage.sidecar_uses import sidecar_uses
from icheat_usd.stage.snapshot import take_snapshot
from tests.robustness.writer import make_stage

GOLDEN = Path(__file__).parents[1] / "golden" / "v0.1.0" / "every-element.icheat.h5"
EDIT = "/World/Edits/warm"


@pytest.fixture
def shot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A shot with one edit, whose payload was written twice: v001 is named by nothing any more."""
    monkeypatch.setenv("ICHEAT_USER", "ann@studio")
    stage_file = make_stage(tmp_path / "show")
    stage = inspection.open_stage(stage_file)
    authoring.add_edit(
        stage, "/World/Edits", "warm", layer="shot.usda", receivers=["Floor"], casters=["Wall"], why="warmer floor"
    )
    file, (digest,) = write_payloads(
        stage_file, [Payload("scale", {"gain": 0.5})], anchor="/World", history=authoring.history_entry("less", EDIT)
    )
    stage_authoring.set_payload_key(stage, EDIT, layer="shot.usda", time=None, payload=(file, digest))
    stage_authoring.save_layer(stage.GetRootLayer())
    return stage_file


def _age(folder: Path) -> None:
    for file in folder.rglob("*.icheat.h5"):
        os.utime(file, (time.time() - 3 * 86400,) * 2)


def _names(layer: Path) -> set[str]:
    return {os.path.basename(file) for file in sidecar_uses([str(layer)], follow=False).files}


# Collecting -----------------------------------------------------------------------------------------------------------


def test_gc_says_what_it_would_move_and_moves_it_only_when_told(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = shot.parent
    assert run(["gc", str(folder)]) == CLEAN
    assert "spared" in capsys.readouterr().out and (folder / "shot.v001.icheat.h5").exists()
    _age(folder)
    content = (folder / "shot.v001.icheat.h5").read_bytes()
    assert run(["gc", str(folder), "--json"]) == CLEAN
    said = json.loads(capsys.readouterr().out)
    assert [os.path.basename(item["file"]) for item in said["unnamed"]] == ["shot.v001.icheat.h5"]
    assert said["bytes"] == len(content) and said["version"] == 1 and not said["moved"]
    assert (folder / "shot.v001.icheat.h5").exists()

    assert run(["gc", str(shot), "--move"]) == CLEAN
    out = capsys.readouterr().out
    assert f"{len(content):,} bytes: moved" in out and ".icheat-trash" in out
    (moved,) = (folder / ".icheat-trash").rglob("*.icheat.h5")
    assert moved.read_bytes() == content and not (folder / "shot.v001.icheat.h5").exists()
    assert not inspection.check(inspection.open_stage(shot))
    # What is in the trash is not looked at again, and moving it back restores it.
    assert not housekeeping.collect([str(folder)], move=True).unnamed
    moved.rename(folder / moved.name)
    assert len(housekeeping.collect([str(folder)]).unnamed) == 1


HIDDEN = {
    "a variant that is not selected": """
over "World" (prepend variantSets = "v")
{
    variantSet "v" = {
        "a" {
            asset icheat:filePath = @./shot.v001.icheat.h5@
        }
        "b" {
        }
    }
}
""",
    "an inactive prim": """
def "Gone" (active = false)
{
    asset icheat:filePath = @./shot.v001.icheat.h5@
}
""",
    "a time sample": """
over "World"
{
    asset icheat:filePath.timeSamples = { 3: @shot.v001.icheat.h5@ }
}
""",
    "metadata": """
over "World" (customData = { asset[] kept = [@./shot.v001.icheat.h5@] })
{
}
""",
    "an expression": """
over "World"
{
    asset icheat:filePath = @`"./shot.${VERSION}.icheat.h5"`@
}
""",
    "an absolute path": """
over "World"
{
    asset icheat:filePath = @FOLDER/shot.v001.icheat.h5@
}
""",
}


@pytest.mark.parametrize("place", HIDDEN)
@pytest.mark.parametrize("how", ["beside", "referenced", "muted", "template"])
def test_gc_finds_every_place_that_names_a_sidecar(place: str, how: str, shot: Path, tmp_path: Path) -> None:
    folder = shot.parent
    text = "#usda 1.0\n" + HIDDEN[place].replace("FOLDER", str(folder))
    _age(folder)
    assert len(housekeeping.collect([str(folder)]).unnamed) == 1
    if how == "beside":
        (folder / "other.usda").write_text(text)
    else:
        # In another folder, which is reached from here alone.
        elsewhere = tmp_path / "elsewhere"
        elsewhere.mkdir()
        moved = text.replace("@./shot", "@../show/shot").replace("@shot", "@../show/shot").replace('"./', '"../show/')
        (elsewhere / "clip.7.usda").write_text(moved)
        arcs = {
            "referenced": 'def "R" (references = @../elsewhere/clip.7.usda@</World>)\n{\n}\n',
            "muted": 'def "R" (payload = @../elsewhere/clip.7.usda@</World>)\n{\n}\n',
            "template": (
                'def "R" (clips = { dictionary default = { string templateAssetPath = "../elsewhere/clip.#.usda" } })\n'
                "{\n}\n"
            ),
        }
        (folder / "other.usdc").unlink(missing_ok=True)
        (folder / "other.usda").write_text("#usda 1.0\n" + arcs[how])
    found = housekeeping.collect([str(folder)], move=True)
    assert not found.problems and not found.unnamed
    assert (folder / "shot.v001.icheat.h5").exists()


def test_gc_reads_layers_in_linked_folders(shot: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    text = HIDDEN["an absolute path"].replace("FOLDER", str(shot.parent))
    (elsewhere / "other.usda").write_text("#usda 1.0\n" + text)
    (elsewhere / "back").symlink_to(shot.parent)
    _age(shot.parent)
    assert len(housekeeping.collect([str(shot.parent)]).unnamed) == 1
    (shot.parent / "linked").symlink_to(elsewhere)
    found = housekeeping.collect([str(shot.parent)], move=True)
    assert not found.problems and not found.unnamed and (shot.parent / "shot.v001.icheat.h5").exists()


def test_gc_moves_nothing_when_a_layer_cannot_be_read(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _age(shot.parent)
    for name, text in (
        ("broken.usda", "#usda 1.0\ndef {"),
        ("reaching.usda", '#usda 1.0\ndef "A" (references = @./gone.usda@)\n{\n}\n'),
        ("unsure.usda", '#usda 1.0\ndef "A"\n{\n    asset a = @`if(${X}, "a.icheat.h5", "b.icheat.h5")`@\n}\n'),
    ):
        (shot.parent / name).write_text(text)
        assert run(["gc", str(shot.parent), "--move"]) == FINDINGS, name
        assert "problem:" in capsys.readouterr().out
        assert (shot.parent / "shot.v001.icheat.h5").exists()
        ignore = "--ignore=" + str(shot.parent / ("gone.*" if name == "reaching.usda" else "broken.*"))
        expected = FINDINGS if name == "unsure.usda" else CLEAN
        assert run(["gc", str(shot.parent), ignore]) == expected
        (shot.parent / name).unlink()
    assert run(["gc", str(shot.parent / "nowhere")]) == FAILURE


def test_gc_reads_the_file_of_a_layer_that_is_open_in_another_state(shot: Path) -> None:
    held = Sdf.Layer.FindOrOpen(str(shot))
    _age(shot.parent)
    assert _names(shot) == {"shot.v002.icheat.h5"}
    # Someone else goes back to the first version; this process still has the layer as it was.
    shot.write_text(shot.read_text().replace("shot.v002", "shot.v001"))
    assert "shot.v002" in held.ExportToString()
    assert not housekeeping.collect([str(shot)], move=True).unnamed


def test_gc_spares_what_is_published_young_linked_or_no_sidecar(shot: Path) -> None:
    folder = shot.parent
    published = publishing.publish(inspection.open_stage(shot))
    (folder / "junk.icheat.h5").write_text("not HDF5")
    (folder / "link.icheat.h5").symlink_to(folder / "shot.v001.icheat.h5")
    _age(folder)
    (folder / "young.icheat.h5").write_bytes(GOLDEN.read_bytes())
    # A published file without its manifest says itself that it is.
    shutil.copyfile(published.file, folder / "alone.icheat.h5")
    os.utime(folder / "alone.icheat.h5", (1, 1))
    found = housekeeping.collect([str(folder)], move=True)
    assert {os.path.basename(file): reason.split(" (")[0] for file, reason in found.spared.items()} == {
        "alone.icheat.h5": "it is published",
        "shot.published.v001.icheat.h5": "it is published",
        "junk.icheat.h5": "it cannot be read",
        "young.icheat.h5": "it is 0.0 hours old",
        "link.icheat.h5": "it is a symbolic link",
    }
    assert [os.path.basename(item.file) for item in found.unnamed] == ["shot.v001.icheat.h5"]


def test_gc_lists_payloads_that_no_layer_names_in_files_that_one_does(shot: Path) -> None:
    packed = housekeeping.pack([str(p) for p in sorted(shot.parent.glob("*.icheat.h5"))], None, layer=str(shot))
    assert len(packed.payloads) == 2
    _age(shot.parent)
    found = housekeeping.collect([str(shot)])
    assert [os.path.basename(item.file) for item in found.partly_named] == ["shot.v003.icheat.h5"]
    assert len(found.partly_named[0].payloads) == 1


# Packing and upgrading ------------------------------------------------------------------------------------------------


def test_pack_merges_what_a_layer_names_and_repoints_it(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = inspection.describe_stack(inspection.open_stage(shot), "/World/Edits")
    assert run(["pack", "--layer", str(shot)]) == CLEAN
    assert "1 values name it now" in capsys.readouterr().out
    assert _names(shot) == {"shot.v003.icheat.h5"}
    assert list_payloads(shot.parent / "shot.v003.icheat.h5") == list_payloads(shot.parent / "shot.v002.icheat.h5")
    stage = inspection.open_stage(shot)
    assert not inspection.check(stage)
    after = inspection.describe_stack(stage, "/World/Edits")
    assert [edit.path for edit in after.edits] == [edit.path for edit in before.edits]


def test_pack_repoints_keys_and_variants_and_leaves_other_files(tmp_path: Path) -> None:
    stage_file = make_stage(tmp_path)
    files = [write_payloads(stage_file, [Payload("scale", {"gain": g})], anchor="/World") for g in (0.5, 2.0, 4.0)]
    (one, (a,)), (two, (b,)), (three, (c,)) = files
    text = stage_file.read_text()
    text += f"""
over "World"
{{
    over "Edits" (
        prepend variantSets = "grade"
    )
    {{
        over "e" (prepend apiSchemas = ["IcheatEditAPI"])
        {{
            asset icheat:filePath.timeSamples = {{ 1: @./{one.name}@, 5: @./{two.name}@ }}
            token icheat:payload.timeSamples = {{ 1: "{a}", 5: "{b}" }}
        }}
        variantSet "grade" = {{
            "dusk" {{
                over "e"
                {{
                    asset icheat:filePath = @./{three.name}@
                    token icheat:payload = "{c}"
                }}
            }}
        }}
    }}
}}
"""
    stage_file.write_text(text)
    packed = housekeeping.pack([], str(tmp_path / "all.icheat.h5"), layer=str(stage_file))
    assert set(packed.payloads) == {a, b, c} and packed.repointed == {str(stage_file): 3}
    assert _names(stage_file) == {"all.icheat.h5"}
    assert {file.name for file in tmp_path.glob("*.icheat.h5")} == {one.name, two.name, three.name, "all.icheat.h5"}
    # The same again from a layer by its path, into the next version beside it.
    again = housekeeping.pack([str(stage_file)], None)
    assert os.path.basename(again.file) == "shot.v004.icheat.h5" and not again.repointed


def test_a_layer_that_changed_meanwhile_is_not_repointed_and_no_file_is_left(
    shot: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = Sdf.Layer.FindOrOpen(str(shot))
    real = housekeeping.sidecar.pack

    def slow(*args: object, **kwargs: object) -> object:
        result = real(*args, **kwargs)  # type: ignore[arg-type]
        shot.write_text(shot.read_text() + '\n# someone else\nover "Other"\n{\n}\n')
        return result

    monkeypatch.setattr(housekeeping.sidecar, "pack", slow)
    with pytest.raises(EditError, match="changed on disk"):
        housekeeping.pack([], None, layer=str(shot))
    assert held and not (shot.parent / "shot.v003.icheat.h5").exists() and 'over "Other"' in shot.read_text()


def test_upgrade_makes_a_file_that_old_stages_can_be_pointed_to(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copyfile(GOLDEN, tmp_path / "shot.v001.icheat.h5")
    assert run(["upgrade", str(tmp_path / "shot.v001.icheat.h5"), "--json"]) == CLEAN
    said = json.loads(capsys.readouterr().out)
    assert os.path.basename(said["file"]) == "shot.v002.icheat.h5"
    for old in list_payloads(GOLDEN):
        assert read_payload(said["file"], old, anchor="/World").operation
    assert list_aliases(said["file"]) == {old: new for old, new in said["payloads"].items() if old != new}
    assert run(["upgrade", "a", "b"]) == FAILURE
    assert "--out" in capsys.readouterr().err


def test_there_is_a_clear_error_where_there_is_nothing_to_pack(shot: Path, tmp_path: Path) -> None:
    empty = make_stage(tmp_path / "empty")
    for inputs, out, message in (
        ([str(empty)], None, "no layer names a sidecar"),
        ([str(shot), str(GOLDEN)], None, "--out"),
        ([str(tmp_path / "gone.usda")], None, "does not exist"),
        ([str(tmp_path / "gone.icheat.h5")], None, "no such sidecar"),
    ):
        with pytest.raises(IcheatError, match=message):
            housekeeping.pack(inputs, out)


# Publishing -----------------------------------------------------------------------------------------------------------


def test_publish_verifies_packs_and_pins(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["publish", str(shot), "--json", "--why", "final"]) == CLEAN
    said = json.loads(capsys.readouterr().out)
    file = Path(said["file"])
    assert file.name == "shot.published.v001.icheat.h5" and file.stat().st_mode & 0o222 == 0 and is_published(file)
    manifest = json.loads(Path(said["manifest"]).read_text())
    assert manifest["payloads"] == said["payloads"] == list(list_payloads(file)) and len(manifest["payloads"]) == 1
    assert manifest["keys"] == [{"edit": EDIT, "time": None, "payload": manifest["payloads"][0]}]
    assert read_history(file)[-1].why == "final" and manifest["who"] == "ann@studio"
    assert _names(shot) == {"shot.v002.icheat.h5"}  # no layer was named

    assert run(["publish", str(shot), "--layer", str(shot)]) == CLEAN
    assert _names(shot) == {"shot.published.v002.icheat.h5"}
    assert not inspection.check(inspection.open_stage(shot))


def test_publish_takes_along_what_a_variant_of_a_repointed_layer_names(shot: Path) -> None:
    file, (digest,) = write_payloads(shot, [Payload("scale", {"gain": 9.0})], anchor="/World")
    shot.write_text(
        shot.read_text()
        + f"""
over "Other" (
    prepend variantSets = "grade"
)
{{
    variantSet "grade" = {{
        "dusk" {{
            asset icheat:filePath = @./{file.name}@
            token icheat:payload = "{digest}"
        }}
    }}
}}
"""
    )
    published = publishing.publish(inspection.open_stage(shot), layers=[str(shot)])
    assert digest in published.payloads and len(published.payloads) == 2
    assert _names(shot) == {"shot.published.v001.icheat.h5"} and published.repointed == {str(shot): 2}


@pytest.mark.parametrize("how", ["missing", "damaged", "other"])
def test_publish_refuses_what_is_missing_or_damaged_even_in_a_muted_edit(
    how: str, shot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    authoring.mute_edit(inspection.open_stage(shot), EDIT, layer="shot.usda")
    file = shot.parent / "shot.v002.icheat.h5"
    if how == "missing":
        file.unlink()
    elif how == "damaged":
        with h5py.File(file, "r+") as root:
            (digest,) = root["payloads"]
            root[f"payloads/{digest}/recipe/parameters/gain"][...] = np.float64(3.0)
    else:
        shutil.copyfile(shot.parent / "shot.v001.icheat.h5", file)
    assert run(["publish", str(shot)]) == FINDINGS
    out = capsys.readouterr().out
    assert "error:" in out and EDIT in out and "not published" in out
    assert not list(shot.parent.glob("*published*"))


def test_publish_without_payloads_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["publish", str(make_stage(tmp_path))]) == FAILURE
    assert "nothing to publish" in capsys.readouterr().err


# History --------------------------------------------------------------------------------------------------------------


def test_history_says_which_payload_came_when_from_whom_and_why(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    events, problems = payload_history.edit_history(inspection.open_stage(shot), EDIT)
    assert not problems and [(event.who, event.why, event.edit) for event in events] == [
        ("ann@studio", "warmer floor", EDIT),
        ("ann@studio", "less", EDIT),
    ]
    assert [event.keys for event in events] == [(), ("always",)]
    assert [os.path.basename(event.file) for event in events] == ["shot.v001.icheat.h5", "shot.v002.icheat.h5"]
    assert all(event.when.endswith("Z") and event.when.startswith("20") for event in events)

    # Also what was collected.
    _age(shot.parent)
    housekeeping.collect([str(shot)], move=True)
    assert run(["history", str(shot), "warm"]) == CLEAN
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 and "warmer floor" in lines[0] and ".icheat-trash" in lines[0]
    assert lines[1].startswith("* ") and "named at always" in lines[1]
    assert run(["cat", str(shot.parent / "shot.v002.icheat.h5"), "--history"]) == CLEAN
    assert "less" in capsys.readouterr().out
    assert run(["history", str(shot), "nothing"]) == FAILURE


def test_the_command_line_is_the_reason_where_none_is_given(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = ["edit", "add", str(shot), "cold", "--receivers", "Floor", "--casters", "Wall", "--set", "gain=0.5"]
    assert run(line) == CLEAN
    (entry,) = read_history(shot.parent / "shot.v003.icheat.h5")
    assert entry.why.startswith("icheat edit add ") and entry.edit == "/World/Edits/cold"
    capsys.readouterr()


# Locks ----------------------------------------------------------------------------------------------------------------


def test_a_lock_waits_is_removed_and_is_not_kept_by_the_dead(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    layer = str(tmp_path / "shot.usda")
    (tmp_path / ".shot.usda.icheat-lock").write_text("")  # of a killed process
    with locked(layer):
        monkeypatch.setattr("icheat_usd.stage.locking._TIMEOUT_SECONDS", 0.05)
        with pytest.raises(EditError, match="being saved by another process"):
            with locked(layer):
                pass
    assert not list(tmp_path.iterdir())


def test_values_of_the_wrong_type_are_named(tmp_path: Path) -> None:
    file = tmp_path / "a.usda"
    file.write_text(
        '#usda 1.0\ndef SphereLight "L"\n{\n    double3 inputs:intensity = (1, 2, 3)\n}\n'
        'def Camera "C"\n{\n}\ndef Cube "Q"\n{\n}\n'
    )
    with pytest.raises(IcheatError, match="/L.inputs:intensity is authored as double3 in .*a.usda, but it is float"):
        take_snapshot(Usd.Stage.Open(str(file)), width=4, height=4)
