"""Selections on the surfaces of one scene: collection times limits times painted mask."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icheat_usd.edits.masks import BoundMask, bind_mask
from icheat_usd.edits.model import (
    Limit,
    Region,
    Rule,
    Selection,
    Shape,
    SurfaceMask,
    SurfacesAt,
    SurfacesOf,
)
from icheat_usd.scene import F32, I32, I64, Finding, SceneSnapshot, SurfacePoints

#: A surface that lies on the border of a region is inside, whichever way its points were rounded.
_BORDER = np.float32(1 + 1e-5)


@dataclass(frozen=True, eq=False)
class BoundSelection:
    """Weights of one side of an edit on the surfaces of one scene."""

    on_instances: F32  #: (n_instances,) what is the same all over an instance; its weights are at most this
    within: tuple[BoundLimit, ...] = ()  #: limits that vary over an instance
    mask: BoundMask | None = None

    @property
    def constant_on_instances(self) -> bool:
        """True if `on_instances` is all there is: the weight of a point depends on its instance alone."""
        return not self.within and self.mask is None

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What the painted mask had to make do with."""
        return () if self.mask is None else self.mask.findings

    def at(self, points: SurfacePoints) -> F32:
        """Weights of the points, (n,) in [0, 1]; 0 where a point is no hit."""
        # The weight behind the last instance's is that of no hit, -1.
        on_instances = np.append(self.on_instances, np.float32(0))
        weights = np.take(on_instances, points.instance)
        if not self.constant_on_instances:
            some = np.flatnonzero(weights)
            weights[some] = self.at_some(points, some)
        return weights

    def at_some(self, points: SurfacePoints, some: I64) -> F32:
        """Weights of some of the points, all of them hits."""
        instance = np.take(points.instance, some)
        weights = np.take(self.on_instances, instance)
        if self.constant_on_instances:
            return weights
        if self.within:
            places = _Places(np.take(points.position, some, axis=0), instance, np.take(points.triangle, some))
            for limit in self.within:
                weights = weights * limit.weights(places)
        if self.mask is not None:
            face, face_uv = np.take(points.face, some), np.take(points.face_uv, some, axis=0)
            weights = weights * self.mask.at(instance, face, face_uv)
        return weights


def bind_selection(
    selection: Selection, mask: SurfaceMask | None, snapshot: SceneSnapshot, where: str
) -> BoundSelection:
    """Find what a selection selects in a scene.

    Parameters
    ----------
    mask
        Painted mask of the payload, None where there is none.
    where
        Whose selection it is, for messages.

    Raises
    ------
    EditError
        The painted mask was made for another scene or mesh.
    """
    on_instances = _at_paths(selection.paths, snapshot)
    within = []
    for limit in selection.limits:
        bound = _bind_limit(limit, snapshot)
        if isinstance(bound, _OnInstances):
            on_instances = on_instances * bound.of_instance
        else:
            within.append(bound)
    return BoundSelection(on_instances, tuple(within), None if mask is None else bind_mask(mask, snapshot, where))


# --------------------------------------------------------------------------- limits


class _Places(NamedTuple):
    """Where n points lie."""

    position: F32  #: (n, 3) metres about the scene's centre
    instance: I32  #: (n,)
    triangle: I32  #: (n,)


class BoundLimit(ABC):
    """A limit on the surfaces of one scene."""

    @abstractmethod
    def weights(self, places: _Places) -> F32:
        """Weights (n,) in [0, 1]."""


@dataclass(frozen=True, eq=False)
class _OnInstances(BoundLimit):
    of_instance: F32  #: (n_instances,)

    def weights(self, places: _Places) -> F32:
        return self.of_instance[places.instance]


@dataclass(frozen=True, eq=False)
class _OnTriangles(BoundLimit):
    of_triangle: F32  #: (n_triangles,)

    def weights(self, places: _Places) -> F32:
        return self.of_triangle[places.triangle]


@dataclass(frozen=True, eq=False)
class _InRegion(BoundLimit):
    shape: Shape
    linear: F32  #: (3, 3)
    translation: F32  #: (3,) from positions about the scene's centre to the shape's own space
    softness: float

    def weights(self, places: _Places) -> F32:
        local = places.position @ self.linear.T + self.translation
        if self.shape is Shape.BOX:
            distance = np.abs(local).max(axis=1, initial=0)
        else:
            distance = np.sqrt(np.einsum("ni,ni->n", local, local))
        if self.softness <= 0:
            return (distance <= _BORDER).astype(np.float32)
        x = np.clip((1 - distance) / np.float32(self.softness), 0, 1)
        return (x * x * (3 - 2 * x)).astype(np.float32)


@dataclass(frozen=True, eq=False)
class _Combined(BoundLimit):
    rule: Rule
    parts: tuple[BoundLimit, ...]  #: at least one

    def weights(self, places: _Places) -> F32:
        return combine(self.rule, [part.weights(places) for part in self.parts])


def combine(rule: Rule, weights: list[F32]) -> F32:
    """Set algebra on soft weights, each (n,) in [0, 1]; at least one."""
    first, *others = weights
    if rule is Rule.INTERSECTION:
        return np.prod(weights, axis=0, dtype=np.float32)
    outside = np.prod([1 - w for w in others], axis=0, dtype=np.float32) if others else np.float32(1)
    return first * outside if rule is Rule.DIFFERENCE else 1 - (1 - first) * outside


def _bind_limit(limit: Limit, snapshot: SceneSnapshot) -> BoundLimit:
    if isinstance(limit, SurfacesAt):
        return _OnInstances(_at_paths(limit.paths, snapshot))
    if isinstance(limit, SurfacesOf):
        return _bind_materials(limit.materials, snapshot)
    if isinstance(limit, Region):
        matrix = np.asarray(limit.to_shape, np.float64).reshape(3, 4)
        # Regions know nothing of the scene's centre; folded in here, in double precision, it costs none.
        translation = matrix[:, 3] + matrix[:, :3] @ snapshot.centre
        return _InRegion(limit.shape, matrix[:, :3].astype(np.float32), translation.astype(np.float32), limit.softness)
    parts = tuple(_bind_limit(part, snapshot) for part in limit.parts)
    if not parts:
        return _OnInstances(np.zeros(snapshot.n_instances, np.float32))
    constant = [part.of_instance for part in parts if isinstance(part, _OnInstances)]
    if len(constant) == len(parts):
        return _OnInstances(combine(limit.rule, constant))
    return _Combined(limit.rule, parts)


def _at_paths(paths: Iterable[str], snapshot: SceneSnapshot) -> F32:
    """(n_instances,) 1 on the surfaces at `paths`."""
    wanted = frozenset(paths)
    included = np.array([surface.path in wanted for surface in snapshot.surfaces], np.float32)
    return included[snapshot.geometry.instance_surface] if len(included) else np.zeros(0, np.float32)


def _bind_materials(materials: frozenset[str], snapshot: SceneSnapshot) -> BoundLimit:
    geometry = snapshot.geometry
    bound = np.array([path in materials for path in snapshot.material_paths], np.float32)
    of_triangle = bound[geometry.material]
    n_selected = np.concatenate([[0], np.cumsum(of_triangle, dtype=np.float64)])[geometry.mesh_begin]
    share = np.diff(n_selected) / np.maximum(np.diff(geometry.mesh_begin), 1)
    if np.isin(share, (0.0, 1.0)).all():
        return _OnInstances(share.astype(np.float32)[geometry.instance_mesh])
    return _OnTriangles(of_triangle)
