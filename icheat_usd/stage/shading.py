"""What materials and lights share: values looked up through connections."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pxr import Usd, UsdShade


def time_code(time: Usd.TimeCode | float | None) -> Usd.TimeCode:
    """A time code to read at; None is the earliest one, at which samples as well as defaults are found."""
    if isinstance(time, Usd.TimeCode):
        return time
    return Usd.TimeCode.EarliestTime() if time is None else Usd.TimeCode(float(time))


@dataclass(frozen=True)
class Source:
    """Where an input's value comes from: a shader node's output, or else a plain value."""

    value: Any = None  #: None where nothing is authored
    node: UsdShade.Shader | None = None
    output: str = ""  #: name of the node's output, without its namespace
    broken: bool = False  #: connected, but to nothing that gives a value


def resolve_input(node: UsdShade.Shader | UsdShade.Material, name: str, time: Usd.TimeCode) -> Source:
    """Follow an input through node graphs and material interfaces.

    Parameters
    ----------
    node
        Any connectable prim.
    name
        The input's name without ``inputs:``.
    time
        When values are read.
    """
    return resolve(node.GetInput(name), time)


def resolve(attribute: UsdShade.Input | UsdShade.Output, time: Usd.TimeCode) -> Source:
    """Follow an input, or the output of a material or node graph, to what gives its value."""
    if not attribute:
        return Source()
    producers = UsdShade.Utils.GetValueProducingAttributes(attribute)
    own = attribute.GetAttr()
    if not producers:
        return Source(value=own.Get(time), broken=own.HasAuthoredConnections())
    producer = producers[0]
    base_name, kind = UsdShade.Utils.GetBaseNameAndType(producer.GetName())
    prim = producer.GetPrim()
    if kind == UsdShade.AttributeType.Output and prim.IsA(UsdShade.Shader):
        return Source(node=UsdShade.Shader(prim), output=str(base_name))
    return Source(value=producer.Get(time))
