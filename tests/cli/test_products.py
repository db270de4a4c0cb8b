"""RenderSettings, RenderProduct and RenderVar prims: what is written without --out."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from icheat_usd.cli import main
from icheat_usd.errors import ImageError
from icheat_usd.image.exr import read_exr
from icheat_usd.session.layer_names import canonical, layer_name
from tests.cli.sequence_stage import QUICK, STAGE, make_stage


def variable(name: str, **values: str) -> str:
    kinds = {"sourceName": "string", "driver:parameters:aov:name": "custom string"}
    lines = "\n".join(f'        {kinds.get(key, "token")} {key} = "{value}"' for key, value in values.items())
    return f"""
    def RenderVar "{name}"
    {{
{lines}
    }}
"""


VARS = "".join(
    (
        variable("Beauty", sourceName="Ci", dataType="color3h"),
        variable("Indirect", sourceName="indirect_edited", **{"driver:parameters:aov:name": "gi"}),
        variable("Depth", sourceName="Z", dataType="half"),
        variable("Expression", sourceName="lpe:CS*O", sourceType="lpe"),
        variable("Edits", sourceName="edits"),
        variable("Ids", sourceName="CryptoObject"),
        variable("Bad", sourceName="specular"),
    )
)


def product(name: str, file: str, *variables: str, more: str = "") -> str:
    targets = ", ".join(f"</Render/{variable}>" for variable in variables)
    return f"""
    def RenderProduct "{name}"
    {{
        {file if "timeSamples" in file else f'token productName = "{file}"'}
        rel orderedVars = [{targets}]
        {more}
    }}
"""


def stage_with(folder: Path, *products: str, listed: str = "") -> Path:
    """The stage with products, those of `listed` in its settings."""
    rel = f"\n        rel products = [{', '.join(f'</Render/{name}>' for name in listed.split())}]"
    text = STAGE.replace("(16, 12)", "(16, 12)" + rel).rstrip().removesuffix("}")
    return make_stage(folder, text + VARS + "".join(products) + "}\n")


def render(stage: Path, *words: str) -> int:
    return main(["render", str(stage), *QUICK, *words])


def one_error(capsys: pytest.CaptureFixture[str]) -> str:
    error = capsys.readouterr().err
    assert error.startswith("icheat: error: ") and error.count("\n") == 1
    return error


def test_check_tells_what_would_keep_products_from_being_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good = product("Good", "good.exr", "Beauty")
    stage = stage_with(tmp_path, good, listed="Good")
    capsys.readouterr()
    assert main(["check", "--json", str(stage)]) == 0
    assert json.loads(capsys.readouterr().out)["findings"] == []
    bad = product("Wrong", "nowhere/wrong.exr", "Bad", "Gone")
    stage = stage_with(tmp_path, bad, listed="Wrong")
    capsys.readouterr()
    assert main(["check", "--json", str(stage)]) == 1
    found = {(one["prim"], one["feature"]): one for one in json.loads(capsys.readouterr().out)["findings"]}
    assert "no RenderVar" in found["/Render/Gone", "orderedVars"]["message"]
    layer = found["/Render/Wrong", "orderedVars"]
    assert "/Render/Bad: there is no layer 'specular'" in layer["message"]
    assert f"{tmp_path / 'nowhere'} does not exist" in found["/Render/Wrong", "productName"]["message"]


def test_every_product_is_written_beside_the_stage_with_its_variables(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").mkdir()
    stage = stage_with(
        tmp_path,
        product("Main", "out/main.####.exr", "Beauty", "Indirect", "Depth", "Expression", "Edits", "Ids"),
        product("Small", "small.exr", "Depth", more="uniform int2 resolution = (8, 6)"),
        product("Unlisted", "unlisted.exr"),
        listed="Main Small",
    )
    capsys.readouterr()
    assert render(stage, "--frame", "2", "--json") == 0
    main_file, small_file = tmp_path / "out" / "main.0002.exr", tmp_path / "small.exr"
    images = json.loads(capsys.readouterr().out)["images"]
    assert [image["files"] for image in images] == [[str(main_file)], [str(small_file)]]
    assert not (tmp_path / "unlisted.exr").exists()
    film = read_exr(main_file)
    assert set(film.layers) == {"beauty", "gi", "depth", "emission", "edit.bleed"}
    assert [matte.name for matte in film.mattes] == ["CryptoObject"]
    assert film.metadata["product"] == "/Render/Main" and film.metadata["layer:edit.bleed"] == "/World/Edits/bleed"
    with OpenEXR.File(str(main_file), separate_channels=True) as file:
        kinds = {name: channel.pixels.dtype for part in file.parts for name, channel in part.channels.items()}
        parts = [part.name() for part in file.parts]
    assert parts == ["beauty", "gi", "depth", "emission", "edit.bleed", "CryptoObject"]
    assert kinds["R"] == np.float16 and kinds["gi.R"] == kinds["Z"] == kinds["CryptoObject00.R"] == np.float32
    small = read_exr(small_file)
    assert (small.width, small.height, list(small.layers)) == (8, 6, ["depth"])


def test_products_that_look_alike_are_rendered_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stage = stage_with(tmp_path, product("A", "a.exr", "Beauty"), product("B", "b.exr", "Indirect"), listed="A B")
    capsys.readouterr()
    assert render(stage, "--json") == 0
    (image,) = json.loads(capsys.readouterr().out)["images"]
    assert [Path(path).name for path in image["files"]] == ["a.exr", "b.exr"]
    assert list(read_exr(tmp_path / "a.exr").layers) == ["beauty"]
    assert list(read_exr(tmp_path / "b.exr").layers) == ["gi"]
    # One of them is gone: only that is written again.
    (tmp_path / "a.exr").unlink()
    before = (tmp_path / "b.exr").stat().st_mtime_ns
    assert render(stage) == 0
    assert (tmp_path / "a.exr").exists() and (tmp_path / "b.exr").stat().st_mtime_ns == before


def test_one_product_is_chosen_and_may_be_written_elsewhere(tmp_path: Path) -> None:
    stage = stage_with(tmp_path, product("A", "a.exr", "Beauty"), product("B", "b.exr", "Indirect"), listed="A")
    assert render(stage, "--product", "/Render/B", "-o", str(tmp_path / "c.exr")) == 0
    assert list(read_exr(tmp_path / "c.exr").layers) == ["gi"]
    assert render(stage, "--product", "/Render/B") == 0
    assert {path.name for path in tmp_path.glob("*.exr")} == {"b.exr", "c.exr"}


def test_a_name_with_time_samples_is_that_of_the_frame(tmp_path: Path) -> None:
    names = 'token productName.timeSamples = { 1: "first.exr", 2: "second.exr" }'
    stage = stage_with(tmp_path, product("A", names, "Depth"), listed="A")
    assert render(stage, "--frames", "1:2") == 0
    assert read_exr(tmp_path / "first.exr").metadata["frame"] == "1"
    assert read_exr(tmp_path / "second.exr").metadata["frame"] == "2"


def test_what_is_not_supported_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    more = "uniform float4 dataWindowNDC = (0, 0, 0.5, 1)"
    deep = product("Deep", "deep.exr", "Depth", more='uniform token productType = "deepRaster"')
    stage = stage_with(tmp_path, product("A", "a.exr", "Beauty", "Depth", more=more), deep, listed="A Deep")
    text = stage.read_text().replace(
        'string sourceName = "Ci"',
        'string sourceName = "Ci"\n        custom float driver:parameters:aov:clearValue = 1',
    )
    stage.write_text(text)
    capsys.readouterr()
    assert render(stage, "--strict") == 1
    said = capsys.readouterr().err
    for words in ("dataWindowNDC", "/Render/Deep productType: 'deepRaster'", "aov:clearValue", "16 bits are too few"):
        assert words in said
    assert (tmp_path / "a.exr").exists() and not (tmp_path / "deep.exr").exists()


@pytest.mark.parametrize(
    ("products", "listed", "words", "message"),
    [
        ((), "", "", "have no product to write; give -o FILE"),
        ((product("A", "a.exr", "Bad"),), "A", "", "/Render/Bad: there is no layer 'specular'; there are beauty"),
        ((product("A", "a.exr"),), "A", "--frames 1:2", "would write the same file; write #### for the frame"),
        ((product("A", "a.exr"), product("B", "a.exr")), "A B", "", "/Render/A at frame"),
        ((product("A", "a.tif"),), "A", "", "a.tif: the name must end in .exr or .png"),
        ((product("A", "no/a.exr"),), "A", "", "there is no folder"),
        ((product("A", ""),), "A", "", "/Render/A: productName is not authored"),
        ((product("A", "a.exr"),), "A", "--aov beauty", "--aov goes with -o FILE"),
        ((product("A", "a.exr"),), "", "--product /Render/B", "no RenderProduct /Render/B; there are /Render/A."),
    ],
)
def test_a_mistake_is_one_line_before_anything_is_rendered(
    products: tuple[str, ...],
    listed: str,
    words: str,
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    stage = stage_with(tmp_path, *products, listed=listed)
    capsys.readouterr()
    frame = [] if "--frame" in words else ["--frame", "1"]
    assert render(stage, *frame, *words.split()) == 2
    assert message in one_error(capsys)
    assert not list(tmp_path.glob("*.exr"))


def test_a_product_with_a_camera_of_its_own_has_that_cameras_edits(tmp_path: Path) -> None:
    other = STAGE[STAGE.index("    def Camera") : STAGE.index("def Scope")].rstrip().removesuffix("}")
    side = other.replace('"Camera"', '"Side"').replace("(0, 0, 1.9)", "(0.5, 0, 1.9)")
    stage = stage_with(tmp_path, product("A", "a.exr", "Depth", more="rel camera = </World/Side>"), listed="A")
    stage.write_text(stage.read_text().replace(other, other + side))
    for name, camera in (("SideEdits", "/World/Side"), ("MainEdits", "/World/Camera")):
        assert main(["stack", "create", str(stage), name, "--camera", camera]) == 0
    assert render(stage) == 0
    about = read_exr(tmp_path / "a.exr").metadata
    assert (about["camera"], about["stack"]) == ("/World/Side", "/World/SideEdits")


def test_a_colour_of_four_channels_has_alpha(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stage = stage_with(tmp_path, product("A", "a.exr", "Beauty"), listed="A")
    stage.write_text(stage.read_text().replace("color3h", "color4h").replace("size = 4", "size = 1"))
    capsys.readouterr()
    assert render(stage, "--strict") == 0
    film = read_exr(tmp_path / "a.exr")
    assert set(film.layers) == {"beauty", "alpha"}
    alpha, beauty = film.layer("alpha"), film.layer("beauty")
    assert alpha.min() == 0 and alpha.max() == 1 and not beauty[alpha == 0].any()
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        assert {name: c.pixels.dtype for name, c in file.parts[0].channels.items()} == dict.fromkeys("RGBA", np.float16)


def test_a_png_product_shows_its_first_variable(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stage = stage_with(tmp_path, product("A", "a.png", "Indirect", "Beauty"), listed="A")
    capsys.readouterr()
    assert render(stage) == 0
    assert "a .png holds one layer, gi" in capsys.readouterr().err
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_source_names_of_pipelines_mean_layers() -> None:
    assert [canonical(name) for name in ("Ci", "color", "Z", "N", "albedo", "light.Key")] == [
        "beauty",
        "beauty",
        "depth",
        "normal",
        "albedo",
        "light.Key",
    ]
    assert canonical(" lpe:C.* [<L.>O]") == canonical("C.*", "lpe") == "beauty"
    assert canonical("lpe:CS*[DG].+[LO]") == "indirect_edited"
    # One lobe of several is not what a layer holds.
    for name, kind in (("lpe:C<RD>L", "raw"), ("C<RS>[<L.>O]", "lpe"), ("st", "primvar"), ("light.", "raw")):
        with pytest.raises(ImageError, match="there are"):
            canonical(name, kind)
    assert (layer_name("beauty", "Ci"), layer_name("normal", "Nworld"), layer_name("crypto_edit")) == (
        "beauty",
        "Nworld",
        "CryptoEdit",
    )
