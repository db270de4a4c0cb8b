"""Calls into Embree from compiled loops, without an array round trip or Python in between.

Functions and scenes come in as plain integers (addresses of this process), so
compiled code holds no address and its cache stays valid when the library is
loaded elsewhere next time. Struct layouts are those of Embree 4's ``rtcore_ray.h``.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import numpy as np
from llvmlite import ir
from numba import prange, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel

#: Floats of a packet, 22 rows of 16, as RTCRayHit16 has them. Shadow rays need room for the fields of a hit, too: where
#: the processor has no AVX-512, rtcOccluded16 reads them and writes them back, behind the end of an RTCRay16. Whatever
#: another thread has there meanwhile would be undone.
PACKET = 22 * 16
CHUNK = 1024  # rays per buffer: enough to hide its allocation, few enough to balance threads
_INVALID = np.uint32(0xFFFFFFFF)


class TraceTable(NamedTuple):
    """What a compiled loop needs to trace: addresses of this process."""

    function: int  #: rtcIntersect16, or rtcIntersect1
    arguments: int  #: RTCIntersectArguments for packets of similar rays
    packets: bool
    scene: int
    mesh_begin: NDArray[np.int64]
    instance_mesh: NDArray[np.int32]


@cast(Any, intrinsic)  # as a caller sees it: without the typing context
def call_1(typingctx: Any, function: Any, scene: Any, ray: Any) -> Any:
    """``function(scene, ray, NULL)``: rtcIntersect1, rtcOccluded1."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [pointer, pointer, pointer])
        callee = builder.inttoptr(args[0], kind.as_pointer())
        builder.call(callee, [builder.inttoptr(a, pointer) for a in args[1:]] + [ir.Constant(pointer, None)])
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64), codegen


@cast(Any, intrinsic)  # as a caller sees it: without the typing context
def call_packet(typingctx: Any, function: Any, valid: Any, scene: Any, rays: Any, arguments: Any) -> Any:
    """``function(valid, scene, rays, arguments)``: rtcIntersect16, rtcOccluded16; arguments 0 for none."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [pointer] * 4)
        callee = builder.inttoptr(args[0], kind.as_pointer())
        builder.call(callee, [builder.inttoptr(a, pointer) for a in args[1:]])
        return context.get_dummy_value()

    return types.void(*[types.int64] * 5), codegen


@kernel
def _call_packet(function: int, valid: int, scene: int, rays: int) -> None:
    """`call_packet` without arguments."""
    call_packet(function, valid, scene, rays, 0)


@kernel
def is_traceable(origins: np.ndarray, directions: np.ndarray, i: int, t_max: float) -> bool:
    """False for rays that hit nothing by definition: not finite, without a direction, or of no length."""
    total = np.float32(0.0)
    length = np.float32(0.0)
    for c in range(3):
        total += origins[i, c] * np.float32(0.0) + directions[i, c] * np.float32(0.0)
        length = max(length, abs(directions[i, c]))
    return total == 0.0 and length > 0.0 and t_max > 0.0


@parallel_kernel
def intersect_single(
    function: int,
    scene: int,
    origins: np.ndarray,
    directions: np.ndarray,
    t_max: np.ndarray,
    mesh_begin: np.ndarray,
    instance_mesh: np.ndarray,
    distance: np.ndarray,
    instance: np.ndarray,
    triangle: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
) -> None:
    """Nearest hits, one ray per call; `t_max` has n entries or one for all."""
    n = origins.shape[0]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        storage = np.empty(64, np.float32)
        shift = np.int64((-storage.ctypes.data % 64) // 4)
        ray = storage[shift : shift + 24]
        words = ray.view(np.uint32)
        address = ray.ctypes.data
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            limit = t_max[min(i, t_max.shape[0] - 1)]
            distance[i] = np.inf
            instance[i] = -1
            triangle[i] = -1
            u[i] = 0.0
            v[i] = 0.0
            if not is_traceable(origins, directions, i, limit):
                continue
            for c in range(3):
                ray[c] = origins[i, c]
                ray[4 + c] = directions[i, c]
            ray[3] = 0.0
            ray[7] = 0.0
            ray[8] = limit
            words[9] = _INVALID
            words[10] = 0
            words[11] = 0
            words[17] = _INVALID
            words[18] = _INVALID
            words[19] = _INVALID
            words[20] = _INVALID
            call_1(function, scene, address)
            if words[18] != _INVALID:
                top = np.int64(words[18] if words[19] == _INVALID else words[19])
                distance[i] = ray[8]
                instance[i] = top
                triangle[i] = mesh_begin[instance_mesh[top]] + np.int64(words[17])
                u[i] = ray[15]
                v[i] = ray[16]


@parallel_kernel
def intersect_packets(
    function: int,
    scene: int,
    origins: np.ndarray,
    directions: np.ndarray,
    t_max: np.ndarray,
    mesh_begin: np.ndarray,
    instance_mesh: np.ndarray,
    distance: np.ndarray,
    instance: np.ndarray,
    triangle: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
) -> None:
    """Nearest hits in packets of 16 successive rays; `t_max` has n entries or one for all."""
    n = origins.shape[0]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        storage = np.empty(PACKET + 32, np.float32)
        shift = np.int64((-storage.ctypes.data % 64) // 4)
        valid = storage[shift : shift + 16].view(np.int32)
        rays = storage[shift + 16 : shift + 16 + PACKET].reshape(22, 16)
        words = rays.view(np.uint32)
        for first in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK), 16):
            count = min(16, n - first)
            for k in range(16):
                i = first + min(k, count - 1)
                limit = t_max[min(i, t_max.shape[0] - 1)]
                active = k < count and is_traceable(origins, directions, i, limit)
                valid[k] = -1 if active else 0
                for c in range(3):
                    rays[c, k] = origins[i, c]
                    rays[4 + c, k] = directions[i, c]
                rays[3, k] = 0.0
                rays[7, k] = 0.0
                rays[8, k] = limit
                words[9, k] = _INVALID
                words[10, k] = 0
                words[11, k] = 0
                words[17, k] = _INVALID
                words[18, k] = _INVALID
                words[19, k] = _INVALID
                words[20, k] = _INVALID
            _call_packet(function, valid.ctypes.data, scene, rays.ctypes.data)
            for k in range(count):
                i = first + k
                if valid[k] != 0 and words[18, k] != _INVALID:
                    top = np.int64(words[18, k] if words[19, k] == _INVALID else words[19, k])
                    distance[i] = rays[8, k]
                    instance[i] = top
                    triangle[i] = mesh_begin[instance_mesh[top]] + np.int64(words[17, k])
                    u[i] = rays[15, k]
                    v[i] = rays[16, k]
                else:
                    distance[i] = np.inf
                    instance[i] = -1
                    triangle[i] = -1
                    u[i] = 0.0
                    v[i] = 0.0


@parallel_kernel
def occluded_packets(
    function: int,
    scene: int,
    origins: np.ndarray,
    directions: np.ndarray,
    t_max: np.ndarray,
    blocked: np.ndarray,
) -> None:
    """Whether anything is hit, in packets of 16 successive rays; `t_max` has n entries or one for all."""
    n = origins.shape[0]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        storage = np.empty(PACKET + 32, np.float32)
        shift = np.int64((-storage.ctypes.data % 64) // 4)
        valid = storage[shift : shift + 16].view(np.int32)
        rays = storage[shift + 16 : shift + 16 + PACKET].reshape(22, 16)
        words = rays.view(np.uint32)
        for first in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK), 16):
            count = min(16, n - first)
            for k in range(16):
                i = first + min(k, count - 1)
                limit = t_max[min(i, t_max.shape[0] - 1)]
                active = k < count and is_traceable(origins, directions, i, limit)
                valid[k] = -1 if active else 0
                for c in range(3):
                    rays[c, k] = origins[i, c]
                    rays[4 + c, k] = directions[i, c]
                rays[3, k] = 0.0
                rays[7, k] = 0.0
                rays[8, k] = limit
                words[9, k] = _INVALID
                words[10, k] = 0
                words[11, k] = 0
            _call_packet(function, valid.ctypes.data, scene, rays.ctypes.data)
            for k in range(count):
                blocked[first + k] = valid[k] != 0 and rays[8, k] < 0.0


@parallel_kernel
def occluded_single(
    function: int,
    scene: int,
    origins: np.ndarray,
    directions: np.ndarray,
    t_max: np.ndarray,
    blocked: np.ndarray,
) -> None:
    """Whether anything is hit, one ray per call; `t_max` has n entries or one for all."""
    n = origins.shape[0]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        storage = np.empty(64, np.float32)
        shift = np.int64((-storage.ctypes.data % 64) // 4)
        ray = storage[shift : shift + 12]
        words = ray.view(np.uint32)
        address = ray.ctypes.data
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            limit = t_max[min(i, t_max.shape[0] - 1)]
            blocked[i] = False
            if not is_traceable(origins, directions, i, limit):
                continue
            for c in range(3):
                ray[c] = origins[i, c]
                ray[4 + c] = directions[i, c]
            ray[3] = 0.0
            ray[7] = 0.0
            ray[8] = limit
            words[9] = _INVALID
            words[10] = 0
            words[11] = 0
            call_1(function, scene, address)
            blocked[i] = ray[8] < 0.0
