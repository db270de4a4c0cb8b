"""Who says what in list-edited relationships: which layer lists a target, takes it out, or names it in vain."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pxr import Sdf, Usd

from icheat_usd.stage import schema
from icheat_usd.stage.stacks import targets


@dataclass(frozen=True)
class Listing:
    """What the layers of a stack say about one of its targets."""

    path: str
    layer: str  #: identifier of the strongest layer that lists it
    removed_by: str = ""  #: identifier of the layer that takes it out again, "" where none does


@dataclass(frozen=True)
class _Opinion:
    """One layer's list edits, with the paths that they mean on the stage; "" where they mean nothing there."""

    layer: str
    added: tuple[tuple[Sdf.Path, str], ...]  #: as authored, and on the stage
    deleted: tuple[str, ...]
    is_explicit: bool


def listings(stack: Usd.Prim) -> tuple[Listing, ...]:
    """Who lists each edit of a stack: those that take part in their order, then those that a layer took out.

    A layer takes an edit out by deleting it, or by an explicit list without it.
    """
    listed: dict[str, str] = {}
    deleted: dict[str, str] = {}
    lost: dict[str, Listing] = {}
    cut_off_by = ""  # the layer whose explicit list hides what is weaker
    for opinion in _opinions(stack, schema.EDITS):
        for _, path in opinion.added:
            if path in listed or not path:
                continue
            remover = deleted.get(path, cut_off_by)
            if remover:
                lost.setdefault(path, Listing(path, opinion.layer, remover))
            else:
                listed[path] = opinion.layer
        for path in opinion.deleted:
            deleted.setdefault(path, opinion.layer)
        if opinion.is_explicit:
            cut_off_by = cut_off_by or opinion.layer
    composed = targets(stack, schema.EDITS)
    return (*(Listing(path, listed.get(path, "")) for path in composed), *lost.values())


def dropped_targets(prim: Usd.Prim, name: str) -> list[tuple[Sdf.Path, str]]:
    """Targets that a layer names and USD drops without a word: as authored, with the layer's identifier.

    A reference maps only paths below the prim that it brings; others have no meaning where it lands. What a stronger
    layer takes out anyway is not dropped.
    """
    composed = set(targets(prim, name))
    taken_out: set[str] = set()
    dropped = []
    for opinion in _opinions(prim, name):
        for authored, path in opinion.added:
            # Targets of a prim in an instance are told by the instance's paths, which mapping does not know.
            is_kept = path in composed or path in taken_out or (bool(path) and prim.IsInstanceProxy())
            if not is_kept:
                dropped.append((authored, opinion.layer))
        if opinion.is_explicit:
            break
        taken_out.update(opinion.deleted)
    return dropped


def _opinions(prim: Usd.Prim, name: str) -> Iterator[_Opinion]:
    """Every opinion on a relationship, strongest first, through all arcs."""
    queried = prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim
    arcs = Usd.PrimCompositionQuery(queried).GetCompositionArcs()
    for arc in arcs:  # Its node lives only as long as the arcs do.
        node = arc.GetTargetNode()

        def on_stage(path: Sdf.Path, node: Any = node) -> str:
            return str(node.mapToRoot.MapSourceToTarget(path))

        for layer in node.layerStack.layers:
            spec = layer.GetRelationshipAtPath(node.path.AppendProperty(name))
            if spec:
                items = spec.targetPathList
                yield _Opinion(
                    layer.identifier,
                    tuple((path, on_stage(path)) for path in items.GetAddedOrExplicitItems()),
                    tuple(on_stage(path) for path in items.deletedItems),
                    items.isExplicit,
                )
