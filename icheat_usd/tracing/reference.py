"""The slow, readable tracer: every ray against every triangle, in double precision. For tests and small scenes."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from icheat_usd.scene import F32, F64, Bool, Hits, SceneSnapshot
from icheat_usd.tracing._rays import checked_rays

_PAIRS_AT_ONCE = 1 << 20


class ReferenceTracer:
    """Moeller & Trumbore 1997 over all pairs of rays and triangles, without any acceleration structure.

    Where two triangles are equally far, the first in (instance, triangle) order
    wins. Edges count as inside, so that closed meshes have no cracks between
    two triangles that share exact corners.
    """

    engine: ClassVar[str] = "reference"

    def __init__(self, snapshot: SceneSnapshot, *, hidden: Bool | None = None) -> None:
        geometry = snapshot.geometry
        begin = geometry.mesh_begin
        corners: list[F64] = [np.zeros((0, 3, 3))]
        owners, rows = [np.zeros(0, np.int32)], [np.zeros(0, np.int32)]
        for instance, mesh in enumerate(geometry.instance_mesh):
            if hidden is not None and hidden[instance]:
                continue
            span = np.arange(begin[mesh], begin[mesh + 1], dtype=np.int32)
            matrix = geometry.instance_to_world[instance].astype(np.float64)
            # Corners are rounded to float32 as the fast tracer's are: then both see the same surface.
            world = (geometry.points[span].astype(np.float64) @ matrix[:, :3].T + matrix[:, 3]).astype(np.float32)
            corners.append(world.astype(np.float64))
            owners.append(np.full(len(span), instance, np.int32))
            rows.append(span)
        everything = np.concatenate(corners)
        self._corner = everything[:, 0]
        self._edge_1 = everything[:, 1] - everything[:, 0]
        self._edge_2 = everything[:, 2] - everything[:, 0]
        self._instance = np.concatenate(owners)
        self._triangle = np.concatenate(rows)

    def close(self) -> None:
        """Nothing to release; here because the fast tracer has it."""

    def compiled(self) -> None:
        """See `Tracer.compiled`."""

    def compiled_shadows(self) -> None:
        """See `Tracer.compiled_shadows`."""

    def intersect(self, origins: F32, directions: F32, t_max: F32 | float | None = None) -> Hits:
        """See `Tracer.intersect`."""
        origins, directions, t_max = checked_rays(origins, directions, t_max)
        n = len(origins)
        limits = np.broadcast_to(t_max, n)
        hits = Hits(
            np.full(n, np.inf, np.float32),
            np.full(n, -1, np.int32),
            np.full(n, -1, np.int32),
            np.zeros(n, np.float32),
            np.zeros(n, np.float32),
        )
        step = max(1, _PAIRS_AT_ONCE // max(1, len(self._corner)))
        for first in range(0, n if len(self._corner) else 0, step):
            part = slice(first, first + step)
            t, u, v = self._all_pairs(origins[part], directions[part], limits[part])
            nearest = t.argmin(axis=1)
            ray = np.arange(len(nearest))
            found = np.isfinite(t[ray, nearest])
            ray, nearest = ray[found], nearest[found]
            hits.distance[first + ray] = t[ray, nearest]
            hits.instance[first + ray] = self._instance[nearest]
            hits.triangle[first + ray] = self._triangle[nearest]
            hits.u[first + ray] = u[ray, nearest]
            hits.v[first + ray] = v[ray, nearest]
        return hits

    def occluded(self, origins: F32, directions: F32, t_max: F32 | float | None = None) -> Bool:
        """See `Tracer.occluded`."""
        return self.intersect(origins, directions, t_max).instance >= 0

    def _all_pairs(self, origins: F32, directions: F32, limits: F32) -> tuple[F64, F64, F64]:
        o = origins.astype(np.float64)[:, None]
        d = directions.astype(np.float64)[:, None]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            p = np.cross(d, self._edge_2)
            determinant = (p * self._edge_1).sum(-1)
            from_corner = o - self._corner
            u = (p * from_corner).sum(-1) / determinant
            q = np.cross(from_corner, self._edge_1)
            v = (q * d).sum(-1) / determinant
            t = (q * self._edge_2).sum(-1) / determinant
            inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= limits[:, None])
            inside &= (limits > 0)[:, None] & np.isfinite(t) & (determinant != 0)
        return np.where(inside, t, np.inf), u, v
