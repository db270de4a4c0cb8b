"""The small elements: the recipe, the rank-1 colours, and what a payload was made against."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from icheat_usd.edits.model import Payload, Value
from icheat_usd.errors import SidecarError
from icheat_usd.sidecar.canonical import Array, Element
from icheat_usd.sidecar.registry import reads, writes
from icheat_usd.sidecar.values import escaped, floats, read_text, read_value, text, unescaped

RGB = tuple[float, float, float]


# Recipe: the only element every payload has; its value fills two fields ----------------------------------------------


@writes("recipe", "recipe", "operation")
def _write_recipe(payload: Payload, anchor: str) -> Element:
    datasets: dict[str, Array] = {"operation": text(payload.operation, "the operation")}
    for key, value in payload.parameters.items():
        datasets[f"parameters/{escaped(key)}"] = _parameter(key, value)
    return Element("recipe", 1, datasets)


def _parameter(key: str, value: Value) -> Array:
    if isinstance(value, (bool, np.bool_)):
        return np.array(bool(value))
    if isinstance(value, str):
        return text(value, f"parameter '{key}'")
    if isinstance(value, (tuple, list)):
        return floats(value, f"parameter '{key}'")
    return floats(value, f"parameter '{key}'").reshape(())


@reads("recipe", 1)
def _read_recipe(element: Element, anchor: str) -> tuple[str, Mapping[str, Value]]:
    parameters: dict[str, Value] = {}
    for path, array in element.datasets.items():
        folder, _, name = path.partition("/")
        if folder == "parameters" and name:
            parameters[unescaped(name)] = read_value(path, array)
    return read_text(element, "operation"), MappingProxyType(parameters)


# Rank-1 colours, the same for all pairs, that the masks multiply ------------------------------------------------------


def _write_rgb(type_: str, value: RGB | None, what: str) -> Element | None:
    if value is None:
        return None
    rgb = floats(value, what)
    if rgb.shape != (3,):
        raise SidecarError(f"{what} has {rgb.size} components; give red, green and blue")
    return Element(type_, 1, {"rgb": rgb})


@writes("scale-delta", "scale-delta", "scale_delta")
def _write_scale_delta(payload: Payload, anchor: str) -> Element | None:
    return _write_rgb("scale-delta", payload.scale_delta, "scale_delta")


@writes("emission", "emission", "emission")
def _write_emission(payload: Payload, anchor: str) -> Element | None:
    return _write_rgb("emission", payload.emission, "emission")


@writes("offset", "offset", "offset")
def _write_offset(payload: Payload, anchor: str) -> Element | None:
    return _write_rgb("offset", payload.offset, "offset")


@reads("scale-delta", 1)
@reads("emission", 1)
@reads("offset", 1)
def _read_rgb(element: Element, anchor: str) -> RGB:
    rgb = element.datasets["rgb"]
    if rgb.shape != (3,) or rgb.dtype.kind != "f" or not np.isfinite(rgb).all():
        raise SidecarError(f"'rgb' is {rgb.dtype} {rgb.shape}; expected three finite numbers")
    return float(rgb[0]), float(rgb[1]), float(rgb[2])


# What a payload was made against --------------------------------------------------------------------------------------


@writes("made-against", "made-against", "made_against")
def _write_made_against(payload: Payload, anchor: str) -> Element | None:
    if not payload.made_against:
        return None
    facts = {escaped(key): _fact(key, value) for key, value in payload.made_against.items()}
    return Element("made-against", 1, facts)


def _fact(key: str, value: str | float | int) -> Array:
    if isinstance(value, str):
        return text(value, f"made_against '{key}'")
    if isinstance(value, (bool, np.bool_)):
        return np.array(bool(value))
    if isinstance(value, (int, np.integer)):
        if not -(2**63) <= value < 2**63:
            raise SidecarError(f"made_against '{key}' is {value}, beyond 64 bits; store it as text")
        return np.array(int(value), dtype=np.int64)
    return floats(value, f"made_against '{key}'").reshape(())


@reads("made-against", 1)
def _read_made_against(element: Element, anchor: str) -> Mapping[str, str | float | int]:
    facts: dict[str, str | float | int] = {}
    for path, array in element.datasets.items():
        value = read_value(path, array)
        if isinstance(value, tuple):
            raise SidecarError(f"'{path}' is a list; expected one text or number")
        facts[unescaped(path)] = value
    return MappingProxyType(facts)
