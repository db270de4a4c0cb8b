"""An edit stack as data: composed opinions and payloads, with no USD, file or scene behind them.

Scale `S`, added emission `E` and offset `O` are functions of a (view sample,
gather sample) pair. An edit says which pairs (receivers x casters, both soft),
which operation with which parameters, how much, and how it is laid over the
weaker edits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from icheat_usd.edits.encodings.sampled import SampledRows

#: A parameter value: number, flag, token, or colour / vector as a tuple of floats.
Value = float | bool | str | tuple[float, ...]


class Blend(StrEnum):
    """How an edit meets the result of the weaker edits."""

    COMPOSE = "compose"  #: S -> s S, E -> s E + e, O -> s O + o
    OVER = "over"  #: S, E, O are lerped towards the edit's own by amount x masks
    ADD = "add"  #: the edit's s - 1, e and o are added


@dataclass(frozen=True)
class MaskedSurface:
    """A surface that a painted mask covers. Paths are absolute here, relative to the anchor in a file."""

    path: str
    n_faces: int
    instance_id: int = -1
    part: str = ""
    topology_digest: str = ""


@dataclass(frozen=True, eq=False)
class SurfaceMask:
    """Painted weights as texels per control face; surfaces it does not name have weight 0.

    `texels` is (n_faces of all surfaces, resolution, resolution) float32 in
    [0, 1]; texel [f, y, x] is centred at face coordinates
    ((x + 1/2) / resolution, (y + 1/2) / resolution), bilinear in between and
    clamped at the face's border. `rest` says where the faces lay when they
    were painted, so that weights find their place again on a mesh whose
    topology has changed: object space, at the texel centres of resolution 2.
    """

    surfaces: tuple[MaskedSurface, ...]
    texels: NDArray[np.float32]
    rest: NDArray[np.float32] | None = None  #: (n_faces, 2, 2, 3), stage units

    @property
    def resolution(self) -> int:
        return int(self.texels.shape[1])


@dataclass(frozen=True, eq=False)
class Payload:
    """Painted and baked data of one edit at one key; immutable, named by its digest.

    What is baked serves readers that do not know `operation`. `scale_delta`,
    `emission` and `offset` are the rank-1 form: the RGB of s - 1, e and o, the
    same for all pairs, that the masks multiply. `rows` is the sampled form, in
    which the masks are already multiplied.
    """

    operation: str
    parameters: Mapping[str, Value]
    receiver_mask: SurfaceMask | None = None
    caster_mask: SurfaceMask | None = None
    scale_delta: tuple[float, float, float] | None = None
    emission: tuple[float, float, float] | None = None  #: radiance
    offset: tuple[float, float, float] | None = None  #: 1 / m^2, not multiplied by the receiver's albedo
    rows: SampledRows | None = None
    made_against: Mapping[str, str | float | int] = field(default_factory=lambda: MappingProxyType({}))
    unknown: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True)
class SurfacesAt:
    """Surfaces by scene path: weight 1 on them."""

    paths: frozenset[str]


@dataclass(frozen=True)
class SurfacesOf:
    """Weight 1 where one of these materials is bound, by path; a face's own binding counts."""

    materials: frozenset[str]


class Shape(StrEnum):
    """Form of a region in its own space."""

    BOX = "box"  #: [-1, 1]^3
    SPHERE = "sphere"  #: of radius 1


@dataclass(frozen=True)
class Region:
    """Weight 1 inside a box or a sphere, falling smoothly to 0 at its border.

    The fall takes `softness` of the way from the centre to the border: 0 is a
    hard border, 1 falls from the centre on.
    """

    shape: Shape
    to_shape: tuple[float, ...]  #: 12 numbers, rows of a (3, 4) matrix: metres, stage axes, to the shape's own space
    softness: float = 0.0


class Rule(StrEnum):
    """Set algebra on soft weights."""

    INTERSECTION = "intersection"  #: product
    UNION = "union"  #: 1 - product of (1 - w)
    DIFFERENCE = "difference"  #: the first times the product of (1 - w) of the others


@dataclass(frozen=True)
class Combination:
    """Several parts under one rule; without parts it selects nothing."""

    rule: Rule
    parts: tuple[Limit, ...]


#: What narrows a selection beyond its collection.
Limit = SurfacesAt | SurfacesOf | Region | Combination


@dataclass(frozen=True)
class Selection:
    """One side of an edit: the surfaces its collection includes, times every limit (and the payload's mask)."""

    paths: frozenset[str]
    limits: tuple[Limit, ...] = ()


@dataclass(frozen=True, eq=False)
class KeyedPayload:
    """A payload and its share in the interpolation at the time that was asked for; None is the identity."""

    payload: Payload | None
    weight: float
    digest: str = ""
    file: str = ""


@dataclass(frozen=True, eq=False)
class Edit:
    """One adjustment as composed at one time code, before it meets a scene.

    `keys` is empty for an edit that needs no payload, else one or two whose
    weights sum to 1. `parameters` are authored opinions over the payload's
    recipe over schema fallbacks, mixed over the keys; each key's payload has
    its own. Points, directions and lengths among them are in metres and stage
    axes; `target` stands for the point parameter of that name.
    """

    path: str
    operation: str
    parameters: Mapping[str, Value]
    receivers: Selection
    casters: Selection
    amount: float = 1.0
    blend: Blend = Blend.COMPOSE
    enabled: bool = True
    keys: tuple[KeyedPayload, ...] = ()
    occluders: tuple[str, ...] = ()
    lights: tuple[str, ...] = ()  #: paths of the lights whose light the scale acts on; empty means all
    target: tuple[float, float, float] | None = None

    @property
    def name(self) -> str:
        return self.path.rpartition("/")[2]

    @property
    def is_active(self) -> bool:
        """Muted edits and edits of amount 0 are skipped, never multiplied."""
        return self.enabled and self.amount != 0.0


@dataclass(frozen=True, eq=False)
class EditStack:
    """Edits in the order in which they apply: weakest first."""

    path: str
    edits: tuple[Edit, ...]
    enabled: bool = True
    digest: str = ""  #: of everything that decides the image; for metadata and caches

    @property
    def active(self) -> tuple[Edit, ...]:
        return tuple(edit for edit in self.edits if edit.is_active) if self.enabled else ()


EMPTY_STACK = EditStack(path="", edits=())
