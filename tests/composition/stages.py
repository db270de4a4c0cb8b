"""Stages of three layers from short snippets, and what they must mean in one layer written by hand.

Every case has a room (`scene.usda`) under a sequence layer (`sequence.usda`) under a shot layer (`shot.usda`, the
root), and where it needs one a session layer or a third file. `Case.flat` is the stack that this must compose to.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from icheat_usd.edits.model import MaskedSurface, Payload, SurfaceMask
from icheat_usd.sidecar import payload_digest, write_payloads

STACK = "/World/Edits"
SURFACES = ("/World/Room", "/World/Block", "/World/Pillar")
SIDECAR = "edits.v001.icheat.h5"

#: Retiming that every case is put under: times of a layer to times of the stage.
OFFSET, SCALE = 100.0, 2.5

SCENE = """
    def Cube "Room"
    {
        double size = 4
        token orientation = "leftHanded"
        color3f[] primvars:displayColor = [(0.7, 0.7, 0.7)]
    }
    def Cube "Block"
    {
        double size = 1
        double3 xformOp:translate = (0.6, -1.5, -0.5)
        uniform token[] xformOpOrder = ["xformOp:translate"]
        color3f[] primvars:displayColor = [(0.8, 0.2, 0.1)]
    }
    def Cube "Pillar"
    {
        double size = 1
        double3 xformOp:translate = (-0.9, -1, -1)
        double3 xformOp:scale = (0.5, 2, 0.5)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
        color3f[] primvars:displayColor = [(0.2, 0.4, 0.8)]
    }
    def RectLight "Lamp"
    {
        float inputs:intensity = 20
        float inputs:width = 1
        float inputs:height = 1
        double3 xformOp:translate = (0, 1.95, 0)
        float xformOp:rotateX = -90
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]
    }
    def Camera "Camera"
    {
        float focalLength = 15
        float horizontalAperture = 20
        float verticalAperture = 15
        double3 xformOp:translate = (0, 0, 1.9)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
"""

_TYPES = {
    "color": "color3f",
    "gain": "float",
    "hue": "float",
    "saturation": "float",
    "value": "float",
    "spread": "float",
}


def _payload(seed: int, **recipe: object) -> Payload:
    """A recipe for the whole selection, but for a mask painted on the room."""
    texels = np.random.default_rng(seed).integers(0, 9, (6, 2, 2)).astype(np.float32) / 8
    mask = SurfaceMask((MaskedSurface("/World/Room", n_faces=6),), texels)
    return Payload("scale", recipe, receiver_mask=mask)  # type: ignore[arg-type]


PAYLOADS = {
    "half": _payload(1, gain=0.5),
    "double": _payload(2, gain=2.0),
    "tint": _payload(3, color=(0.25, 1.0, 2.0)),
}
DIGESTS = {name: payload_digest(payload, anchor="/World") for name, payload in PAYLOADS.items()}


# --------------------------------------------------------------------------- snippets


def layer(body: str, *, weaker: Sequence[str] = (), metadata: str = "") -> str:
    """A layer whose default prim `World` says `body`."""
    subLayers = ", ".join(f"@./{name}@" if "@" not in name else name for name in weaker)
    return (
        '#usda 1.0\n(\ndefaultPrim = "World"\nmetersPerUnit = 1\nupAxis = "Y"\n'
        f"subLayers = [{subLayers}]\n{metadata}\n)\n"
        f'def Xform "World"\n{{\n{body}\n}}\n'
    )


def stack(*body: str, listed: Sequence[str] = (), how: str = "append", metadata: str = "", over: bool = False) -> str:
    """The prim of the stack with what a layer says about it; `listed` are names of edits."""
    head = "over" if over else "def Scope"
    schemas = "" if over else 'prepend apiSchemas = ["IcheatStackAPI"]\n'
    return f'{head} "Edits" (\n{schemas}{metadata}\n)\n{{\n{listing(*listed, how=how)}\n' + "\n".join(body) + "\n}"


def listing(*names: str, how: str = "append") -> str:
    """A list edit of the stack's edits: append, prepend, delete, reorder, or "" for an explicit list."""
    return f"{how} rel icheat:edits = [{', '.join(f'<{STACK}/{name}>' for name in names)}]" if names else ""


def edit(
    name: str,
    *body: str,
    operation: str = "scale",
    receivers: Sequence[str] = (),
    casters: Sequence[str] = (),
    metadata: str = "",
    specifier: str = "def",
    **parameters: object,
) -> str:
    """A whole edit."""
    schemas = f'prepend apiSchemas = ["IcheatEditAPI", "Icheat{operation.capitalize()}API"]'
    lines = [f'uniform token icheat:operation = "{operation}"', *body, values(operation, **parameters)]
    lines += [select("Receivers", *receivers), select("Casters", *casters)]
    return f'{specifier} Scope "{name}" (\n{schemas}\n{metadata}\n)\n{{\n' + "\n".join(lines) + "\n}"


def over(name: str, *body: str, metadata: str = "") -> str:
    """What a stronger layer says about an edit."""
    return f'over "{name}" (\n{metadata}\n)\n{{\n' + "\n".join(body) + "\n}"


def values(operation: str = "scale", **parameters: object) -> str:
    """Opinions on parameters: a number or colour, or a mapping of times to these."""
    lines = []
    for name, value in parameters.items():
        attribute = f"{_TYPES[name]} icheat:{operation}:{name}"
        lines.append(_assigned(attribute, value))
    return "\n".join(lines)


def amount(value: object) -> str:
    """An opinion on the amount: a number, or a mapping of times to numbers."""
    return _assigned("float icheat:amount", value)


def _assigned(attribute: str, value: object) -> str:
    if isinstance(value, Mapping):
        return f"{attribute}.timeSamples = {{ {', '.join(f'{time}: {one}' for time, one in value.items())} }}"
    return f"{attribute} = {value}"


def select(side: str, *paths: str, how: str = "append") -> str:
    """Includes of the receivers or the casters."""
    listed = ", ".join(f"<{path}>" for path in paths)
    return f"{how} rel collection:icheat{side}:includes = [{listed}]" if paths else ""


def keys(samples: Mapping[float, str | None] | str, file: str = f"@./{SIDECAR}@") -> str:
    """Keys by the names of their payloads, None for a block; a name alone is a payload for all times."""
    anchor = "rel icheat:anchor = </World>"
    if isinstance(samples, str):
        return f'{anchor}\nasset icheat:filePath = {file}\ntoken icheat:payload = "{DIGESTS[samples]}"'
    files = {time: "None" if name is None else file for time, name in samples.items()}
    digests = {time: "None" if name is None else f'"{DIGESTS[name]}"' for time, name in samples.items()}
    return "\n".join([anchor, _assigned("asset icheat:filePath", files), _assigned("token icheat:payload", digests)])


# --------------------------------------------------------------------------- cases


@dataclass(frozen=True)
class Case:
    """A composed stage, what it means, and who says so."""

    name: str
    layers: Mapping[str, str]  #: by file name; `shot.usda` is the root
    flat: str  #: the stack prim that it must compose to, in one layer, by hand
    winners: Mapping[str, str] = field(default_factory=dict)  #: "edit.value" to the file that decides it
    removed: Mapping[str, str] = field(default_factory=dict)  #: edits to the file that takes them out
    session: str = ""  #: text of the session layer
    muted: tuple[str, ...] = ()
    time: float = 4.0
    scene: str = SCENE
    surfaces: tuple[str, ...] = SURFACES
    findings: tuple[str, ...] = ()  #: rules of `check` that it breaks
    retimings: tuple[str, ...] = ("sublayer", "reference")  #: ways to bring the shot under a layer offset


def write_case(case: Case, folder: Path) -> dict[str, object]:
    """Write all files of a case; how to open the composed stage, and the retimed ones, as JSON would say it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.usda").write_text(layer(case.scene))
    for name, text in case.layers.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    write_payloads(folder / SIDECAR, PAYLOADS.values(), anchor="/World")
    if case.session:
        (folder / "session.usda").write_text(case.session)
    timing = f"(offset = {OFFSET}; scale = {SCALE})"
    (folder / "retimed_sublayer.usda").write_text(layer("", weaker=[f"@./shot.usda@ {timing}"]))
    referenced = layer("").replace('def Xform "World"', f'def "World" (\nreferences = @./shot.usda@ {timing}\n)')
    (folder / "retimed_reference.usda").write_text(referenced)
    return {
        "root": str(folder / "shot.usda"),
        "session": str(folder / "session.usda") if case.session else "",
        "muted": [str(folder / name) for name in case.muted],
        "time": case.time,
        "stack": STACK,
        "surfaces": list(case.surfaces),
    }


def write_flat(case: Case, folder: Path) -> dict[str, object]:
    """Write the one layer that a person would have written for the same image."""
    folder.mkdir(parents=True, exist_ok=True)
    body = case.scene + case.flat
    (folder / "flat.usda").write_text(layer(body))
    if not (folder / SIDECAR).exists():
        write_payloads(folder / SIDECAR, PAYLOADS.values(), anchor="/World")
    return {
        "root": str(folder / "flat.usda"),
        "session": "",
        "muted": [],
        "time": case.time,
        "stack": STACK,
        "surfaces": list(case.surfaces),
    }


def retimed(opened: dict[str, object], how: str) -> dict[str, object]:
    """The same stage under a scaled layer offset, at the time that was the case's."""
    root = Path(str(opened["root"])).with_name(f"retimed_{how}.usda")
    return opened | {"root": str(root), "time": OFFSET + SCALE * float(str(opened["time"]))}
