"""Links, multipliers and shaping are read as UsdLux says; what is not supported is told."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd

from icheat_usd.scene import PLAIN, LightControls, SceneSnapshot
from icheat_usd.stage.snapshot import take_snapshot
from tests.ies import profile_text

WORLD = """
def Xform "World"
{
    def Cube "a" {}
    def Cube "b" {}
    def Xform "set"
    {
        def Cube "c" {}
    }
    def Mesh "mirror" ( prepend apiSchemas = ["MaterialBindingAPI"] )
    {
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
        rel material:binding = </Chrome>
    }
}
def Material "Chrome"
{
    token outputs:surface.connect = </Chrome/s.outputs:surface>
    def Shader "s"
    {
        uniform token info:id = "UsdPreviewSurface"
        float inputs:metallic = 1
        float inputs:roughness = 0
        token outputs:surface
    }
}
"""
SHAPING = '( prepend apiSchemas = ["ShapingAPI"] )'
SHADOW = '( prepend apiSchemas = ["ShadowAPI"] )'


def light(kind: str, inputs: str = "", metadata: str = "", name: str = "L") -> str:
    return f'def {kind} "{name}" {metadata}\n{{\n    {inputs}\n}}\n'


def read(folder: Path, *lights: str) -> SceneSnapshot:
    path = folder / f"{len(list(folder.iterdir()))}.usda"  # USD remembers layers by their names
    path.write_text("#usda 1.0\n(\n    metersPerUnit = 1\n)\n" + WORLD + "".join(lights))
    return take_snapshot(Usd.Stage.Open(str(path)), camera="auto", width=8, height=8)


def control(folder: Path, kind: str, inputs: str = "", metadata: str = "") -> LightControls:
    snapshot = read(folder, light(kind, inputs, metadata))
    assert snapshot.findings == ()
    return snapshot.controls(0)


def names(snapshot: SceneSnapshot, members: np.ndarray | None) -> set[str]:
    assert members is not None
    return {snapshot.surfaces[snapshot.geometry.instance_surface[i]].path for i in np.flatnonzero(members)}


# Links ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("opinions", "members"),
    [
        ("uniform bool collection:{}:includeRoot = 0", set()),
        ("uniform bool collection:{0}:includeRoot = 0\n rel collection:{0}:includes = </World/set>", {"/World/set/c"}),
        ("rel collection:{}:excludes = [</World/a>, </World/set>]", {"/World/b", "/World/mirror"}),
        (
            'uniform bool collection:{0}:includeRoot = 0\n pathExpression collection:{0}:membershipExpression = "//b"',
            {"/World/b"},
        ),
    ],
)
@pytest.mark.parametrize("link", ["lightLink", "shadowLink"])
def test_links_are_their_collections_members(tmp_path: Path, link: str, opinions: str, members: set[str]) -> None:
    snapshot = read(tmp_path, light("SphereLight", opinions.format(link)), light("RectLight", name="Plain"))
    linked, plain = snapshot.light_controls
    mine, other = (linked.receivers, linked.blockers) if link == "lightLink" else (linked.blockers, linked.receivers)
    assert names(snapshot, mine) == members and other is None and plain is PLAIN
    assert mine is not None and mine.dtype == np.uint8
    assert snapshot.findings == ()


def test_links_that_leave_nothing_out_are_none(tmp_path: Path) -> None:
    includes = "rel collection:lightLink:includes = </World/a>\n"  # beside the root, which is everything
    whole = "uniform bool collection:shadowLink:includeRoot = 0\n rel collection:shadowLink:includes = </World>"
    assert read(tmp_path, light("SphereLight", includes + whole)).light_controls == ()


def test_lights_that_are_linked_alike_share_a_table(tmp_path: Path) -> None:
    link = "rel collection:lightLink:excludes = </World/a>"
    found = read(tmp_path, light("SphereLight", link, name="A"), light("RectLight", link, name="B")).light_controls
    assert found[0].receivers is found[1].receivers


def test_links_of_lights_in_instances_name_the_instances_own_surfaces(tmp_path: Path) -> None:
    asset = 'class "Torch"\n{\n    def Cube "cube" {}\n' + light(
        "SphereLight", "rel collection:lightLink:excludes = </Torch/cube>"
    ).replace("\n", "\n    ")
    bodies = [asset + "}\n"]
    bodies += [f'def Xform "{name}" ( instanceable = true; inherits = </Torch> ) {{}}\n' for name in "PQ"]
    snapshot = read(tmp_path, *bodies)
    everything = names(snapshot, np.ones(snapshot.n_instances))
    assert {"/P/cube", "/Q/cube"} <= everything
    for path, controls in zip(snapshot.light_paths, snapshot.light_controls, strict=True):
        assert everything - names(snapshot, controls.receivers) == {path.replace("/L", "/cube")}


def test_a_light_without_shadows_is_blocked_by_nothing(tmp_path: Path) -> None:
    snapshot = read(tmp_path, light("SphereLight", "bool inputs:shadow:enable = 0", SHADOW))
    assert names(snapshot, snapshot.controls(0).blockers) == set() and snapshot.findings == ()


def test_mirrors_that_show_a_dome_they_are_not_linked_to_are_told(tmp_path: Path) -> None:
    link = "rel collection:lightLink:excludes = </World/mirror>"
    assert read(tmp_path, light("RectLight", link)).findings == ()
    (finding,) = read(tmp_path, light("DomeLight", link)).findings
    assert (finding.prim, finding.feature) == ("/L", "lightLink") and "/World/mirror" in finding.message


# Multipliers and shaping ------------------------------------------------------------------------


def test_multipliers_are_read(tmp_path: Path) -> None:
    found = control(tmp_path, "RectLight", "float inputs:diffuse = 0.25\nfloat inputs:specular = 2")
    assert (found.diffuse, found.specular) == (0.25, 2.0)


def test_a_negative_multiplier_counts_as_none_and_is_told(tmp_path: Path) -> None:
    snapshot = read(tmp_path, light("RectLight", "float inputs:diffuse = -1"))
    assert snapshot.controls(0).diffuse == 0.0
    assert [(f.prim, f.feature) for f in snapshot.findings] == [("/L", "diffuse")]


def test_a_soft_cone_begins_to_fade_where_the_documentation_says(tmp_path: Path) -> None:
    inputs = "float inputs:shaping:cone:angle = 40\nfloat inputs:shaping:cone:softness = 0.25"
    shaping = control(tmp_path, "SphereLight", inputs, SHAPING).shaping
    assert shaping is not None
    np.testing.assert_allclose(shaping.cone, (math.radians(30), math.radians(40)))


@pytest.mark.parametrize(
    ("kind", "inputs", "cone"),
    [
        ("SphereLight", "", 90),  # what ShapingAPI falls back to
        ("SphereLight", "float inputs:shaping:cone:angle = 180", None),
        ("RectLight", "", None),  # all that a flat light fills
        ("RectLight", "float inputs:shaping:cone:angle = 60", 60),
        ("DistantLight", "float inputs:shaping:cone:angle = 90", None),
    ],
)
def test_cones_that_cut_nothing_are_none(tmp_path: Path, kind: str, inputs: str, cone: float | None) -> None:
    shaping = control(tmp_path, kind, inputs, SHAPING).shaping
    if cone is None:
        assert shaping is None
    else:
        assert shaping is not None
        np.testing.assert_allclose(shaping.cone, math.radians(cone))


def test_focus_and_its_tint_are_read_at_the_time(tmp_path: Path) -> None:
    inputs = "float inputs:shaping:focus.timeSamples = { 1: 3, 2: 5 }\ncolor3f inputs:shaping:focusTint = (0, 0.5, 1)"
    shaping = control(tmp_path, "DiskLight", inputs, SHAPING).shaping
    assert shaping is not None and shaping.focus == 3.0 and shaping.focus_tint.tolist() == [0.0, 0.5, 1.0]


@pytest.mark.parametrize("normalize", [False, True])
def test_a_profile_is_read_from_beside_the_layer(tmp_path: Path, normalize: bool) -> None:
    angles = np.linspace(0, 180, 181)
    (tmp_path / "lamp.ies").write_text(profile_text(angles.tolist(), (0,), 50.0), newline="")
    inputs = f"asset inputs:shaping:ies:file = @./lamp.ies@\nbool inputs:shaping:ies:normalize = {int(normalize)}\n"
    inputs += "float inputs:shaping:ies:angleScale = -0.5"
    shaping = control(tmp_path, "SphereLight", inputs + "\nfloat inputs:shaping:cone:angle = 180", SHAPING).shaping
    assert shaping is not None and shaping.profile_scale == -0.5 and shaping.cone.tolist() == [math.inf, math.inf]
    np.testing.assert_allclose(shaping.intensity, 1.0 if normalize else 50.0, rtol=1e-4)
    np.testing.assert_allclose(shaping.vertical, np.radians(angles))


@pytest.mark.parametrize("content", [None, "not a profile"])
def test_a_profile_that_cannot_be_used_leaves_the_light_as_it_is(tmp_path: Path, content: str | None) -> None:
    if content is not None:
        (tmp_path / "lamp.ies").write_text(content)
    snapshot = read(tmp_path, light("RectLight", "asset inputs:shaping:ies:file = @./lamp.ies@", SHAPING))
    assert snapshot.light_controls == ()
    (finding,) = snapshot.findings
    assert (finding.prim, finding.feature) == ("/L", "shaping:ies:file") and "lamp.ies" in finding.message


# What is not supported --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "feature", "inputs", "metadata"),
    [
        ("SphereLight", "shadow:color", "color3f inputs:shadow:color = (1, 0, 0)", SHADOW),
        ("SphereLight", "shadow:distance", "float inputs:shadow:distance = 2", SHADOW),
        ("SphereLight", "shadow:falloff", "float inputs:shadow:falloff = 2", SHADOW),
        ("SphereLight", "light:filters", "rel light:filters = </F>", ""),
        ("DomeLight", "shaping:focus", "float inputs:shaping:focus = 3", SHAPING),
        ("DomeLight", "shaping:cone:angle", "float inputs:shaping:cone:angle = 30", SHAPING),
        ("DomeLight", "shaping:ies:file", "asset inputs:shaping:ies:file = @a.ies@", SHAPING),
    ],
)
def test_what_a_light_asks_for_and_does_not_get_is_reported_once(
    tmp_path: Path, kind: str, feature: str, inputs: str, metadata: str
) -> None:
    snapshot = read(tmp_path, light(kind, inputs, metadata))
    assert snapshot.light_controls == ()
    assert [(f.prim, f.feature) for f in snapshot.findings] == [("/L", feature)]


def test_a_mesh_light_is_linked_and_multiplied_but_not_shaped(tmp_path: Path) -> None:
    body = """
    float inputs:specular = 0
    float inputs:shaping:focus = 2
    rel collection:lightLink:excludes = </World/a>
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    rel material:binding = </Glow>
"""
    glow = (
        WORLD[WORLD.index("def Material") :]
        .replace("Chrome", "Glow")
        .replace("float inputs:metallic = 1", "color3f inputs:emissiveColor = (1, 1, 1)")
    )
    apis = '( prepend apiSchemas = ["MeshLightAPI", "ShapingAPI", "MaterialBindingAPI"] )'
    snapshot = read(tmp_path, light("Mesh", body, apis), glow)
    (found,) = snapshot.light_controls
    assert found.specular == 0.0 and found.shaping is None and snapshot.light_paths == ("/L",)
    assert "/World/a" not in names(snapshot, found.receivers)
    assert [(f.prim, f.feature) for f in snapshot.findings] == [("/L", "shaping:focus")]


def test_fallbacks_of_applied_schemas_are_not_reported(tmp_path: Path) -> None:
    metadata = '( prepend apiSchemas = ["ShapingAPI", "ShadowAPI"] )'
    snapshot = read(tmp_path, light("DiskLight", "", metadata, "A"), light("DomeLight", "", metadata, "B"))
    assert snapshot.findings == () and snapshot.light_controls == ()
