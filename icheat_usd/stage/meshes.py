"""Polygon meshes and subdivision surfaces as triangles."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom

from icheat_usd.scene import F32, F64, I32, I64
from icheat_usd.stage.polygons import corner_normals, degenerate, face_parametrisation, triangulate
from icheat_usd.stage.primvars import MeshValues, Topology, expand, find_primvar, read_primvar
from icheat_usd.stage.reporting import Reporter
from icheat_usd.stage.subdivision import Cage, refine

#: UsdPreviewSurface's own diffuseColor, for a mesh without displayColor.
DEFAULT_COLOR = 0.18
#: A mesh is refined no further than this many triangles.
MOST_TRIANGLES = 8_000_000
#: Points this many radii from their origin are moved next to it, so that float32 still resolves the shape.
FAR_FROM_ORIGIN = 8.0


@dataclass(frozen=True)
class FaceMaterials:
    """Rows of `Materials` on the faces of one mesh, and the texture coordinates they ask for."""

    row: int  #: of the faces in no subset
    subsets: tuple[tuple[int, I64], ...] = ()  #: (row, faces)
    st_names: tuple[tuple[int, str], ...] = ()  #: (row, primvar); a row that is missing asks for ``st``

    def rows(self, n_faces: int) -> I32:
        rows = np.full(n_faces, self.row, np.int32)
        for row, faces in self.subsets:
            rows[faces[(faces >= 0) & (faces < n_faces)]] = row
        return rows

    def st_name(self, row: int) -> str:
        return dict(self.st_names).get(row, "st")


@dataclass(frozen=True)
class TriangleMesh:
    """One mesh of `Geometry` before it is joined to the others."""

    points: F32  #: (n, 3, 3) object space, about `origin`
    normals: F32  #: (n, 3, 3)
    st: F32  #: (n, 3, 2)
    color: F32  #: (n, 3, 3)
    face: I32  #: (n,)
    face_uv: F32  #: (n, 3, 2)
    material: I32  #: (n,)
    double_sided: bool
    n_faces: int
    topology_digest: str
    origin: F64 = field(default_factory=lambda: np.zeros(3))  #: object-space place that `points` are about

    @property
    def bounds(self) -> tuple[F64, F64]:
        """Smallest and largest corner, object space, about `origin`."""
        corners = self.points.reshape(-1, 3)
        return corners.min(axis=0).astype(np.float64), corners.max(axis=0).astype(np.float64)


def topology_digest(counts: NDArray[np.integer], indices: NDArray[np.integer]) -> str:
    """SHA-256 (hex) of face counts and indices, each with its length first, as little-endian int64."""
    digest = hashlib.sha256()
    for values in (counts, indices):
        digest.update(np.int64(len(values)).astype("<i8").tobytes())
        digest.update(np.ascontiguousarray(values, dtype="<i8").tobytes())
    return digest.hexdigest()


def read_mesh(
    mesh: UsdGeom.Mesh, time: Usd.TimeCode, materials: FaceMaterials, level: int, report: Reporter
) -> TriangleMesh | None:
    """Triangles of a mesh at one time, or None with a finding where its data cannot be used.

    Parameters
    ----------
    mesh
        A mesh prim; an instance proxy is welcome.
    time
        When points, topology and primvars are read.
    materials
        Material rows of the faces; they decide which texture coordinates are read.
    level
        Subdivision steps for ``catmullClark`` and ``bilinear`` meshes.
    report
        Receives what is wrong or not supported.
    """
    prim = mesh.GetPrim()
    control = _read_control_mesh(mesh, time, report)
    if control is None:
        return None
    points, counts, indices, face = control
    authored = Topology(len(points), counts, indices)
    digest = topology_digest(counts, indices)
    n_faces = len(counts)

    scheme = str(mesh.GetSubdivisionSchemeAttr().Get(time) or "catmullClark")
    if scheme == "loop":
        report(prim, "subdivisionScheme loop", "Loop subdivision is not supported; the control mesh is used, smoothed.")
    elif scheme not in ("none", "catmullClark", "bilinear"):
        report(prim, "subdivisionScheme", f"'{scheme}' is no subdivision scheme; the mesh is taken as polygons.")
        scheme = "none"

    # Columns that ride along: on vertices behind the position, on corners behind the place in the face.
    rows = materials.rows(n_faces)
    used_rows = np.unique(rows) if n_faces else np.array([materials.row])
    names = sorted({materials.st_name(int(row)) for row in used_rows})
    columns = {name: _read_values(prim, name, 2, time, authored, report) for name in names}
    columns["displayColor"] = _read_values(prim, "displayColor", 3, time, authored, report)
    if scheme == "none":
        columns["normals"] = _read_normals(mesh, time, authored, report)

    vertex_columns, corner_columns = [points], [face_parametrisation(counts)]
    places: dict[str, tuple[bool, int, int]] = {}
    for name, column in columns.items():
        if column is None:
            continue
        target = vertex_columns if column.on_vertices else corner_columns
        begin = sum(part.shape[1] for part in target)
        places[name] = (column.on_vertices, begin, begin + column.values.shape[1])
        target.append(column.values)

    cage = Cage(np.concatenate(vertex_columns, axis=1), counts, indices, np.concatenate(corner_columns, axis=1), face)
    kept = _visible_faces(mesh, time, cage, report)
    if scheme in ("catmullClark", "bilinear"):
        sharp = str(mesh.GetInterpolateBoundaryAttr().Get(time)) != "edgeOnly"
        if scheme == "catmullClark":
            _report_creases(mesh, time, report)
        cage = refine(
            _only(cage, counts >= 3),
            _affordable_level(int(counts.sum()), level, prim, report),
            smooth=scheme == "catmullClark",
            sharp_corners=sharp,
        )
    smooth = scheme in ("catmullClark", "loop")
    vertex_normals = _smooth_normals(cage) if smooth else None
    cage = _only(cage, kept[cage.face])

    # Triangles -----------------------------------------------------------
    origin = _origin(cage.vertices[:, :3])
    positions = cage.vertices[:, :3] - origin
    corners, triangle_face = triangulate(positions, cage.counts, cage.indices)
    if str(mesh.GetOrientationAttr().Get(time)) == "leftHanded":
        corners = corners[:, [0, 2, 1]]
        vertex_normals = None if vertex_normals is None else -vertex_normals
    vertex = cage.indices[corners]
    triangles = positions[vertex]
    good = ~degenerate(triangles)
    if not good.any():
        report(prim, "mesh", "it has no face with an area; left out.")
        return None
    if not good.all():
        corners, triangle_face, vertex, triangles = corners[good], triangle_face[good], vertex[good], triangles[good]
    control_face = cage.face[triangle_face]

    def gather(name: str) -> F64 | None:
        if name not in places:
            return None
        on_vertices, begin, end = places[name]
        return cage.vertices[vertex, begin:end] if on_vertices else cage.corners[corners, begin:end]

    row_of_triangle = rows[control_face]
    st = np.zeros((len(triangles), 3, 2), np.float32)
    for row in used_rows:
        values = gather(materials.st_name(int(row)))
        if values is not None:
            chosen = row_of_triangle == row
            st[chosen] = values[chosen]
    color = gather("displayColor")
    normals = vertex_normals[vertex] if vertex_normals is not None else gather("normals")
    return TriangleMesh(
        points=triangles.astype(np.float32),
        normals=unit_normals(normals, triangles),
        st=st,
        color=np.full((len(triangles), 3, 3), DEFAULT_COLOR, np.float32) if color is None else color.astype(np.float32),
        face=control_face.astype(np.int32),
        face_uv=np.clip(cage.corners[corners, :2], 0.0, 1.0).astype(np.float32),
        material=row_of_triangle,
        double_sided=bool(mesh.GetDoubleSidedAttr().Get(time)),
        n_faces=n_faces,
        topology_digest=digest,
        origin=origin,
    )


def unit_normals(normals: F64 | None, triangles: F64) -> F32:
    """Unit normals per corner ``(n, 3, 3) float32``; the triangle's own where none is given or one has no length."""
    flat = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    if normals is None:
        return np.ascontiguousarray(np.broadcast_to(flat[:, None, :], triangles.shape), dtype=np.float32)
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    usable = length > 1e-30
    unit = np.where(usable, normals / np.where(usable, length, 1.0), flat[:, None, :])
    return unit.astype(np.float32)


def _read_control_mesh(
    mesh: UsdGeom.Mesh, time: Usd.TimeCode, report: Reporter
) -> tuple[F64, I64, I64, I64] | None:
    prim = mesh.GetPrim()
    points = np.array(mesh.GetPointsAttr().Get(time) or (), dtype=np.float64).reshape(-1, 3)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get(time) or (), dtype=np.int64)
    indices = np.array(mesh.GetFaceVertexIndicesAttr().Get(time) or (), dtype=np.int64)
    if not len(points) or not len(counts):
        report(prim, "mesh", "it has no points or no faces at this time; left out.")
        return None
    if counts.min() < 0 or counts.sum() != len(indices):
        report(
            prim,
            "mesh",
            f"faceVertexCounts sum to {counts.sum()} and there are {len(indices)} faceVertexIndices; left out.",
        )
        return None
    if len(indices) and (indices.min() < 0 or indices.max() >= len(points)):
        report(prim, "mesh", f"faceVertexIndices reach outside its {len(points)} points; left out.")
        return None
    if not np.isfinite(points).all():
        if not np.isfinite(points[indices]).all():
            report(prim, "mesh", "a point is not finite (NaN or infinity); left out.")
            return None
        points = np.where(np.isfinite(points), points, 0.0)
    return points, counts, indices, np.arange(len(counts))


def _read_values(
    prim: Usd.Prim, name: str, width: int, time: Usd.TimeCode, topology: Topology, report: Reporter
) -> MeshValues | None:
    primvar = find_primvar(prim, name)
    return None if primvar is None else read_primvar(primvar, time, topology, width, report, prim)


def _read_normals(
    mesh: UsdGeom.Mesh, time: Usd.TimeCode, topology: Topology, report: Reporter
) -> MeshValues | None:
    prim = mesh.GetPrim()
    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar("normals")
    if primvar and primvar.HasAuthoredValue():
        return read_primvar(primvar, time, topology, 3, report, prim)
    attribute = mesh.GetNormalsAttr()
    if not attribute.HasAuthoredValue():
        return None
    return expand(
        attribute.Get(time), None, str(mesh.GetNormalsInterpolation()), topology, 3, "normals", report, prim
    )


def _visible_faces(mesh: UsdGeom.Mesh, time: Usd.TimeCode, cage: Cage, report: Reporter) -> NDArray[np.bool_]:
    kept = np.ones(len(cage.counts), np.bool_)
    holes = np.array(mesh.GetHoleIndicesAttr().Get(time) or (), dtype=np.int64)
    if holes.size:
        inside = (holes >= 0) & (holes < len(kept))
        if not inside.all():
            report(mesh.GetPrim(), "holeIndices", "some name no face of the mesh; those are ignored.")
        kept[holes[inside]] = False
    return kept


def _report_creases(mesh: UsdGeom.Mesh, time: Usd.TimeCode, report: Reporter) -> None:
    if mesh.GetCreaseIndicesAttr().Get(time) or mesh.GetCornerIndicesAttr().Get(time):
        report(mesh.GetPrim(), "creases", "creases and sharp corners are not supported; the surface is smooth there.")


def _affordable_level(n_corners: int, level: int, prim: Usd.Prim, report: Reporter) -> int:
    affordable = level
    while affordable > 0 and n_corners * 2 * 4 ** (affordable - 1) > MOST_TRIANGLES:
        affordable -= 1
    if affordable < level:
        report(
            prim,
            "subdivision level",
            f"level {level} would give more than {MOST_TRIANGLES} triangles; level {affordable} is used.",
        )
    return affordable


def _only(cage: Cage, kept: NDArray[np.bool_]) -> Cage:
    if kept.all():
        return cage
    corners = np.repeat(kept, cage.counts)
    return Cage(
        cage.vertices, cage.counts[kept], cage.indices[corners], cage.corners[corners], cage.face[kept]
    )


def _smooth_normals(cage: Cage) -> F64:
    """Area-weighted mean of the faces' normals at each vertex; not unit."""
    turns = corner_normals(cage.vertices[cage.indices, :3], cage.counts)
    n = len(cage.vertices)
    return np.stack([np.bincount(cage.indices, turns[:, k], n) for k in range(3)], axis=1)


def _origin(points: F64) -> F64:
    lower, upper = points.min(axis=0), points.max(axis=0)
    centre, radius = 0.5 * (lower + upper), 0.5 * float(np.linalg.norm(upper - lower))
    return centre if float(np.linalg.norm(centre)) > FAR_FROM_ORIGIN * radius else np.zeros(3)
