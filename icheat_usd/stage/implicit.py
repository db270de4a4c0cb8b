"""Sphere, Cube, Cylinder, Cone, Capsule and Plane as triangles with their true normals.

Each is a grid of control faces: a cube has six, a plane one, the round shapes
`AROUND` per ring. Shapes are inscribed: their vertices lie on the surface.
"""

from __future__ import annotations

import numpy as np
from pxr import Usd, UsdGeom

from icheat_usd.scene import F64, I64
from icheat_usd.stage.meshes import DEFAULT_COLOR, FaceMaterials, TriangleMesh, measure, topology_digest, unit_normals
from icheat_usd.stage.polygons import face_parametrisation, triangulate
from icheat_usd.stage.primvars import find_primvar
from icheat_usd.stage.reporting import Reporter

AROUND = 48  #: faces around the axis
ALONG_SPHERE = 24  #: rings from pole to pole
ALONG_CAP = 12  #: rings of a capsule's hemisphere

_ATTRIBUTES = {
    "Sphere": ("radius",),
    "Cube": ("size",),
    "Cylinder": ("radius", "height", "axis"),
    "Cylinder_1": ("radiusTop", "radiusBottom", "height", "axis"),
    "Cone": ("radius", "height", "axis"),
    "Capsule": ("radius", "height", "axis"),
    "Capsule_1": ("radiusTop", "radiusBottom", "height", "axis"),
    "Plane": ("width", "length", "axis"),
}
#: Types this module turns into triangles.
TYPES = tuple(_ATTRIBUTES)

#: points, counts, indices, normals per corner, st per corner
Shape = tuple[F64, I64, I64, F64, F64]

_AXES = {"X": [2, 0, 1], "Y": [1, 2, 0], "Z": [0, 1, 2]}


def parameters(prim: Usd.Prim, time: Usd.TimeCode) -> tuple[object, ...]:
    """Everything that shapes an implicit prim at a time: equal parameters, equal triangles."""
    kind = str(prim.GetTypeName())
    values: list[object] = [kind]
    for name in ("size", "radius", "height", "radiusTop", "radiusBottom", "width", "length", "axis"):
        value = prim.GetAttribute(name).Get(time) if name in _ATTRIBUTES[kind] else None
        if name == "axis" or value is None:
            values.append(None if value is None else str(value))
        else:
            values.append(float(value) if isinstance(value, int | float) else float("nan"))
    gprim = UsdGeom.Gprim(prim)
    values.append(bool(gprim.GetDoubleSidedAttr().Get(time)))
    values.append(str(gprim.GetOrientationAttr().Get(time)))
    return tuple(values)


def display_color(prim: Usd.Prim, time: Usd.TimeCode, report: Reporter) -> tuple[float, float, float]:
    """The one displayColor of an implicit prim."""
    grey = (DEFAULT_COLOR, DEFAULT_COLOR, DEFAULT_COLOR)
    primvar = find_primvar(prim, "displayColor")
    value = None if primvar is None else primvar.ComputeFlattened(time)
    if value is None or not len(value):
        return grey
    try:
        colors = np.array(value, dtype=np.float64).reshape(-1, 3)
    except (TypeError, ValueError):
        colors = np.full((1, 3), np.nan)
    if not np.isfinite(colors).all():
        report(prim, "primvar displayColor", "displayColor is not finite or no colour; ignored.")
        return grey
    if len(colors) > 1:
        kind = prim.GetTypeName()
        report(prim, "primvar displayColor", f"a {kind} takes one displayColor; the first of {len(colors)} is used.")
    return (float(colors[0, 0]), float(colors[0, 1]), float(colors[0, 2]))


def read_implicit(
    shape_parameters: tuple[object, ...],
    color: tuple[float, float, float],
    materials: FaceMaterials,
    prim: Usd.Prim,
    report: Reporter,
) -> TriangleMesh | None:
    """Triangles of an implicit shape, or None with a finding where its parameters make none."""
    kind, size, radius, height, top, bottom, width, length, axis, double_sided, orientation = shape_parameters
    numbers = np.array([_number(value) for value in (size, radius, height, top, bottom, width, length)])
    if not np.isfinite(numbers).all() or numbers.min() < 0.0:
        report(prim, "implicit shape", f"a size of this {kind} is negative or not finite; left out.")
        return None
    order = _AXES.get(str(axis), _AXES["Z"])
    shape: Shape
    if kind == "Cube":
        shape = _cube(_number(size))
    elif kind == "Plane":
        shape = _plane(_number(width), _number(length), str(axis))
        order = _AXES["Z"]
    else:
        shape = _round(str(kind), _number(radius), _number(height), top, bottom)
        if kind == "Sphere":
            order = _AXES["Z"]
    points, counts, indices, normals, st = shape
    points, normals = np.ascontiguousarray(points[:, order]), normals[:, order]

    corners, face = triangulate(points, counts, indices)
    if orientation == "leftHanded":
        corners, normals = np.ascontiguousarray(corners[:, [0, 2, 1]]), -normals
    vertex = indices[corners]
    flat, good = measure(points, vertex)
    if not good.any():
        report(prim, "implicit shape", f"this {kind} has no area; left out.")
        return None
    corners, face, vertex, flat = corners[good], face[good], vertex[good], flat[good]
    return TriangleMesh(
        points=points[vertex].astype(np.float32),
        normals=unit_normals(normals, corners, flat),
        st=st[corners].astype(np.float32),
        color=np.broadcast_to(np.array(color, np.float32), (len(face), 3, 3)).copy(),
        face=face.astype(np.int32),
        face_uv=face_parametrisation(counts)[corners].astype(np.float32),
        material=np.full(len(face), materials.row, np.int32),
        double_sided=bool(double_sided),
        n_faces=len(counts),
        topology_digest=topology_digest(counts, indices),
    )


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else 0.0


def _cube(size: float) -> Shape:
    h = 0.5 * size
    points = np.array([(x, y, z) for z in (-h, h) for y in (-h, h) for x in (-h, h)])
    # -X, +X, -Y, +Y, -Z, +Z, each counter-clockwise from outside.
    faces = [(4, 6, 2, 0), (1, 3, 7, 5), (0, 1, 5, 4), (6, 7, 3, 2), (2, 3, 1, 0), (4, 5, 7, 6)]
    indices = np.array(faces, np.int64).reshape(-1)
    normals = np.zeros((6, 4, 3))
    for face in range(6):
        normals[face, :, face // 2] = 1.0 if face % 2 else -1.0
    st = np.tile(np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]), (6, 1))
    return points, np.full(6, 4, np.int64), indices, normals.reshape(-1, 3), st


def _plane(width: float, length: float, axis: str) -> Shape:
    w, h = 0.5 * width, 0.5 * length
    # UsdGeomPlane: width runs along x (z if axis is X), length along y (z if axis is Y); the front looks along +axis.
    along_width = {"X": 2}.get(axis, 0)
    along_length = {"Y": 2}.get(axis, 1)
    up = {"X": 0, "Y": 1}.get(axis, 2)
    points = np.zeros((4, 3))
    points[:, along_width] = (-w, w, w, -w)
    points[:, along_length] = (-h, -h, h, h)
    normals = np.zeros((4, 3))
    normals[:, up] = 1.0
    st = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    if np.dot(np.cross(points[1] - points[0], points[2] - points[1]), normals[0]) < 0.0:
        points, st = points[[0, 3, 2, 1]], st[[0, 3, 2, 1]]
    return points, np.array([4]), np.arange(4), normals, st


def _round(kind: str, radius: float, height: float, top: object, bottom: object) -> Shape:
    """Solids of revolution about Z, from the profile of (radius, z, normal) at the bottom to the one at the top."""
    half = 0.5 * height
    parts: list[list[tuple[float, float, float, float]]]  # r, z, normal r, normal z
    if kind == "Sphere":
        angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, ALONG_SPHERE + 1)
        parts = [[(radius * np.cos(a), radius * np.sin(a), np.cos(a), np.sin(a)) for a in angle]]
    elif kind in ("Capsule", "Capsule_1"):
        below = _number(bottom) if bottom is not None else radius
        above = _number(top) if top is not None else radius
        # Caps are half spheres on the ends of the cylinder or cone between them.
        quarter = np.linspace(0.0, 0.5 * np.pi, ALONG_CAP + 1)
        profile = [(below * np.sin(a), -half - below * np.cos(a), np.sin(a), -np.cos(a)) for a in quarter]
        profile += [(above * np.cos(a), half + above * np.sin(a), np.cos(a), np.sin(a)) for a in quarter]
        parts = [profile]
    else:
        if kind == "Cone":
            below, above = radius, 0.0
        else:
            below = _number(bottom) if bottom is not None else radius
            above = _number(top) if top is not None else radius
        slope = np.array([height, below - above])
        length = float(np.linalg.norm(slope))
        nr, nz = slope / length if length > 0.0 else (1.0, 0.0)
        parts = [[(below, -half, nr, nz), (above, half, nr, nz)], [(0.0, -half, 0.0, -1.0), (below, -half, 0.0, -1.0)]]
        if above > 0.0:
            parts.append([(above, half, 0.0, 1.0), (0.0, half, 0.0, 1.0)])
    return _revolve(parts)


def _revolve(parts: list[list[tuple[float, float, float, float]]]) -> Shape:
    turn = 2.0 * np.pi * np.arange(AROUND) / AROUND
    cos, sin = np.cos(turn), np.sin(turn)
    points, indices, normals, st = [], [], [], []
    base = 0
    around = np.arange(AROUND)
    following = (around + 1) % AROUND
    for part in parts:
        profile = np.array(part)
        rings = len(profile)
        ring_points = np.stack(
            [profile[:, :1] * cos, profile[:, :1] * sin, np.broadcast_to(profile[:, 1:2], (rings, AROUND))], axis=2
        )
        ring_normals = np.stack(
            [profile[:, 2:3] * cos, profile[:, 2:3] * sin, np.broadcast_to(profile[:, 3:4], (rings, AROUND))], axis=2
        )
        points.append(ring_points.reshape(-1, 3))
        lower, upper = np.arange(rings - 1)[:, None] * AROUND, np.arange(1, rings)[:, None] * AROUND
        quads = np.stack([lower + around, lower + following, upper + following, upper + around], axis=2).reshape(-1)
        indices.append(base + quads)
        normals.append(ring_normals.reshape(-1, 3)[quads])
        u0 = np.broadcast_to(around / AROUND, (rings - 1, AROUND))
        u1 = u0 + 1.0 / AROUND
        v = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(profile[:, 0]), np.diff(profile[:, 1])))])
        v = v / v[-1] if v[-1] > 0.0 else v
        v0 = np.broadcast_to(v[:-1, None], (rings - 1, AROUND))
        v1 = np.broadcast_to(v[1:, None], (rings - 1, AROUND))
        st.append(np.stack([u0, v0, u1, v0, u1, v1, u0, v1], axis=2).reshape(-1, 2))
        base += rings * AROUND
    all_indices = np.concatenate(indices)
    return (
        np.concatenate(points),
        np.full(len(all_indices) // 4, 4, np.int64),
        all_indices,
        np.concatenate(normals),
        np.concatenate(st),
    )
