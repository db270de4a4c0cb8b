"""Materials are read as UsdPreviewSurface defines them, and what cannot be read is said once."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdShade, UsdUtils

from icheat_usd.scene import Materials, Texture
from icheat_usd.stage.materials import MaterialLibrary
from icheat_usd.stage.textures import TextureLibrary
from tests.images import encode_png


def write_stage(folder: Path, body: str, name: str = "a.usda") -> Usd.Stage:
    path = folder / name
    path.write_text(f'#usda 1.0\n(\n    metersPerUnit = 1\n    upAxis = "Y"\n)\n{body}')
    return Usd.Stage.Open(str(path))


def surface(inputs: str, nodes: str = "", interface: str = "") -> str:
    return f"""
def Material "M"
{{
    {interface}
    token outputs:surface.connect = </M/S.outputs:surface>
    def Shader "S"
    {{
        uniform token info:id = "UsdPreviewSurface"
        {inputs}
        token outputs:surface
    }}
    {nodes}
}}
"""


def texture(inputs: str, name: str = "T", st: str = "</M/P.outputs:result>") -> str:
    return f"""
    def Shader "{name}"
    {{
        uniform token info:id = "UsdUVTexture"
        float2 inputs:st.connect = {st}
        {inputs}
        float outputs:r
        float outputs:g
        float outputs:b
        float outputs:a
        float3 outputs:rgb
    }}
"""


PRIMVAR = """
    def Shader "P"
    {
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "st"
        float2 outputs:result
    }
"""


def read(stage: Usd.Stage, path: str = "/M", time: float | None = None) -> tuple[Materials, int, MaterialLibrary]:
    library = MaterialLibrary(stage, time)
    row = library.row(UsdShade.Material(stage.GetPrimAtPath(path)), prim_path="/mesh")
    return library.tables()[0], row, library


def features(library: MaterialLibrary) -> list[str]:
    return [finding.feature for finding in library.findings]


# UsdPreviewSurface ------------------------------------------------------------------------------


def test_unauthored_inputs_have_the_fallbacks_of_the_shader_definition(tmp_path: Path) -> None:
    from pxr import Sdr, Tf

    table, row, library = read(write_stage(tmp_path, surface("")))
    try:
        node = Sdr.Registry().GetShaderNodeByIdentifier("UsdPreviewSurface")
    except Tf.ErrorException:
        node = None
    if node is None:
        pytest.skip("the wheels of usd-core 25.5 lack the shader definitions")

    def default(name: str) -> Any:
        return node.GetShaderInput(name).GetDefaultValue()

    np.testing.assert_allclose(table.diffuse[row], list(default("diffuseColor")))
    np.testing.assert_allclose(table.emission[row], list(default("emissiveColor")))
    np.testing.assert_allclose(table.specular[row], list(default("specularColor")))
    assert table.use_specular[row] == default("useSpecularWorkflow")
    for column, name in (
        (table.metallic, "metallic"),
        (table.roughness, "roughness"),
        (table.opacity, "opacity"),
        (table.opacity_threshold, "opacityThreshold"),
        (table.ior, "ior"),
    ):
        assert column[row] == pytest.approx(default(name)), name
    assert (table.texture[row] == -1).all() and not table.use_display_color[row]
    assert library.findings == []
    assert library.tables()[1] == ("", "/M")


def test_authored_inputs_reach_their_columns(tmp_path: Path) -> None:
    table, row, _ = read(
        write_stage(
            tmp_path,
            surface("""
        color3f inputs:diffuseColor = (0.1, 0.2, 0.3)
        color3f inputs:emissiveColor = (17, 12, 4)
        color3f inputs:specularColor = (0.4, 0.5, 0.6)
        int inputs:useSpecularWorkflow = 1
        float inputs:metallic = 0.7
        float inputs:roughness = 0.25
        float inputs:opacity = 0.5
        float inputs:opacityThreshold = 0.125
        float inputs:ior = 1.33
    """),
        )
    )
    np.testing.assert_allclose(table.diffuse[row], [0.1, 0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(table.emission[row], [17, 12, 4])
    np.testing.assert_allclose(table.specular[row], [0.4, 0.5, 0.6], rtol=1e-6)
    values = (table.use_specular, table.metallic, table.roughness, table.opacity, table.opacity_threshold, table.ior)
    np.testing.assert_allclose([column[row] for column in values], [1, 0.7, 0.25, 0.5, 0.125, 1.33], rtol=1e-6)


def test_row_zero_is_a_matte_display_color(tmp_path: Path) -> None:
    library = MaterialLibrary(write_stage(tmp_path, 'def Mesh "mesh" {}'), None)
    assert library.row(None, prim_path="/mesh") == 0
    table, paths = library.tables()
    assert paths == ("",) and table.use_display_color[0] == 1 and table.ior[0] == 1.0
    assert library.st_name(0) == "" and library.findings == []


def test_values_come_through_the_material_interface_and_nested_node_graphs(tmp_path: Path) -> None:
    stage = write_stage(
        tmp_path,
        surface(
            "float inputs:roughness.connect = </M.inputs:rough>\nfloat inputs:metallic.connect = </M/G.outputs:m>\n",
            'def NodeGraph "G"\n{\n    float inputs:metal.connect = </M.inputs:metal>\n'
            "    float outputs:m.connect = </M/G.inputs:metal>\n}\n",
            "float inputs:rough = 0.75\nfloat inputs:metal = 0.5",
        ),
    )
    # A connected input keeps a value of its own, which must lose.
    UsdShade.Shader(stage.GetPrimAtPath("/M/S")).GetInput("roughness").GetAttr().Set(0.1)
    table, row, library = read(stage)
    assert (table.roughness[row], table.metallic[row]) == (0.75, 0.5)
    assert library.findings == []


def test_inputs_are_read_at_the_time_code(tmp_path: Path) -> None:
    stage = write_stage(tmp_path, surface("float inputs:roughness.timeSamples = { 1: 0.2, 11: 0.4 }"))
    assert read(stage, time=6.0)[0].roughness[1] == pytest.approx(0.3)
    assert read(stage, time=11.0)[0].roughness[1] == pytest.approx(0.4)
    assert read(stage, time=None)[0].roughness[1] == pytest.approx(0.2)


def test_a_material_is_one_row_however_often_it_is_bound(tmp_path: Path) -> None:
    stage = write_stage(tmp_path, surface(""))
    library = MaterialLibrary(stage, None)
    material = UsdShade.Material(stage.GetPrimAtPath("/M"))
    assert [library.row(material, prim_path=f"/mesh{i}") for i in range(3)] == [1, 1, 1]


def test_instances_share_a_row_under_a_scene_path(tmp_path: Path) -> None:
    stage = write_stage(
        tmp_path,
        """
class "Asset"
{
    def Mesh "mesh" ( prepend apiSchemas = ["MaterialBindingAPI"] )
    {
        rel material:binding = </Asset/M>
    }
    def Material "M"
    {
        token outputs:surface.connect = </Asset/M/S.outputs:surface>
        def Shader "S"
        {
            uniform token info:id = "UsdPreviewSurface"
            float inputs:clearcoat = 1
            token outputs:surface
        }
    }
}
def "A" ( instanceable = true; inherits = </Asset> ) {}
def "B" ( instanceable = true; inherits = </Asset> ) {}
""",
    )
    library = MaterialLibrary(stage, None)
    rows = []
    for path in ("/A/mesh", "/B/mesh"):
        prim = stage.GetPrimAtPath(path)
        assert prim.IsInstanceProxy()
        rows.append(library.row(UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0], prim_path=path))
    in_prototype = stage.GetPrimAtPath("/A").GetPrototype().GetChild("M")
    rows.append(library.row(UsdShade.Material(in_prototype), prim_path="/A/mesh"))
    assert rows == [1, 1, 1]
    assert library.tables()[1][1] in ("/A/M", "/B/M")
    assert [finding.prim in ("/A/M", "/B/M") for finding in library.findings] == [True]


# Textures ---------------------------------------------------------------------------------------


def test_a_texture_is_decoded_and_described_by_its_lookup(tmp_path: Path) -> None:
    samples = np.array([[[188, 0, 10], [255, 128, 255]], [[0, 64, 5], [12, 34, 56]]], np.uint8)
    (tmp_path / "a.png").write_bytes(encode_png(samples))
    inputs = """asset inputs:file = @./a.png@
        token inputs:wrapS = "repeat"
        token inputs:wrapT = "mirror"
        float4 inputs:scale = (0.5, 2, 1, 1)
        float4 inputs:bias = (0.1, 0, 0, 0)"""
    table, row, library = read(
        write_stage(
            tmp_path,
            surface("color3f inputs:diffuseColor.connect = </M/T.outputs:rgb>", texture(inputs) + PRIMVAR),
        )
    )
    images = library.textures.table()
    index = table.texture[row, Texture.DIFFUSE]
    assert index == 0 and table.texture_channel[row, Texture.DIFFUSE] == -1
    np.testing.assert_allclose(table.texture_scale[row, Texture.DIFFUSE], [0.5, 2, 1, 1])
    np.testing.assert_allclose(table.texture_bias[row, Texture.DIFFUSE], [0.1, 0, 0, 0], rtol=1e-6)
    np.testing.assert_array_equal(images.wrap, [[0, 2]])
    assert (images.width[0], images.height[0], images.begin[0]) == (2, 2, 0)
    expected = [[linear(v / 255.0) for v in texel] + [1.0] for texel in samples.reshape(-1, 3)]
    np.testing.assert_allclose(images.texels, expected, rtol=1e-5, atol=1e-7)
    mean = np.mean(expected, axis=0)[:3] * [0.5, 2, 1] + [0.1, 0, 0]
    np.testing.assert_allclose(table.diffuse[row], mean, rtol=1e-5)
    assert library.st_name(row) == "st" and library.findings == []


def linear(v: float) -> float:
    """IEC 61966-2-1, one value."""
    return v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4


@pytest.mark.parametrize(
    ("token", "depth", "channels", "decoded"),
    [
        ("auto", np.uint8, 3, True),
        ("auto", np.uint8, 4, True),
        ("auto", np.uint8, 1, False),
        ("auto", np.uint16, 3, False),
        ("raw", np.uint8, 3, False),
        ("sRGB", np.uint8, 1, True),
        ("sRGB", np.uint16, 3, True),
    ],
)
def test_the_colour_space_decides_what_is_decoded_and_never_alpha(
    tmp_path: Path, token: str, depth: type, channels: int, decoded: bool
) -> None:
    full = np.iinfo(depth).max
    (tmp_path / "a.png").write_bytes(encode_png(np.full((1, 1, channels), full // 5, depth)))
    inputs = f'asset inputs:file = @./a.png@\ntoken inputs:sourceColorSpace = "{token}"'
    nodes = texture(inputs) + PRIMVAR
    _, _, library = read(
        write_stage(tmp_path, surface("color3f inputs:diffuseColor.connect = </M/T.outputs:rgb>", nodes))
    )
    texel = library.textures.table().texels[0]
    stored = (full // 5) / full
    np.testing.assert_allclose(texel[:3], linear(stored) if decoded else stored, rtol=1e-4)
    assert texel[3] == pytest.approx(stored if channels == 4 else 1.0, rel=1e-4)


def test_every_8_bit_code_is_decoded_to_its_own_value(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(encode_png(np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, axis=2)))
    library = TextureLibrary()
    library.add(str(tmp_path / "a.png"))
    np.testing.assert_allclose(library.table().texels[:, 0], [linear(k / 255.0) for k in range(256)], rtol=2e-6)


def test_texels_that_are_not_finite_are_made_so(tmp_path: Path) -> None:
    import OpenEXR

    rgb = np.array([[[np.nan, np.inf, -np.inf], [1.0, 2.0, 3.0]]], np.float32)
    OpenEXR.File({}, {"RGB": rgb}).write(str(tmp_path / "a.exr"))
    library = TextureLibrary()
    library.add(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(library.table().texels, [[0, 65504, -65504, 1], [1, 2, 3, 1]])


def test_one_file_read_for_several_inputs_is_stored_once(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(encode_png(np.array([[[10, 20, 30, 40]]], np.uint8)))
    raw = 'asset inputs:file = @./a.png@\ntoken inputs:sourceColorSpace = "raw"\n'
    nodes = (
        texture(raw)
        + texture(raw + 'token inputs:wrapS = "clamp"', "U")
        + texture('asset inputs:file = @./a.png@\ntoken inputs:sourceColorSpace = "sRGB"', "V")
        + PRIMVAR
    )
    table, row, library = read(
        write_stage(
            tmp_path,
            surface(
                "float inputs:roughness.connect = </M/T.outputs:g>\n"
                "float inputs:metallic.connect = </M/T.outputs:b>\n"
                "float inputs:opacity.connect = </M/U.outputs:a>\n"
                "color3f inputs:emissiveColor.connect = </M/V.outputs:rgb>\n",
                nodes,
            ),
        )
    )
    images = library.textures.table()
    columns = [Texture.ROUGHNESS, Texture.METALLIC, Texture.OPACITY, Texture.EMISSION]
    rows = table.texture[row, columns]
    assert rows[0] == rows[1] != rows[2] != rows[3]
    assert table.texture_channel[row, columns].tolist() == [1, 2, 3, -1]
    assert images.begin[rows[0]] == images.begin[rows[2]] != images.begin[rows[3]]
    assert len(images.texels) == 2
    # Black is what an unauthored wrap mode means where the file has no opinion.
    assert images.wrap[[rows[0], rows[2]]].tolist() == [[3, 3], [1, 3]]
    np.testing.assert_allclose(
        [table.roughness[row], table.metallic[row], table.opacity[row]], np.array([20, 30, 40]) / 255.0, rtol=1e-5
    )


def test_transforms_of_texture_coordinates_chain_into_one_matrix(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(encode_png(np.zeros((1, 1, 3), np.uint8)))
    nodes = (
        texture("asset inputs:file = @./a.png@", st="</M/X.outputs:result>")
        + """
    def Shader "X"
    {
        uniform token info:id = "UsdTransform2d"
        float2 inputs:in.connect = </M/Y.outputs:result>
        float inputs:rotation = 30
        float2 inputs:scale = (2, 3)
        float2 inputs:translation = (0.25, -0.5)
        float2 outputs:result
    }
    def Shader "Y"
    {
        uniform token info:id = "UsdTransform2d"
        float2 inputs:in.connect = </M/P.outputs:result>
        float2 inputs:translation = (1, 0)
        float2 outputs:result
    }
    def Shader "P"
    {
        uniform token info:id = "UsdPrimvarReader_float2"
        token inputs:varname.connect = </M.inputs:frame:st>
        float2 outputs:result
    }
"""
    )
    table, row, library = read(
        write_stage(
            tmp_path,
            surface(
                "color3f inputs:diffuseColor.connect = </M/T.outputs:rgb>", nodes, 'token inputs:frame:st = "map1"'
            ),
        )
    )
    s, t = 0.3, 0.7
    x, y = 2 * (s + 1.0), 3 * t
    c, n = math.cos(math.pi / 6), math.sin(math.pi / 6)
    expected = [c * x - n * y + 0.25, n * x + c * y - 0.5]
    np.testing.assert_allclose(table.texture_transform[row, Texture.DIFFUSE] @ [s, t, 1.0], expected, rtol=1e-5)
    assert library.st_name(row) == "map1" and library.findings == []


def test_two_sets_of_texture_coordinates_are_reported(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(encode_png(np.zeros((1, 1, 3), np.uint8)))
    file = "asset inputs:file = @./a.png@"
    nodes = (
        texture(file)
        + texture(file, "U", "</M/Q.outputs:result>")
        + PRIMVAR
        + PRIMVAR.replace('"P"', '"Q"').replace('"st"', '"st1"')
    )
    _, row, library = read(
        write_stage(
            tmp_path,
            surface(
                "color3f inputs:diffuseColor.connect = </M/T.outputs:rgb>\n"
                "float inputs:roughness.connect = </M/U.outputs:r>",
                nodes,
            ),
        )
    )
    assert library.st_name(row) == "st"
    assert features(library) == ["texture coordinates"] and "'st1'" in library.findings[0].message


def test_a_missing_file_is_its_fallback_unscaled_and_reported_once(tmp_path: Path) -> None:
    inputs = """asset inputs:file = @./gone.png@
        float4 inputs:fallback = (0.5, 0.25, 0.125, 0.75)
        float4 inputs:scale = (2, 2, 2, 2)"""
    table, row, library = read(
        write_stage(
            tmp_path,
            surface(
                "color3f inputs:diffuseColor.connect = </M/T.outputs:rgb>\n"
                "float inputs:opacity.connect = </M/T.outputs:a>",
                texture(inputs) + PRIMVAR,
            ),
        )
    )
    np.testing.assert_allclose(table.diffuse[row], [0.5, 0.25, 0.125])
    assert table.opacity[row] == 0.75 and (table.texture[row] == -1).all()
    assert [(f.prim, f.feature) for f in library.findings] == [("/M/T", "texture ./gone.png")]


@pytest.mark.parametrize(
    ("name", "content", "word"), [("bad.png", b"junk", "cannot be read"), ("a.<UDIM>.png", b"", "UDIM")]
)
def test_damaged_files_and_tile_sets_are_reported_with_their_name(
    tmp_path: Path, name: str, content: bytes, word: str
) -> None:
    (tmp_path / name.replace("<UDIM>", "1001")).write_bytes(content)
    nodes = texture(f"asset inputs:file = @./{name}@") + PRIMVAR
    table, row, library = read(
        write_stage(tmp_path, surface("color3f inputs:diffuseColor.connect = </M/T.outputs:rgb>", nodes))
    )
    np.testing.assert_array_equal(table.diffuse[row], [0, 0, 0])
    assert len(library.findings) == 1
    assert word in library.findings[0].message and name in library.findings[0].message


def test_textures_inside_a_package_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(encode_png(np.array([[[51, 102, 204]]], np.uint8)))
    inputs = 'asset inputs:file = @./a.png@\ntoken inputs:sourceColorSpace = "raw"'
    write_stage(
        tmp_path,
        surface("color3f inputs:diffuseColor.connect = </M/T.outputs:rgb>", texture(inputs) + PRIMVAR),
    )
    assert UsdUtils.CreateNewUsdzPackage(str(tmp_path / "a.usda"), str(tmp_path / "a.usdz"))
    (tmp_path / "a.png").unlink()
    table, row, library = read(Usd.Stage.Open(str(tmp_path / "a.usdz")))
    np.testing.assert_allclose(table.diffuse[row], [0.2, 0.4, 0.8], rtol=1e-5)
    assert library.findings == []


def test_display_color_read_through_a_primvar_is_the_meshs(tmp_path: Path) -> None:
    reader = PRIMVAR.replace("float2", "float3").replace('"st"', '"displayColor"')
    table, row, library = read(
        write_stage(tmp_path, surface("color3f inputs:diffuseColor.connect = </M/P.outputs:result>", reader))
    )
    assert table.use_display_color[row] == 1 and library.findings == []
    other = PRIMVAR.replace("float2", "float3").replace('"st"', '"tint"')
    table, row, library = read(
        write_stage(tmp_path, surface("color3f inputs:diffuseColor.connect = </M/P.outputs:result>", other), "b.usda")
    )
    assert table.use_display_color[row] == 0
    assert features(library) == ["diffuseColor"] and "'tint'" in library.findings[0].message


# What is not supported --------------------------------------------------------------------------


def test_ignored_inputs_are_reported_once_and_only_where_they_matter(tmp_path: Path) -> None:
    neutral = "float inputs:clearcoat = 0\nnormal3f inputs:normal = (0, 0, 1)\nfloat inputs:occlusion = 1"
    assert read(write_stage(tmp_path, surface(neutral)))[2].findings == []
    nodes = texture("asset inputs:file = @./gone.png@") + PRIMVAR
    stage = write_stage(
        tmp_path,
        surface(
            "float inputs:clearcoat = 0.5\nfloat inputs:displacement = 0.1\n"
            "normal3f inputs:normal.connect = </M/T.outputs:rgb>\nfloat inputs:occlusion.connect = </M/T.outputs:r>",
            nodes,
        ),
        "b.usda",
    )
    _, _, library = read(stage)
    library.row(UsdShade.Material(stage.GetPrimAtPath("/M")), prim_path="/other")
    assert sorted(features(library)) == ["clearcoat", "displacement", "normal", "occlusion"]
    assert {finding.prim for finding in library.findings} == {"/M"}


def material_of(identifier: str, context: str, inputs: str = "") -> str:
    return f"""
def Material "M"
{{
    token outputs:{context}surface.connect = </M/S.outputs:out>
    def Shader "S"
    {{
        uniform token info:id = "{identifier}"
        {inputs}
        token outputs:out
    }}
}}
"""


def test_a_foreign_surface_is_display_color_and_reported(tmp_path: Path) -> None:
    table, row, library = read(write_stage(tmp_path, material_of("PxrSurface", "ri:")))
    assert row == 1 and table.use_display_color[row] == 1
    assert features(library) == ["surface shader"] and "PxrSurface" in library.findings[0].message


def test_materialx_preview_surface_is_read_in_its_own_render_context(tmp_path: Path) -> None:
    inputs = "color3f inputs:diffuseColor = (0.725, 0.71, 0.68)\nfloat inputs:roughness = 1"
    table, row, library = read(
        write_stage(tmp_path, material_of("ND_UsdPreviewSurface_surfaceshader", "mtlx:", inputs))
    )
    np.testing.assert_allclose(table.diffuse[row], [0.725, 0.71, 0.68], rtol=1e-6)
    assert table.roughness[row] == 1.0 and table.ior[row] == 1.5 and library.findings == []


def test_materialx_standard_surface_maps_its_constants(tmp_path: Path) -> None:
    inputs = """
        float inputs:base = 0.5
        color3f inputs:base_color = (1, 0.5, 0.25)
        float inputs:metalness = 0.75
        float inputs:specular_roughness = 0.3
        float inputs:specular_IOR = 1.4
        float inputs:emission = 2
        color3f inputs:emission_color = (1, 2, 3)
        float inputs:transmission = 0.25
        float inputs:coat = 1"""
    table, row, library = read(write_stage(tmp_path, material_of("ND_standard_surface_surfaceshader", "mtlx:", inputs)))
    np.testing.assert_allclose(table.diffuse[row], [0.5, 0.25, 0.125])
    np.testing.assert_allclose(table.emission[row], [2, 4, 6])
    values = [column[row] for column in (table.metallic, table.roughness, table.ior, table.opacity)]
    np.testing.assert_allclose(values, [0.75, 0.3, 1.4, 0.75], rtol=1e-6)
    assert features(library) == ["coat"]


def test_a_readable_surface_in_another_context_wins_over_an_unreadable_universal_one(tmp_path: Path) -> None:
    body = material_of("PxrSurface", "").replace(
        'def Shader "S"',
        'token outputs:mtlx:surface.connect = </M/N.outputs:out>\n    def Shader "N"\n    {\n'
        '        uniform token info:id = "ND_UsdPreviewSurface_surfaceshader"\n'
        '        color3f inputs:diffuseColor = (0.5, 0, 0)\n        token outputs:out\n    }\n    def Shader "S"',
    )
    table, row, library = read(write_stage(tmp_path, body))
    np.testing.assert_array_equal(table.diffuse[row], [0.5, 0, 0])
    assert library.findings == []


def test_a_binding_that_leads_nowhere_is_reported_once_per_material(tmp_path: Path) -> None:
    stage = write_stage(
        tmp_path,
        """
def Xform "set" ( prepend apiSchemas = ["MaterialBindingAPI"] )
{
    rel material:binding = </Looks/gone>
    def Mesh "a" {}
    def Mesh "b" {}
}
def Mesh "c" {}
""",
    )
    library = MaterialLibrary(stage, None)
    for path in ("/set/a", "/set/b", "/c"):
        material = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath(path)).ComputeBoundMaterial()[0]
        assert library.row(material, prim_path=path) == 0
    assert [(f.prim, f.feature) for f in library.findings] == [("/Looks/gone", "missing material")]


# Outside scenes ---------------------------------------------------------------------------------


def read_all(path: Path) -> MaterialLibrary:
    stage = Usd.Stage.Open(str(path))
    library = MaterialLibrary(stage, None)
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()):
        if prim.IsA(UsdGeom.Gprim):
            bound = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
            library.row(bound, prim_path=str(prim.GetPath()))
    return library


@pytest.mark.parametrize(
    ("flavour", "n_materials", "feature"),
    [
        ("usdpreviewsurface", 4, None),
        ("mtlx-usdshade", 4, None),
        ("mtlx-ref", 0, "missing material"),
        ("mdl", 4, "surface shader"),
        ("display-color", 0, None),
    ],
)
def test_every_flavour_of_the_cornell_box_is_read_or_says_why_not(
    shared_scenes: Path, flavour: str, n_materials: int, feature: str | None
) -> None:
    library = read_all(shared_scenes / "cornell_box" / flavour / "cornell-box.usda")
    table, paths = library.tables()
    assert len(paths) == n_materials + 1
    assert features(library) == ([feature] * 4 if feature else [])
    if n_materials and not feature:
        light = [path.rsplit("/", 1)[-1] for path in paths].index("light")
        np.testing.assert_allclose(table.emission[light], [17, 12, 4])


def test_textured_rooms_are_read_without_findings(shared_scenes: Path) -> None:
    library = read_all(shared_scenes / "bitterli_veach-ajar" / "veach-ajar.usda")
    table, _ = library.tables()
    assert (table.texture[:, Texture.DIFFUSE] >= 0).sum() == 4
    assert library.findings == []
