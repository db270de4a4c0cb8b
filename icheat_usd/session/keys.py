"""Keyframes written for good: a payload in a new sidecar, its time in one layer, and the layer saved."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from icheat_usd.edits import operations
from icheat_usd.edits.model import MaskedSurface, Payload, SurfaceMask, Value
from icheat_usd.edits.operations.base import plain_values
from icheat_usd.edits.operations.constants import baked_constants
from icheat_usd.edits.staleness import value_text
from icheat_usd.errors import EditError, SidecarError
from icheat_usd.scene import F32, F64, Finding
from icheat_usd.session.authoring import read_payload
from icheat_usd.session.key_values import parameters_at
from icheat_usd.session.origin import history_entry
from icheat_usd.sidecar import write_payloads
from icheat_usd.stage import key_authoring, layers, schema
from icheat_usd.stage.edit_stack import anchor_path, open_asset
from icheat_usd.stage.keys import SAME_TIME, Key, read_keys, strongest_opinion
from icheat_usd.stage.parameters import authored_parameters, mix_parameters
from icheat_usd.stage.stacks import EditFinding, edit_prim
from icheat_usd.stage.variants import selected_variant


@dataclass(frozen=True)
class ListedKey:
    """One keyframe as composed."""

    time: float | None  #: stage time; None: one payload for all times
    payload: str  #: digest, "" for the identity
    file: str  #: where its sidecar was looked for, "" for the identity
    is_found: bool
    parameters: Mapping[str, Value] = field(default_factory=dict)  #: that hold there; none where they cannot be read


@dataclass(frozen=True)
class KeyList:
    """All keys of an edit, and who says so."""

    edit: str
    keys: tuple[ListedKey, ...]
    interpolation: str
    layer: str  #: identifier of the layer that decides the keys, "" without keys
    copied_from: str  #: identifier of the layer they were copied from, "" where they were not
    is_current: bool  #: False where that layer has other keys by now


def list_keys(stage: Any, edit: str) -> KeyList:
    """The composed keys of an edit.

    Raises
    ------
    EditError
        There is no such edit, or its keys cannot be read.
    """
    prim = edit_prim(stage, edit)
    track = read_keys(prim)
    if track is None:
        return KeyList(edit, (), schema.read_attribute(prim, schema.KEY_INTERPOLATION, None), "", "", True)
    copied_from, is_current = key_authoring.copied_keys_are_current(prim) or ("", True)
    keys = tuple(
        ListedKey(key.time, key.digest, key.anchored, bool(key.resolved), _parameters(prim, key)) for key in track.keys
    )
    return KeyList(edit, keys, track.interpolation.value, track.layer, copied_from, is_current)


def _parameters(prim: Any, key: Key) -> dict[str, Value]:
    try:
        return parameters_at(prim, key) if key.digest else {}
    except (EditError, SidecarError):
        return {}


def set_key(
    stage: Any,
    edit: str,
    *,
    layer: str,
    frame: float | None,
    parameters: Mapping[str, Value] | None = None,
    receiver_mask: SurfaceMask | None = None,
    caster_mask: SurfaceMask | None = None,
    identity: bool = False,
    interpolation: str | None = None,
    made_against: Mapping[str, str | float | int] | None = None,
    sidecar: str | Path | None = None,
    why: str = "",
    variant: tuple[str, str] | None = None,
) -> tuple[Finding, ...]:
    """Set one keyframe and save the layer. What is not given is as it is at that frame.

    A parameter that has been authored for all times is keyed from now on: the
    other keys take the value that it had, and the authored one goes.

    Parameters
    ----------
    frame : stage time
        None sets one payload for all times, in place of every key.
    parameters
        Values at this key.
    receiver_mask, caster_mask : SurfaceMask, optional
        Masks at this key, in place of those of the keys around it.
    identity : bool
        Let the edit do nothing at this key.
    interpolation : "linear", "smooth" or "held", optional
        What happens between all keys of the edit.
    sidecar : path, optional
        Folder or file for the payload; beside the layer's file by default.
    variant : (str, str), optional
        Variant set and variant to write into.

    Returns
    -------
    tuple of Finding
        What was authored without effect, as a stronger layer decides it, and what had to be left out.

    Raises
    ------
    EditError, SidecarError
        Something named does not exist or cannot be written. The layer is then
        as before, and no sidecar is left behind.
    """
    target = layers.find_layer(stage, layer)
    if identity:
        if parameters or receiver_mask is not None or caster_mask is not None:
            raise EditError(f"{edit}: an identity key has no parameters and no masks; leave them out")
        with _saved(stage, edit, target, variant):
            return key_authoring.set_payload_key(
                stage, edit, layer=target, time=frame, payload=None, interpolation=interpolation, variant=variant
            )
    with selected_variant(stage, edit, variant):
        return _set_payloads(
            _Made(stage, edit, frame, plain_values(parameters)),
            frame,
            (receiver_mask, caster_mask),
            target,
            made_against or {},
            interpolation,
            sidecar,
            why,
            variant,
        )


def _set_payloads(
    made: _Made,
    frame: float | None,
    masks: tuple[SurfaceMask | None, SurfaceMask | None],
    target: Any,
    made_against: Mapping[str, str | float | int],
    interpolation: str | None,
    sidecar: str | Path | None,
    why: str,
    variant: tuple[str, str] | None,
) -> tuple[Finding, ...]:
    stage, edit = made.prim.GetStage(), str(made.prim.GetPath())
    kept = made.unchanged_payload() if masks == (None, None) else None
    payloads: dict[float | None, Payload] = {}
    if kept is None:
        payloads = {frame: made.payload(masks, made_against), **made.other_payloads()}
    file: Path | None = None
    try:
        named: dict[float | None, tuple[str | Path, str]] = {frame: kept} if kept else {}
        if payloads:
            beside = sidecar or target.realPath
            if not beside:
                raise EditError(
                    f"layer '{target.identifier}' has no file to put a sidecar beside; name one with --sidecar"
                )
            history = history_entry(why, edit)
            file, digests = write_payloads(beside, payloads.values(), anchor=anchor_path(made.prim), history=history)
            named = {time: (file, digest) for time, digest in zip(payloads, digests, strict=True)}
        with _saved(stage, edit, target, variant):
            findings: tuple[Finding, ...] = ()
            for time, payload in named.items():
                findings = key_authoring.set_payload_key(
                    stage,
                    edit,
                    layer=target,
                    time=time,
                    payload=payload,
                    interpolation=interpolation,
                    variant=variant,
                )
            released = key_authoring.release_parameters(stage, edit, made.released(), layer=target, variant=variant)
    except Exception:
        # Not after an interruption: the layer may have been saved already, and then names this file.
        if file is not None:
            file.unlink(missing_ok=True)
        raise
    return tuple(dict.fromkeys((*findings, *released, *made.findings)))


def copy_key(
    stage: Any, edit: str, *, layer: str, frame: float, to: float, variant: tuple[str, str] | None = None
) -> tuple[Finding, ...]:
    """Let the payload of the key at `frame` hold at `to` too, and save the layer."""
    target = layers.find_layer(stage, layer)
    with _saved(stage, edit, target, variant):
        return key_authoring.copy_payload_key(stage, edit, layer=target, time=frame, to=to, variant=variant)


def remove_key(
    stage: Any, edit: str, *, layer: str, frame: float, variant: tuple[str, str] | None = None
) -> tuple[Finding, ...]:
    """Take the key at `frame` out and save the layer; the only key stays, see `stage.key_authoring`."""
    target = layers.find_layer(stage, layer)
    with _saved(stage, edit, target, variant):
        return key_authoring.remove_payload_key(stage, edit, layer=target, time=frame, variant=variant)


def set_interpolation(
    stage: Any, edit: str, *, layer: str, interpolation: str, variant: tuple[str, str] | None = None
) -> tuple[Finding, ...]:
    """Set what happens between the keys and save the layer."""
    target = layers.find_layer(stage, layer)
    with _saved(stage, edit, target, variant):
        return key_authoring.set_key_interpolation(
            stage, edit, layer=target, interpolation=interpolation, variant=variant
        )


def payload_at(stage: Any, edit: str, frame: float | None, made_against: Mapping[str, str | float | int]) -> Payload:
    """What an edit says at a frame as one payload: recipe, with what is authored over it, and masks.

    Raises
    ------
    EditError, SidecarError
        There is no such edit, or its keys cannot be read.
    """
    return _Made(stage, edit, frame, {}).payload((None, None), made_against)


class _Made:
    """What an edit says around one frame, and the payloads that a key there needs."""

    def __init__(self, stage: Any, edit: str, frame: float | None, parameters: dict[str, Value]) -> None:
        self.prim = edit_prim(stage, edit)
        self.frame = frame
        self.parameters = parameters
        self.findings: list[Finding] = []
        track = read_keys(self.prim)
        self._keys = track.keys if track else ()
        self._share = track.at(frame) if track else ()
        self._payloads = [(self._read(key), weight) for key, weight in self._share if key.digest]
        if 0 < len(self._payloads) < len(self._share):
            message = (
                f"one of the keys around frame {frame or 0.0:g} is the identity, which no payload can be part of;"
                " the new key has the other at full strength, so lower its parameters to fade it"
            )
            self.findings.append(EditFinding(edit, schema.PAYLOAD, message))
        self.operation = self._operation()
        known = schema.operations().get(self.operation)
        self._names = {name: p.name for name, p in known.parameters.items()} if known else {}
        implementation = operations.find(self.operation)
        if parameters and implementation is None:
            raise EditError(f"{edit}: operation '{self.operation}' is unknown here, so its parameters cannot be keyed")
        if implementation is not None:
            implementation.complete(parameters, edit)
        authored = authored_parameters(self.prim, self.operation, frame)
        #: authored for all times or all layers' keys, and keyed from now on
        self._newly_keyed = [name for name in parameters if name in authored]

    def _operation(self) -> str:
        if strongest_opinion(self.prim.GetAttribute(schema.OPERATION)) is None and self._payloads:
            return self._payloads[0][0].operation
        return str(schema.read_attribute(self.prim, schema.OPERATION, None))

    def _read(self, key: Key) -> Payload:
        return read_payload(key.anchored, open_asset(self.prim, key), key.digest, anchor_path(self.prim))

    def unchanged_payload(self) -> tuple[str, str] | None:
        """File and digest that can be named again: nothing is to change and one key holds at the frame."""
        held = [key for key, _ in self._share if key.digest]
        if self.parameters or len(self._share) != 1 or not held:
            return None
        return held[0].anchored, held[0].digest

    def payload(
        self, masks: tuple[SurfaceMask | None, SurfaceMask | None], made_against: Mapping[str, str | float | int]
    ) -> Payload:
        """What holds at the frame, with the given parameters and masks."""
        same = [(p, weight) for p, weight in self._payloads if p.operation == self.operation]
        recipe = mix_parameters([(p.parameters, weight) for p, weight in same]) if same else {}
        authored = authored_parameters(self.prim, self.operation, self.frame)
        complete = {**recipe, **authored, **self.parameters}
        base = max(self._payloads, key=lambda pair: pair[1])[0] if self._payloads else None
        receiver = masks[0] if masks[0] is not None else self._mixed_mask("receiver_mask")
        caster = masks[1] if masks[1] is not None else self._mixed_mask("caster_mask")
        implementation = operations.find(self.operation)
        if implementation is None and base is not None:
            return replace(base, receiver_mask=receiver, caster_mask=caster)
        made = Payload(self.operation, complete, receiver, caster, made_against=made_against)
        return self._baked(made)

    def other_payloads(self) -> dict[float | None, Payload]:
        """By time: payloads of the other keys with the values, so far authored, of parameters that are keyed now."""
        others: dict[float | None, Payload] = {}
        if self.frame is None:
            return others  # One payload for all times leaves no other key.
        for key in self._keys if self._newly_keyed else ():
            if not key.digest or key.time is None or abs(key.time - self.frame) <= SAME_TIME:
                continue
            authored = authored_parameters(self.prim, self.operation, key.time)
            payload = self._read(key)
            values = {name: authored[name] for name in self._newly_keyed if name in authored}
            others[key.time] = self._baked(replace(payload, parameters={**payload.parameters, **values}, rows=None))
            changed = [name for name in values if values[name] != payload.parameters.get(name)]
            for name in changed:
                message = f"was {value_text(values[name])} at all frames, so the key at {key.time:g} has that now"
                self.findings.append(EditFinding(str(self.prim.GetPath()), self._names[name], message))
        return others

    def released(self) -> list[str]:
        """Full names of the attributes that keys decide from now on."""
        return [self._names[name] for name in self._newly_keyed]

    def _baked(self, payload: Payload) -> Payload:
        implementation = operations.find(payload.operation)
        if implementation is None:
            return payload
        complete = implementation.complete(payload.parameters, str(self.prim.GetPath()))
        # What is baked of the parameters that the payload had must not outlive them.
        found = baked_constants(implementation, complete)
        constants = {name: found.get(name) for name in ("scale_delta", "emission", "offset")}
        return replace(payload, **constants)  # type: ignore[arg-type]

    def _mixed_mask(self, side: str) -> SurfaceMask | None:
        """The mask between those of the keys around; with equal parameters at both it is what was there."""
        masks: Sequence[tuple[SurfaceMask | None, float]] = [(getattr(p, side), w) for p, w in self._payloads]
        if not masks:
            return None
        heaviest = max(masks, key=lambda pair: pair[1])[0]
        if len(masks) == 1 or all(_equal(mask, heaviest) for mask, _ in masks):
            return heaviest
        painted = [(mask, weight) for mask, weight in masks if mask is not None]
        if heaviest is None or len(painted) < len(masks) or len({mask.resolution for mask, _ in painted}) > 1:
            around = f"the keys around frame {self.frame or 0.0:g}"
            message = f"{around} have masks of another kind; that of the nearer key is taken"
            self.findings.append(EditFinding(str(self.prim.GetPath()), side.replace("_", " "), message))
            return heaviest
        return _mean_mask(painted)


def _mean_mask(masks: Sequence[tuple[SurfaceMask, float]]) -> SurfaceMask:
    """Weighted mean; a surface that a mask does not name has weight 0 there."""
    total = sum(weight for _, weight in masks)
    mixed: dict[MaskedSurface, F64] = {}
    rest: dict[MaskedSurface, F32 | None] = {}
    for mask, weight in masks:
        begin = 0
        for surface in mask.surfaces:
            some = slice(begin, begin + surface.n_faces)
            mixed[surface] = mixed.get(surface, 0.0) + weight / total * mask.texels[some].astype(np.float64)
            rest[surface] = rest.get(surface) if mask.rest is None else mask.rest[some]
            begin += surface.n_faces
    known = [places for places in rest.values() if places is not None]
    return SurfaceMask(
        tuple(mixed),
        (np.round(np.concatenate(list(mixed.values())) * 255) / 255).astype(np.float32),
        np.concatenate(known) if len(known) == len(rest) else None,
    )


def _equal(a: SurfaceMask | None, b: SurfaceMask | None) -> bool:
    if a is None or b is None:
        return a is b
    return a.surfaces == b.surfaces and np.array_equal(a.texels, b.texels)


@contextmanager
def _saved(stage: Any, edit: str, target: Any, variant: tuple[str, str] | None) -> Iterator[None]:
    """Write to an edit, then save the layer; after any error the layer says what it said before."""
    with layers.writing(stage, target, edit, variant):
        yield
        if not target.anonymous:
            layers.save_layer(target)
