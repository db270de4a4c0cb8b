"""A variant as the place that opinions are written to: the dusk grade of a stack, the soft look of an edit."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from pxr import Sdf, Usd

from icheat_usd.errors import EditError


@contextmanager
def selected_variant(stage: Usd.Stage, path: str, variant: tuple[str, str] | None) -> Iterator[Sdf.Path | None]:
    """Have a variant selected meanwhile, whatever is selected otherwise.

    Parameters
    ----------
    path
        Prim that is written to. The variant set is that of the nearest prim at or above it that has one so called.
    variant
        (set, variant), or None for no variant.

    Yields
    ------
    Sdf.Path or None
        Path of the variant, such as ``/World/Edits{grade=dusk}``.

    Raises
    ------
    EditError
        There is no such set or variant, or it is not selected and the stage has no session layer to select it in.
    """
    if variant is None:
        yield None
        return
    owner = _owner(stage, path, *variant)
    place = owner.GetPath().AppendVariantSelection(*variant)
    if owner.GetVariantSet(variant[0]).GetVariantSelection() == variant[1]:
        yield place
        return
    session = stage.GetSessionLayer()
    if not session:
        raise EditError(
            f"{owner.GetPath()}: {variant[0]}={variant[1]} is not selected; select it or open the stage with a session"
        )
    first_new = next((p for p in owner.GetPath().GetPrefixes() if not session.GetPrimAtPath(p)), None)
    selections = Sdf.CreatePrimInLayer(session, owner.GetPath()).variantSelections
    before = selections.get(variant[0])
    selections[variant[0]] = variant[1]
    try:
        yield place
    finally:
        _select_again(session, owner.GetPath(), variant[0], before, first_new)


def _select_again(
    session: Sdf.Layer, path: Sdf.Path, name: str, before: str | None, first_new: Sdf.Path | None
) -> None:
    """Put a selection back, and take out the prims that only held ours."""
    spec = session.GetPrimAtPath(path)
    if before is None:
        del spec.variantSelections[name]
    else:
        spec.variantSelections[name] = before
    if first_new is not None:
        prefixes = [prefix for prefix in path.GetPrefixes() if prefix.HasPrefix(first_new)]
        for prefix in reversed(prefixes):
            if session.GetPrimAtPath(prefix):  # Removing an inert prim takes inert parents along.
                session.ScheduleRemoveIfInert(session.GetPrimAtPath(prefix))


def _owner(stage: Usd.Stage, path: str, set_name: str, name: str) -> Usd.Prim:
    """The nearest prim at or above `path` with the set, which must have the variant."""
    prefixes = Sdf.Path(path).GetPrefixes() if Sdf.Path.IsValidPathString(path) else []
    prims = [prim for prim in map(stage.GetPrimAtPath, reversed(prefixes)) if prim]
    owner = next((prim for prim in prims if prim.GetVariantSets().HasVariantSet(set_name)), None)
    if owner is None:
        named = [(prim.GetPath(), prim.GetVariantSets().GetNames()) for prim in prims]
        sets = [f"{where} has {', '.join(names)}" for where, names in named if names]
        raise EditError(
            f"{path}: neither it nor a prim above it has a variant set '{set_name}'; "
            f"{'; '.join(sets) or 'there are none'}; add it to the stack's prim first"
        )
    variants = owner.GetVariantSet(set_name).GetVariantNames()
    if name not in variants:
        known = ", ".join(variants) or "no variants"
        raise EditError(f"{owner.GetPath()}: variant set '{set_name}' has no variant '{name}'; it has {known}")
    return owner


def variant_target(stage: Usd.Stage, layer: Sdf.Layer, place: Sdf.Path) -> Usd.EditTarget:
    """Where opinions in a selected variant go in one layer of the stage, times mapped into it."""
    owner = place.GetPrimPath()
    spec = layer.GetPrimAtPath(owner)
    names = spec.GetInfo("variantSetNames") if spec and spec.HasInfo("variantSetNames") else None
    Sdf.JustCreatePrimInLayer(layer, place)
    # Layers here name the set already, as a rule; naming it again would change the strength of the prim's other sets.
    spec = layer.GetPrimAtPath(owner)
    if names is None:
        spec.ClearInfo("variantSetNames")
    else:
        spec.SetInfo("variantSetNames", names)
    target = _composed_target(stage, layer, place)
    if target is None:  # Only what is referenced names it.
        spec.variantSetNameList.appendedItems.append(place.GetVariantSelection()[0])
        target = _composed_target(stage, layer, place)
    if target is None:
        raise EditError(f"{place} does not compose from {layer.identifier}; author it without a variant")
    return target


def _composed_target(stage: Usd.Stage, layer: Sdf.Layer, place: Sdf.Path) -> Usd.EditTarget | None:
    """The variant's opinions of a layer as they compose, None where they do not."""
    arcs = Usd.PrimCompositionQuery(stage.GetPrimAtPath(place.GetPrimPath())).GetCompositionArcs()
    for arc in arcs:  # Its node lives only as long as the arcs do.
        node = arc.GetTargetNode()
        if node.path == place and layer in node.layerStack.layers:
            return Usd.EditTarget(layer, node)
    return None
