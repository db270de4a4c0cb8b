"""How many edits and payloads a stage has, and how large they are."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from icheat_usd.edits.model import Payload
from icheat_usd.errors import IcheatError
from icheat_usd.session.authoring import read_payload
from icheat_usd.sidecar import list_elements, list_payloads
from icheat_usd.stage import schema
from icheat_usd.stage.check.rule import look_at
from icheat_usd.stage.edit_stack import open_asset
from icheat_usd.stage.keys import read_keys
from icheat_usd.stage.opening import quiet_usd


@dataclass(frozen=True)
class SidecarStatistics:
    """One sidecar that the stage uses."""

    file: str
    file_bytes: int
    payloads: int
    used: int  #: by this stage as composed; other shots may use the others
    payload_bytes: int  #: stored, of the used ones


@dataclass(frozen=True)
class Statistics:
    """Counts and sizes of all edits on a stage, listed by a stack or not."""

    stacks: int
    edits: int
    muted: int
    unlisted: int
    operations: dict[str, int]  #: edits by operation
    blends: dict[str, int]
    keys: int
    payloads: int  #: different ones
    painted_surfaces: int
    texels: int
    painted_texels: int  #: above 0
    rows: int  #: sampled rows
    sidecars: tuple[SidecarStatistics, ...]
    problems: tuple[str, ...]  #: what could not be read and is not counted


def statistics(stage: Any, frame: float | None = None) -> Statistics:
    """Count everything, reading every payload once."""
    problems: list[str] = []
    named: dict[str, dict[str, Any]] = {}  # by file: what to read it from, and the digests used
    found: dict[str, Payload] = {}
    n_keys = 0
    with quiet_usd():
        context = look_at(stage, frame, read_payload)
        for prim in context.edits:
            try:
                track = read_keys(prim)
            except IcheatError as error:
                problems.append(str(error))
                continue
            for key in track.keys if track else ():
                n_keys += 1
                if not key.digest:
                    continue
                try:
                    source = open_asset(prim, key)
                    payload = context.payload(prim, key)
                except IcheatError as error:
                    problems.append(str(error))
                    continue
                named.setdefault(key.anchored, {"source": source, "used": set()})["used"].add(key.digest)
                if payload is not None:
                    found[key.digest] = payload

        def tally(name: str) -> dict[str, int]:
            values = Counter(str(schema.read_attribute(prim, name, context.time)) for prim in context.edits)
            return dict(sorted(values.items()))

        muted = sum(not schema.read_attribute(prim, schema.ENABLED, context.time) for prim in context.edits)
        unlisted = sum(str(prim.GetPath()) not in context.listed for prim in context.edits)
        masks = [mask for p in found.values() for mask in (p.receiver_mask, p.caster_mask) if mask is not None]
        return Statistics(
            stacks=len(context.stacks),
            edits=len(context.edits),
            muted=muted,
            unlisted=unlisted,
            operations=tally(schema.OPERATION),
            blends=tally(schema.BLEND),
            keys=n_keys,
            payloads=len(found),
            painted_surfaces=len({(s.path, s.instance_id, s.part) for mask in masks for s in mask.surfaces}),
            texels=sum(int(mask.texels.size) for mask in masks),
            painted_texels=sum(int(np.count_nonzero(mask.texels)) for mask in masks),
            rows=sum(len(p.rows.row_pattern) for p in found.values() if p.rows is not None),
            sidecars=tuple(_sidecar(file, **what) for file, what in sorted(named.items())),
            problems=tuple(dict.fromkeys(problems)),
        )


def _sidecar(file: str, source: Any, used: set[str]) -> SidecarStatistics:
    size = len(source) if isinstance(source, bytes) else os.path.getsize(source)
    stored = sum(info.stored_bytes for info in list_elements(source, name=file) if info.payload in used)
    return SidecarStatistics(file, size, len(list_payloads(source, name=file)), len(used), stored)
