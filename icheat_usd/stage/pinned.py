"""Every payload that the edits of a stage name, at every key, muted edits included."""

from __future__ import annotations

import os
from dataclasses import dataclass

from pxr import Usd

from icheat_usd.errors import IcheatError
from icheat_usd.scene import Finding
from icheat_usd.stage import schema
from icheat_usd.stage.edit_stack import anchor_path
from icheat_usd.stage.keys import read_keys, strongest_opinion
from icheat_usd.stage.refusals import named_refusals
from icheat_usd.stage.stacks import EditFinding, Severity, edit_prim


@dataclass(frozen=True)
class PinnedKey:
    """A payload that an edit names at one of its keys."""

    edit: str
    time: float | None  #: stage time; None where it holds for all times
    digest: str
    file: str  #: where the sidecar is looked for
    anchor: str


@named_refusals
def pinned_keys(stage: Usd.Stage) -> tuple[tuple[PinnedKey, ...], list[Finding]]:
    """Keys of every active edit prim, and findings for edits whose keys cannot be read."""
    keys: list[PinnedKey] = []
    findings: list[Finding] = []
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()):
        if schema.has_schema(prim, schema.EDIT_API):
            try:
                keys += edit_keys(prim)
            except IcheatError as problem:
                findings.append(EditFinding(str(prim.GetPath()), schema.PAYLOAD, str(problem), Severity.ERROR))
    return tuple(keys), findings


def edit_keys(prim: Usd.Prim) -> list[PinnedKey]:
    """The keys of one edit that name a payload. Raises `EditError` as `read_keys`."""
    track = read_keys(prim)
    if track is None:
        return []
    path, anchor = str(prim.GetPath()), anchor_path(prim)
    return [PinnedKey(path, key.time, key.digest, key.anchored, anchor) for key in track.keys if key.digest]


@named_refusals
def keys_and_layers(stage: Usd.Stage, edit: str) -> tuple[list[PinnedKey], list[str]]:
    """The keys of the edit at a path, and the files of all layers that say something about its payload.

    Raises
    ------
    EditError
        There is no such edit, or its keys cannot be read.
    """
    prim = edit_prim(stage, edit)
    specs = [spec for name in (schema.PAYLOAD, schema.FILE_PATH) for spec in prim.GetAttribute(name).GetPropertyStack()]
    layers = dict.fromkeys(spec.layer.realPath for spec in specs if spec.layer.realPath)
    if opinion := strongest_opinion(prim.GetAttribute(schema.PAYLOAD)):
        layers[opinion.layer.realPath] = None
    return edit_keys(prim), [layer for layer in layers if layer and os.path.isfile(layer)]
