"""What a rule is, and what rules may look at."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar

from pxr import Usd

from icheat_usd.edits.facts import Facts, facts
from icheat_usd.edits.model import Payload
from icheat_usd.errors import IcheatError
from icheat_usd.stage import schema
from icheat_usd.stage.edit_stack import PayloadReader, anchor_path, open_asset
from icheat_usd.stage.keys import Key, read_keys
from icheat_usd.stage.stacks import Severity, listed_edits


@dataclass(frozen=True)
class Context:
    """What rules look at. Payloads and scenes are read when a rule first asks, and kept."""

    stage: Usd.Stage
    time: float | None
    stacks: tuple[Usd.Prim, ...]
    edits: tuple[Usd.Prim, ...]  #: active ones, listed or not
    selections: tuple[Usd.Prim, ...]  #: active prims with IcheatSelectionAPI
    read_payload: PayloadReader | None = None
    listed: frozenset[str] = field(default=frozenset())  #: paths of edits that some stack lists
    _payloads: dict[tuple[str, str, str], Payload | IcheatError] = field(default_factory=dict)
    _facts: dict[tuple[float | None, str], Facts | None] = field(default_factory=dict)

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

    def facts_at(self, time: float | None, anchor: str) -> Facts | None:
        """What the scene is like at a time, in full; None where it cannot be read."""
        if (time, anchor) not in self._facts:
            # Loaded when needed: hosts without kernels check stages too.
            from icheat_usd.stage.snapshot import AUTO_CAMERA, take_snapshot

            try:
                snapshot = take_snapshot(self.stage, camera=AUTO_CAMERA, time=time)
                self._facts[time, anchor] = facts(snapshot, anchor, limit=False)
            except IcheatError:
                self._facts[time, anchor] = None
        return self._facts[time, anchor]


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
