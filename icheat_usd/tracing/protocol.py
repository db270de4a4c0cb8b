"""What a tracer can do, and how rays leave surfaces."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike

from icheat_usd.errors import IcheatError
from icheat_usd.scene import F32, Bool, Hits, SceneSnapshot, SurfacePoints

if TYPE_CHECKING:
    from icheat_usd.kernels.embree import TraceTable


class Tracer(Protocol):
    """Pure geometry: any triangle of any instance of the snapshot it was built for, both sides."""

    engine: ClassVar[str]  #: what `build_tracer` knows it by

    def intersect(self, origins: F32, directions: F32, t_max: F32 | float | None = None) -> Hits:
        """Nearest hits with ``0 <= t <= t_max``.

        Parameters
        ----------
        origins : (n, 3) float32, metres
        directions : (n, 3) float32
            Any length; distances are in units of it. A ray that is not finite, has no direction or no
            length (`t_max` <= 0) hits nothing.
        t_max : (n,) float32, one number, or None for no limit
        """
        ...

    def occluded(self, origins: F32, directions: F32, t_max: F32 | float | None = None) -> Bool:
        """(n,) whether `intersect` would hit anything."""
        ...

    def compiled(self) -> TraceTable | None:
        """What compiled loops need to trace rays by themselves, while this tracer is open; None if they cannot."""
        ...

    def compiled_shadows(self) -> TraceTable | None:
        """The same for rays that ask whether anything is hit."""
        ...

    def close(self) -> None:
        """Release what the tracer holds; do not trace afterwards."""
        ...


def build_tracer(snapshot: SceneSnapshot, engine: str = "embree", hidden: Bool | None = None) -> Tracer:
    """Tracer for a snapshot.

    Parameters
    ----------
    engine : "embree" or "reference"
        The reference compares every ray with every triangle: for tests and small scenes.
    hidden : (n_instances,) bool, optional
        Instances that no ray sees; all others keep their numbers.

    Raises
    ------
    IcheatError
        The engine is unknown or cannot start.
    """
    if engine == "embree":
        from icheat_usd.tracing.embree import EmbreeTracer

        return EmbreeTracer(snapshot, hidden=hidden)
    if engine == "reference":
        from icheat_usd.tracing.reference import ReferenceTracer

        return ReferenceTracer(snapshot, hidden=hidden)
    raise IcheatError(f"Unknown tracing engine {engine!r}; expected 'embree' or 'reference'.")


def spawn_origins(positions: ArrayLike, normals: ArrayLike, directions: ArrayLike, magnitude: ArrayLike = 0.0) -> F32:
    """Origins of rays that leave surfaces, moved off them so that they do not hit where they start.

    Parameters
    ----------
    positions, normals, directions : (n, 3) float32
        Geometric normals; the origin moves to the side that its direction points to.
    magnitude : (n,) float32 or one number, metres
        Largest coordinate that the surface's precision depends on, where that is more than the position's own:
        a large triangle through the origin of the world. `spawn_points` knows it; else the scene's radius is safe.

    Returns
    -------
    (n, 3) float32
        Offsets are 2^-18 of the larger of magnitude and position: nothing in metres, so a scaled scene
        gives the same image.
    """
    from icheat_usd.kernels import tracing

    rows = np.require(positions, np.float32, ["C", "W"])
    out = np.empty_like(rows)
    tracing.offset_origins(
        rows,
        np.require(normals, np.float32, ["C", "W"]),
        np.require(directions, np.float32, ["C", "W"]),
        np.require(np.atleast_1d(np.asarray(magnitude)), np.float32, ["C", "W"]),
        out,
    )
    return out


def spawn_points(snapshot: SceneSnapshot, points: SurfacePoints, directions: ArrayLike) -> F32:
    """`spawn_origins` for surface points, with the precision of each point's own triangle."""
    from icheat_usd.kernels import tracing

    magnitude = np.empty(len(points.instance), np.float32)
    tracing.point_magnitudes(snapshot.geometry, points.instance, points.triangle, magnitude)
    return spawn_origins(points.position, points.normal, directions, magnitude)
