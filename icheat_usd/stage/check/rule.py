"""What a rule is, and what rules may look at."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

from pxr import Sdf, Usd

from icheat_usd.edits.facts import Facts, facts, selection_facts
from icheat_usd.edits.model import Edit, Payload
from icheat_usd.errors import IcheatError
from icheat_usd.stage import collections, schema
from icheat_usd.stage.edit_stack import PayloadReader, anchor_path, open_asset
from icheat_usd.stage.keys import Key, read_keys
from icheat_usd.stage.selections import with_limits
from icheat_usd.stage.spaces import read_target
from icheat_usd.stage.stacks import Severity, listed_edits, targets


@dataclass(frozen=True)
class Context:
    """What rules look at. Payloads and facts about scenes are read when a rule first asks, and kept."""

    stage: Usd.Stage
    time: float | None
    stacks: tuple[Usd.Prim, ...]
    edits: tuple[Usd.Prim, ...]  #: active ones, listed or not
    selections: tuple[Usd.Prim, ...]  #: active prims with IcheatSelectionAPI
    read_payload: PayloadReader | None = None
    listed: frozenset[str] = field(default=frozenset())  #: paths of edits that some stack lists
    _payloads: dict[tuple[str, str, str], Payload | IcheatError] = field(default_factory=dict)
    _facts: dict[tuple[object, ...], tuple[Facts, frozenset[str]]] = field(default_factory=dict)

    def payload(self, prim: Usd.Prim, key: Key) -> Payload | None:
        """The payload of a key; None where nothing was given to read it with.

        Raises
        ------
        IcheatError
            The file is missing, or the reader refuses it.
        """
        if self.read_payload is None:
            open_asset(prim, key)
            return None
        anchor = anchor_path(prim)
        name = (key.anchored, key.digest, anchor)
        if name not in self._payloads:
            try:
                source = open_asset(prim, key)
                self._payloads[name] = self.read_payload(key.anchored, source, key.digest, anchor)
            except IcheatError as error:
                self._payloads[name] = error
        found = self._payloads[name]
        if isinstance(found, IcheatError):
            raise found
        return found

    def payloads(self, prim: Usd.Prim) -> Iterator[tuple[Key, Payload]]:
        """Keys of an edit with their payloads, those that can be read: of the others `MissingSidecar` speaks."""
        if self.read_payload is None:
            return
        try:
            track = read_keys(prim)
        except IcheatError:
            return
        for key in track.keys if track else ():
            try:
                payload = self.payload(prim, key) if key.digest else None
            except IcheatError:
                continue
            if payload is not None:
                yield key, payload

    def all_payloads(self) -> Iterator[tuple[Usd.Prim, Key, Payload]]:
        """Every edit with each of its keys and payloads that can be read; see `payloads`."""
        for prim in self.edits:
            for key, payload in self.payloads(prim):
                yield prim, key, payload

    def facts_at(self, prim: Usd.Prim, time: float | None, then: Mapping[str, str | float | int]) -> Facts | None:
        """What the scene and an edit's selections are like at a time, in full; None where they cannot be read.

        Seen by the camera of `then`, at its size, where that camera is still there.
        """
        # Loaded when needed: hosts without kernels check stages too.
        from icheat_usd.stage.snapshot import AUTO_CAMERA, take_snapshot

        anchor = anchor_path(prim)
        camera, size = self._camera(anchor, then)
        seen = (time, anchor, camera, *size)
        try:
            if seen not in self._facts:
                width, height = size
                shot = take_snapshot(self.stage, camera=camera or AUTO_CAMERA, time=time, width=width, height=height)
                paths = frozenset(surface.path for surface in shot.surfaces)
                self._facts[seen] = facts(shot, anchor, limit=False), paths
            found, paths = self._facts[seen]
            now = found | selection_facts(selected_by(prim, time, paths), anchor)
        except IcheatError:
            return None
        if then.get("camera") == AUTO_CAMERA:
            del now["camera-view"]  # It moves with the bounds of the scene.
        elif not camera:
            now["camera"] = ""
        return now

    def _camera(self, anchor: str, then: Mapping[str, str | float | int]) -> tuple[str, tuple[int | None, int | None]]:
        name = str(then.get("camera", ""))
        path = name if name.startswith("/") or not name else f"{anchor.rstrip('/')}/{name}"
        found = Sdf.Path.IsValidPathString(path) and self.stage.GetPrimAtPath(path)
        if not found or not found.IsActive() or found.GetTypeName() != "Camera":
            return "", (None, None)
        width, height = (then.get(side) for side in ("width", "height"))
        if not isinstance(width, int) or not isinstance(height, int) or not 0 < width * height < 1 << 32:
            return path, (None, None)
        return path, (width, height)


def selected_by(prim: Usd.Prim, time: float | None, surface_paths: frozenset[str]) -> Edit:
    """An edit as far as its selections and aims go."""
    receivers, casters = (collections.select(prim, n, surface_paths) for n in (schema.RECEIVERS, schema.CASTERS))
    edit = Edit(str(prim.GetPath()), "", {}, receivers, casters, occluders=targets(prim, schema.OCCLUDERS))
    edit, _ = with_limits(prim, edit, time, surface_paths)
    return replace(edit, target=read_target(prim, time)[0])


Found = Iterator[tuple[Usd.Prim, str, str]]  #: prim, property or "", message


class Rule(ABC):
    """One thing that can be wrong."""

    doc: ClassVar[str]
    severity: ClassVar[Severity] = Severity.ERROR

    @abstractmethod
    def find(self, context: Context) -> Found:
        """Yield prim, property name ("" for the prim itself) and message of everything that breaks the rule."""


def look_at(stage: Usd.Stage, time: float | None = None, read_payload: PayloadReader | None = None) -> Context:
    """Find the edits of a stage, for rules to look at."""
    everything = list(Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()))

    def with_schema(name: str) -> tuple[Any, ...]:
        return tuple(prim for prim in everything if schema.has_schema(prim, name))

    stacks = with_schema(schema.STACK_API)
    listed = frozenset(str(prim.GetPath()) for stack in stacks for prim in listed_edits(stack)[0])
    edits, selections = with_schema(schema.EDIT_API), with_schema(schema.SELECTION_API)
    return Context(stage, schema.default_time(stage, time), stacks, edits, selections, read_payload, listed)
