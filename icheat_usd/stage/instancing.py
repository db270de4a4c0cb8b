"""Point instancers: many placements of a few prototypes, never copies of their triangles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, Vt

from icheat_usd.scene import F64, I64
from icheat_usd.stage.placing import GeometryBuilder, relative_matrix
from icheat_usd.stage.walking import walk


@dataclass(frozen=True)
class _Part:
    """One mesh of a prototype."""

    mesh: int
    matrix: F64  #: (4, 4) row-vector, through the transform of the prototype's root
    name: str  #: path relative to the prototype


@dataclass(frozen=True)
class _Placed:
    """One part of one prototype, everywhere its instancer puts it."""

    mesh: int
    matrices: F64  #: (k, 4, 4) row-vector, to the instancer's space
    ids: I64  #: (k,)
    part: str


class InstancerReader:
    """Places what point instancers show; prototypes are read once."""

    def __init__(self, builder: GeometryBuilder) -> None:
        self._builder = builder
        self._report = builder.report
        self._parts: dict[Sdf.Path, list[_Part]] = {}
        self._open: set[Sdf.Path] = set()  # prototypes being read

    def place(self, prim: Usd.Prim) -> None:
        """Add every visible instance of an instancer that is itself shown.

        Surfaces carry the instancer's path, the instance's id and, where the
        prototype has several meshes, the mesh's path relative to the prototype.
        """
        to_world = np.array(self._builder.xforms.GetLocalToWorldTransform(prim))
        path = str(prim.GetPath())
        for placed in self._expand(prim):
            names = [(path, int(instance_id), placed.part) for instance_id in placed.ids]
            meshes = np.full(len(names), placed.mesh, np.int64)
            self._builder.place(meshes, placed.matrices @ to_world, names)

    def _expand(self, prim: Usd.Prim) -> list[_Placed]:
        instancer = UsdGeom.PointInstancer(prim)
        time = self._instance_time(instancer)
        which = np.array(instancer.GetProtoIndicesAttr().Get(time) or (), dtype=np.int64)
        if not len(which):
            self._report(prim, "point instancer", "it has no protoIndices at this time; nothing is instanced.")
            return []
        matrices = self._matrices(instancer, time, len(which))
        if matrices is None:
            return []
        self._report_per_instance_color(prim)
        shown = self._mask(instancer, time, len(which))
        ids = self._ids(instancer, time, len(which))
        targets = instancer.GetPrototypesRel().GetForwardedTargets()
        prototypes = [prim.GetStage().GetPrimAtPath(target) for target in targets]
        if which.min() < 0 or which.max() >= len(prototypes):
            self._report(
                prim,
                "protoIndices",
                f"protoIndices reach outside its {len(prototypes)} prototypes; those instances are left out.",
            )
        result = []
        for index, prototype in enumerate(prototypes):
            chosen = np.flatnonzero((which == index) & shown)
            if not len(chosen):
                continue
            if not prototype:
                self._report(prim, "prototypes", f"prototype {index} does not exist; its instances are left out.")
                continue
            for part in self._prototype_parts(prototype):
                result.append(_Placed(part.mesh, part.matrix @ matrices[chosen], ids[chosen], part.name))
        return result

    def _instance_time(self, instancer: UsdGeom.PointInstancer) -> Usd.TimeCode:
        """A true time for the instances: velocities are extrapolated to it, which no 'earliest' allows."""
        time = self._builder.time
        if time != Usd.TimeCode.EarliestTime():
            return time
        samples = instancer.GetPositionsAttr().GetTimeSamples() or instancer.GetProtoIndicesAttr().GetTimeSamples()
        return Usd.TimeCode(samples[0]) if samples else Usd.TimeCode.Default()

    def _matrices(self, instancer: UsdGeom.PointInstancer, time: Usd.TimeCode, n: int) -> F64 | None:
        prim = instancer.GetPrim()
        positions = instancer.GetPositionsAttr().Get(time)
        if positions is None or len(positions) != n:
            count = 0 if positions is None else len(positions)
            self._report(prim, "point instancer", f"it has {n} protoIndices and {count} positions; left out.")
            return None
        mismatched = set()
        for name in ("orientations", "orientationsf", "scales", "velocities", "accelerations", "angularVelocities"):
            attribute = prim.GetAttribute(name)
            values = attribute.Get(time) if attribute else None
            if values and len(values) != n:
                self._report(prim, name, f"{name} has {len(values)} values for {n} instances; ignored.")
                mismatched.add(name)
        if mismatched:
            # USD itself would read past the end of the short array (seen in 26.11) and give what memory holds there.
            return _placed_without(instancer, time, positions, mismatched)
        # With prototype transforms included USD gives up altogether where one index is wrong.
        try:
            matrices = instancer.ComputeInstanceTransformsAtTime(
                time, time, UsdGeom.PointInstancer.ExcludeProtoXform, UsdGeom.PointInstancer.IgnoreMask
            )
        except Tf.ErrorException:
            matrices = None
        if matrices is None or len(matrices) != n:
            self._report(prim, "point instancer", "USD finds no transforms for its instances; left out.")
            return None
        return np.array(matrices, dtype=np.float64)

    def _mask(self, instancer: UsdGeom.PointInstancer, time: Usd.TimeCode, n: int) -> NDArray[np.bool_]:
        mask = instancer.ComputeMaskAtTime(time)
        return np.array(mask, dtype=np.bool_) if len(mask) == n else np.ones(n, np.bool_)

    def _ids(self, instancer: UsdGeom.PointInstancer, time: Usd.TimeCode, n: int) -> I64:
        ids = np.array(instancer.GetIdsAttr().Get(time) or (), dtype=np.int64)
        if not len(ids):
            return np.arange(n)
        if len(ids) != n or len(np.unique(ids)) != n:
            self._report(
                instancer.GetPrim(), "ids", f"ids are not {n} different numbers; instances are numbered in order."
            )
            return np.arange(n)
        return ids

    def _report_per_instance_color(self, prim: Usd.Prim) -> None:
        primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar("displayColor")
        if primvar and primvar.HasAuthoredValue() and str(primvar.GetInterpolation()) != "constant":
            self._report(
                prim, "primvar displayColor", "a colour per instance is not supported; the prototype's colour is used."
            )

    def _prototype_parts(self, root: Usd.Prim) -> list[_Part]:
        path = root.GetPath()
        if path in self._parts:
            return self._parts[path]
        if path in self._open:
            self._report(
                root, "prototypes", "this prototype holds an instancer of itself; the inner instances are left out."
            )
            return []
        self._open.add(path)
        builder = self._builder
        own, _ = builder.xforms.GetLocalTransformation(root)
        to_prototype = np.array(own)  # the instance's transform comes on top of the prototype's own
        found = walk(root, self._report, prototypes=True)
        for light in found.lights:
            if light not in found.gprims:
                self._report(light, "instanced light", "a light inside a point-instanced prototype is left out.")
        gprims = [prim for prim in found.gprims if self._is_shown_within(prim, root)]
        parts = [
            _Part(mesh, builder.matrix_below(prim, root) @ to_prototype, _relative_path(prim, root))
            for prim, mesh in zip(gprims, builder.add_meshes(gprims), strict=True)
            if mesh is not None
        ]
        for nested in found.instancers:
            if not self._is_shown_within(nested, root):
                continue
            base, matrix = _relative_path(nested, root), relative_matrix(builder.xforms, nested, root) @ to_prototype
            for placed in self._expand(nested):
                below = f"/{placed.part}" if placed.part else ""
                parts.extend(
                    _Part(placed.mesh, placed.matrices[i] @ matrix, f"{base}[{placed.ids[i]}]{below}")
                    for i in range(len(placed.ids))
                )
        if len(parts) == 1:
            parts = [_Part(parts[0].mesh, parts[0].matrix, "")]
        self._open.remove(path)
        self._parts[path] = parts
        return parts

    def _is_shown_within(self, prim: Usd.Prim, root: Usd.Prim) -> bool:
        """Shown as part of a prototype: what hides the prototype's ancestors does not hide its instances."""
        if not self._builder.has_purpose(prim):
            return False
        step = prim
        while step:
            attribute = UsdGeom.Imageable(step).GetVisibilityAttr()
            if attribute and attribute.Get(self._builder.time) == "invisible":
                return False
            if step == root:
                return True
            step = step.GetParent()
        return True


def _relative_path(prim: Usd.Prim, root: Usd.Prim) -> str:
    return str(prim.GetPath().MakeRelativePath(root.GetPath()))


def _placed_without(
    instancer: UsdGeom.PointInstancer, time: Usd.TimeCode, positions: Vt.Vec3fArray, left_out: set[str]
) -> F64:
    """Row-vector transforms from positions, and from those of scales and orientations that are not left out."""
    prim = instancer.GetPrim()

    def values(name: str) -> Any:
        attribute = prim.GetAttribute(name)
        return attribute.Get(time) if attribute and name not in left_out else None

    scales, turns = values("scales"), values("orientationsf") or values("orientations")
    matrices = np.empty((len(positions), 4, 4))
    for i, position in enumerate(positions):
        matrix = Gf.Matrix4d(1).SetScale(Gf.Vec3d(scales[i])) if scales else Gf.Matrix4d(1)
        if turns:
            matrix *= Gf.Matrix4d().SetRotate(Gf.Quatd(turns[i]))
        matrices[i] = np.array(matrix * Gf.Matrix4d().SetTranslate(Gf.Vec3d(position)))
    return matrices
