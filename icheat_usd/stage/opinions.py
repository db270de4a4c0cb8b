"""What one layer says about edits, opinion by opinion, composed with nothing."""

from __future__ import annotations

import os
from typing import Any

from pxr import Sdf, Tf

from icheat_usd.errors import StageError
from icheat_usd.stage import schema
from icheat_usd.stage.opening import quiet_usd


def edit_opinions(file: str) -> dict[str, str]:
    """Every opinion of a layer on edits, stacks and selections as text, by path.

    Raises
    ------
    StageError
        The file cannot be read as a layer.
    """
    if not os.path.isfile(file):
        raise StageError(f"{file} does not exist; name a layer file")
    with quiet_usd():
        try:
            layer = Sdf.Layer.FindOrOpen(file)
        except Tf.ErrorException:
            layer = None
    if not layer:
        raise StageError(f"{file} cannot be read as a layer; name a .usd, .usda, .usdc or .usdz file")
    found: dict[str, str] = {}

    def visit(path: Sdf.Path) -> None:
        spec = layer.GetObjectAtPath(path)
        if isinstance(spec, Sdf.PrimSpec):
            if _is_ours(spec):
                if spec.HasInfo("active"):
                    found[f"{path}.active"] = str(spec.active)
                schemas = [name for name in spec.GetInfo("apiSchemas").GetAddedOrExplicitItems() if "Icheat" in name]
                if schemas:
                    found[f"{path}.apiSchemas"] = ", ".join(schemas)
        elif path.IsPrimPropertyPath() and "icheat" in path.name:
            found.update(_property(layer, path, spec))

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    return found


def _is_ours(spec: Sdf.PrimSpec) -> bool:
    return any("icheat" in name for name in spec.properties.keys()) or any(  # noqa: SIM118
        "Icheat" in name for name in spec.GetInfo("apiSchemas").GetAddedOrExplicitItems()
    )


def _property(layer: Sdf.Layer, path: Sdf.Path, spec: Any) -> dict[str, str]:
    if isinstance(spec, Sdf.RelationshipSpec):
        items = spec.targetPathList
        kinds = ("explicit", "prepended", "appended", "added", "deleted", "ordered")
        said = [(kind, getattr(items, f"{kind}Items")) for kind in kinds]
        return {str(path): "; ".join(f"{kind} {', '.join(map(str, paths))}" for kind, paths in said if paths) or "none"}
    found = {}
    if spec.HasInfo("default"):
        found[str(path)] = _text(spec.default)
    if spec.HasInfo("spline"):
        found[f"{path} spline"] = str(spec.GetInfo("spline"))
    for time in layer.ListTimeSamplesForPath(path):
        found[f"{path} at {time:g}"] = _text(layer.QueryTimeSample(path, time))
    return found


def _text(value: Any) -> str:
    if isinstance(value, Sdf.ValueBlock):
        return "blocked"
    if isinstance(value, Sdf.AssetPath):
        return str(value.path)
    converted = schema.to_value(value)
    if isinstance(converted, tuple):
        return "(" + ", ".join(f"{number:g}" for number in converted) + ")"
    return f"{converted:g}" if isinstance(converted, float) else str(value)
