"""Points and normals of meshes that a skeleton or blend shapes deform (UsdSkel), as of one time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdSkel, Vt

from icheat_usd.scene import F64, I64
from icheat_usd.stage.reporting import Reporter

#: What makes a prim skinned, as authored on it or above it.
_JOINT_INDICES = "primvars:skel:jointIndices"
_BLEND_SHAPES = "skel:blendShapes"


class Skinning:
    """Finds what deforms a prim. Skeletons are read once, each below its SkelRoot.

    Linear blend and dual quaternion skinning, rigidly bound prims, blend
    shapes with inbetweens, and skeletons in instances are supported. A prim
    that says it is skinned and cannot be is reported and stays at rest.
    """

    def __init__(self, time: Usd.TimeCode, xforms: UsdGeom.XformCache, report: Reporter) -> None:
        self._time = time
        self._xforms = xforms
        self._report = report
        self._cache = UsdSkel.Cache()
        self._populated: set[Sdf.Path] = set()

    def deformation(self, prim: Usd.Prim) -> Deformation | None:
        """What deforms a prim now; None where nothing does."""
        says_so = (
            prim.GetAttribute(_JOINT_INDICES).HasAuthoredValue() or prim.GetAttribute(_BLEND_SHAPES).HasAuthoredValue()
        )
        root = UsdSkel.Root.Find(prim)
        if not root:
            if says_so:
                self._report(prim, "skinning", "it is not below a SkelRoot, so no skeleton moves it; it is at rest.")
            return None
        try:
            if root.GetPath() not in self._populated:
                self._populated.add(root.GetPath())
                self._cache.Populate(root, Usd.TraverseInstanceProxies())
            query = self._cache.GetSkinningQuery(prim)
            skeleton = UsdSkel.BindingAPI(prim).GetInheritedSkeleton()
            skeleton_query = self._cache.GetSkelQuery(skeleton) if skeleton else None
            if not query or not skeleton_query:
                if says_so:
                    self._report(prim, "skinning", "no usable skeleton is bound to it (skel:skeleton); it is at rest.")
                return None
            joints = self._joints(prim, query, skeleton_query, skeleton.GetPrim())
            shapes = self._shapes(prim, query, skeleton_query)
        except Tf.ErrorException as error:
            self._report(prim, "skinning", f"USD cannot skin it ({_first_line(error)}); it is at rest.")
            return None
        if joints is None and shapes is None:
            return None
        return Deformation(prim, joints, shapes, self._report)

    def _joints(
        self, prim: Usd.Prim, query: UsdSkel.SkinningQuery, skeleton: UsdSkel.SkeletonQuery, stands_at: Usd.Prim
    ) -> _Joints | None:
        if not query.HasJointInfluences():
            if prim.GetAttribute(_JOINT_INDICES).HasAuthoredValue():
                self._report(prim, "skinning", "its joint indices and weights do not fit together; it is at rest.")
            return None
        # Without these USD returns transforms all the same, as it happened to leave them.
        animation, posed = skeleton.GetAnimQuery(), skeleton.HasRestPose()
        if not skeleton.HasBindPose() or not (posed or (animation and not skeleton.GetMapper().IsSparse())):
            missing = "restTransforms" if skeleton.HasBindPose() else "bindTransforms"
            where = skeleton.GetPrim().GetPath()
            self._report(prim, "skinning", f"{where} lacks {missing} for each of its joints; it is at rest.")
            return None
        transforms = skeleton.ComputeSkinningTransforms(self._time)
        mapper = query.GetJointMapper()
        if mapper is not None:
            transforms = mapper.RemapTransforms(transforms)
        to_world = self._xforms.GetLocalToWorldTransform(stands_at)
        return _Joints(query, Vt.Matrix4dArray(transforms), to_world, self._to_mesh(prim, to_world), self._time)

    def _to_mesh(self, prim: Usd.Prim, skeleton_to_world: Gf.Matrix4d) -> Gf.Matrix4d:
        return skeleton_to_world * self._xforms.GetLocalToWorldTransform(prim).GetInverse()

    def _shapes(self, prim: Usd.Prim, query: UsdSkel.SkinningQuery, skeleton: UsdSkel.SkeletonQuery) -> _Shapes | None:
        animation = skeleton.GetAnimQuery()
        if not query.HasBlendShapes() or not animation:
            return None
        weights = animation.ComputeBlendShapeWeights(self._time)
        mapper = query.GetBlendShapeMapper()
        if weights is None or mapper is None:
            return None
        weights = mapper.Remap(weights)
        shapes = UsdSkel.BlendShapeQuery(UsdSkel.BindingAPI(prim))
        if weights is None or len(weights) != shapes.GetNumBlendShapes():
            self._report(
                prim, "blend shapes", "its blend shapes and their targets differ in number; they are left out."
            )
            return None
        return _Shapes(shapes, *shapes.ComputeSubShapeWeights(weights))


@dataclass(frozen=True, eq=False)
class Deformation:
    """What moves the points of one prim from rest to where they are at a time."""

    prim: Usd.Prim
    _joints: _Joints | None
    _shapes: _Shapes | None
    _report: Reporter

    def points(self, rest: F64) -> F64 | None:
        """Points (n, 3) in the prim's own space; None, with a finding, where USD cannot tell."""
        points = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(rest, np.float32))
        try:
            moved = (self._shapes is None or self._shapes.move(points)) and (
                self._joints is None or self._joints.skin(points)
            )
        except Tf.ErrorException:
            moved = False
        if not moved:
            self._report(
                self.prim,
                "skinning",
                f"its influences or blend shapes do not fit its {len(rest)} points; it is at rest.",
            )
            return None
        result = np.array(points, np.float64)
        result = result if self._joints is None else _transformed(result, np.array(self._joints.to_mesh))
        if not np.isfinite(result).all():
            self._report(self.prim, "skinning", "a weight, joint or offset is not finite; it is at rest.")
            return None
        return result

    def normals(self, rest: F64, vertex: I64, n_points: int) -> F64:
        """Normals in the prim's own space, not unit.

        Parameters
        ----------
        rest : (n, 3) float64
        vertex : (n,) int64
            The point that each normal is at.
        """
        result = rest
        if self._shapes is not None:
            result = result + self._shapes.normal_offsets(n_points)[vertex]
        if self._joints is None:
            return result
        linear = self._joints.linear_maps(n_points)
        if linear is None:
            return result
        linear = linear @ np.array(self._joints.to_mesh)[:3, :3]
        # Row vectors: a normal takes the inverse transpose. Joints scaled to nothing leave it as it is.
        invertible = np.abs(np.linalg.det(linear)) > 1e-12
        inverse = np.tile(np.eye(3), (n_points, 1, 1))
        inverse[invertible] = np.linalg.inv(linear[invertible]).transpose(0, 2, 1)
        return np.asarray(np.einsum("ni,nij->nj", result, inverse[vertex]))

    def placement(self) -> Gf.Matrix4d | None:
        """Local-to-world matrix of a prim without points; None where joints do not move it as a whole."""
        if self._joints is None or not self._joints.query.IsRigidlyDeformed():
            self._report(self.prim, "skinning", "only meshes can bend; this is bound to several joints and at rest.")
            return None
        return self._joints.rigid()


@dataclass(frozen=True, eq=False)
class _Joints:
    query: UsdSkel.SkinningQuery
    transforms: Vt.Matrix4dArray  #: from bind pose to now, in skeleton space, in the prim's own order of joints
    to_world: Gf.Matrix4d  #: of the skeleton
    to_mesh: Gf.Matrix4d  #: skeleton space to the prim's
    time: Usd.TimeCode

    def skin(self, points: Vt.Vec3fArray) -> bool:
        """Move points of the prim to skeleton space."""
        return self._skin(points, len(points), copies=1)

    def linear_maps(self, n_points: int) -> F64 | None:
        """Row-vector maps (n, 3, 3) of directions at each point, to skeleton space."""
        # For given weights either method is affine: where origin and axes go tells all of it.
        probes = np.zeros((n_points, 4, 3), np.float32)
        probes[:, 1:] = np.eye(3)
        moved = Vt.Vec3fArray.FromNumpy(probes.reshape(-1, 3))
        if not self._skin(moved, n_points, copies=4):
            return None
        ends = np.array(moved, np.float64).reshape(n_points, 4, 3)
        return ends[:, 1:] - ends[:, :1]

    def _skin(self, points: Vt.Vec3fArray, n_points: int, copies: int) -> bool:
        influences = self.query.ComputeVaryingJointInfluences(n_points, self.time)
        if influences is None:
            return False
        n = self.query.GetNumInfluencesPerComponent()
        indices, weights = (np.array(values) for values in influences)
        if len(indices) != n * n_points or len(weights) != n * n_points:
            return False
        if len(indices) and (indices.min() < 0 or indices.max() >= len(self.transforms)):
            return False
        if copies > 1:
            indices = np.repeat(indices.reshape(-1, n), copies, axis=0).reshape(-1)
            weights = np.repeat(weights.reshape(-1, n), copies, axis=0).reshape(-1)
        return bool(
            UsdSkel.SkinPoints(
                self.query.GetSkinningMethod(),
                self.query.GetGeomBindTransform(self.time),
                self.transforms,
                Vt.IntArray.FromNumpy(np.ascontiguousarray(indices, np.int32)),
                Vt.FloatArray.FromNumpy(np.ascontiguousarray(weights, np.float32)),
                n,
                points,
            )
        )

    def rigid(self) -> Gf.Matrix4d | None:
        moved = self.query.ComputeSkinnedTransform(self.transforms, self.time)
        return None if moved is None else moved * self.to_world


@dataclass(frozen=True, eq=False)
class _Shapes:
    query: UsdSkel.BlendShapeQuery
    weights: Vt.FloatArray  #: of each sub-shape: a shape or one of its inbetweens
    shape: Vt.UIntArray
    sub_shape: Vt.UIntArray

    def move(self, points: Vt.Vec3fArray) -> bool:
        indices = self.query.ComputeBlendShapePointIndices()
        offsets = self.query.ComputeSubShapePointOffsets()
        return bool(
            self.query.ComputeDeformedPoints(self.weights, self.shape, self.sub_shape, indices, offsets, points)
        )

    def normal_offsets(self, n_points: int) -> F64:
        """What the shapes add to the normal at each point, (n_points, 3)."""
        total = np.zeros((n_points, 3))
        for weight, shape_index, sub_shape in zip(self.weights, self.shape, self.sub_shape, strict=True):
            shape = self.query.GetBlendShape(shape_index)
            inbetween = self.query.GetInbetween(sub_shape)
            offsets = inbetween.GetNormalOffsets() if inbetween else shape.GetNormalOffsetsAttr().Get()
            if offsets is None or not len(offsets):
                continue
            indices = np.array(shape.GetPointIndicesAttr().Get() or range(n_points), np.int64)
            if len(indices) == len(offsets) and indices.min() >= 0 and indices.max() < n_points:
                np.add.at(total, indices, weight * np.array(offsets, np.float64))
        return total


def _transformed(points: F64, matrix: F64) -> F64:
    return np.asarray(points @ matrix[:3, :3] + matrix[3, :3])


def _first_line(error: Tf.ErrorException) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), "unknown reason")
