"""The rank-1 form of an operation: what a payload holds for readers that do not know the operation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypedDict

from icheat_usd.edits.model import Value
from icheat_usd.edits.operations.base import Operation
from icheat_usd.scene import F32

_Rgb = tuple[float, float, float]


class BakedConstants(TypedDict, total=False):
    """Fields of a `Payload`; those that are the identity are absent."""

    scale_delta: _Rgb
    emission: _Rgb
    offset: _Rgb


def baked_constants(operation: Operation | None, parameters: Mapping[str, Value]) -> BakedConstants:
    """What a payload can hold baked of an operation with complete `parameters`.

    Empty if the operation is unknown, or if it is not the same for all pairs
    of any scene. Then only sampled rows can hold it.
    """
    coefficients = None if operation is None else operation.constants(parameters)
    if operation is None or coefficients is None:
        return {}
    if coefficients.through is not None or (coefficients.offset is not None and operation.offset_times_albedo):
        return {}  # What passes occluders, or is reflected by receivers, has no place in a payload.
    found: BakedConstants = {"scale_delta": _rgb(coefficients.scale - 1)}
    if coefficients.emission is not None:
        found["emission"] = _rgb(coefficients.emission)
    if coefficients.offset is not None:
        found["offset"] = _rgb(coefficients.offset)
    return found


def _rgb(row: F32) -> _Rgb:
    red, green, blue = (float(component) for component in row[0])
    return red, green, blue
