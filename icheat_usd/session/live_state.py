"""What an artist has changed since the layers were last written: values laid over the stage, frozen.

Every command makes a new state and leaves the old one to undo; a state says everything, so that two ways to the same
state give the same image. Places are metres in stage axes, as everywhere outside a snapshot.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from icheat_usd.edits import operations
from icheat_usd.edits.model import Blend, Edit, EditStack, KeyedPayload, Payload, SurfaceMask, Value
from icheat_usd.errors import EditError
from icheat_usd.scene import F32, F64, LightKind

Colour = tuple[float, float, float]
_WHITE: Colour = (1.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class LightChange:
    """Where a light differs from what the stage says; None is as the stage says."""

    gain: Colour = _WHITE  #: factor of its radiance, linear
    to_world: F64 | None = None  #: (3, 4) metres, stage axes
    radiance: Colour | None = None
    size: tuple[float, float] | None = None  #: as in `scene.Lights`
    texture: F32 | None = None  #: (height, width, 3 or 4) linear; of size 0: none
    texture_file: str = ""  #: where `texture` was read from
    added: LightKind | None = None  #: the stage has no such light; the values above are all there is
    removed: bool = False


@dataclass(frozen=True, eq=False)
class EditChange:
    """Where an edit differs from what the stage says; None is as the stage says."""

    amount: float | None = None
    enabled: bool | None = None
    blend: Blend | None = None
    parameters: Mapping[str, Value] = field(default_factory=lambda: MappingProxyType({}))
    receiver_mask: SurfaceMask | None = None
    caster_mask: SurfaceMask | None = None


@dataclass(frozen=True, eq=False)
class LiveState:
    """All changes, by path, in the order in which they were first made."""

    lights: Mapping[str, LightChange] = field(default_factory=lambda: MappingProxyType({}))
    edits: Mapping[str, EditChange] = field(default_factory=lambda: MappingProxyType({}))
    order: tuple[str, ...] = ()  #: of the edits, weakest first; what it does not name keeps its place after them

    @property
    def is_empty(self) -> bool:
        return not (self.lights or self.edits or self.order)

    def with_light(self, path: str, **values: Any) -> LiveState:
        change = replace(self.lights.get(path, LightChange()), **values)
        return replace(self, lights=MappingProxyType({**self.lights, path: change}))

    def without_light(self, path: str) -> LiveState:
        """Forget what was changed about a light; one that was added is gone."""
        return replace(self, lights=MappingProxyType({p: c for p, c in self.lights.items() if p != path}))

    def with_edit(self, path: str, **values: Any) -> LiveState:
        change = replace(self.edits.get(path, EditChange()), **values)
        return replace(self, edits=MappingProxyType({**self.edits, path: change}))

    def with_parameters(self, path: str, values: Mapping[str, Value]) -> LiveState:
        known = self.edits.get(path, EditChange()).parameters
        return self.with_edit(path, parameters=MappingProxyType({**known, **values}))

    def check_parameters(self, path: str, stack: EditStack) -> None:
        """See whether the operation of an edit takes its parameters.

        Raises
        ------
        EditError
            It does not.
        """
        edit = next(edit for edit in self.laid_over(stack).edits if edit.path == path)
        given = [(edit.operation, edit.parameters)]
        payloads = [key.payload for key in edit.keys if key.payload is not None]
        for name, parameters in [(one.operation, one.parameters) for one in payloads] or given:
            operation = operations.find(name)
            if operation is not None:
                operation.complete(parameters, path)

    def laid_over(self, stack: EditStack) -> EditStack:
        """The stack as the stage has it, with these changes."""
        if not (self.edits or self.order):
            return stack
        edits = tuple(_changed(edit, self.edits.get(edit.path)) for edit in stack.edits)
        # The stage's digest is not of this.
        return replace(stack, edits=_ordered(edits, self.order), digest="")


#: Nothing is changed.
UNCHANGED = LiveState()


def _changed(edit: Edit, change: EditChange | None) -> Edit:
    if change is None:
        return edit
    given = {name: getattr(change, name) for name in ("amount", "enabled", "blend")}
    edit = replace(edit, **{name: value for name, value in given.items() if value is not None})
    masks = {name: getattr(change, name) for name in ("receiver_mask", "caster_mask")}
    masks = {name: mask for name, mask in masks.items() if mask is not None}
    if not (change.parameters or masks):
        return edit
    parameters = MappingProxyType({**edit.parameters, **change.parameters})
    keys = edit.keys
    if not keys and masks:
        keys = (KeyedPayload(Payload(edit.operation, parameters), 1.0),)
    return replace(edit, parameters=parameters, keys=tuple(_changed_key(key, change, masks) for key in keys))


def _changed_key(key: KeyedPayload, change: EditChange, masks: Mapping[str, SurfaceMask]) -> KeyedPayload:
    if key.payload is None:
        return key
    payload = key.payload
    changed = replace(
        payload,
        parameters=MappingProxyType({**payload.parameters, **change.parameters}),
        receiver_mask=masks.get("receiver_mask", payload.receiver_mask),
        caster_mask=masks.get("caster_mask", payload.caster_mask),
    )
    return replace(key, payload=changed, digest="")


def _ordered(edits: tuple[Edit, ...], order: Sequence[str]) -> tuple[Edit, ...]:
    place = {path: i for i, path in enumerate(order)}
    return tuple(sorted(edits, key=lambda edit: place.get(edit.path, len(place))))


def moved(paths: Sequence[str], path: str, *, before: str | None = None, after: str | None = None) -> tuple[str, ...]:
    """An order with one path moved before or after another one; to the end if neither is given.

    Raises
    ------
    EditError
        Both are given, or a path is not among them.
    """
    if before is not None and after is not None:
        raise EditError(f"{path}: moving needs one of before and after, not both")
    rest = [other for other in paths if other != path]
    other = before if before is not None else after
    if other == path:
        return tuple(paths)
    index = len(rest) if other is None else rest.index(other) + (after is not None)
    return (*rest[:index], path, *rest[index:])


def colour(value: float | Sequence[float], what: str) -> Colour:
    """A number or three as a colour.

    Raises
    ------
    EditError
        It is neither, negative or not finite.
    """
    try:
        r, g, b = (float(v) for v in np.broadcast_to(np.asarray(value, np.float64), (3,)))
    except (TypeError, ValueError):
        raise EditError(f"{what} is {value!r}, expected a number or three") from None
    if not all(np.isfinite(v) and v >= 0 for v in (r, g, b)):
        raise EditError(f"{what} is {value!r}; it must be finite and not negative")
    return r, g, b


def numbers(values: ArrayLike, n: int, what: str) -> F64:
    """Finite numbers, (n,) float64.

    Raises
    ------
    EditError
        They are not numbers, not `n`, or not finite.
    """
    try:
        found = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        found = np.full(0, np.nan)
    if found.shape != (n,) or not np.isfinite(found).all():
        raise EditError(f"{what} is {values!r}, expected {n} finite numbers")
    return found


def number(value: object, what: str) -> float:
    """A finite number.

    Raises
    ------
    EditError
        It is none.
    """
    if not isinstance(value, (int, float, np.integer, np.floating)) or not np.isfinite(value):
        raise EditError(f"{what} is {value!r}, expected a finite number")
    return float(value)
