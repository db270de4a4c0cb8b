"""What differs between two stages, layers or sidecars, in an artist's words."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from icheat_usd.edits.facts import relative
from icheat_usd.edits.model import Value
from icheat_usd.edits.staleness import value_text
from icheat_usd.errors import IcheatError
from icheat_usd.session.authoring import read_payload
from icheat_usd.session.inspection import StackDescription, describe_stacks
from icheat_usd.session.payload_differences import payload_differences
from icheat_usd.stage.description import EditDescription
from icheat_usd.stage.edit_stack import open_asset
from icheat_usd.stage.keys import SAME_TIME, Key
from icheat_usd.stage.opening import quiet_usd

_ARROW = "\N{RIGHTWARDS ARROW}"


@dataclass(frozen=True)
class Difference:
    """One thing that is not the same in B as it is in A."""

    edit: str  #: name of the edit, or of the stack
    aspect: str  #: "added", "removed", "order", "muted", "amount", "parameter", "receivers", "key", ...
    text: str
    layer: str = ""  #: file name of the layer that decides the value in B


def compare_stages(a: Any, b: Any, frame: float | None = None) -> list[Difference]:
    """Differences of all edits and stacks of two stages as composed.

    Stacks and edits are matched by their paths below the default prim, and a
    stage's only stack with the other's only one. Animated values are compared
    at all their samples.
    """
    with quiet_usd():
        first, second = ({_name(s, d.path): d for d in describe_stacks(s, frame)} for s in (a, b))
        if len(first) == len(second) == 1:
            pairs = [(next(iter(second)), next(iter(first.values())), next(iter(second.values())))]
        else:
            pairs = [(name, first[name], second[name]) for name in first if name in second]
        found = [Difference(n, "removed", f"stack {n} removed") for n in first if len(first) > 1 and n not in second]
        if not second and first:
            found = [Difference(n, "removed", f"stack {n} removed") for n in first]
        if len(second) != 1 or len(first) != 1:
            found += [Difference(n, "added", f"stack {n} added") for n in second if n not in first]
        for name, one, other in pairs:
            found += _Comparison(a, b, frame).stacks(name, one, other)
    return list(dict.fromkeys(found))


def _name(stage: Any, path: str) -> str:
    default = stage.GetDefaultPrim()
    return relative(path, str(default.GetPath())) if default else path


class _Comparison:
    """Two stages side by side."""

    def __init__(self, a: Any, b: Any, frame: float | None) -> None:
        self.a, self.b, self.frame = a, b, frame

    def stacks(self, name: str, one: StackDescription, other: StackDescription) -> Iterator[Difference]:
        if one.enabled != other.enabled:
            yield Difference(name, "enabled", f"stack {name} turned {'on' if other.enabled else 'off'}")
        yield from self._paths(name, "camera", one.cameras, other.cameras)
        were = {_name(self.a, edit.path): edit for edit in one.edits}
        are = {_name(self.b, edit.path): edit for edit in other.edits}
        shown = _short([*were, *are])
        for path in were:
            if path not in are:
                yield Difference(shown[path], "removed", f"{shown[path]} removed")
        order = list(are)
        for index, (path, edit) in enumerate(are.items()):
            if path in were:
                yield from self.edits(shown[path], were[path], edit)
            else:
                after = f"after {shown[order[index - 1]]}" if index else "first"
                layer = os.path.basename(edit.listed_by)
                yield Difference(shown[path], "added", f"{shown[path]} added {after}" + _in(layer), layer)
        orders = [[shown[path] for path in paths if path in were and path in are] for paths in (were, are)]
        if orders[0] != orders[1]:
            text = f"order: {', '.join(orders[0])} {_ARROW} {', '.join(orders[1])}"
            yield Difference(name, "order", text)

    def edits(self, name: str, one: EditDescription, other: EditDescription) -> Iterator[Difference]:
        if one.is_active != other.is_active:
            yield Difference(name, "active", f"{name} {'activated' if other.is_active else 'deactivated'}")
        if one.enabled.value != other.enabled.value:
            layer = os.path.basename(other.enabled.layer)
            word = "unmuted" if other.enabled.value else "muted"
            yield Difference(name, "muted", f"{name} {word}{_in(layer)}", layer)
        values = [("operation", "icheat:operation"), ("amount", "icheat:amount"), ("blend", "icheat:blend")]
        for aspect, attribute in values:
            yield from self._value(name, aspect, aspect, attribute, one, other)
        if one.operation.value == other.operation.value:
            for parameter in dict.fromkeys([*one.parameters, *other.parameters]):
                attribute = f"icheat:{other.operation.value}:{parameter}"
                yield from self._value(name, "parameter", parameter, attribute, one, other)
        for side in ("receivers", "casters"):
            yield from self._paths(name, side, getattr(one, side), getattr(other, side))
            excluded = getattr(one, f"{side}_excluded"), getattr(other, f"{side}_excluded")
            yield from self._paths(name, f"{side} excluded", *excluded)
            was, is_ = getattr(one, f"{side}_expression"), getattr(other, f"{side}_expression")
            if was != is_:
                yield Difference(name, side, f"{name}: {side} expression {was or 'none'} {_ARROW} {is_ or 'none'}")
            limits = getattr(one, f"{side[:-1]}_limits"), getattr(other, f"{side[:-1]}_limits")
            yield from self._paths(name, f"{side[:-1]} limits", *limits)
        for aspect in ("lights", "occluders"):
            yield from self._paths(name, aspect, getattr(one, aspect), getattr(other, aspect))
        for aspect in ("target", "anchor"):
            both = [[path] if path else [] for path in (getattr(one, aspect), getattr(other, aspect))]
            yield from self._paths(name, aspect, *both)
        yield from self._keys(name, one, other)

    def _value(
        self, name: str, aspect: str, label: str, attribute: str, one: EditDescription, other: EditDescription
    ) -> Iterator[Difference]:
        described = [
            getattr(edit, aspect) if aspect != "parameter" else edit.parameters.get(label) for edit in (one, other)
        ]
        texts = ["none" if value is None else value_text(value.value) for value in described]
        layer = os.path.basename(described[1].layer) if described[1] is not None else ""
        if texts[0] != texts[1]:
            yield Difference(name, aspect, f"{name}: {label} {texts[0]} {_ARROW} {texts[1]}{_in(layer)}", layer)
            return
        samples = [_samples(stage, edit.path, attribute) for stage, edit in ((self.a, one), (self.b, other))]
        times = sorted({time for found in samples for time in found})
        differing = [t for t in times if _at(self.a, one, attribute, t) != _at(self.b, other, attribute, t)]
        if differing:
            time = differing[0]
            was, is_ = (_at(s, e, attribute, time) for s, e in ((self.a, one), (self.b, other)))
            more = f", and at {len(differing) - 1} more times" if len(differing) > 1 else ""
            text = f"{name}: {label} {was} {_ARROW} {is_} at {time:g}{more}{_in(layer)}"
            yield Difference(name, aspect, text, layer)

    def _paths(self, name: str, aspect: str, was: Iterable[str], is_: Iterable[str]) -> Iterator[Difference]:
        before = dict.fromkeys(_name(self.a, path) for path in was)
        after = dict.fromkeys(_name(self.b, path) for path in is_)
        added, gone = [p for p in after if p not in before], [p for p in before if p not in after]
        if added or gone:
            words = [*(f"+ {path}" for path in added), *(f"\N{MINUS SIGN} {path}" for path in gone)]
            yield Difference(name, aspect, f"{name}: {aspect} {', '.join(words)}")

    def _keys(self, name: str, one: EditDescription, other: EditDescription) -> Iterator[Difference]:
        if one.problem != other.problem:
            yield Difference(name, "key", f"{name}: {other.problem or 'keys can be read again'}")
        if one.keys is None and other.keys is None:
            return
        layer = os.path.basename(other.keys.layer) if other.keys else ""
        was, is_ = (list(edit.keys.keys) if edit.keys else [] for edit in (one, other))
        how = [str(getattr(e.keys, "interpolation", "") or "") for e in (one, other) if e.keys]
        if len(how) == 2 and how[0] != how[1]:
            yield Difference(name, "key", f"{name}: keys {how[0]} {_ARROW} {how[1]}{_in(layer)}", layer)
        for key in is_:
            old = _same_time(key, was)
            if old is None:
                yield Difference(name, "key", f"{name}: key{_when(key)} added{_in(layer)}", layer)
            elif old.digest != key.digest:
                text = "; ".join(self._payloads(one, old, other, key))
                yield Difference(name, "key", f"{name}: key{_when(key)}: {text}{_in(layer)}", layer)
        for key in was:
            if _same_time(key, is_) is None:
                yield Difference(name, "key", f"{name}: key{_when(key)} removed{_in(layer)}", layer)

    def _payloads(self, one: EditDescription, old: Key, other: EditDescription, new: Key) -> Sequence[str]:
        if not old.digest or not new.digest:
            return ["the identity became a payload" if new.digest else "became the identity"]
        read = []
        for stage, edit, key in ((self.a, one, old), (self.b, other, new)):
            try:
                source = open_asset(stage.GetPrimAtPath(edit.path), key)
                read.append(read_payload(key.anchored, source, key.digest, "/"))
            except IcheatError as error:
                return [f"payload {old.digest[:12]} {_ARROW} {new.digest[:12]}, which cannot be read ({error})"]
        return payload_differences(read[0], read[1])


# --------------------------------------------------------------------------- layers


def compare_layers(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[Difference]:
    """Differences of what two layers say themselves, opinion by opinion; see `stage.opinions.edit_opinions`."""
    found = []
    for path in dict.fromkeys([*a, *b]):
        prim, _, name = path.partition(".")
        label = prim.rpartition("/")[2]
        what = f"{label}: {name.removeprefix('icheat:')}" if name else label
        was, is_ = a.get(path), b.get(path)
        if was == is_:
            continue
        if was is None:
            found.append(Difference(label, "added", f"{what} authored: {is_}"))
        elif is_ is None:
            found.append(Difference(label, "removed", f"{what} no longer authored: it was {was}"))
        else:
            found.append(Difference(label, "changed", f"{what} {was} {_ARROW} {is_}"))
    return found


# --------------------------------------------------------------------------- words


def _in(layer: str) -> str:
    return f" ({layer})" if layer else ""


def _when(key: Key) -> str:
    return " for all times" if key.time is None else f" at {key.time:g}"


def _same_time(key: Key, keys: Sequence[Key]) -> Key | None:
    for other in keys:
        if key.time is None or other.time is None:
            if key.time is other.time:
                return other
        elif abs(key.time - other.time) <= SAME_TIME:
            return other
    return None


def _samples(stage: Any, path: str, attribute: str) -> list[float]:
    found = stage.GetPrimAtPath(path).GetAttribute(attribute)
    return list(found.GetTimeSamples()) if found else []


def _at(stage: Any, edit: EditDescription, attribute: str, time: float) -> str:
    found = stage.GetPrimAtPath(edit.path).GetAttribute(attribute)
    value = found.Get(time) if found else None
    return "none" if value is None else _value_text(value)


def _value_text(value: Any) -> str:
    if isinstance(value, (bool, str)):
        return str(value)
    if isinstance(value, (int, float)):
        return f"{value:g}"
    converted: Value = tuple(float(component) for component in value)
    return value_text(converted)


def _short(paths: Sequence[str]) -> dict[str, str]:
    """The name alone where it says enough."""
    names = [path.rpartition("/")[2] for path in dict.fromkeys(paths)]
    return {path: path if names.count(path.rpartition("/")[2]) > 1 else path.rpartition("/")[2] for path in paths}
