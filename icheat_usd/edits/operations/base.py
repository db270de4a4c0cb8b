"""The interface of an operation."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from icheat_usd.edits.model import Value
from icheat_usd.errors import EditError
from icheat_usd.scene import F32


def number(parameters: Mapping[str, Value], name: str) -> float:
    """A parameter that `Operation.complete` has checked to be a number."""
    value = parameters[name]
    assert isinstance(value, (int, float))
    return float(value)


@dataclass(frozen=True)
class Parameter:
    """One input of an operation: USD attribute ``icheat:<operation>:<name>``."""

    name: str
    default: Value
    doc: str
    minimum: float | None = None


class Pairs(NamedTuple):
    """What an operation may look at, for n (view sample, gather sample) pairs.

    `incident` is the radiance that the receiver gets from the caster, as the
    weaker edits left it: S b + E, scene-linear RGB. Geometry cancels in it, so
    it stands for the transported light up to one factor per pair.
    """

    incident: F32  #: (n, 3)


class PairCoefficients(NamedTuple):
    """What an operation asks for at full amount and full masks.

    The light of a pair becomes ``t (scale b + emission) + A offset b``.
    """

    scale: F32  #: (n, 3) or (1, 3)
    emission: F32 | None = None  #: (n, 3) radiance added to what the caster sends; None is 0
    offset: F32 | None = None  #: (n, 3) density, 1 / m^2; None is 0


class Operation(ABC):
    """A rule that turns pairs into scale, added emission and offset."""

    name: ClassVar[str]
    doc: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    #: True if the coefficients depend on `Pairs.incident`, so that they change with the lights.
    uses_incident: ClassVar[bool] = False
    #: True if `evaluate` gives offsets.
    has_offset: ClassVar[bool] = False
    #: True if the offset is light that the receiver's diffuse albedo reflects, False if it is paint on top.
    offset_times_albedo: ClassVar[bool] = True

    @abstractmethod
    def evaluate(self, parameters: Mapping[str, Value], pairs: Pairs) -> PairCoefficients:
        """Coefficients of every pair; `parameters` is complete and checked."""

    def constant_delta(self, parameters: Mapping[str, Value]) -> tuple[float, float, float] | None:
        """RGB of scale - 1 if it is the same for all pairs, to bake for readers that do not know the operation."""
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
                raise EditError(f"{where}: operation '{self.name}' has no parameter '{name}'; it has {sorted(known)}")
        return {name: _checked(given.get(name, p.default), p, where) for name, p in known.items()}


def _checked(value: Value, parameter: Parameter, where: str) -> Value:
    expected = parameter.default
    numbers = value if isinstance(value, tuple) else (value,)
    if isinstance(expected, (str, bool)):
        fits = isinstance(value, type(expected))
    else:
        fits = isinstance(value, tuple) == isinstance(expected, tuple) and all(
            isinstance(x, (int, float)) and not isinstance(x, bool) and abs(x) < float("inf") for x in numbers
        )
        fits = fits and (not isinstance(expected, tuple) or len(numbers) == len(expected))
    if not fits:
        raise EditError(f"{where}: parameter '{parameter.name}' is {value!r}, expected something like {expected!r}")
    if parameter.minimum is not None and any(float(x) < parameter.minimum for x in numbers):
        raise EditError(f"{where}: parameter '{parameter.name}' is {value!r}, expected at least {parameter.minimum}")
    return value
