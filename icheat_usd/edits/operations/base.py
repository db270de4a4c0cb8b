"""The interface of an operation."""

from __future__ import annotations

from abc import ABC
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, ClassVar, NamedTuple, Protocol

from icheat_usd.edits.model import Value
from icheat_usd.errors import EditError
from icheat_usd.scene import F32

#: No parameter is larger: a product of two, such as a gain and a colour, times light is what 32-bit floats hold.
_LARGEST = 1e18


class Level(StrEnum):
    """What an operation acts on."""

    PAIR = "pair"  #: the light from one caster point to one receiver point
    AGGREGATE = "aggregate"  #: all the light that one receiver point gets from the casters
    VIEW = "view"  #: all indirect light of one receiver point, after every other edit


class Measure(StrEnum):
    """What the numbers of a parameter are, so that a reader of stages converts their space and unit."""

    PLAIN = "plain"
    LENGTH = "length"  #: in the edit prim's own space; metres here
    POINT = "point"  #: in the edit prim's own space; metres about the scene's centre here
    DIRECTION = "direction"  #: in the edit prim's own space; unit vector in stage axes here


class Encoding(StrEnum):
    """Forms in which a file can hold an operation's result, cheapest first."""

    VECTOR = "vector"  #: numbers per receiver (level VIEW)
    RANK_1 = "rank-1"  #: mask x mask x colour; needs `constants`
    RECIPE = "recipe"  #: operation and parameters, evaluated anew
    ROWS = "rows"  #: sampled Haar rows


@dataclass(frozen=True)
class Parameter:
    """One input of an operation: USD attribute ``icheat:<operation>:<name>``.

    A default that is a tuple fixes the number of components, unless the
    parameter is an array: then any number will do.
    """

    name: str
    default: Value
    doc: str
    minimum: float | None = None
    measure: Measure = Measure.PLAIN
    choices: tuple[str, ...] = ()  #: of a token
    is_array: bool = False


class PairEnd(NamedTuple):
    """Points at one end of n pairs; arrays are (n, 3) or (1, 3), metres about the scene's centre."""

    position: F32
    normal: F32  #: unit, shading normal
    albedo: F32  #: diffuse reflectance


class Pairs(NamedTuple):
    """What an operation may look at, for n (view sample, gather sample) pairs.

    `incident` is the radiance that the receiver gets from the caster, as the
    weaker edits left it: S b + E, scene-linear RGB. Geometry cancels in it, so
    it stands for the transported light up to one factor per pair.
    """

    incident: F32  #: (n, 3)
    receiver: PairEnd
    caster: PairEnd


class PairCoefficients(NamedTuple):
    """What an operation asks for at full amount and full masks.

    The light of a pair becomes ``t (scale b + emission) + A offset b``, and
    light that the edit's occluders hold back arrives ``through`` times.
    """

    scale: F32  #: (n, 3) or (1, 3)
    emission: F32 | None = None  #: (n, 3) or (1, 3) radiance added to what the caster sends; None is 0
    offset: F32 | None = None  #: (n, 3) or (1, 3) density, 1 / m^2; None is 0
    through: F32 | None = None  #: (n, 3) or (1, 3) share of the light behind the occluders; None is 0


class ViewCoefficients(NamedTuple):
    """All indirect light of a receiver becomes ``scale light + offset``, (3,) each."""

    scale: F32
    offset: F32  #: radiance


class BoundScene(Protocol):
    """What an operation may ask about the scene and the selections it is bound to, once, before it is evaluated."""

    def mean_distance(self) -> float:
        """Mean distance of receivers and casters, metres."""
        ...

    def caster_area(self) -> float:
        """Area of the casters, each surface once, weighted by their masks, square metres."""
        ...


class Operation(ABC):
    """A rule that turns pairs into scale, added emission and offset.

    Implement the one ``evaluate...`` of your level. An operation holds no
    state: all it knows comes in `parameters`.
    """

    name: ClassVar[str]
    doc: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    level: ClassVar[Level] = Level.PAIR
    encodings: ClassVar[tuple[Encoding, ...]] = (Encoding.RECIPE, Encoding.ROWS)
    #: True if the coefficients depend on `Pairs.incident`, so that they change with the lights.
    uses_incident: ClassVar[bool] = False
    #: True if they depend on `Pairs.receiver`, so that view samples cannot share them.
    uses_receiver: ClassVar[bool] = False
    #: True if they depend on `Pairs.caster`.
    uses_caster: ClassVar[bool] = False
    #: False if it looks at no more of receivers and casters than where they are.
    uses_normals: ClassVar[bool] = True
    #: True if `evaluate` gives offsets.
    has_offset: ClassVar[bool] = False
    #: True if the offset is light that the receiver's diffuse albedo reflects, False if it is paint on top.
    offset_times_albedo: ClassVar[bool] = True
    #: True if `evaluate` gives `through`, which needs `rel icheat:occluders`.
    has_through: ClassVar[bool] = False

    def prepare(self, parameters: Mapping[str, Value], scene: BoundScene) -> Mapping[str, Value]:
        """Parameters with what only the scene can tell filled in; called once for each key."""
        return parameters

    def evaluate(self, parameters: Mapping[str, Value], pairs: Pairs) -> PairCoefficients:
        """Level PAIR: coefficients of every pair; `parameters` is complete, checked and prepared."""
        raise NotImplementedError(f"operation '{self.name}' acts on {self.level}s")

    def evaluate_aggregate(self, parameters: Mapping[str, Value], light: F32) -> F32:
        """Level AGGREGATE: what (n, 3) `light` from all casters should become; radiance, at least 0."""
        raise NotImplementedError(f"operation '{self.name}' acts on {self.level}s")

    def evaluate_view(self, parameters: Mapping[str, Value]) -> ViewCoefficients:
        """Level VIEW: what should become of all indirect light."""
        raise NotImplementedError(f"operation '{self.name}' acts on {self.level}s")

    def constants(self, parameters: Mapping[str, Value]) -> PairCoefficients | None:
        """The coefficients, (1, 3) each, if they are the same for all pairs of any scene; they can be baked as such."""
        return None

    def complete(self, given: Mapping[str, Value], where: str) -> dict[str, Value]:
        """Fill in defaults and check `given`.

        Raises
        ------
        EditError
            A parameter is unknown, of the wrong kind, not finite or below its minimum.
        """
        known = {parameter.name: parameter for parameter in self.parameters}
        for name in given:
            if name not in known:
                listed = ", ".join(sorted(known))
                raise EditError(f"{where}: operation '{self.name}' has no parameter '{name}'; it has {listed}")
        return {name: _checked(given.get(name, p.default), p, where) for name, p in known.items()}


def plain_values(parameters: Mapping[str, Any] | None) -> dict[str, Value]:
    """Parameters as scripts give them, lists and NumPy's numbers and vectors too, in the types of `Value`."""

    def plain(value: Any) -> Value:
        if hasattr(value, "tolist"):  # NumPy's, and of the same kind in other libraries
            value = value.tolist()
        return tuple(value) if isinstance(value, list) else value

    return {name: plain(value) for name, value in (parameters or {}).items()}


def number(parameters: Mapping[str, Value], name: str) -> float:
    """A parameter that `Operation.complete` has checked to be a number."""
    value = parameters[name]
    assert isinstance(value, (int, float))
    return float(value)


def numbers(parameters: Mapping[str, Value], name: str) -> tuple[float, ...]:
    """A parameter that `Operation.complete` has checked to be a tuple of numbers."""
    value = parameters[name]
    assert isinstance(value, tuple)
    return value


def _checked(value: Value, parameter: Parameter, where: str) -> Value:
    expected = parameter.default
    components = value if isinstance(value, tuple) else (value,)
    if isinstance(expected, (str, bool)):
        fits = isinstance(value, type(expected))
    else:
        fits = isinstance(value, tuple) == isinstance(expected, tuple) and all(
            isinstance(x, (int, float)) and not isinstance(x, bool) for x in components
        )
        fits = fits and (not isinstance(expected, tuple) or parameter.is_array or len(components) == len(expected))
    if not fits:
        raise EditError(f"{where}: parameter '{parameter.name}' is {value!r}, expected something like {expected!r}")
    if any(isinstance(x, (int, float)) and not abs(x) <= _LARGEST for x in components):
        raise EditError(f"{where}: parameter '{parameter.name}' is {value!r}, expected no size above {_LARGEST:g}")
    if parameter.minimum is not None and any(float(x) < parameter.minimum for x in components):
        raise EditError(f"{where}: parameter '{parameter.name}' is {value!r}, expected at least {parameter.minimum}")
    if parameter.choices and value not in parameter.choices:
        raise EditError(f"{where}: parameter '{parameter.name}' is {value!r}, expected one of {parameter.choices}")
    return value
