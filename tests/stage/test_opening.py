"""Opening a stage says what is wrong with it and loads the rest."""

from __future__ import annotations

from pathlib import Path

import pytest
from pxr import Usd

from icheat_usd.errors import StageError
from icheat_usd.stage.opening import composition_findings, open_stage


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_a_missing_file_is_named_with_what_to_do(tmp_path: Path) -> None:
    path = tmp_path / "gone.usda"
    with pytest.raises(StageError, match=r"gone\.usda does not exist; give"):
        open_stage(path)


@pytest.mark.parametrize("name", ["image.png", "notes", "scene.obj2"])
def test_a_file_of_another_kind_is_not_usd(tmp_path: Path, name: str) -> None:
    with pytest.raises(StageError, match="is not a USD file"):
        open_stage(written(tmp_path, name, "hello"))


@pytest.mark.parametrize("name", ["bad.usda", "bad.usd", "bad.usdc", "bad.usdz"])
def test_a_damaged_file_is_one_sentence_and_silent(
    tmp_path: Path, name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, name, "#usda 1.0\ndef {")
    with pytest.raises(StageError) as caught:
        open_stage(path)
    assert str(path) in str(caught.value) and "cannot be read as USD" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


def test_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StageError, match="is a folder"):
        open_stage(tmp_path)


def test_missing_sublayers_and_references_are_findings_not_failures(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = written(
        tmp_path,
        "shot.usda",
        "#usda 1.0\n(subLayers = [@nowhere.usda@])\n"
        + "".join(f'def "a{i}" (references = @gone.usda@</x>) {{}}\n' for i in range(5))
        + 'def "kept" {}\n',
    )
    stage = open_stage(path)
    assert stage.GetPrimAtPath("/kept")
    findings = composition_findings(stage)
    assert capfd.readouterr().err == ""
    assert len(findings) == 2  # one per asset, not per prim
    by_asset = {"gone" if "gone.usda" in f.message else "nowhere": f for f in findings}
    assert by_asset["gone"].prim == "/a0" and "4 more" in by_asset["gone"].message
    assert "nowhere.usda" in by_asset["nowhere"].message


def test_a_whole_stage_has_no_findings() -> None:
    stage = Usd.Stage.CreateInMemory()
    stage.DefinePrim("/a", "Mesh")
    assert composition_findings(stage) == ()
