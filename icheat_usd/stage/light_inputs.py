"""Inputs of lights: values through connections, and findings about what is not supported."""

from __future__ import annotations

from typing import Any

from pxr import Usd, UsdShade

from icheat_usd.stage.reporting import Reporter
from icheat_usd.stage.shading import resolve_input


class LightInputs:
    """Reads inputs at one time, and collects findings: one per light and feature."""

    def __init__(self, time: Usd.TimeCode) -> None:
        self.time = time
        self.report = Reporter()

    def number(self, prim: Usd.Prim, name: str, default: float) -> float:
        """An input by its name without "inputs:", as `value`."""
        return float(self.value(prim, name, default))

    def value(self, prim: Usd.Prim, name: str, default: Any) -> Any:
        """What an input says, or its schema's fallback; `default` where there is neither."""
        source = resolve_input(UsdShade.ConnectableAPI(prim), name, self.time)
        if source.node is not None:
            self.unsupported(prim, name, f"{source.node.GetPath()} is connected to it, and its plain value is used")
            value = UsdShade.ConnectableAPI(prim).GetInput(name).GetAttr().Get(self.time)
        else:
            value = source.value
        return default if value is None else value

    def unsupported(self, prim: Usd.Prim, feature: str, consequence: str) -> None:
        """Note that a feature is not supported, and what happens instead."""
        self.report(prim.GetPath(), feature, f"{feature} is not supported; {consequence}.")
