"""The committed sample stages are what the tool makes, valid USD, and light what their documentation says."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("pxr")

from pxr import Sdf, Tf, Usd, UsdGeom, UsdRender  # noqa: E402

from icheat_usd.edits import operations  # noqa: E402
from icheat_usd.session import Quality, Session, inspection  # noqa: E402

REPOSITORY = Path(__file__).parents[1]
STAGES = REPOSITORY / "sample_stages"
NAMES = ("animated_room", "cornell_box", "furnished_room", "glossy_set", "staircase")
OPERATIONS = sorted(path.stem for path in (STAGES / "operations").glob("*.usda"))


def test_every_committed_file_is_what_the_tool_writes() -> None:
    result = subprocess.run(
        [sys.executable, "tools/make_sample_stages", "--check"], cwd=REPOSITORY, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr


def test_the_folder_holds_the_stages_and_none_is_large() -> None:
    assert sorted(path.name for path in STAGES.iterdir()) == sorted((*NAMES, "operations"))
    sizes = {path: path.stat().st_size for path in STAGES.rglob("*") if path.is_file()}
    assert max(sizes.values()) < 300_000 and sum(sizes.values()) < 1_000_000


LAYERS = [f"{name}/{layer}" for name in NAMES for layer in ("scene", "sequence", "shot")]


@pytest.mark.parametrize("layer", [*LAYERS, *(f"operations/{name}" for name in OPERATIONS)])
def test_usd_finds_nothing_wrong(layer: str) -> None:
    validation = pytest.importorskip("pxr.UsdValidation", reason="usd-core before 25.2 has no validators")
    try:
        validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    except Tf.ErrorException:
        pytest.skip("the wheels of usd-core 25.5 name validators whose libraries they lack")
    stage = Usd.Stage.Open(str(STAGES / f"{layer}.usda"))
    errors = validation.ValidationContext(validators).Validate(stage)
    assert [f"{error.GetName()}: {error.GetMessage()}" for error in errors] == []


@pytest.mark.parametrize("name", NAMES)
def test_a_stage_says_what_it_shows_and_how_to_look_at_it(name: str) -> None:
    stage = Usd.Stage.Open(str(STAGES / name / "shot.usda"))
    scene = Usd.Stage.Open(str(STAGES / name / "scene.usda"))
    assert "Expect" in scene.GetRootLayer().documentation
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0 and UsdGeom.GetStageUpAxis(stage) == "Y"
    assert str(stage.GetDefaultPrim().GetPath()) == "/World"
    settings = UsdRender.Settings.GetStageRenderSettings(stage)
    (camera,) = settings.GetCameraRel().GetTargets()
    assert stage.GetPrimAtPath(camera).IsA(UsdGeom.Camera)


@pytest.mark.parametrize("name", NAMES)
def test_the_shot_overrides_an_edit_of_the_sequence_and_adds_its_own(name: str) -> None:
    sequence = inspection.open_stage(STAGES / name / "sequence.usda")
    shot = inspection.open_stage(STAGES / name / "shot.usda")
    weaker = inspection.describe_stack(sequence, "/World/Edits").edits
    composed = inspection.describe_stack(shot, "/World/Edits").edits
    assert [edit.path for edit in composed[: len(weaker)]] == [edit.path for edit in weaker]
    assert len(composed) > len(weaker)
    assert any(edit.amount.value != before.amount.value for edit, before in zip(composed, weaker, strict=False))
    assert inspection.check(shot) == ()


def test_every_operation_has_a_stage_of_its_own() -> None:
    shown = {}
    for name in OPERATIONS:
        stage = inspection.open_stage(STAGES / "operations" / f"{name}.usda")
        (edit,) = inspection.describe_stack(stage, "/World/Edits").edits
        shown[name] = edit.operation.value
        assert inspection.check(stage) == ()
    assert set(shown.values()) == set(operations.names())
    assert all(name == operation for name, operation in shown.items() if name in operations.names())


def luminance(pixels: NDArray[np.float32]) -> float:
    return float(np.mean(pixels.astype(np.float64) @ (0.2126, 0.7152, 0.0722)))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_documentation_states_the_light_that_is_there(name: str) -> None:
    documentation = Sdf.Layer.FindOrOpen(str(STAGES / name / "scene.usda")).documentation
    line = next(line for line in documentation.splitlines() if line.startswith("Expect"))
    found = re.fullmatch(
        r"Expect at (\d+) x (\d+)(?: in frame (\d+))?: mean luminance ([\d.]+), (\d+) % indirect; "
        r"shot.usda changes the indirect light by ([-+][\d.]+) %\.",
        line,
    )
    assert found, line
    width, height, frame, mean, share, change = found.groups()
    session = Session.open(
        STAGES / name / "shot.usda",
        # Half the size of what is stated: a mean hardly depends on it.
        width=int(width) // 2,
        height=int(height) // 2,
        frame=float(frame) if frame else None,
        quality=Quality(n_gather=8192, rays_per_row=96, rays_per_bounce_row=64),
    )
    layers = session.relight().layers
    indirect = luminance(layers["indirect"])
    unedited = luminance(layers["direct"]) + indirect
    assert unedited == pytest.approx(float(mean), rel=0.05)
    assert 100 * indirect / unedited == pytest.approx(float(share), abs=3)
    assert 100 * luminance(layers["edit_delta"]) / indirect == pytest.approx(float(change), abs=0.3, rel=0.1)
    assert session.findings == ()


@pytest.mark.slow
@pytest.mark.parametrize("name", OPERATIONS)
def test_an_operation_changes_the_light_as_its_documentation_states(name: str) -> None:
    documentation = Sdf.Layer.FindOrOpen(str(STAGES / "operations" / f"{name}.usda")).documentation
    found = re.search(r"Expect at 160 x 120: the edit changes the indirect light by ([-+][\d.]+) %\.$", documentation)
    assert found, documentation
    session = Session.open(
        STAGES / "operations" / f"{name}.usda",
        width=80,
        height=60,
        quality=Quality(n_gather=16_384, rays_per_row=128, rays_per_bounce_row=64, light_samples=8),
    )
    layers = session.relight().layers
    change = 100 * luminance(layers["edit_delta"]) / luminance(layers["indirect"])
    assert change == pytest.approx(float(found[1]), abs=0.3, rel=0.08)
    assert session.findings == ()


def test_the_gallery_shows_every_operation_stage() -> None:
    text = (REPOSITORY / "docs" / "gallery.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"\(gallery/(\w+)\.png\)", text)) == OPERATIONS
    assert sorted(path.stem for path in (REPOSITORY / "docs" / "gallery").glob("*.png")) == OPERATIONS
