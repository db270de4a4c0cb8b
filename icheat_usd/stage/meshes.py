"""Polygon meshes and subdivision surfaces as triangles."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom

from icheat_usd.kernels import meshing
from icheat_usd.scene import F32, F64, I32, I64
from icheat_usd.stage.creases import faces_without_a_surface, read_creases
from icheat_usd.stage.polygons import THINNEST, face_parametrisation, triangulate
from icheat_usd.stage.primvars import MeshValues, Topology, expand, find_primvar, read_primvar
from icheat_usd.stage.reporting import Reporter
from icheat_usd.stage.skinning import Deformation
from icheat_usd.stage.subdivision import NO_CREASES, Cage, Creases, refine, smooth_normals

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
    mesh: UsdGeom.Mesh,
    time: Usd.TimeCode,
    materials: FaceMaterials,
    level: int | None,
    report: Reporter,
    known: dict[bytes, TriangleMesh | None] | None = None,
    deformation: Deformation | None = None,
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
        Subdivision steps for ``catmullClark`` and ``bilinear`` meshes; None takes them as polygons.
    report
        Receives what is wrong or not supported.
    known
        Meshes built so far by the digest of their data: equal prims are refined once.
    deformation
        What moves the control points from rest to where they are.
    """
    control = _read_control_mesh(mesh, time, materials, level, report, deformation)
    if control is None:
        return None
    key = control.digest()
    known = {} if known is None else known
    if key not in known:
        known[key] = _build(control)
    built = known[key]
    if built is None:
        report(mesh.GetPrim(), "mesh", "it has no face with an area; left out.")
        return None
    # The same triangles with other materials are shared too, where two prims ask for the same ones.
    with_rows = key + control.rows.tobytes()
    if with_rows not in known:
        rows = control.rows[built.face]
        known[with_rows] = built if np.array_equal(rows, built.material) else replace(built, material=rows)
    return known[with_rows]


@dataclass(frozen=True)
class _ControlMesh:
    """All that decides the triangles of a mesh."""

    points: F64
    counts: I64
    indices: I64
    scheme: str
    level: int
    sharp_corners: bool
    creases: Creases
    left_handed: bool
    double_sided: bool
    shown: NDArray[np.bool_]  #: (n_faces,) False for holes
    columns: dict[str, MeshValues]  #: "displayColor", "normals", and texture coordinates as "st 0", "st 1", ...
    st_column: I32  #: (n_faces,) which of the texture coordinates a face takes
    rows: I32  #: (n_faces,) material rows, which do not shape the triangles

    @property
    def n_faces(self) -> int:
        return len(self.counts)

    def digest(self) -> bytes:
        digest = hashlib.blake2b(digest_size=32)
        flags = (self.scheme, self.level, self.sharp_corners, self.left_handed, self.double_sided)
        digest.update(
            repr((flags, [(name, c.on_vertices, c.values.shape) for name, c in self.columns.items()])).encode()
        )
        arrays = [self.points, self.counts, self.indices, self.shown, self.st_column, *self.creases]
        for array in (*arrays, *(column.values for column in self.columns.values())):
            # What was broadcast from one value is hashed as one.
            data = array[:1] if array.ndim == 2 and array.strides[0] == 0 else array
            digest.update(repr(array.shape).encode())
            digest.update(np.ascontiguousarray(data).data)
        return digest.digest()


def _build(control: _ControlMesh) -> TriangleMesh | None:
    # Columns ride along: on vertices behind the position, on corners behind the place in the face.
    vertex_columns, corner_columns = [control.points], [face_parametrisation(control.counts)]
    places: dict[str, tuple[bool, int, int]] = {}
    for name, column in control.columns.items():
        target = vertex_columns if column.on_vertices else corner_columns
        begin = sum(part.shape[1] for part in target)
        places[name] = (column.on_vertices, begin, begin + column.values.shape[1])
        target.append(column.values)
    cage = Cage(
        np.concatenate(vertex_columns, axis=1),
        control.counts,
        control.indices,
        np.concatenate(corner_columns, axis=1),
        np.arange(control.n_faces),
        control.creases,
    )
    cage = _only(cage, control.counts >= 3)
    if not len(cage.counts):
        return None
    if control.scheme != "none":
        cage = refine(cage, control.level, control.scheme, sharp_corners=control.sharp_corners)
    shown = control.shown[cage.face]
    smooth: tuple[F64, I64] | None = None  # normals, and the row of each corner
    if control.scheme in ("catmullClark", "loop"):
        normals_found, row_of_corner = smooth_normals(cage)
        smooth = normals_found, row_of_corner[np.repeat(shown, cage.counts)]
    cage = _only(cage, shown)
    if not len(cage.counts):
        return None

    # Triangles -----------------------------------------------------------
    origin = _origin(cage.vertices[:, :3])
    positions = np.ascontiguousarray(cage.vertices[:, :3] - origin)
    corners, triangle_face = triangulate(positions, cage.counts, cage.indices)
    if control.left_handed:
        corners = np.ascontiguousarray(corners[:, [0, 2, 1]])
        smooth = None if smooth is None else (-smooth[0], smooth[1])
    vertex = cage.indices[corners]
    flat, good = measure(positions, vertex)
    if not good.any():
        return None
    if not good.all():
        corners, triangle_face, vertex, flat = corners[good], triangle_face[good], vertex[good], flat[good]
    control_face = cage.face[triangle_face]

    def gather(name: str, width: int) -> F32 | None:
        if name not in places:
            return None
        on_vertices, begin, _ = places[name]
        return take(cage.vertices, vertex, begin, width) if on_vertices else take(cage.corners, corners, begin, width)

    st = np.zeros((len(vertex), 3, 2), np.float32)
    for which in np.unique(control.st_column):
        values = gather(f"st {which}", 2)
        if values is not None:
            chosen = control.st_column[control_face] == which
            st[chosen] = values[chosen]
    color = gather("displayColor", 3)
    if smooth is not None:
        normals = unit_normals(smooth[0], smooth[1][corners], flat)
    elif "normals" in places:
        on_vertices, begin, end = places["normals"]
        source = (cage.vertices if on_vertices else cage.corners)[:, begin:end]
        normals = unit_normals(source, vertex if on_vertices else corners, flat)
    else:
        normals = np.repeat(flat.astype(np.float32)[:, None], 3, axis=1)
    face_uv = take(cage.corners, corners, 0, 2)
    return TriangleMesh(
        points=take(positions, vertex, 0, 3),
        normals=normals,
        st=st,
        color=np.full((len(vertex), 3, 3), DEFAULT_COLOR, np.float32) if color is None else color,
        face=control_face.astype(np.int32),
        face_uv=np.clip(face_uv, 0.0, 1.0, out=face_uv),
        material=control.rows[control_face],
        double_sided=control.double_sided,
        n_faces=control.n_faces,
        topology_digest=topology_digest(control.counts, control.indices),
        origin=origin,
    )


def take(values: F64, rows: I64, begin: int, width: int) -> F32:
    """Columns `begin` to `begin` + `width` of `values` at the corners of triangles, ``(n, 3, width)``."""
    taken = np.empty((*rows.shape, width), np.float32)
    meshing.take(values, begin, rows, taken)
    return taken


def measure(positions: F64, vertex: I64) -> tuple[F64, NDArray[np.bool_]]:
    """Unit normals ``(n, 3)`` of triangles, and which of them have an area to speak of."""
    flat, good = np.empty((len(vertex), 3)), np.empty(len(vertex), np.uint8)
    meshing.measure_triangles(positions, vertex, THINNEST, flat, good)
    return flat, good.view(np.bool_)


def unit_normals(values: F64, rows: I64, flat: F64) -> F32:
    """Unit normals at the corners of triangles, ``(n, 3, 3)``; `flat`, the triangle's own, where one has no length."""
    normals = np.empty((*rows.shape, 3), np.float32)
    meshing.unit_normals(np.ascontiguousarray(values), rows, flat, normals)
    return normals


def _read_control_mesh(
    mesh: UsdGeom.Mesh,
    time: Usd.TimeCode,
    materials: FaceMaterials,
    level: int | None,
    report: Reporter,
    deformation: Deformation | None,
) -> _ControlMesh | None:
    prim = mesh.GetPrim()
    topology = _read_topology(mesh, time, report)
    if topology is None:
        return None
    points, counts, indices = topology
    if deformation is not None:
        moved = deformation.points(points)
        points, deformation = (points, None) if moved is None else (moved, deformation)
    scheme = str(mesh.GetSubdivisionSchemeAttr().Get(time) or "catmullClark")
    if scheme == "loop" and (counts > 3).any():
        report(prim, "subdivisionScheme loop", "a face is no triangle; the mesh is refined by catmullClark.")
        scheme = "catmullClark"
    elif scheme not in ("none", "catmullClark", "bilinear", "loop"):
        report(prim, "subdivisionScheme", f"'{scheme}' is no subdivision scheme; the mesh is taken as polygons.")
        scheme = "none"
    if level is None:
        scheme = "none"
    boundary = str(mesh.GetInterpolateBoundaryAttr().Get(time))
    creases, shown = NO_CREASES, _shown_faces(mesh, time, len(counts), report)
    if scheme in ("catmullClark", "loop"):
        creases = read_creases(mesh, time, counts, indices, report)
        if boundary == "none":
            shown &= ~faces_without_a_surface(counts, indices, creases)

    sizes = Topology(len(points), counts, indices)
    rows = materials.rows(len(counts))
    names = sorted({materials.st_name(int(row)) for row in np.unique(rows)})
    wanted = [(f"st {which}", _read_values(prim, name, 2, time, sizes, report)) for which, name in enumerate(names)]
    wanted.append(("displayColor", _read_values(prim, "displayColor", 3, time, sizes, report)))
    if scheme == "none":
        wanted.append(("normals", _read_normals(mesh, time, sizes, report, deformation)))
    st_column = np.zeros(len(counts), np.int32)
    for row in np.unique(rows):
        st_column[rows == row] = names.index(materials.st_name(int(row)))
    return _ControlMesh(
        points=points,
        counts=counts,
        indices=indices,
        scheme=scheme,
        level=0 if level is None or scheme == "none" else _affordable_level(len(indices), level, prim, report),
        sharp_corners=boundary != "edgeOnly",
        creases=creases,
        left_handed=str(mesh.GetOrientationAttr().Get(time)) == "leftHanded",
        double_sided=bool(mesh.GetDoubleSidedAttr().Get(time)),
        shown=shown,
        columns={name: column for name, column in wanted if column is not None},
        st_column=st_column,
        rows=rows,
    )


def _read_topology(mesh: UsdGeom.Mesh, time: Usd.TimeCode, report: Reporter) -> tuple[F64, I64, I64] | None:
    prim = mesh.GetPrim()
    try:
        points = np.array(mesh.GetPointsAttr().Get(time) or (), dtype=np.float64).reshape(-1, 3)
        counts = np.array(mesh.GetFaceVertexCountsAttr().Get(time) or (), dtype=np.int64).reshape(-1)
        indices = np.array(mesh.GetFaceVertexIndicesAttr().Get(time) or (), dtype=np.int64).reshape(-1)
    except (TypeError, ValueError):
        report(
            prim,
            "mesh",
            "points, faceVertexCounts or faceVertexIndices have another type than UsdGeomMesh's; left out.",
        )
        return None
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
    finite = np.isfinite(points)
    if not finite.all():
        if not finite[indices].all():
            report(prim, "mesh", "a point is not finite (NaN or infinity); left out.")
            return None
        points = np.where(finite, points, 0.0)
    return points, counts, indices


def _read_values(
    prim: Usd.Prim, name: str, width: int, time: Usd.TimeCode, topology: Topology, report: Reporter
) -> MeshValues | None:
    primvar = find_primvar(prim, name)
    return None if primvar is None else read_primvar(primvar, time, topology, width, report, prim)


def _read_normals(
    mesh: UsdGeom.Mesh, time: Usd.TimeCode, topology: Topology, report: Reporter, deformation: Deformation | None
) -> MeshValues | None:
    prim = mesh.GetPrim()
    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar("normals")
    attribute = mesh.GetNormalsAttr()
    if primvar and primvar.HasAuthoredValue():
        found = read_primvar(primvar, time, topology, 3, report, prim)
    elif attribute.HasAuthoredValue():
        interpolation = str(mesh.GetNormalsInterpolation())
        found = expand(attribute.Get(time), None, interpolation, topology, 3, "normals", report, prim)
    else:
        return None
    if found is None or deformation is None:
        return found
    vertex = np.arange(topology.n_points) if found.on_vertices else topology.indices
    return replace(found, values=deformation.normals(found.values, vertex, topology.n_points))


def _shown_faces(mesh: UsdGeom.Mesh, time: Usd.TimeCode, n_faces: int, report: Reporter) -> NDArray[np.bool_]:
    shown = np.ones(n_faces, np.bool_)
    holes = np.array(mesh.GetHoleIndicesAttr().Get(time) or (), dtype=np.int64)
    if holes.size:
        inside = (holes >= 0) & (holes < n_faces)
        if not inside.all():
            report(mesh.GetPrim(), "holeIndices", "some name no face of the mesh; those are ignored.")
        shown[holes[inside]] = False
    return shown


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
    return cage._replace(
        counts=cage.counts[kept], indices=cage.indices[corners], corners=cage.corners[corners], face=cage.face[kept]
    )


def _origin(points: F64) -> F64:
    lower, upper = points.min(axis=0), points.max(axis=0)
    centre, radius = 0.5 * (lower + upper), 0.5 * float(np.linalg.norm(upper - lower))
    return centre if float(np.linalg.norm(centre)) > FAR_FROM_ORIGIN * radius else np.zeros(3)
