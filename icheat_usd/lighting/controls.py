"""What lights do to some surfaces only, and in some directions only: the controls of a snapshot at work.

Nothing here costs anything, or changes a bit, where a light has no controls.
"""

from __future__ import annotations

import threading
from weakref import WeakKeyDictionary

import numpy as np

from icheat_usd.kernels.shaping import shape_rays
from icheat_usd.scene import F32, F64, I32, Bool, LightKind, SceneSnapshot
from icheat_usd.tracing import Tracer, build_tracer

#: Tracers without what does not block some lights, of each tracer that has everything; by the bits of what is hidden.
_WITHOUT: WeakKeyDictionary[Tracer, dict[bytes, Tracer]] = WeakKeyDictionary()
_lock = threading.Lock()


def receives(snapshot: SceneSnapshot, light: int, instance: I32) -> Bool | None:
    """Whether a light shines on points of these instances (n,), -1 for no surface; None: on everything."""
    receivers = snapshot.controls(light).receivers
    if receivers is None:
        return None
    return np.asarray((instance >= 0) & (receivers[np.maximum(instance, 0)] != 0))


def lit_instances(snapshot: SceneSnapshot, light: int, instance: I32) -> I32:
    """`instance` (n,), and -1 for points that a light does not shine on: samplers pass those over."""
    lit = receives(snapshot, light, instance)
    return instance if lit is None else np.where(lit, instance, np.int32(-1))


def darken(snapshot: SceneSnapshot, light: int, instance: I32, values: F32) -> None:
    """Set rows of `values` (n, ...) to 0 where a light does not shine on a point's instance (n,)."""
    lit = receives(snapshot, light, instance)
    if lit is not None:
        values[~lit] = 0.0


def hidden_instances(snapshot: SceneSnapshot, light: int) -> Bool | None:
    """(n_instances,) which instances do not block a light; None: everything blocks it.

    A glowing mesh always blocks its own light: a ray to one of its points cannot pass another one.
    """
    blockers = snapshot.controls(light).blockers
    if blockers is None:
        return None
    hidden = np.asarray(blockers == 0)
    lights = snapshot.lights
    if lights.kind[light] == LightKind.MESH:
        hidden = hidden.copy()
        hidden[lights.triangle_instance[lights.triangle_begin[light] : lights.triangle_begin[light + 1]]] = False
    return hidden if hidden.any() else None


def tracer_for(snapshot: SceneSnapshot, tracer: Tracer, light: int) -> Tracer:
    """The tracer for shadow rays to a light: `tracer`, or one without the instances that do not block it.

    Lights that nothing of the same kind blocks share one, which lives as long as `tracer`.
    """
    return without(snapshot, tracer, hidden_instances(snapshot, light))


def without(snapshot: SceneSnapshot, tracer: Tracer, hidden: Bool | None) -> Tracer:
    """`tracer`, or one that does not see some instances (n_instances,)."""
    if hidden is None:
        return tracer
    with _lock:
        known = _WITHOUT.setdefault(tracer, {})
        key = hidden.tobytes()
        if key not in known:
            known[key] = build_tracer(snapshot, tracer.engine, hidden=hidden)
        return known[key]


def shape(snapshot: SceneSnapshot, light: int, direction: F32, values: F32) -> None:
    """Multiply rows of `values` (m, 3) by what a light emits against unit directions (m, 3) that lead to it."""
    shaping = snapshot.controls(light).shaping
    if shaping is not None and len(values):
        shape_rays(shaping, *emission_frame(snapshot, light), direction, values)


def emission_frame(snapshot: SceneSnapshot, light: int) -> tuple[F64, F64]:
    """A light's +Z in the world, unit, and the map (3, 3) of directions to its own space."""
    linear = snapshot.lights.to_world[light, :, :3].astype(np.float64)
    across = np.cross(linear[:, 0], linear[:, 1])
    if not abs(across @ linear[:, 2]) > 0.0:  # a flat light may be squashed along its axis
        linear[:, 2] = across / max(float(np.linalg.norm(across)), 1e-300)
    axis = linear[:, 2] / max(float(np.linalg.norm(linear[:, 2])), 1e-300)
    return axis, np.ascontiguousarray(np.linalg.pinv(linear))
