"""Mutated layers: half of them changed text, half well-formed layers that say wrong things.

`case` makes one from its number alone. `read` composes it, and reads and
checks all that this package reads from a stage. USD's own parsers and
composition run in the same process: a crash inside USD ends it.
"""

from __future__ import annotations

import random
import re
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Tf

from icheat_usd.edits.model import MaskedSurface, Payload, SurfaceMask
from icheat_usd.errors import IcheatError
from icheat_usd.session import housekeeping, inspection
from icheat_usd.session.authoring import read_payload
from icheat_usd.sidecar import write_payloads
from icheat_usd.stage.edit_stack import read_edit_stack
from icheat_usd.stage.opening import quiet_usd
from icheat_usd.stage.pinned import pinned_keys
from icheat_usd.stage.snapshot import take_snapshot

_SURFACES = ("/World/Wall", "/World/Floor", "/World/Ball")

_BASE = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 0.01
    upAxis = "Y"
    startTimeCode = 1
    endTimeCode = 24
    renderSettingsPrimPath = "/Render/Settings"
    subLayers = [@./under.usda@ (offset = 10; scale = 2)]
)

def Xform "World" (
    variants = { string grade = "day" }
    prepend variantSets = "grade"
)
{
    def Mesh "Wall" (prepend apiSchemas = ["MaterialBindingAPI"])
    {
        int[] faceVertexCounts = [4, 3]
        int[] faceVertexIndices = [0, 1, 2, 3, 0, 1, 2]
        point3f[] points = [(-100, 0, 0), (100, 0, 0), (100, 100, 0), (-100, 100, 0)]
        normal3f[] normals = [(0, 0, 1), (0, 0, 1), (0, 0, 1), (0, 0, 1)]
        uniform token subdivisionScheme = "none"
        color3f[] primvars:displayColor = [(0.8, 0.7, 0.6)]
        texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = "vertex")
        rel material:binding = </World/Looks/Red>
        def GeomSubset "half"
        {
            uniform token elementType = "face"
            uniform token familyName = "materialBind"
            int[] indices = [1]
        }
    }
    def Cube "Floor"
    {
        double size = 50
        double3 xformOp:translate.timeSamples = { 1: (0, -30, 0), 24: (5, -30, 0) }
        float3 xformOp:rotateXYZ = (0, 30, 0)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]
    }
    def Sphere "Ball" { double radius = 20; }
    def PointInstancer "Trees"
    {
        rel prototypes = </World/Trees/Tree>
        int[] protoIndices = [0, 0]
        int64[] ids = [5, 9]
        point3f[] positions = [(0, 0, 50), (30, 0, 50)]
        quath[] orientations = [(1, 0, 0, 0), (1, 0, 0, 0)]
        def Cone "Tree" { double height = 10; }
    }
    def Scope "Looks"
    {
        def Material "Red"
        {
            token outputs:surface.connect = </World/Looks/Red/Shader.outputs:surface>
            def Shader "Shader"
            {
                uniform token info:id = "UsdPreviewSurface"
                color3f inputs:diffuseColor = (0.8, 0.1, 0.1)
                float inputs:roughness = 0.4
                token outputs:surface
            }
        }
    }
    def RectLight "Lamp" { float inputs:intensity = 20; }
    def Camera "Camera"
    {
        float focalLength = 20
        float horizontalAperture = 20
        double3 xformOp:translate = (0, 20, 300)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Scope "Edits" (prepend apiSchemas = ["IcheatStackAPI"])
    {
        append rel icheat:edits = [</World/Edits/warm>, </World/Edits/keyed>, </World/Edits/aimed>]
        rel icheat:camera = </World/Camera>
        def Scope "warm" (prepend apiSchemas = ["IcheatEditAPI", "IcheatScaleAPI"])
        {
            uniform token collection:icheatCasters:expansionRule = "expandPrims"
            uniform bool collection:icheatCasters:includeRoot = 0
            rel collection:icheatCasters:includes = </World/Wall>
            rel collection:icheatCasters:excludes = </World/Trees>
            uniform bool collection:icheatReceivers:includeRoot = 0
            rel collection:icheatReceivers:includes = [</World/Floor>, </World/Ball>]
            rel icheat:receiverLimits = [</World/Edits/box>, </World/Looks/Red>, </World/Edits/both>]
            color3f icheat:scale:color = (1.8, 1.5, 1)
            float icheat:amount.timeSamples = { 1: 0.5, 12: 1, 24: 0 }
            uniform token icheat:blend = "over"
        }
        def Scope "keyed" (prepend apiSchemas = ["IcheatEditAPI", "IcheatHsvAPI"])
        {
            uniform bool collection:icheatCasters:includeRoot = 0
            rel collection:icheatCasters:includes = </World/Wall>
            uniform bool collection:icheatReceivers:includeRoot = 0
            rel collection:icheatReceivers:includes = </World/Ball>
            uniform token icheat:operation = "hsv"
            float icheat:hsv:hue = 0.1
            rel icheat:anchor = </World>
            asset icheat:filePath.timeSamples = { 1: @./base.v001.icheat.h5@, 12: @./base.v001.icheat.h5@ }
            token icheat:payload.timeSamples = { 1: "DIGEST0", 12: "DIGEST1" }
            uniform token icheat:keyInterpolation = "linear"
        }
        def Scope "aimed" (prepend apiSchemas = ["IcheatEditAPI", "IcheatRedirectAPI"])
        {
            uniform bool collection:icheatCasters:includeRoot = 0
            rel collection:icheatCasters:includes = </World/Floor>
            uniform bool collection:icheatReceivers:includeRoot = 0
            rel collection:icheatReceivers:includes = </World/Wall>
            uniform token icheat:operation = "redirect"
            point3f icheat:redirect:target = (0, 20, 0)
            rel icheat:target = </World/Ball>
            rel icheat:lights = </World/Lamp>
        }
        def Cube "box" (prepend apiSchemas = ["IcheatRegionAPI"])
        {
            float icheat:softness = 0.3
            double3 xformOp:scale = (50, 50, 50)
            uniform token[] xformOpOrder = ["xformOp:scale"]
        }
        def Scope "both" (prepend apiSchemas = ["IcheatSelectionAPI"])
        {
            uniform token icheat:rule = "union"
            rel icheat:parts = [</World/Edits/box>, </World/Ball>]
        }
    }
    variantSet "grade" = {
        "day"
        {
            over "Edits"
            {
                over "warm"
                {
                    float icheat:scale:gain = 1.2
                }
            }
        }
        "dusk"
        {
            over "Edits"
            {
                over "warm"
                {
                    bool icheat:enabled = 0
                }
            }
        }
    }
}
def Scope "Render"
{
    def RenderSettings "Settings" { int2 resolution = (64, 48); rel camera = </World/Camera>; }
}
"""

_UNDER = """#usda 1.0
over "World"
{
    over "Edits"
    {
        over "warm"
        {
            float icheat:amount = 0.3
            color3f icheat:scale:color = (2, 2, 2)
        }
    }
}
"""

_TYPES = ("Float", "Token", "Asset", "String", "Color3f", "Double3", "Bool")
_NUMBERS = ("nan", "inf", "-inf", "1e308", "-1", "0", "1e-45", "4294967296", "-9223372036854775808", "99999999", "2.5")
_PATHS = ("/", "/World", "/World/Edits", "/World/Edits/warm", "/World/Edits/both", "/Nowhere", "/World/Wall.points")
_PATHS += ("/World/Edits/keyed", "/World/Looks/Red", "/World/Edits/warm.collection:icheatCasters", "/World/Trees")
_TOKENS = ("", "scale", "baked", "unheard", "over", "expandPrims", "expandPrimsAndProperties", "explicitOnly", "held")
_TOKENS += ("\x1b[2J", "../../etc/passwd", "ü" * 300, "none", "DIGEST", "catmullClark", "linear")


# One case -------------------------------------------------------------------------------------------------------------


@cache
def _base(folder: Path) -> str:
    """The text to start from; what it refers to is written beside it."""
    texels = np.array([[[1.0, 0.5], [0.25, 0.0]]] * 2, np.float32)
    mask = SurfaceMask((MaskedSurface("/World/Wall", 2),), texels)
    payloads = [Payload("hsv", {"hue": hue}, receiver_mask=mask) for hue in (0.1, 0.2)]
    (folder / "base.v001.icheat.h5").unlink(missing_ok=True)
    _, digests = write_payloads(folder / "base.v001.icheat.h5", payloads, anchor="/World")
    (folder / "under.usda").write_text(_UNDER)
    return _BASE.replace("DIGEST0", digests[0]).replace("DIGEST1", digests[1])


def case(number: int, folder: Path) -> Path:
    """Write mutated layer `number` into a folder of its own; nothing decides what it is but the number."""
    choose = random.Random(number)
    text = _base(folder)
    place = folder / "case"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    for name in ("base.v001.icheat.h5", "under.usda"):
        shutil.copyfile(folder / name, place / name)
    # Layers are cached by name for as long as anything holds them.
    path = place / f"case{number}.usda"
    if number % 2:
        for _ in range(choose.choice((1, 1, 2, 5))):
            text = choose.choice(_TEXT_CHANGES)(choose, text)
        path.write_bytes(text.encode("utf-8", "surrogateescape"))
        return path
    with quiet_usd():
        layer = Sdf.Layer.CreateAnonymous(".usda")
        layer.ImportFromString(text)
        for _ in range(choose.choice((1, 1, 2, 4))):
            try:
                choose.choice(_LAYER_CHANGES)(choose, layer, path.name)
            except (Tf.ErrorException, RuntimeError, TypeError, ValueError, IndexError):
                pass  # USD refuses to author it, or there is nothing left to change
        path = path.with_suffix(choose.choice((".usda", ".usda", ".usdc")))
        layer.Export(str(path))
    if not path.exists():
        path.write_text(text)
    return path


def read(path: Path) -> str:
    """Compose a layer and read all that there is: ``"accepted"``, or ``"refused"`` where something said an error.

    Raises
    ------
    Exception
        Something raised what is no `IcheatError`, or an error that is not one clear sentence.
    """
    outcome = "accepted"

    def attempt(action: Callable[[], object]) -> object:
        nonlocal outcome
        try:
            return action()
        except IcheatError as error:
            text = str(error)
            if "\n" in text or len(text) < 20 or len(text) > 4000:
                raise AssertionError(f"not one clear sentence: {text!r}") from error
            outcome = "refused"
            return None

    stage = attempt(lambda: inspection.open_stage(str(path)))
    attempt(lambda: housekeeping.collect([str(path.parent)]))
    if stage is None:
        return outcome
    attempt(lambda: inspection.describe_stacks(stage, 6.0))
    attempt(lambda: inspection.check(stage, None))
    attempt(lambda: pinned_keys(stage))
    stack = attempt(lambda: inspection.find_stack(stage, None, None))
    if isinstance(stack, str):
        attempt(lambda: read_edit_stack(stage, stack, 6.0, _SURFACES, read_payload))
    attempt(lambda: take_snapshot(stage, width=8, height=6, subdivision_level=1))
    return outcome


# Changed text ---------------------------------------------------------------------------------------------------------


def _swap_number(choose: random.Random, text: str) -> str:
    found = list(re.finditer(r"(?<![\w\"@/])-?\d+(\.\d+)?", text))
    if not found:
        return text
    hit = choose.choice(found)
    return text[: hit.start()] + choose.choice(_NUMBERS) + text[hit.end() :]


def _swap_words(choose: random.Random, text: str) -> str:
    found = list(re.finditer(r"[A-Za-z_][\w:]*", text))
    if len(found) < 2:
        return text
    one, other = sorted(choose.sample(found, 2), key=lambda hit: hit.start())
    return text[: one.start()] + other[0] + text[one.end() : other.start()] + one[0] + text[other.end() :]


def _swap_quoted(choose: random.Random, text: str) -> str:
    found = list(re.finditer(r"\"[^\"\n]*\"|<[^>\n]*>|@[^@\n]*@", text))
    if not found:
        return text
    hit = choose.choice(found)
    new = choose.choice(found)[0] if choose.random() < 0.5 else hit[0][0] + choose.choice(_TOKENS) + hit[0][-1]
    if hit[0][0] == "<" and choose.random() < 0.5:
        new = f"<{choose.choice(_PATHS)}>"
    return text[: hit.start()] + new + text[hit.end() :]


def _cut(choose: random.Random, text: str) -> str:
    if len(text) < 2:
        return text
    begin = choose.randrange(len(text))
    end = begin + choose.choice((1, 1, 5, 80, 1000, len(text)))
    return text[:begin] + text[end:]


def _repeat(choose: random.Random, text: str) -> str:
    lines = text.splitlines(keepends=True)
    if not lines:
        return text
    begin = choose.randrange(len(lines))
    block = lines[begin : begin + choose.choice((1, 1, 3, 20))]
    return "".join(lines[: begin + len(block)] + block * choose.choice((1, 2, 200)) + lines[begin + len(block) :])


def _garble(choose: random.Random, text: str) -> str:
    place = choose.randrange(len(text) + 1)
    junk = choose.choice(("\0", "\udcff\udcfe", "{" * 500, "[" * 500, "(((", '"""', "@@@", "]", "}", "\x1b", "é", "#"))
    return text[:place] + junk + text[place:]


def _long(choose: random.Random, text: str) -> str:
    found = list(re.finditer(r"\[[^\]@]*\]", text))
    if not found:
        return text
    hit = choose.choice(found)
    inner = hit[0][1:-1]
    return text[: hit.start()] + "[" + ", ".join([inner] * choose.choice((0, 7, 3000))) + "]" + text[hit.end() :]


_TEXT_CHANGES: tuple[Callable[[random.Random, str], str], ...]
_TEXT_CHANGES = (_swap_number, _swap_number, _swap_words, _swap_quoted, _swap_quoted, _cut, _repeat, _garble, _long)


# Well-formed layers that say wrong things -----------------------------------------------------------------------------


def _prims(layer: Sdf.Layer) -> list[Sdf.PrimSpec]:
    found: list[Sdf.Path] = []
    layer.Traverse(Sdf.Path.absoluteRootPath, found.append)
    return [layer.GetPrimAtPath(path) for path in found if path.IsPrimPath()]


def _attributes(layer: Sdf.Layer) -> list[Sdf.AttributeSpec]:
    return [spec for prim in _prims(layer) for spec in prim.properties if isinstance(spec, Sdf.AttributeSpec)]


def _retype(choose: random.Random, layer: Sdf.Layer, name: str) -> None:
    spec = choose.choice(_attributes(layer))
    path, owner = spec.name, spec.owner
    del owner.properties[path]
    type_ = getattr(Sdf.ValueTypeNames, choose.choice(_TYPES))
    made = Sdf.AttributeSpec(owner, path, type_)
    values = {"float": 2.5, "token": "x", "asset": Sdf.AssetPath("x.icheat.h5"), "string": "s", "bool": True}
    made.default = values.get(str(type_), Gf.Vec3f(1, 2, 3) if "3f" in str(type_) else Gf.Vec3d(1, 2, 3))


def _array(choose: random.Random, layer: Sdf.Layer, name: str) -> None:
    spec = choose.choice([s for s in _attributes(layer) if str(s.typeName).endswith("[]")])
    values = list(spec.default or [])
    kind = choose.randrange(4)
    spec.default = type(spec.default)([[], values[:-1], values * 3, values[::-1]][kind])


def _number(choose: random.Random, layer: Sdf.Layer, name: str) -> None:
    specs = [s for s in _attributes(layer) if str(s.typeName) in ("float", "double", "color3f", "point3f", "double3")]
    spec = choose.choice(specs)
    value = float(choose.choice(("nan", "inf", "-inf", "1e38", "-1", "0", "1e-40")))
    size = 3 if "3" in str(spec.typeName) else 0
    spec.default = (Gf.Vec3d if "double" in str(spec.typeName) else Gf.Vec3f)(value) if size else value
    if choose.random() < 0.3:
        layer.SetTimeSample(spec.path, choose.choice((1.0, 6.0, -1e30, 1e300)), spec.default)


def _token(choose: random.Random, layer: Sdf.Layer, name: str) -> None:
    spec = choose.choice([s for s in _attributes(layer) if str(s.typeName) in ("token", "string")])
    spec.default = choose.choice(_TOKENS)
    if choose.random() < 0.3:
        layer.SetTimeSample(spec.path, 3.0, choose.choice((*_TOKENS, Sdf.ValueBlock())))


def _block(choose: random.Random, layer: Sdf.Layer, name: str) -> None:
    choose.choice(_attributes(layer)).default = Sdf.ValueBlock()


def _samples(choose: random.Random, layer: Sdf.Layer, name: str) -> None:
    spec = choose.choice([s for s in _attributes(layer) if "icheat" in s.name])
    for time in choose.choice(((1.0,), (1.0, 1.0 + 1e-9), tuple(map(float, range(500))), (-1e308, 1e308))):
        value = Sdf.AssetPath(f"./x{time:g}.icheat.h5") if str(spec.typeName) == "asset" else spec.default
        layer.SetTimeSample(spec.path, time, value if value is not None else Sdf.ValueBlock())


def _targets(choose: random.Random, layer: Sdf.Layer, name: str) -> None:
    specs = [s for p in _prims(layer) for s in p.properties if isinstance(s, Sdf.RelationshipSpec)]
    spec = choose.choice(specs)
    count = choose.choice((0, 1, 3, 2000))
    paths = [choose.choice(_PATHS) if count < 10 else f"/World/P{n}" for n in range(count)]
    items = choose.choice((spec.targetPathList.explicitItems, spec.targetPathList.prependedItems))
    for path in dict.fromkeys(paths):
        items.append(Sdf.Path(path))


def _arcs(choose: random.Random, layer: Sdf.Layer, name: str) -> None:
    prim = choose.choice(_prims(layer))
    target = choose.choice([p for p in _PATHS if "." not in p])
    kind = choose.randrange(6)
    asset = choose.choice(("", f"./{name}", "./gone.usda", "./base.v001.icheat.h5", "./under.usda"))
    if kind == 0:
        prim.referenceList.prependedItems.append(Sdf.Reference(asset, target))
    elif kind == 1:
        prim.payloadList.prependedItems.append(Sdf.Payload(asset, target))
    elif kind == 2:
        prim.inheritPathList.prependedItems.append(Sdf.Path(target))
    elif kind == 3:
        prim.specializesList.prependedItems.append(Sdf.Path(target))
    elif kind == 4:
        prim.instanceable = True
    else:
        prim.variantSelections["grade"] = choose.choice(("dusk", "", "none such", "day"))


def _sublayers(choose: random.Random, layer: Sdf.Layer, name: str) -> None:
    for file in choose.choice(((f"./{name}",), ("./gone.usda",), ("./under.usda",) * 3, ("./base.v001.icheat.h5",))):
        layer.subLayerPaths.append(file)
    offset, scale = choose.choice(((0, 0), (float("nan"), 1), (0, -1), (1e300, 1e300), (0, 1e-300)))
    layer.subLayerOffsets[0] = Sdf.LayerOffset(offset, scale)


def _prim(choose: random.Random, layer: Sdf.Layer, name: str) -> None:
    prim = choose.choice(_prims(layer))
    kind = choose.randrange(5)
    if kind == 0:
        prim.typeName = choose.choice(("Mesh", "Scope", "Camera", "Unheard", "", "PointInstancer", "Material"))
    elif kind == 1:
        prim.active = False
    elif kind == 2:
        prim.specifier = choose.choice((Sdf.SpecifierOver, Sdf.SpecifierClass, Sdf.SpecifierDef))
    elif kind == 3:
        names = [
            "IcheatEditAPI",
            "IcheatStackAPI",
            "IcheatRegionAPI",
            "CollectionAPI:x",
            "Unheard",
            "IcheatSelectionAPI",
        ]
        prim.SetInfo("apiSchemas", Sdf.TokenListOp.Create(choose.sample(names, 2)))
    elif prim.nameParent:
        del prim.nameParent.nameChildren[prim.name]


def _metadata(choose: random.Random, layer: Sdf.Layer, name: str) -> None:
    key, value = choose.choice(
        (
            ("metersPerUnit", choose.choice((0.0, -1.0, float("nan"), 1e300))),
            ("upAxis", choose.choice(("X", "", "z"))),
            ("startTimeCode", choose.choice((float("nan"), 1e300, -1e300))),
            ("timeCodesPerSecond", choose.choice((0.0, float("nan")))),
            ("defaultPrim", choose.choice(("Nowhere", "", "World/Edits"))),
            ("renderSettingsPrimPath", choose.choice(("", "/World", "not a path", "/World/Edits"))),
            ("expressionVariables", {"X": choose.choice(("a", 3, '`"${X}"`'))}),
        )
    )
    layer.pseudoRoot.SetInfo(key, value)


def _expression(choose: random.Random, layer: Sdf.Layer, name: str) -> None:
    spec = choose.choice([s for s in _attributes(layer) if s.name == "icheat:filePath"])
    path = choose.choice(
        ('`"./${X}.icheat.h5"`', "`if(`", "`${X}`", "", "/", ".", "x.usdz[a.icheat.h5]", "\x01", "~root")
    )
    for time in [*layer.ListTimeSamplesForPath(spec.path), None]:
        if time is None:
            spec.default = Sdf.AssetPath(path)
        else:
            layer.SetTimeSample(spec.path, time, Sdf.AssetPath(path))


_LAYER_CHANGES: tuple[Callable[[random.Random, Sdf.Layer, str], None], ...]
_LAYER_CHANGES = (
    _retype,
    _array,
    _number,
    _number,
    _token,
    _block,
    _samples,
    _targets,
    _arcs,
    _arcs,
    _sublayers,
    _prim,
)
_LAYER_CHANGES += (_sublayers, _prim, _metadata, _expression)
