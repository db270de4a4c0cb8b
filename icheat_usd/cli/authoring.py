"""What the verbs that write to a layer have in common."""

from __future__ import annotations

import argparse
from typing import Any

from icheat_usd.errors import EditError


def open_for_writing(options: argparse.Namespace) -> tuple[Any, str]:
    """The stage, and the layer to write to: --layer, else the stage's root layer.

    Raises
    ------
    EditError
        The stage cannot be written to, or the layer has no file and would be gone when the program ends.
    """
    from icheat_usd.session import authoring, inspection

    stage = inspection.open_stage(options.stage)
    layer = options.layer or stage.GetRootLayer().identifier
    if not authoring.is_kept(stage, layer):
        raise EditError(f"layer '{layer}' has no file, so nothing of it would stay; name a layer with a file")
    return stage, layer


def named_edit(stage: Any, options: argparse.Namespace) -> tuple[str, str]:
    """Paths of the stack and of the edit that the command line names, the latter by path or by name.

    With --variant the edit may be one that only that variant has.

    Raises
    ------
    EditError
        The stage has no such stack, or the stack no such edit or variant.
    """
    from icheat_usd.session import inspection
    from icheat_usd.stage.variants import selected_variant

    path = inspection.find_stack(stage, options.stack, options.camera)
    if path is None:
        raise EditError(f"{options.stage} has no edit stack; make one with `icheat stack create`")
    guess = options.edit if options.edit.startswith("/") else f"{path}/{options.edit}"
    with selected_variant(stage, guess, getattr(options, "variant", None)):
        paths = [edit.path for edit in inspection.describe_stack(stage, path).edits]
    found = [p for p in paths if p == options.edit] or [p for p in paths if p.rpartition("/")[2] == options.edit]
    if len(found) != 1:
        raise EditError(f"{path} has no edit '{options.edit}'; it has {', '.join(paths) or 'no edits'}")
    return path, found[0]
