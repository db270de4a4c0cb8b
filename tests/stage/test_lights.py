"""Lights are read with the radiance, size and place that UsdLux gives them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdLux

from icheat_usd.scene import Finding, Geometry, LightKind, Lights, Materials, Surface, Texture, Textures
from icheat_usd.stage.lights import (
    cylinder_area,
    disk_area,
    distant_size_factor,
    read_lights,
    read_mesh_factors,
    rect_area,
    sphere_area,
    with_mesh_lights,
)
from icheat_usd.stage.materials import MaterialLibrary
from icheat_usd.stage.textures import TextureLibrary
from icheat_usd.stage.transforms import Placement
from tests.images import encode_png


def write_stage(folder: Path, body: str, up: str = "Y", meters_per_unit: float = 1.0) -> Usd.Stage:
    path = folder / "a.usda"
    path.write_text(f'#usda 1.0\n(\n    metersPerUnit = {meters_per_unit}\n    upAxis = "{up}"\n)\n{body}')
    return Usd.Stage.Open(str(path))


def read(
    stage: Usd.Stage, time: float | None = None, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> tuple[Lights, tuple[str, ...], list[Finding], TextureLibrary]:
    textures = TextureLibrary()
    placement = Placement(UsdGeom.GetStageMetersPerUnit(stage), np.array(centre))
    prims = Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())
    lights, paths, findings = read_lights(prims, time, placement, textures)
    return lights, paths, findings, textures


def light(kind: str, inputs: str = "", name: str = "L", metadata: str = "") -> str:
    return f'def {kind} "{name}" {metadata}\n{{\n    {inputs}\n}}\n'


SCALED = 'float3 xformOp:scale = (2, 3, 4)\n    uniform token[] xformOpOrder = ["xformOp:scale"]\n    '
SHEARED = (
    "matrix4d xformOp:transform = ( (1, 0.5, 0, 0), (0, 2, 0.25, 0), (0.3, 0, 1, 0), (5, 6, 7, 1) )\n"
    '    uniform token[] xformOpOrder = ["xformOp:transform"]\n    '
)


# Kinds and places -------------------------------------------------------------------------------


def test_each_kind_has_its_sizes_and_the_fallback_intensity_of_its_schema(tmp_path: Path) -> None:
    kinds = ["SphereLight", "DiskLight", "RectLight", "CylinderLight", "DistantLight", "DomeLight", "DomeLight_1"]
    lights, paths, findings, _ = read(write_stage(tmp_path, "".join(light(k, name=k) for k in kinds)))
    assert paths == tuple(f"/{k}" for k in kinds)
    assert lights.kind.tolist() == [0, 1, 2, 3, 4, 5, 5]
    half_angle = math.radians(0.53) / 2
    sizes = np.array([[0.5, 0], [0.5, 0], [1, 1], [0.5, 1], [half_angle, 0], [0, 0], [0, 0]])
    np.testing.assert_allclose(lights.size, sizes, rtol=1e-6)
    np.testing.assert_allclose(lights.radiance, np.array([[1, 1, 1, 1, 50000, 1, 1]] * 3).T)
    assert (lights.texture == -1).all() and (lights.surface == -1).all()
    assert lights.triangle_begin.tolist() == [0] * 8
    assert findings == []


def test_transforms_keep_scale_shear_and_mirroring_in_metres_about_the_centre(tmp_path: Path) -> None:
    mirrored = SHEARED.replace("(1, 0.5, 0, 0)", "(-1, 0.5, 0, 0)")
    stage = write_stage(tmp_path, light("RectLight", mirrored), meters_per_unit=0.01)
    lights, _, _, _ = read(stage, centre=(0.1, 0.2, 0.3))
    # Columns are where the axes go; USD authors them as rows.
    expected = np.array([[-1, 0, 0.3, 5 - 10], [0.5, 2, 0, 6 - 20], [0, 0.25, 1, 7 - 30]]) * 0.01
    np.testing.assert_allclose(lights.to_world[0], expected, rtol=1e-5)
    assert np.linalg.det(lights.to_world[0][:, :3]) < 0


def test_lights_move_and_change_at_the_time_code(tmp_path: Path) -> None:
    inputs = (
        "double3 xformOp:translate.timeSamples = { 1: (0, 0, 0), 11: (10, 0, 0) }\n"
        '    uniform token[] xformOpOrder = ["xformOp:translate"]\n'
        "    float inputs:intensity.timeSamples = { 1: 2, 11: 4 }\n"
        '    token visibility.timeSamples = { 1: "inherited", 20: "invisible" }'
    )
    stage = write_stage(tmp_path, light("SphereLight", inputs))
    lights, _, _, _ = read(stage, 6.0)
    assert lights.to_world[0, 0, 3] == pytest.approx(5.0)
    assert lights.radiance[0, 0] == pytest.approx(3.0)
    assert read(stage)[0].radiance[0, 0] == pytest.approx(2.0)
    assert read(stage, 20.0)[1] == ()


def test_an_invisible_ancestor_hides_a_light(tmp_path: Path) -> None:
    body = 'def Xform "X"\n{\n    token visibility = "invisible"\n' + light("RectLight") + "}\n"
    assert read(write_stage(tmp_path, body))[1] == ()


def test_lights_inside_instances_have_scene_paths_and_their_own_places(tmp_path: Path) -> None:
    body = 'class "Torch"\n{\n' + light("SphereLight", "bool treatAsPoint = true") + "}\n"
    for i, name in enumerate("AB"):
        body += (
            f'def Xform "{name}" ( instanceable = true; inherits = </Torch> )\n{{\n'
            f"    double3 xformOp:translate = ({i + 1}, 0, 0)\n"
            '    uniform token[] xformOpOrder = ["xformOp:translate"]\n}\n'
        )
    lights, paths, findings, _ = read(write_stage(tmp_path, body))
    assert paths == ("/A/L", "/B/L")
    np.testing.assert_allclose(lights.to_world[:, 0, 3], [1, 2])
    assert [f.prim for f in findings] == ["/A/L", "/B/L"]


# Radiance ---------------------------------------------------------------------------------------


def test_radiance_is_colour_times_intensity_times_two_to_the_exposure(tmp_path: Path) -> None:
    inputs = "color3f inputs:color = (1, 0.5, 0.25)\nfloat inputs:intensity = 3\nfloat inputs:exposure = 2"
    lights, _, _, _ = read(write_stage(tmp_path, light("SphereLight", SCALED + inputs)))
    np.testing.assert_allclose(lights.radiance[0], [12, 6, 3])


def test_colour_temperature_multiplies_only_where_it_is_enabled(tmp_path: Path) -> None:
    inputs = "float inputs:colorTemperature = 3000\nbool inputs:enableColorTemperature = {}"
    body = light("DomeLight", inputs.format("true"), "On") + light("DomeLight", inputs.format("false"), "Off")
    lights, _, _, _ = read(write_stage(tmp_path, body))
    np.testing.assert_allclose(lights.radiance[0], list(UsdLux.BlackbodyTemperatureAsRgb(3000.0)), rtol=1e-6)
    np.testing.assert_array_equal(lights.radiance[1], [1, 1, 1])
    # Independent of USD: warm light is red, and only its colour changes, not its luminance.
    assert lights.radiance[0, 0] > lights.radiance[0, 1] > lights.radiance[0, 2]
    assert lights.radiance[0] @ [0.2126, 0.7152, 0.0722] == pytest.approx(1.0, rel=0.01)


@pytest.mark.parametrize(
    ("kind", "inputs", "area"),
    [
        ("SphereLight", "float inputs:radius = 2", 16 * math.pi),
        ("DiskLight", "float inputs:radius = 2", 4 * math.pi),
        ("RectLight", "float inputs:width = 2\nfloat inputs:height = 3", 6),
        ("CylinderLight", "float inputs:radius = 2\nfloat inputs:length = 3", 12 * math.pi),
        ("DistantLight", "float inputs:angle = 60\nfloat inputs:intensity = 1", math.pi / 4),
        ("DistantLight", "float inputs:angle = 0\nfloat inputs:intensity = 1", 1),
        ("DomeLight", "", 1),
        ("DomeLight_1", "", 1),
    ],
)
def test_normalize_divides_by_the_size_factor(tmp_path: Path, kind: str, inputs: str, area: float) -> None:
    lights, _, _, _ = read(write_stage(tmp_path, light(kind, inputs + "\nbool inputs:normalize = true")))
    np.testing.assert_allclose(lights.radiance[0], 1.0 / area, rtol=1e-5)


@pytest.mark.parametrize(
    ("kind", "area"),
    [
        ("DiskLight", 2 * 3 * math.pi * 0.25),
        ("RectLight", 2 * 3),
        ("SphereLight", None),
        ("CylinderLight", None),
    ],
)
def test_areas_are_of_the_scaled_light_in_stage_units(tmp_path: Path, kind: str, area: float | None) -> None:
    inputs = SCALED + "bool inputs:normalize = true"
    if area is None:
        area = triangulated_area(kind, np.diag([2.0, 3.0, 4.0]))
    for meters_per_unit in (1.0, 0.01):
        lights, _, _, _ = read(write_stage(tmp_path, light(kind, inputs), meters_per_unit=meters_per_unit))
        assert 1.0 / lights.radiance[0, 0] == pytest.approx(area, rel=1e-3)


def triangulated_area(kind: str, linear: np.ndarray, n: int = 400) -> float:
    """Area of the fallback sphere or cylinder (radius 1/2, length 1) under a linear map, by summing small quads."""
    u = np.linspace(0.0, 2.0 * math.pi, n + 1)[None, :]
    v = np.linspace(0.0, 1.0, n + 1)[:, None]
    if kind == "SphereLight":
        ring = 0.5 * np.sin(math.pi * v)
        x, y, z = ring * np.cos(u), ring * np.sin(u), 0.5 * np.cos(math.pi * v) * np.ones_like(u)
    else:
        x, y, z = (v - 0.5) * np.ones_like(u), 0.5 * np.cos(u) * np.ones_like(v), 0.5 * np.sin(u) * np.ones_like(v)
    p = np.stack([x, y, z], axis=-1) @ linear.T
    diagonals = np.cross(p[1:, 1:] - p[:-1, :-1], p[1:, :-1] - p[:-1, 1:])
    return float(np.linalg.norm(diagonals, axis=-1).sum() / 2.0)


@pytest.mark.parametrize("scale", [(1, 1, 1), (2, 3, 4), (1, 1, 0.05), (0.1, 5, 1), (-1, 2, 1)])
def test_areas_under_rotation_shear_and_uneven_scale_agree_with_triangulated_surfaces(
    scale: tuple[float, float, float],
) -> None:
    generator = np.random.default_rng(3)
    rotation = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    linear = rotation @ np.diag(scale) @ (np.eye(3) + 0.3 * generator.normal(size=(3, 3)))
    assert sphere_area(linear, 0.5) == pytest.approx(triangulated_area("SphereLight", linear), rel=1e-3)
    assert cylinder_area(linear, 0.5, 1.0) == pytest.approx(triangulated_area("CylinderLight", linear), rel=1e-3)
    parallelogram = np.linalg.norm(np.cross(linear @ [2.0, 0, 0], linear @ [0, 3.0, 0]))
    assert rect_area(linear, 2.0, 3.0) == pytest.approx(parallelogram)
    assert disk_area(linear, 2.0) == pytest.approx(parallelogram * 4 * math.pi / 6)


@pytest.mark.parametrize("degrees", [0.53, 30.0, 90.0, 120.0, 180.0])
def test_a_distant_lights_size_factor_is_the_irradiance_of_unit_radiance(degrees: float) -> None:
    """The integral of |cos| over the cap of directions, by the midpoint rule."""
    half = math.radians(degrees)
    theta = (np.arange(20000) + 0.5) * half / 20000
    integral = 2 * math.pi * (np.abs(np.cos(theta)) * np.sin(theta)).sum() * half / 20000
    assert distant_size_factor(half) == pytest.approx(integral, rel=1e-6)


def test_negative_light_counts_as_none_and_is_reported(tmp_path: Path) -> None:
    lights, _, findings, _ = read(write_stage(tmp_path, light("RectLight", "color3f inputs:color = (1, -1, 0)")))
    np.testing.assert_array_equal(lights.radiance, [[1, 0, 0]])
    assert [f.feature for f in findings] == ["radiance"]


# Points, textures, domes ------------------------------------------------------------------------


def test_a_point_light_without_radius_keeps_the_power_that_normalize_gives_it(tmp_path: Path) -> None:
    inputs = "float inputs:radius = 0\nbool treatAsPoint = true\n"
    inputs += "bool inputs:normalize = true\nfloat inputs:intensity = 8"
    stage = write_stage(tmp_path, light("SphereLight", SCALED.replace("(2, 3, 4)", "(5, 5, 5)") + inputs))
    lights, _, findings, _ = read(stage)
    radius = lights.size[0, 0] * 5.0
    assert 0.0 < radius <= 0.001
    # Intensity of a small sphere towards any side: radiance times the disk it shows.
    assert lights.radiance[0, 0] * math.pi * radius**2 == pytest.approx(8.0 / 4.0, rel=1e-4)
    assert findings == []


def test_a_light_without_area_is_left_out_and_reported(tmp_path: Path) -> None:
    _, paths, findings, _ = read(write_stage(tmp_path, light("RectLight", "float inputs:width = 0")))
    assert paths == () and [f.feature for f in findings] == ["size"]


def test_textured_lights_share_images_with_their_wrapping(tmp_path: Path) -> None:
    (tmp_path / "sky.png").write_bytes(encode_png(np.full((2, 4, 3), 51, np.uint8)))
    file = "asset inputs:texture:file = @./sky.png@"
    body = light("DomeLight", file, "Dome") + light("RectLight", file, "Rect")
    lights, _, findings, textures = read(write_stage(tmp_path, body))
    table = textures.table()
    assert table.wrap[lights.texture].tolist() == [[0, 1], [1, 1]]
    assert len(table.texels) == 8
    assert table.texels[0, 0] == pytest.approx(((0.2 + 0.055) / 1.055) ** 2.4, rel=1e-5)
    assert findings == [] and textures.report.findings() == ()


def test_an_image_that_cannot_be_used_leaves_the_plain_light_and_one_finding(tmp_path: Path) -> None:
    (tmp_path / "ball.png").write_bytes(encode_png(np.zeros((2, 2, 3), np.uint8)))
    body = light("DomeLight", "asset inputs:texture:file = @./gone.exr@", "Missing") + light(
        "DomeLight", 'asset inputs:texture:file = @./ball.png@\ntoken inputs:texture:format = "mirroredBall"', "Ball"
    )
    lights, _, findings, textures = read(write_stage(tmp_path, body))
    assert lights.texture.tolist() == [-1, -1]
    assert [(f.prim, f.feature) for f in findings] == [("/Ball", "texture:format")]
    assert [(f.prim, f.feature) for f in textures.report.findings()] == [("/Missing", "texture ./gone.exr")]


@pytest.mark.parametrize(
    ("kind", "axis", "up", "pole"),
    [
        ("DomeLight", None, "Z", "Y"),
        ("DomeLight_1", None, "Y", "Y"),
        ("DomeLight_1", None, "Z", "Z"),
        ("DomeLight_1", "Y", "Z", "Y"),
        ("DomeLight_1", "Z", "Y", "Z"),
        ("DomeLight_1", "scene", "Z", "Z"),
    ],
)
def test_a_domes_pole_follows_its_axis(tmp_path: Path, kind: str, axis: str | None, up: str, pole: str) -> None:
    inputs = f'uniform token poleAxis = "{axis}"' if axis else ""
    lights, _, _, _ = read(write_stage(tmp_path, light(kind, inputs), up))
    frame = lights.to_world[0][:, :3]
    np.testing.assert_allclose(frame @ [0, 1, 0], [0, 1, 0] if pole == "Y" else [0, 0, 1], atol=1e-7)
    # The image's centre (longitude 0), and longitude pi / 2, which stays on +X.
    np.testing.assert_allclose(frame @ [0, 0, 1], [0, 0, 1] if pole == "Y" else [0, -1, 0], atol=1e-7)
    np.testing.assert_allclose(frame @ [1, 0, 0], [1, 0, 0], atol=1e-7)


def test_the_pole_turns_before_the_domes_own_transform(tmp_path: Path) -> None:
    inputs = 'double xformOp:rotateZ = 90\n    uniform token[] xformOpOrder = ["xformOp:rotateZ"]'
    lights, _, _, _ = read(write_stage(tmp_path, light("DomeLight_1", inputs), "Z"))
    frame = lights.to_world[0][:, :3]
    np.testing.assert_allclose(frame @ [0, 1, 0], [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(frame @ [1, 0, 0], [0, 1, 0], atol=1e-6)


# What is not supported --------------------------------------------------------------------------


def test_what_a_light_asks_for_and_does_not_get_is_reported_once(tmp_path: Path) -> None:
    _, paths, findings, _ = read(write_stage(tmp_path, light("SphereLight", "bool treatAsPoint = true")))
    assert paths == ("/L",)
    assert [(f.prim, f.feature) for f in findings] == [("/L", "treatAsPoint")]


@pytest.mark.parametrize("kind", ["GeometryLight", "PortalLight", "PluginLight"])
def test_lights_of_other_kinds_are_left_out_and_reported(tmp_path: Path, kind: str) -> None:
    _, paths, findings, _ = read(write_stage(tmp_path, light(kind)))
    assert paths == () and [(f.prim, f.feature) for f in findings] == [("/L", kind)]


@pytest.mark.parametrize(
    ("inputs", "features"),
    [
        ("", []),
        ("float inputs:intensity = 5", []),
        ("bool inputs:normalize = 1", ["normalize"]),
        ('uniform token light:materialSyncMode = "independent"', ["light:materialSyncMode"]),
    ],
)
def test_a_mesh_light_says_what_is_ignored(tmp_path: Path, inputs: str, features: list[str]) -> None:
    body = light("Mesh", inputs, metadata='( prepend apiSchemas = ["MeshLightAPI"] )')
    _, paths, findings, _ = read(write_stage(tmp_path, body))
    assert paths == () and [f.feature for f in findings] == features


# Emissive meshes --------------------------------------------------------------------------------


def two_meshes() -> Geometry:
    """Mesh 0: materials 1, 0, 2, 1; mesh 1: material 0 alone. Instances: 0, 1, 0 mirrored."""
    n = 5
    to_world = np.zeros((3, 3, 4), np.float32)
    to_world[:, 0, 0] = to_world[:, 1, 1] = to_world[:, 2, 2] = 1.0
    to_world[2, 0, 0] = -1.0
    return Geometry(
        points=np.zeros((n, 3, 3), np.float32),
        normals=np.zeros((n, 3, 3), np.float32),
        st=np.zeros((n, 3, 2), np.float32),
        color=np.zeros((n, 3, 3), np.float32),
        face=np.zeros(n, np.int32),
        face_uv=np.zeros((n, 3, 2), np.float32),
        material=np.array([1, 0, 2, 1, 0], np.int32),
        mesh_begin=np.array([0, 4, 5], np.int64),
        mesh_double_sided=np.zeros(2, np.uint8),
        instance_mesh=np.array([0, 1, 0], np.int32),
        instance_surface=np.array([2, 1, 0], np.int32),
        instance_to_world=to_world,
        instance_to_object=to_world.copy(),
        instance_flip=np.array([0, 0, 1], np.uint8),
    )


def three_materials(folder: Path, emission_texel: tuple[int, int, int]) -> tuple[Materials, Textures]:
    """Row 0 dark, row 1 with emissive colour, row 2 with an emissive texture of one texel."""
    library = MaterialLibrary(write_stage(folder, ""), None)
    columns: list[Any] = [np.repeat(column, 3, axis=0) for column in library.tables()[0]]
    materials = Materials(*columns)
    materials.emission[1] = [0.0, 3.0, 0.0]
    (folder / "glow.png").write_bytes(encode_png(np.array([[emission_texel]], np.uint8)))
    materials.texture[2, Texture.EMISSION] = library.textures.add(str(folder / "glow.png"), "raw")
    return materials, library.textures.table()


SURFACES = (Surface("/c"), Surface("/b"), Surface("/a"))


@pytest.mark.parametrize(("texel", "triangles"), [((0, 0, 1), [0, 2, 3]), ((0, 0, 0), [0, 3])])
def test_each_placed_mesh_with_emissive_triangles_is_one_light(
    tmp_path: Path, texel: tuple[int, int, int], triangles: list[int]
) -> None:
    lights, paths, _, _ = read(write_stage(tmp_path, light("RectLight")))
    materials, textures = three_materials(tmp_path, texel)
    lights, paths = with_mesh_lights(lights, paths, two_meshes(), SURFACES, materials, textures)
    n = len(triangles)
    assert paths == ("/L", "/a", "/c")
    assert lights.kind.tolist() == [LightKind.RECT, LightKind.MESH, LightKind.MESH]
    assert lights.surface.tolist() == [-1, 2, 0]
    assert lights.triangle_begin.tolist() == [0, 0, n, 2 * n]
    assert lights.triangle.tolist() == triangles * 2
    assert lights.triangle_instance.tolist() == [0] * n + [2] * n
    np.testing.assert_array_equal(lights.radiance[1:], 1.0)
    np.testing.assert_array_equal(lights.to_world[2], two_meshes().instance_to_world[2])
    reference = read(write_stage(tmp_path, light("RectLight")))[0]
    assert [column.dtype for column in lights] == [column.dtype for column in reference]
    again, again_paths = with_mesh_lights(lights, paths, two_meshes(), SURFACES, materials, textures)
    assert again.triangle_begin.tolist() == [0, 0, n, 2 * n, 3 * n, 4 * n] and len(again_paths) == 5


def test_light_inputs_of_a_mesh_tint_what_its_material_gives(tmp_path: Path) -> None:
    inputs = "float inputs:intensity = 3\nfloat inputs:exposure = 1\ncolor3f inputs:color = (1, 0.5, 0)\n"
    metadata = '( prepend apiSchemas = ["MeshLightAPI"] )'
    body = light("Mesh", inputs, "a", metadata) + light("Mesh", "", "b", metadata)
    body += light("Mesh", inputs + 'uniform token light:materialSyncMode = "independent"', "c", metadata)
    body += light("Mesh", "", "d") + light("RectLight", inputs)
    stage = write_stage(tmp_path, body)
    factors = read_mesh_factors(stage.Traverse(), None)
    assert sorted(factors) == ["/a", "/b"]
    np.testing.assert_allclose(factors["/a"], [6, 3, 0])
    lights, paths, _, _ = read(stage)
    materials, textures = three_materials(tmp_path, (0, 0, 0))
    lights, paths = with_mesh_lights(lights, paths, two_meshes(), SURFACES, materials, textures, factors)
    assert paths == ("/L", "/a", "/c")
    np.testing.assert_allclose(lights.radiance[1:], [[6, 3, 0], [1, 1, 1]])


def test_a_dark_scene_gains_no_lights(tmp_path: Path) -> None:
    lights, paths, _, _ = read(write_stage(tmp_path, ""))
    materials, textures = three_materials(tmp_path, (0, 0, 0))
    materials.emission[:] = 0.0
    lights, paths = with_mesh_lights(lights, paths, two_meshes(), SURFACES, materials, textures)
    assert paths == () and lights.to_world.shape == (0, 3, 4) and lights.triangle_begin.tolist() == [0]


# Outside scenes ---------------------------------------------------------------------------------


def test_outside_scenes_have_the_lights_their_notes_tell_of(shared_scenes: Path) -> None:
    for path, kinds in (
        ("bitterli_veach-ajar/veach-ajar.usda", [LightKind.RECT]),
        ("bitterli_living-room/living-room.usda", [LightKind.DOME]),
        ("cornell_box/usdpreviewsurface/cornell-box.usda", []),
        ("openusd_testenv/testUsdLuxLightListAPI/root_with_instances.usda", [5, 0, 0]),
    ):
        lights, paths, findings, textures = read(Usd.Stage.Open(str(shared_scenes / path)))
        assert lights.kind.tolist() == kinds, path
        assert len(set(paths)) == len(paths)
        assert [*findings, *textures.report.findings()] == []
