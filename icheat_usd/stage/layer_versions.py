"""What a layer said at some moment, to be said again by undo."""

from __future__ import annotations

from typing import NamedTuple

from pxr import Sdf, Usd

from icheat_usd.errors import EditError
from icheat_usd.stage.layers import find_layer, save_layer


class LayerVersion(NamedTuple):
    """A layer and a copy of its content."""

    layer: Sdf.Layer
    content: Sdf.Layer


def layer_version(stage: Usd.Stage, layer: str | Sdf.Layer) -> LayerVersion:
    """What a layer of the stage says now.

    Raises
    ------
    EditError
        The stage cannot write to such a layer.
    """
    found = find_layer(stage, layer)
    content = Sdf.Layer.CreateAnonymous()
    content.TransferContent(found)
    return LayerVersion(found, content)


def go_to_version(now: LayerVersion, then: LayerVersion) -> None:
    """Have a layer say what it said at another moment, and save it if it has a file.

    Parameters
    ----------
    now
        What it is expected to say.

    Raises
    ------
    EditError
        It says something else by now, which would be lost, or it cannot be saved; it is then as before.
    """
    layer = now.layer
    if layer.ExportToString() != now.content.ExportToString():
        raise EditError(
            f"{layer.identifier} was changed by something else since, so this step cannot be taken back;"
            " what it says stays"
        )
    layer.TransferContent(then.content)
    if layer.anonymous:
        return
    try:
        save_layer(layer)
    except Exception:
        layer.TransferContent(now.content)
        raise
