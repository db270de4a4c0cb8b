"""Writing keyframes of an edit into one layer, so that other layers keep theirs."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from pxr import Sdf, Usd

from icheat_usd.errors import EditError
from icheat_usd.stage import schema
from icheat_usd.stage.keys import (
    SAME_TIME,
    Interpolation,
    Key,
    KeyTrack,
    read_keys,
    strongest_opinion,
)
from icheat_usd.stage.layers import asset_path, overridden_opinions, spec_path, writable_edit, writing
from icheat_usd.stage.stacks import EditFinding
from icheat_usd.stage.variants import selected_variant

Variant = tuple[str, str] | None

#: customData of icheat:payload in a layer that copied another layer's keys: where they came from.
COPIED_FROM = "icheatCopiedFrom"


def set_payload_key(
    stage: Usd.Stage,
    edit: str,
    *,
    layer: str | Sdf.Layer,
    time: float | None,
    payload: tuple[str | Path, str] | None,
    interpolation: str | None = None,
    variant: Variant = None,
) -> tuple[EditFinding, ...]:
    """Author the payload of one keyframe.

    USD does not merge time samples of two layers. If another layer decides the
    keys, all of them are therefore copied to `layer` first, and the layer
    notes where they came from; `check` reports when the source has moved on. A
    payload that held for all times is not a key, and the first key hides it.

    Parameters
    ----------
    time
        Stage time of the key; None authors one payload for all times, in place of all keys.
    payload
        (file, digest), or None for the identity.
    interpolation
        ``"linear"``, ``"smooth"`` or ``"held"``; None leaves it.
    variant
        (set, variant) to write into, as for the other functions here; another one may be selected.

    Raises
    ------
    EditError
        There is no such edit, or its composed keys cannot be copied.
    """
    _check_interpolation(edit, interpolation)
    with _writing_edit(stage, edit, layer, variant) as (prim, target):
        if time is None:
            _clear_keys(prim, target)
        else:
            _own_keys(prim, target)
        asset = asset_path(target, os.fspath(payload[0])) if payload is not None else None
        write_key(prim, target, time, asset, payload[1] if payload is not None else "")
        if interpolation is not None:
            prim.GetAttribute(schema.KEY_INTERPOLATION).Set(interpolation)
        return overridden_opinions(prim, target, (schema.PAYLOAD, schema.FILE_PATH), time)


def remove_payload_key(
    stage: Usd.Stage, edit: str, *, layer: str | Sdf.Layer, time: float, variant: Variant = None
) -> tuple[EditFinding, ...]:
    """Take one keyframe out; if another layer decides the keys, the others are copied to `layer` first.

    Raises
    ------
    EditError
        There is no such edit or key, or it is the only key: without it the edit would lose its masks.
    """
    with _writing_edit(stage, edit, layer, variant) as (prim, target):
        key = key_at(prim, time)
        track = read_keys(prim)
        if track is None or len(track.times) < 2:
            raise EditError(
                f"{prim.GetPath()}: its only key is at {time:g}, and without it the edit would lose what was painted; "
                f"make the key an identity, mute the edit or remove it"
            )
        _own_keys(prim, target)
        for name in (schema.PAYLOAD, schema.FILE_PATH):
            _erase_sample(prim, target, name, float(key.time or 0.0))
        return overridden_opinions(prim, target, (schema.PAYLOAD, schema.FILE_PATH), time)


def copy_payload_key(
    stage: Usd.Stage, edit: str, *, layer: str | Sdf.Layer, time: float, to: float, variant: Variant = None
) -> tuple[EditFinding, ...]:
    """Let the payload of the key at `time` hold at `to` too.

    Raises
    ------
    EditError
        There is no such edit or key.
    """
    with selected_variant(stage, edit, variant):
        key = key_at(writable_edit(stage, edit), time)
        payload = (key.anchored, key.digest) if key.digest else None
        return set_payload_key(stage, edit, layer=layer, time=to, payload=payload, variant=variant)


def set_key_interpolation(
    stage: Usd.Stage, edit: str, *, layer: str | Sdf.Layer, interpolation: str, variant: Variant = None
) -> tuple[EditFinding, ...]:
    """Author what happens between the keys: ``"linear"``, ``"smooth"`` or ``"held"``.

    Raises
    ------
    EditError
        There is no such edit or interpolation.
    """
    _check_interpolation(edit, interpolation)
    with _writing_edit(stage, edit, layer, variant) as (prim, target):
        prim.GetAttribute(schema.KEY_INTERPOLATION).Set(interpolation)
        return overridden_opinions(prim, target, (schema.KEY_INTERPOLATION,), None)


def release_parameters(
    stage: Usd.Stage, edit: str, names: Iterable[str], *, layer: str | Sdf.Layer, variant: Variant = None
) -> tuple[EditFinding, ...]:
    """Let keys decide parameters that have been authored for all times, as far as `layer` can.

    What the layer says about them goes; what weaker layers say is blocked.

    Parameters
    ----------
    names
        Full names of attributes, such as ``icheat:scale:gain``.

    Returns
    -------
    tuple of EditFinding
        Parameters that a stronger layer goes on deciding.
    """
    findings = []
    with _writing_edit(stage, edit, layer, variant) as (prim, target):
        for name in names:
            own = spec_path(stage, prim.GetPath().AppendProperty(name))
            if target.GetAttributeAtPath(own):
                del target.GetPrimAtPath(own.GetPrimPath()).properties[name]
            attribute = prim.GetAttribute(name)
            if attribute and attribute.HasAuthoredValue():
                attribute.Block()
            opinion = strongest_opinion(prim.GetAttribute(name))
            if opinion is not None and not opinion.is_blocked:
                message = f"{opinion.layer.identifier} decides it at all times, so that keys do not; clear it there"
                findings.append(EditFinding(str(prim.GetPath()), name, message))
    return tuple(findings)


@contextmanager
def _writing_edit(
    stage: Usd.Stage, edit: str, layer: str | Sdf.Layer, variant: Variant
) -> Iterator[tuple[Usd.Prim, Sdf.Layer]]:
    """An edit's prim and the layer to write to, with the variant selected that may alone have the edit."""
    with selected_variant(stage, edit, variant):
        prim = writable_edit(stage, edit)
        with writing(stage, layer, prim.GetPath(), variant) as target:
            yield prim, target


def key_at(prim: Usd.Prim, time: float) -> Key:
    """The composed key at just this stage time.

    Raises
    ------
    EditError
        There is none.
    """
    track = read_keys(prim)
    for key in track.keys if track else ():
        if key.time is not None and abs(key.time - time) <= SAME_TIME:
            return key
    times = ", ".join(f"{known:g}" for known in track.times) if track else ""
    held = "one payload for all times" if track and track.keys else "no keys"
    raise EditError(f"{prim.GetPath()}: no key at {time:g}; it has {f'keys at {times}' if times else held}")


def _check_interpolation(edit: str, interpolation: str | None) -> None:
    if interpolation is not None and interpolation not in list(Interpolation):
        known = ", ".join(Interpolation)
        raise EditError(f"{edit}: no key interpolation is called '{interpolation}'; there are {known}")


def _clear_keys(prim: Usd.Prim, layer: Sdf.Layer) -> None:
    for name in (schema.PAYLOAD, schema.FILE_PATH):
        spec = layer.GetAttributeAtPath(spec_path(prim.GetStage(), prim.GetPath().AppendProperty(name)))
        if spec:
            for time in layer.ListTimeSamplesForPath(spec.path):
                layer.EraseTimeSample(spec.path, time)
            spec.ClearDefaultValue()
            spec.SetInfo("customData", {k: v for k, v in spec.customData.items() if k != COPIED_FROM})


def _own_keys(prim: Usd.Prim, layer: Sdf.Layer) -> None:
    """Make `layer` the one that decides the keys, by copying all composed ones."""
    track = read_keys(prim)
    opinion = strongest_opinion(prim.GetAttribute(schema.PAYLOAD))
    own = spec_path(prim.GetStage(), prim.GetPath().AppendProperty(schema.PAYLOAD))
    if track is None or opinion is None or (opinion.layer, opinion.path) == (layer, own) or not track.times:
        return
    for key in track.keys:
        write_key(prim, layer, key.time, asset_path(layer, key.anchored) if key.digest else None, key.digest)
    spec = layer.GetAttributeAtPath(own)
    source = opinion.layer.realPath or opinion.layer.identifier
    if spec:
        spec.customData[COPIED_FROM] = {"layer": asset_path(layer, source), "keys": track.digest}


def copied_keys_are_current(prim: Usd.Prim) -> tuple[str, bool] | None:
    """Whether keys that a layer copied still equal their source.

    Returns
    -------
    (str, bool) or None
        Identifier of the source layer and whether it still says the same; None where nothing was copied.
    """
    opinion = strongest_opinion(prim.GetAttribute(schema.PAYLOAD))
    if opinion is None:
        return None
    note = opinion.layer.GetAttributeAtPath(opinion.path).customData.get(COPIED_FROM)
    if not note:
        return None
    identifier = Sdf.ComputeAssetPathRelativeToLayer(opinion.layer, str(note.get("layer", "")))
    for spec, offset in prim.GetAttribute(schema.PAYLOAD).GetPropertyStackWithLayerOffsets(schema.time_code(None)):
        # A class or a variant may have copied keys within one layer.
        is_source = (spec.layer, spec.path) != (opinion.layer, opinion.path)
        if (
            is_source
            and identifier in (spec.layer.identifier, spec.layer.realPath)
            and spec.layer.GetNumTimeSamplesForPath(spec.path) > 0
        ):
            samples = [
                (t, spec.layer.QueryTimeSample(spec.path, t)) for t in spec.layer.ListTimeSamplesForPath(spec.path)
            ]
            keys = tuple(
                Key(offset * t, "" if isinstance(value, Sdf.ValueBlock) else str(value)) for t, value in samples
            )
            # Interpolation composes by itself, so that a copy does not go stale with it.
            possible = {KeyTrack(keys, interpolation, identifier).digest for interpolation in Interpolation}
            return identifier, note.get("keys") in possible
    return identifier, False


def write_key(prim: Usd.Prim, layer: Sdf.Layer, time: float | None, asset: str | None, digest: str) -> None:
    """Author one key in the layer that the stage writes to; no asset is the identity."""
    when = schema.time_to_write(time)
    for name, value in ((schema.FILE_PATH, asset and Sdf.AssetPath(asset)), (schema.PAYLOAD, digest)):
        attribute = prim.GetAttribute(name)
        if time is None:
            attribute.Set(value if asset else Sdf.ValueBlock())
            continue
        stage_time = float(time)
        _erase_sample(prim, layer, name, stage_time)
        attribute.Set(value if asset else Sdf.ValueBlock(), when)


def _erase_sample(prim: Usd.Prim, layer: Sdf.Layer, name: str, stage_time: float) -> None:
    """Drop a sample at the same stage time that rounding of the layer offset moved by a hair."""
    path = spec_path(prim.GetStage(), prim.GetPath().AppendProperty(name))
    target = prim.GetStage().GetEditTargetForLocalLayer(layer)
    offset = target.GetMapFunction().timeOffset
    for layer_time in layer.ListTimeSamplesForPath(path):
        if abs(offset * layer_time - stage_time) <= SAME_TIME:
            layer.EraseTimeSample(path, layer_time)
