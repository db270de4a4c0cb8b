"""What edits say as composed, and which layer says so."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from pxr import Usd

from icheat_usd.edits.model import Value
from icheat_usd.errors import EditError
from icheat_usd.stage import collections, schema
from icheat_usd.stage.keys import KeyTrack, comes_from_clips, read_keys, strongest_opinion
from icheat_usd.stage.list_edits import listings
from icheat_usd.stage.parameters import authored_parameters
from icheat_usd.stage.stacks import edit_prim, stack_prims, targets


@dataclass(frozen=True)
class Described:
    """A value and the layer whose opinion it is; "" for a fallback.

    A layer that blocks a value decides it too: the value is then the fallback.
    """

    value: Value
    layer: str
    source: str = "fallback"  #: "default", "timeSamples", "spline", "valueClips", "block" or "fallback"


@dataclass(frozen=True)
class EditDescription:
    """What an edit says at a time, and which layer says so. Needs no payload to be readable."""

    path: str
    is_active: bool  #: the prim's `active`
    operation: Described
    amount: Described
    blend: Described
    enabled: Described
    parameters: Mapping[str, Described]
    receivers: tuple[str, ...]
    receivers_excluded: tuple[str, ...]
    receivers_expression: str
    casters: tuple[str, ...]
    casters_excluded: tuple[str, ...]
    casters_expression: str
    receiver_limits: tuple[str, ...]
    caster_limits: tuple[str, ...]
    occluders: tuple[str, ...]
    lights: tuple[str, ...]
    target: str
    anchor: str
    key_times: tuple[float, ...]
    keys: KeyTrack | None
    file: str  #: of the key that weighs most
    payload_digest: str
    layers: tuple[str, ...]  #: identifiers of all layers with an opinion on the prim, strongest first
    listed_by: str = ""  #: identifier of the layer that lists it in its stack, "" where no stack does
    problem: str = ""  #: why keys cannot be read


def describe_edit(
    stage: Usd.Stage, path: str, time: float | None = None, stack: Usd.Prim | None = None
) -> EditDescription:
    """Describe an edit, also an inactive one.

    Parameters
    ----------
    stack
        The stack that it is described as a part of; by default the first one that lists it.

    Raises
    ------
    EditError
        There is no edit at `path`.
    """
    time = schema.default_time(stage, time)
    prim = stage.GetPrimAtPath(path)
    if not prim or (prim.IsActive() and not schema.has_schema(prim, schema.EDIT_API)):
        prim = edit_prim(stage, path)
    path = str(prim.GetPath())
    operation = _described(prim, schema.OPERATION, time)
    known = schema.operations().get(str(operation.value))
    names = {name: parameter.name for name, parameter in known.parameters.items()} if known else {}
    for name in authored_parameters(prim, str(operation.value), time):
        names.setdefault(name, f"icheat:{operation.value}:{name}")
    problem, track = "", None
    try:
        track = read_keys(prim)
    except EditError as error:
        problem = str(error)
    key = max(track.at(time), key=lambda pair: pair[1])[0] if track else None
    stacks = [stack] if stack is not None else [s for s in stack_prims(stage) if path in targets(s, schema.EDITS)]
    owners = [one.layer for one in listings(stacks[0]) if one.path == path and not one.removed_by] if stacks else []
    receivers, receivers_excluded, receivers_expression = collections.authored(prim, schema.RECEIVERS)
    casters, casters_excluded, casters_expression = collections.authored(prim, schema.CASTERS)
    return EditDescription(
        path=path,
        is_active=prim.IsActive(),
        operation=operation,
        amount=_described(prim, schema.AMOUNT, time),
        blend=_described(prim, schema.BLEND, time),
        enabled=_described(prim, schema.ENABLED, time),
        parameters=MappingProxyType({name: _described(prim, full, time) for name, full in names.items()}),
        receivers=receivers,
        receivers_excluded=receivers_excluded,
        receivers_expression=receivers_expression,
        casters=casters,
        casters_excluded=casters_excluded,
        casters_expression=casters_expression,
        receiver_limits=targets(prim, schema.RECEIVER_LIMITS),
        caster_limits=targets(prim, schema.CASTER_LIMITS),
        occluders=targets(prim, schema.OCCLUDERS),
        lights=targets(prim, schema.LIGHTS),
        target=(targets(prim, schema.TARGET) or ("",))[0],
        anchor=(targets(prim, schema.ANCHOR) or ("",))[0],
        key_times=track.times if track else (),
        keys=track,
        file=key.anchored if key else "",
        payload_digest=key.digest if key else "",
        layers=tuple(dict.fromkeys(spec.layer.identifier for spec in prim.GetPrimStack())),
        listed_by=owners[0] if owners else "",
        problem=problem,
    )


def _described(prim: Usd.Prim, name: str, time: float | None) -> Described:
    attribute = prim.GetAttribute(name)
    opinion = strongest_opinion(attribute, time)
    value = schema.read_attribute(prim, name, time)
    if value is None:
        registered = schema.operations()
        value = next((p.fallback for o in registered.values() for p in o.parameters.values() if p.name == name), None)
    converted = None if value is None else schema.to_value(value)
    shown = "" if converted is None else converted
    if opinion is None:
        return Described(shown, "")
    source = "valueClips" if comes_from_clips(attribute, time) else opinion.source
    return Described(shown, opinion.layer.identifier, "block" if opinion.is_blocked else source)
