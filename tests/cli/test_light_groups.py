"""Groups of lights, as pipelines author them, as layers of a frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom

from icheat_usd.cli import main
from icheat_usd.image.exr import read_exr
from icheat_usd.session.layer_names import canonical
from icheat_usd.stage.light_tags import read_light_tags
from tests.cli.sequence_stage import QUICK, STAGE

LAMPS = """
def SphereLight "Left" {
    float inputs:intensity = 8
    float inputs:radius = 0.2
    double3 xformOp:translate = (-1.5, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    string inputs:karma:light:lpetag = "rim light"
}
def SphereLight "Right" {
    float inputs:intensity = 8
    float inputs:radius = 0.2
    double3 xformOp:translate = (1.5, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    string inputs:ri:light:lightGroup = "rim light"
}
"""


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    path = tmp_path / "stage.usda"
    path.write_text(STAGE.replace('    def RectLight "Lamp"', LAMPS + '    def RectLight "Lamp"'))
    return path


def test_a_group_of_lights_is_a_layer_and_groups_add_up_to_the_beauty(stage: Path) -> None:
    out = stage.parent / "groups.exr"
    names = ["beauty", "direct", "indirect", "lights", "lights_direct", "lights_indirect", "lpe:C.*<L.'rim light'>"]
    assert main(["render", str(stage), "-o", str(out), *(f"--aov={name}" for name in names), *QUICK]) == 0
    film = read_exr(out)
    groups = ("rim_light", "Lamp")
    assert {name for name in film.layers if name.startswith("light.")} == {f"light.{group}" for group in groups}
    assert film.metadata["layer:light.rim_light"] == "/World/Left, /World/Right"
    for prefix, whole in (("light", "beauty"), ("light_direct", "direct"), ("light_indirect", "indirect")):
        parts = [film.layer(f"{prefix}.{group}") for group in groups]
        assert min(part.mean() for part in parts) > 0.02 * film.layer(whole).mean()
        np.testing.assert_allclose(sum(parts), film.layer(whole), rtol=1e-5, atol=1e-6)


def test_expressions_name_a_group() -> None:
    assert canonical("C.* <L.'rim light'>", "lpe") == "light.rim_light"
    assert canonical("lpe:CS*[DG].+<L.'key'>") == "light_indirect_edited.key"
    for text in ("C.*<L.'NAME'>", "CS*[DG]?<L.'NAME'>"):
        assert canonical(text, "lpe").endswith(".NAME")


def test_glowing_shapes_inherit_their_group() -> None:
    stage = Usd.Stage.CreateInMemory()
    group = UsdGeom.Xform.Define(stage, "/lamps")
    primvars = UsdGeom.PrimvarsAPI(group)
    primvars.CreatePrimvar("karma:object:lpetag", Sdf.ValueTypeNames.String).Set("neon")
    tube, other = (UsdGeom.Cube.Define(stage, path).GetPrim() for path in ("/lamps/tube", "/other"))
    paths = ["/other", "/lamps/tube", "/lamps/tube"]
    assert read_light_tags([tube, other], None, paths) == ("", "neon", "neon")
    assert read_light_tags([other], None, ["/other"]) == ()
