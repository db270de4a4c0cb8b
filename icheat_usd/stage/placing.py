"""Meshes, and where they stand: shared by native instances, point instances and ordinary prims."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Usd, UsdGeom, UsdShade

from icheat_usd.scene import F64, I64, Geometry, Surface
from icheat_usd.stage import implicit
from icheat_usd.stage.materials import MaterialLibrary
from icheat_usd.stage.meshes import FaceMaterials, TriangleMesh, read_mesh
from icheat_usd.stage.primvars import find_primvar
from icheat_usd.stage.reporting import Reporter
from icheat_usd.stage.skinning import Skinning
from icheat_usd.stage.transforms import Placement, inverse

Scalar = TypeVar("Scalar", np.float32, np.int32)


class GeometryBuilder:
    """Collects meshes and their placements, and joins them into `Geometry`.

    Parameters
    ----------
    time
        When everything is read.
    materials
        Where bound materials get their rows.
    level
        Subdivision steps, or None for control meshes.
    purposes
        Purposes that are shown.
    material_purpose
        The purpose whose material bindings win: "full" or "preview".
    report
        Receives findings.
    """

    def __init__(
        self,
        time: Usd.TimeCode,
        materials: MaterialLibrary,
        level: int | None,
        purposes: Sequence[str],
        material_purpose: str,
        report: Reporter,
    ) -> None:
        self.time = time
        self.materials = materials
        self.level = level
        self.purposes = frozenset(purposes)
        self.material_purpose = material_purpose
        self.report = report
        self.xforms = UsdGeom.XformCache(time)
        self.skinning = Skinning(time, self.xforms, report)
        self.meshes: list[TriangleMesh] = []
        self.surfaces: list[Surface] = []
        self._mesh_of: dict[tuple[object, ...], int | None] = {}
        self._row_of_mesh: dict[int, int] = {}  # by identity: `meshes` keeps them alive
        self._known: dict[bytes, TriangleMesh | None] = {}
        self._instance_mesh: list[NDArray[np.int64]] = []
        self._transforms: list[F64] = []

    # What is shown -------------------------------------------------------

    def has_purpose(self, prim: Usd.Prim) -> bool:
        return str(UsdGeom.Imageable(prim).ComputePurpose()) in self.purposes

    def is_shown(self, prim: Usd.Prim) -> bool:
        imageable = UsdGeom.Imageable(prim)
        return (
            str(imageable.ComputePurpose()) in self.purposes
            and str(imageable.ComputeVisibility(self.time)) != "invisible"
        )

    # Meshes --------------------------------------------------------------

    def add_meshes(self, prims: Sequence[Usd.Prim]) -> list[int | None]:
        """Rows of the meshes of gprims, read or found again; None for one that was left out."""
        return [self._add_mesh(prim, bound) for prim, bound in zip(prims, self._face_materials(prims), strict=True)]

    def _face_materials(self, prims: Sequence[Usd.Prim]) -> list[FaceMaterials]:
        bound_prims, subsets = list(prims), []
        for prim in prims:
            own = []
            if prim.IsA(UsdGeom.Mesh) and prim.GetChildren():
                own = UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets()
            subsets.append(own)
            bound_prims.extend(subset.GetPrim() for subset in own)
        if not bound_prims:
            return []
        bound, _ = UsdShade.MaterialBindingAPI.ComputeBoundMaterials(bound_prims, self.material_purpose)
        rows = [
            self.materials.row(material if material else None, prim_path=str(prim.GetPath()))
            for prim, material in zip(bound_prims, bound, strict=True)
        ]
        subset_row = iter(rows[len(prims) :])
        result = []
        for row, own in zip(rows, subsets, strict=False):
            of_faces = []
            for subset in own:
                faces = np.array(subset.GetIndicesAttr().Get(self.time) or (), dtype=np.int64)
                of_faces.append((next(subset_row), faces))
            used = {row, *(subset_row_ for subset_row_, _ in of_faces)}
            names = tuple((used_row, name) for used_row in sorted(used) if (name := self.materials.st_name(used_row)))
            result.append(FaceMaterials(row, tuple(of_faces), names))
        return result

    def _add_mesh(self, prim: Usd.Prim, materials: FaceMaterials) -> int | None:
        if prim.IsA(UsdGeom.Mesh):
            deformation = self.skinning.deformation(prim)
            # Instances share a mesh, but each may be animated by its own means.
            key = self._mesh_key(prim, materials) if deformation is None else (str(prim.GetPath()), materials.row)
            if key in self._mesh_of:
                return self._mesh_of[key]
            mesh = read_mesh(
                UsdGeom.Mesh(prim), self.time, materials, self.level, self.report, self._known, deformation
            )
        else:
            shape = implicit.parameters(prim, self.time)
            color = implicit.display_color(prim, self.time, self.report)
            key = (shape, color, materials.row)
            if key in self._mesh_of:
                return self._mesh_of[key]
            mesh = implicit.read_implicit(shape, color, materials, prim, self.report)
        row = None
        if mesh is not None:
            row = self._row_of_mesh.setdefault(id(mesh), len(self.meshes))
            if row == len(self.meshes):
                self.meshes.append(mesh)
        self._mesh_of[key] = row
        return row

    def _mesh_key(self, prim: Usd.Prim, materials: FaceMaterials) -> tuple[object, ...]:
        """Equal for instance proxies that show the same triangles: what is inherited from outside counts too."""
        rows = (materials.row, *(row for row, _ in materials.subsets))
        if not prim.IsInstanceProxy():
            return (str(prim.GetPath()), rows)
        inherited = []
        for name in sorted({"displayColor", *(name for _, name in materials.st_names or ((0, "st"),))}):
            primvar = find_primvar(prim, name)
            if primvar is not None:
                owner = primvar.GetAttr().GetPrim()
                shared = owner.GetPrimInPrototype() if owner.IsInstanceProxy() else owner
                inherited.append((name, str(shared.GetPath())))
        return (str(prim.GetPrimInPrototype().GetPath()), rows, tuple(inherited))

    # Placements ----------------------------------------------------------

    def place_prims(self, prims: Sequence[Usd.Prim], meshes: Sequence[int | None]) -> None:
        """One surface for each gprim that has a mesh, where it stands."""
        placed = [(prim, mesh) for prim, mesh in zip(prims, meshes, strict=True) if mesh is not None]
        if not placed:
            return
        matrices = np.array([self._local_to_world(prim) for prim, _ in placed], dtype=np.float64)
        names = [(str(prim.GetPath()), -1, "") for prim, _ in placed]
        self.place(np.array([mesh for _, mesh in placed]), matrices, names)

    def _local_to_world(self, prim: Usd.Prim) -> Gf.Matrix4d:
        moved = self._moved_by_joints(prim)
        return self.xforms.GetLocalToWorldTransform(prim) if moved is None else moved

    def matrix_below(self, prim: Usd.Prim, root: Usd.Prim) -> F64:
        """Row-vector matrix (4, 4) from a gprim's space to that of `root`, whose own transform is left out."""
        moved = self._moved_by_joints(prim)
        if moved is None:
            return relative_matrix(self.xforms, prim, root)
        return np.array(moved * self.xforms.GetLocalToWorldTransform(root).GetInverse())

    def _moved_by_joints(self, prim: Usd.Prim) -> Gf.Matrix4d | None:
        """Local-to-world matrix of a gprim without points that is bound to a skeleton, None for any other."""
        deformation = None if prim.IsA(UsdGeom.Mesh) else self.skinning.deformation(prim)
        return None if deformation is None else deformation.placement()

    def place(self, meshes: I64, matrices: F64, names: Sequence[tuple[str, int, str]]) -> None:
        """Add one surface per row.

        Parameters
        ----------
        meshes : (k,) int64
            Rows of the meshes.
        matrices : (k, 4, 4) float64
            Row-vector local-to-world matrices in stage units.
        names : k of (path, id, part)
        """
        finite = np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
        for i in np.flatnonzero(~finite).tolist():
            self.report(names[i][0], "transform", "a transform is not finite; left out there.")
        # Scaled to nothing is a usual way to hide; it has no area.
        kept = finite & (np.abs(np.where(finite[:, None, None], matrices, 0.0)[:, :3, :3]).max(axis=(1, 2)) > 0.0)
        if not kept.any():
            return
        meshes = meshes[kept]
        transforms = np.transpose(matrices[kept], (0, 2, 1))[:, :3, :].copy()
        origins = np.array([mesh.origin for mesh in self.meshes])
        transforms[:, :, 3] += np.einsum("nij,nj->ni", transforms[:, :, :3], origins[meshes])
        self._instance_mesh.append(meshes)
        self._transforms.append(transforms)
        kept_names = [name for name, keep in zip(names, kept.tolist(), strict=True) if keep]
        for (path, instance_id, part), mesh in zip(kept_names, meshes.tolist(), strict=True):
            source = self.meshes[mesh]
            self.surfaces.append(Surface(path, instance_id, part, source.n_faces, source.topology_digest))

    def bounds(self) -> tuple[F64, F64] | None:
        """Box around everything placed, stage units; None where nothing is."""
        boxes = self._boxes(self._all_transforms())
        if boxes is None:
            return None
        middle, half = boxes
        return (middle - half).min(axis=0), (middle + half).max(axis=0)

    def radius(self, placement: Placement) -> float:
        """Of a sphere about the snapshot's origin that holds everything placed; metres."""
        boxes = self._boxes(placement.place(self._all_transforms()))
        return 0.0 if boxes is None else float(np.linalg.norm(np.abs(boxes[0]) + boxes[1], axis=1).max())

    def _all_transforms(self) -> F64:
        return np.concatenate(self._transforms) if self._transforms else np.empty((0, 3, 4))

    def _boxes(self, transforms: F64) -> tuple[F64, F64] | None:
        if not len(transforms):
            return None
        bounds = np.array([mesh.bounds for mesh in self.meshes])
        mesh = np.concatenate(self._instance_mesh)
        middle, half = 0.5 * (bounds[mesh, 0] + bounds[mesh, 1]), 0.5 * (bounds[mesh, 1] - bounds[mesh, 0])
        linear = transforms[:, :, :3]
        return (
            np.einsum("nij,nj->ni", linear, middle) + transforms[:, :, 3],
            np.einsum("nij,nj->ni", np.abs(linear), half),
        )

    def build(self, placement: Placement) -> Geometry:
        """All tables, with transforms to metres about the centre."""
        meshes = self.meshes
        to_world = placement.place(self._all_transforms())
        counts = [len(mesh.points) for mesh in meshes]

        def join(name: str, shape: tuple[int, ...], kind: type[Scalar]) -> NDArray[Scalar]:
            parts = [getattr(mesh, name) for mesh in meshes] or [np.empty((0, *shape))]
            return np.ascontiguousarray(np.concatenate(parts), dtype=kind)

        n = len(to_world)
        instance_mesh = np.concatenate(self._instance_mesh) if n else np.empty(0)
        return Geometry(
            points=join("points", (3, 3), np.float32),
            normals=join("normals", (3, 3), np.float32),
            st=join("st", (3, 2), np.float32),
            color=join("color", (3, 3), np.float32),
            face=join("face", (), np.int32),
            face_uv=join("face_uv", (3, 2), np.float32),
            material=join("material", (), np.int32),
            mesh_begin=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            mesh_double_sided=np.array([mesh.double_sided for mesh in meshes], dtype=np.uint8),
            instance_mesh=instance_mesh.astype(np.int32),
            instance_surface=np.arange(n, dtype=np.int32),
            instance_to_world=np.ascontiguousarray(to_world, dtype=np.float32),
            instance_to_object=np.ascontiguousarray(inverse(to_world), dtype=np.float32),
            instance_flip=(np.linalg.det(to_world[:, :, :3]) < 0.0).astype(np.uint8),
        )


def relative_matrix(xforms: UsdGeom.XformCache, prim: Usd.Prim, root: Usd.Prim) -> F64:
    """Row-vector matrix from a prim's space to the space of `root`, the transform of `root` itself left out."""
    if prim == root:
        return np.eye(4)
    matrix, _ = xforms.ComputeRelativeTransform(prim, root)
    return np.array(matrix if isinstance(matrix, Gf.Matrix4d) else Gf.Matrix4d(matrix))
