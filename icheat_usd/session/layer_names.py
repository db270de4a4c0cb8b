"""The layers that a final frame can have, and what pipelines call them; needs no renderer."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

from icheat_usd.errors import ImageError

#: What a final frame has unless something else is asked for.
DEFAULT = ("beauty", "direct", "indirect", "indirect_edited", "edit_delta", "albedo", "normal", "depth")

#: Every layer but those of lights and edits.
LAYERS: Mapping[str, str] = MappingProxyType(
    {
        "beauty": "direct + indirect_edited",
        "direct": "background + emission + light that surfaces in sight reflect straight from the lights",
        "indirect": "light that they reflect from other surfaces, without edits",
        "indirect_edited": "the same with edits",
        "edit_delta": "beauty less beauty without edits: add it to any renderer's beauty",
        "edit_ratio": "beauty over beauty without edits: multiply any renderer's beauty by it; 1 where nothing changes",
        "emission": "what glows in sight",
        "background": "domes in sight",
        "unlit": "what edits add that left no light, such as emit: beauty less light.NAME of every light",
        "alpha": "share of the pixel that surfaces cover: beauty less background is premultiplied by it",
        "albedo": "diffuse reflectance",
        "normal": "world space",
        "depth": "length of the path from the eye, metres",
        "records": "cached light: how many records stand in the pixel, how far they reach and from which round of the "
        "overture they are, both in pixels (the cached method only)",
        "crypto_object": "Cryptomatte of prims",
        "crypto_edit": "Cryptomatte of the edits that pixels receive",
    }
)

#: Families: one layer for each light or group of lights, or each edit.
FAMILIES: Mapping[str, str] = MappingProxyType(
    {
        "lights": "light.NAME of every light or group of lights: its part of beauty; with unlit they add up to it",
        "lights_direct": "light_direct.NAME: its part of direct",
        "lights_indirect": "light_indirect.NAME: its part of indirect",
        "lights_indirect_edited": "light_indirect_edited.NAME: its part of indirect_edited, again with unlit",
        "edits": "edit.NAME of every edit: they sum to edit_delta",
    }
)

#: What the layers of a family are called before the dot.
MEMBERS: Mapping[str, str] = MappingProxyType({family: re.sub("s(_|$)", r"\1", family) for family in FAMILIES})

#: Other names of `sourceName` in RenderVar prims.
ALIASES: Mapping[str, str] = MappingProxyType(
    {
        "Ci": "beauty",
        "C": "beauty",
        "color": "beauty",
        "rgba": "beauty",
        "A": "alpha",
        "a": "alpha",
        "Z": "depth",
        "z": "depth",
        "N": "normal",
        "Nn": "normal",
        "CryptoObject": "crypto_object",
        "CryptoEdit": "crypto_edit",
    }
)

#: Light path expressions that say exactly what a layer holds. Camera paths follow mirrors and glass (S*) before the
#: first surface that scatters, whose diffuse and glossy lobes ([DG]) are not told apart; expressions for one lobe,
#: such as C<RD>L, are therefore no layer. The light of a beauty is edited, so that its parts sum to it.
EXPRESSIONS: Mapping[str, str] = MappingProxyType(
    {
        "C.*": "beauty",
        "C.*[LO]": "beauty",
        "C.*[<L.>O]": "beauty",
        "C[DS]*[<L.>O]": "beauty",
        "CS*[DG]?[LO]": "direct",
        "CS*[DG]?[<L.>O]": "direct",
        "CS*[DG].+[LO]": "indirect_edited",
        "CS*[DG].+[<L.>O]": "indirect_edited",
        "CS*O": "emission",
        "C.*<L.'NAME'>": "light.NAME",
        "C[DS]*<L.'NAME'>": "light.NAME",
        "CS*[DG]?<L.'NAME'>": "light_direct.NAME",
        "CS*[DG].+<L.'NAME'>": "light_indirect_edited.NAME",
    }
)

_LIGHT = re.compile(r"<L\.'([^']+)'>")


class MatteName(NamedTuple):
    kind: str  #: of `FinalGather.coverage`
    name: str  #: type name in files


MATTES: Mapping[str, MatteName] = MappingProxyType(
    {"crypto_object": MatteName("object", "CryptoObject"), "crypto_edit": MatteName("edit", "CryptoEdit")}
)

#: Layers of one number a pixel.
SCALARS = frozenset({"alpha", "depth"})


@dataclass(frozen=True)
class Layer:
    """A layer of a film by what it holds."""

    source: str  #: name in `LAYERS`, or that of a member of a family, such as ``light.NAME``
    name: str  #: in the film; mattes: the type name


def canonical(source: str, kind: str = "raw", where: str = "") -> str:
    """The layer, or the family of layers, that a source name stands for.

    Parameters
    ----------
    kind : str
        sourceType of a RenderVar.

    Raises
    ------
    ImageError
        There is no such layer; the message lists those there are.
    """
    place = f"{where}: " if where else ""
    text = source.strip()
    if kind == "lpe" or text.startswith("lpe:"):
        expression = re.sub(r"('[^']*')|\s", r"\1", text.removeprefix("lpe:"))
        light = _LIGHT.search(expression)
        layer = EXPRESSIONS.get(_LIGHT.sub("<L.'NAME'>", expression), "")
        if layer and layer.endswith(".NAME") == (light is not None):
            return layer if light is None else f"{layer.removesuffix('NAME')}{channel_name(light[1])}"
        known = ", ".join(f"{path} ({layer})" for path, layer in EXPRESSIONS.items())
        raise ImageError(f"{place}no layer holds exactly the light of '{source}'; there are {known}")
    if kind in ("raw", "intrinsic"):
        found = ALIASES.get(text, text)
        family, _, name = found.partition(".")
        if found in LAYERS or found in FAMILIES or (name and family in MEMBERS.values()):
            return found
    names = ", ".join((*LAYERS, *(f"{member}.NAME" for member in MEMBERS.values())))
    aliases = ", ".join(f"{alias} = {name}" for alias, name in ALIASES.items())
    what = f"'{source}'" if kind == "raw" else f"{kind} '{source}'"
    close = difflib.get_close_matches(text, [*LAYERS, *FAMILIES, *ALIASES], n=1)
    meant = f" (did you mean {close[0]}?)" if close else ""
    raise ImageError(f"{place}there is no layer {what}{meant}; there are {names} ({aliases})")


def channel_name(text: str) -> str:
    """A text as part of a channel's name."""
    name = re.sub(r"\W", "_", text, flags=re.ASCII)
    # A layer may not end like a channel of another one, nor begin with a digit.
    return f"{name}_" if len(name) == 1 or name[:1].isdigit() else name


def n_channels(source: str) -> int:
    """Numbers a pixel has in a layer; 0 for mattes, which have as many as they need."""
    return 0 if source in MATTES else 1 if source in SCALARS else 3


def layer_name(source: str, wanted: str = "") -> str:
    """What a layer is called in a film: as wanted, unless that is one of its own other names."""
    usual = MATTES[source].name if source in MATTES else source
    return usual if not wanted or ALIASES.get(wanted, wanted) == source else wanted
