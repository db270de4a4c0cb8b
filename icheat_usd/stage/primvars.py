"""Values on a mesh, of any interpolation, indexed or not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pxr import Usd, UsdGeom

from icheat_usd.scene import F64, I64
from icheat_usd.stage.reporting import Reporter


@dataclass(frozen=True)
class Topology:
    """Sizes that a primvar's values are checked against."""

    n_points: int
    counts: I64  #: (n_faces,)
    indices: I64  #: (n_corners,)


@dataclass(frozen=True)
class MeshValues:
    """A primvar made ready for a mesh: on its vertices, or on its corners."""

    values: F64  #: (n_points, k) or (n_corners, k)
    on_vertices: bool  #: interpolation ``vertex``: smoothed along with the points


def find_primvar(prim: Usd.Prim, name: str) -> UsdGeom.Primvar | None:
    """The primvar that is in force on a prim, its own or inherited; None where there is none with a value."""
    primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
    return primvar if primvar and primvar.HasAuthoredValue() else None


def read_primvar(
    primvar: UsdGeom.Primvar, time: Usd.TimeCode, topology: Topology, width: int, report: Reporter, prim: Usd.Prim
) -> MeshValues | None:
    """Values of a primvar of `width` numbers per element; None, with a finding, where they do not fit the mesh."""
    return expand(
        primvar.Get(time),
        primvar.GetIndices(time) if primvar.IsIndexed() else None,
        str(primvar.GetInterpolation()),
        topology,
        width,
        str(primvar.GetPrimvarName()),
        report,
        prim,
    )


def expand(
    value: object,
    indices: object,
    interpolation: str,
    topology: Topology,
    width: int,
    name: str,
    report: Reporter,
    prim: Usd.Prim,
) -> MeshValues | None:
    """Flatten an indexed value of any interpolation; see `read_primvar`."""
    feature = f"primvar {name}"
    if value is None:
        return None
    try:
        values = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        report(prim, feature, f"{name} holds no numbers; ignored.")
        return None
    if values.ndim == 1 and values.size == width:
        values = values.reshape(1, width)
    if values.ndim != 2 or values.shape[1] < width or not np.isfinite(values[:, :width]).all():
        report(prim, feature, f"{name} needs {width} finite numbers per element and has shape {values.shape}; ignored.")
        return None
    values = values[:, :width]
    if indices is not None:
        rows = np.array(indices, dtype=np.int64)
        if rows.size and (rows.min() < 0 or rows.max() >= len(values)):
            report(prim, feature, f"indices of {name} reach outside its {len(values)} values; ignored.")
            return None
        values = values[rows]

    n_corners, n_faces = len(topology.indices), len(topology.counts)
    expected = {
        "constant": 1,
        "uniform": n_faces,
        "varying": topology.n_points,
        "vertex": topology.n_points,
        "faceVarying": n_corners,
    }.get(interpolation)
    if expected is None or len(values) != expected:
        report(
            prim,
            feature,
            f"{name} ({interpolation}) has {len(values)} values where the mesh needs {expected}; ignored.",
        )
        return None
    if interpolation == "constant":
        return MeshValues(np.broadcast_to(values, (n_corners, width)), False)
    if interpolation == "uniform":
        return MeshValues(np.repeat(values, topology.counts, axis=0), False)
    if interpolation == "varying":
        return MeshValues(values[topology.indices], False)
    return MeshValues(values, interpolation == "vertex")
