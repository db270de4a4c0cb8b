"""The fast tracer: Embree 4, from the library that the embreex wheel carries, called by compiled loops.

Choices that were measured (million rays per second of one AMD Zen 5 core, incoherent rays from 64 per origin):

=========================  =================  ===================  ==================
scene                      copies 16 / 1      instances 16 / 1     shadow 16 / 1
=========================  =================  ===================  ==================
40 placements of 3,120     7.7 / 6.7          8.3 / 7.5            13.1 / 8.2
2,000 placements of 480    2.5 / 2.5          3.2 / 4.1            2.4 / 3.6
3,000 placements of 12     3.9 / 3.7          2.9 / 4.2            2.0 / 4.0
=========================  =================  ===================  ==================

(shadow: with instances.) So meshes placed repeatedly are instances, which also build ten times as fast; packets of 16
are traced in scenes of few instances, single rays in scenes of many.

embreex's own interface against these calls, same rays, one thread: 10.6 and 13.4 for nearest hits in a room of 143,000
triangles, 17 and 26 for occlusion; inside a bumpy sphere of 156,000 traversal is all, and both are equal to 10 %. The
calls are there for the shadow rays, and because the interface traces one ray at a time and has no instances.

No ray may pass between triangles that share an edge. Embree's robust mode sees to it; here triangles overlap by some
rounding instead (`kernels.overlap`). Million rays per second of one core of a Xeon of 2.5 GHz, nearest hits of 64 rays
from an origin and shadow rays of neighbours to one point, medians of nine rounds by turns:

==================================  ===========  ===========
scene                               robust       overlapping
==================================  ===========  ===========
34 triangles                        5.0 / 21.1   7.1 / 26.4
4,482                               3.4 / 13.6   5.2 / 23.3
32,568                              3.0 / 9.1    4.6 / 11.6
62,434, of which some are placed    2.4 / 8.7    3.2 / 9.5
142,973                             2.0 / 7.4    2.6 / 9.9
==================================  ===========  ===========

Of 15 million rays from surfaces of each of the last four, robust mode stops none that gets through overlapping ones,
but for two that graze a surface or a sliver in each of two scenes; without either, up to eight get through.
"""

from __future__ import annotations

import ctypes
import functools
import weakref
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from icheat_usd.errors import IcheatError
from icheat_usd.kernels.embree import (
    TraceTable,
    intersect_packets,
    intersect_single,
    occluded_packets,
    occluded_single,
)
from icheat_usd.kernels.overlap import overlap_triangles
from icheat_usd.scene import F32, Bool, Geometry, Hits, SceneSnapshot
from icheat_usd.tracing._rays import checked_rays

# Values from Embree 4's rtcore headers.
_GEOMETRY_TRIANGLE, _GEOMETRY_INSTANCE = 0, 121
_BUFFER_INDEX, _BUFFER_VERTEX = 0, 1
_FORMAT_UINT3, _FORMAT_FLOAT3, _FORMAT_FLOAT3X4_ROW_MAJOR = 0x5003, 0x9003, 0x9134

#: Meshes placed more than once are copied into world space while all copies together have at most so many triangles;
#: beyond it they become Embree instances.
COPIED_TRIANGLES = 20_000
#: Packets of 16 rays are slower than single rays where there are more Embree instances than this.
INSTANCES_FOR_PACKETS = 256
#: Rays from further away than so many times a triangle's largest coordinate may pass between it and its neighbours.
FARTHEST = 16.0


@functools.cache
def _library() -> ctypes.CDLL:
    try:
        import embreex.rtcore  # loads libembree4 and the libtbb next to it
    except ImportError as error:
        raise IcheatError(
            "The Embree tracer needs the package 'embreex' (>= 4.4), which could not be imported; "
            "install it or choose engine='reference'."
        ) from error
    package = Path(embreex.__file__).parent
    found = sorted([*package.parent.glob("embreex.libs/libembree4*"), *package.glob("**/*embree4*")])
    if not found:
        raise IcheatError(
            f"No libembree4 beside {package}; the Embree tracer expects the wheel of embreex >= 4.4: reinstall it."
        )
    library = ctypes.CDLL(str(found[0]))
    handle, uint = ctypes.c_void_p, ctypes.c_uint
    signatures: dict[str, tuple[Any, list[Any]]] = {
        "rtcNewDevice": (handle, [ctypes.c_char_p]),
        "rtcReleaseDevice": (None, [handle]),
        "rtcGetDeviceError": (ctypes.c_int, [handle]),
        "rtcNewScene": (handle, [handle]),
        "rtcReleaseScene": (None, [handle]),
        "rtcCommitScene": (None, [handle]),
        "rtcNewGeometry": (handle, [handle, ctypes.c_int]),
        "rtcReleaseGeometry": (None, [handle]),
        "rtcCommitGeometry": (None, [handle]),
        "rtcAttachGeometryByID": (None, [handle, handle, uint]),
        "rtcSetNewGeometryBuffer": (
            handle,
            [handle, ctypes.c_int, uint, ctypes.c_int, ctypes.c_size_t, ctypes.c_size_t],
        ),
        "rtcSetGeometryInstancedScene": (None, [handle, handle]),
        "rtcSetGeometryTransform": (None, [handle, uint, ctypes.c_int, handle]),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


@functools.cache
def _address(name: str) -> int:
    return ctypes.cast(getattr(_library(), name), ctypes.c_void_p).value or 0


class _Arguments(ctypes.Structure):
    """RTCIntersectArguments of Embree 4."""

    _fields_ = [
        ("flags", ctypes.c_uint),
        ("feature_mask", ctypes.c_uint),
        ("context", ctypes.c_void_p),
        ("filter", ctypes.c_void_p),
        ("intersect", ctypes.c_void_p),
        ("reserved", ctypes.c_void_p * 4),
    ]


# For packets of rays that were put in order of direction: two to three times as fast. For others, half as fast.
_COHERENT = _Arguments(1 << 16, 0xFFFFFFFF)


def _release(library: ctypes.CDLL, device: int, scenes: list[int]) -> None:
    for scene in reversed(scenes):
        library.rtcReleaseScene(scene)
    library.rtcReleaseDevice(device)


def _corners(geometry: Geometry, mesh: int) -> F32:
    found: F32 = geometry.points[geometry.mesh_begin[mesh] : geometry.mesh_begin[mesh + 1]]
    return found


def _in_world(geometry: Geometry, instance: int) -> F32:
    """Corners (n, 3, 3) of an instance's triangles."""
    matrix = geometry.instance_to_world[instance].astype(np.float64)
    corners = _corners(geometry, geometry.instance_mesh[instance]).astype(np.float64)
    return np.ascontiguousarray(corners @ matrix[:, :3].T + matrix[:, 3], np.float32)


class _Reaches:
    """How far away rays start, of which the rounding of what they meet depends; see `overlap_triangles`.

    The same for all choices of what is hidden, so that the others stay what they are.
    """

    def __init__(self, geometry: Geometry, world: dict[int, F32], shared: Bool) -> None:
        self._mesh = geometry.instance_mesh
        matrix = geometry.instance_to_world.astype(np.float64)
        stretch = np.linalg.svd(matrix[:, :, :3], compute_uv=False)
        radius = np.array([np.abs(_corners(geometry, m)).max(initial=0.0) * s for m, s in enumerate(shared)])
        self._farthest = np.abs(matrix[:, :, 3]).max(axis=1) + np.sqrt(3.0) * stretch[:, 0] * radius[self._mesh]
        self._least_stretch = stretch[:, 2]
        self.world = self._of_most(geometry, world, shared)  #: largest coordinate of most triangles

    def _of_most(self, geometry: Geometry, world: dict[int, F32], shared: Bool) -> float:
        """A ground that goes to the horizon is not where rays start."""
        placed = np.flatnonzero(shared[self._mesh])
        sizes = [np.abs(corners).max(axis=(1, 2)) for corners in world.values()] + [self._farthest[placed]]
        counts = [np.ones(len(some)) for some in sizes[:-1]] + [np.diff(geometry.mesh_begin)[self._mesh[placed]]]
        size, count = np.concatenate(sizes), np.concatenate(counts)
        order = np.argsort(size)
        below = np.cumsum(count[order])
        return float(size[order][np.searchsorted(below, 0.9 * below[-1])]) if len(size) else 0.0

    def of_mesh(self, mesh: int) -> float:
        """The same in the space of a mesh that is placed: the largest over its places."""
        where = (self._mesh == mesh) & (self._least_stretch > 0)
        own = self._farthest[where]
        reach = own + np.minimum(self.world, FARTHEST * own)
        return float(np.max(reach / self._least_stretch[where], initial=0.0))


class EmbreeTracer:
    """Nearest hits and occlusion against every triangle of every instance.

    A mesh placed once is copied into world space, as are small ones; others are
    single-level Embree instances, so that 70,000 placements share one mesh.
    Embree owns its copy of the vertices: the snapshot may go.

    Raises
    ------
    IcheatError
        embreex is not installed, or Embree ran out of memory.
    """

    engine: ClassVar[str] = "embree"

    def __init__(
        self, snapshot: SceneSnapshot, *, copied_triangles: int = COPIED_TRIANGLES, hidden: Bool | None = None
    ) -> None:
        self._mesh_begin = snapshot.geometry.mesh_begin
        self._instance_mesh = snapshot.geometry.instance_mesh
        self._n_placed = 0
        library = _library()
        self._device: int = library.rtcNewDevice(b"verbose=0")
        if not self._device:
            raise IcheatError(f"Embree could not start (error {library.rtcGetDeviceError(None)}).")
        scenes: list[int] = []
        self._finalizer = weakref.finalize(self, _release, library, self._device, scenes)
        self._scene = self._build(snapshot.geometry, scenes, copied_triangles, hidden)
        if error := library.rtcGetDeviceError(self._device):
            self.close()
            raise IcheatError(
                f"Embree could not build {snapshot.stage_path or 'the scene'} (error {error}: "
                f"{'out of memory' if error == 4 else 'see RTCError'}); reduce its subdivision level."
            )

    def close(self) -> None:
        """Release Embree's memory now; also happens when the tracer is garbage. Do not trace afterwards."""
        self._scene = 0
        self._finalizer()

    def _new_scene(self, scenes: list[int]) -> int:
        scene: int = _library().rtcNewScene(self._device)
        scenes.append(scene)
        return scene

    def _attach_triangles(self, scene: int, corners: F32, geometry_id: int) -> None:
        library = _library()
        n = len(corners)
        geometry = library.rtcNewGeometry(self._device, _GEOMETRY_TRIANGLE)
        # Buffers made by Embree end in the padding that its 16-byte loads need.
        vertices = library.rtcSetNewGeometryBuffer(geometry, _BUFFER_VERTEX, 0, _FORMAT_FLOAT3, 12, 3 * n)
        indices = library.rtcSetNewGeometryBuffer(geometry, _BUFFER_INDEX, 0, _FORMAT_UINT3, 12, n)
        if vertices and indices:
            ctypes.memmove(vertices, corners.ctypes.data, corners.nbytes)
            order = np.arange(3 * n, dtype=np.uint32)
            ctypes.memmove(indices, order.ctypes.data, order.nbytes)
            library.rtcCommitGeometry(geometry)
            library.rtcAttachGeometryByID(scene, geometry, geometry_id)
        library.rtcReleaseGeometry(geometry)

    def _build(self, geometry: Geometry, scenes: list[int], copied_triangles: int, hidden: Bool | None) -> int:
        library = _library()
        size = np.diff(geometry.mesh_begin)
        uses = np.bincount(geometry.instance_mesh, minlength=len(size))
        copies = np.where(uses > 1, size * uses, 0)
        order = np.argsort(copies, kind="stable")
        shared = np.zeros(len(size), bool)
        shared[order] = (np.cumsum(copies[order]) > copied_triangles) & (copies[order] > 0)

        top = self._new_scene(scenes)
        world = {
            i: _in_world(geometry, i) for i, mesh in enumerate(geometry.instance_mesh.tolist()) if not shared[mesh]
        }
        reaches = _Reaches(geometry, world, shared)
        prototypes: dict[int, int] = {}
        for instance, mesh in enumerate(geometry.instance_mesh.tolist()):
            if size[mesh] == 0 or (hidden is not None and hidden[instance]):
                continue
            if not shared[mesh]:
                corners = world.pop(instance)
                overlap_triangles(corners, reaches.world, FARTHEST, corners)
                self._attach_triangles(top, corners, instance)
                continue
            if mesh not in prototypes:
                prototypes[mesh] = self._new_scene(scenes)
                corners = np.array(_corners(geometry, mesh), np.float32)
                overlap_triangles(corners, reaches.of_mesh(mesh), np.inf, corners)
                self._attach_triangles(prototypes[mesh], corners, 0)
                library.rtcCommitScene(prototypes[mesh])
            placed = library.rtcNewGeometry(self._device, _GEOMETRY_INSTANCE)
            library.rtcSetGeometryInstancedScene(placed, prototypes[mesh])
            rows = np.ascontiguousarray(geometry.instance_to_world[instance], np.float32)
            library.rtcSetGeometryTransform(placed, 0, _FORMAT_FLOAT3X4_ROW_MAJOR, rows.ctypes.data)
            library.rtcCommitGeometry(placed)
            library.rtcAttachGeometryByID(top, placed, instance)
            library.rtcReleaseGeometry(placed)
            self._n_placed += 1
        library.rtcCommitScene(top)
        return top

    def intersect(self, origins: F32, directions: F32, t_max: F32 | float | None = None) -> Hits:
        """See `Tracer.intersect`."""
        origins, directions, t_max = checked_rays(origins, directions, t_max)
        n = len(origins)
        hits = Hits(
            np.empty(n, np.float32),
            np.empty(n, np.int32),
            np.empty(n, np.int32),
            np.empty(n, np.float32),
            np.empty(n, np.float32),
        )
        self._require_open()
        packets = self._n_placed <= INSTANCES_FOR_PACKETS
        trace = intersect_packets if packets else intersect_single
        trace(
            _address("rtcIntersect16" if packets else "rtcIntersect1"),
            self._scene,
            origins,
            directions,
            t_max,
            self._mesh_begin,
            self._instance_mesh,
            *hits,
        )
        return hits

    def occluded(self, origins: F32, directions: F32, t_max: F32 | float | None = None) -> Bool:
        """See `Tracer.occluded`."""
        origins, directions, t_max = checked_rays(origins, directions, t_max)
        blocked = np.empty(len(origins), np.bool_)
        self._require_open()
        packets = self._n_placed <= INSTANCES_FOR_PACKETS
        trace = occluded_packets if packets else occluded_single
        name = "rtcOccluded16" if packets else "rtcOccluded1"
        trace(_address(name), self._scene, origins, directions, t_max, blocked)
        return blocked

    def compiled(self) -> TraceTable:
        """See `Tracer.compiled`."""
        self._require_open()
        packets = self._n_placed <= INSTANCES_FOR_PACKETS
        return TraceTable(
            _address("rtcIntersect16" if packets else "rtcIntersect1"),
            ctypes.addressof(_COHERENT),
            packets,
            self._scene,
            self._mesh_begin,
            self._instance_mesh,
        )

    def compiled_shadows(self) -> TraceTable:
        """See `Tracer.compiled_shadows`."""
        table = self.compiled()
        # Shadow rays of neighbours are much alike.
        return table._replace(function=_address("rtcOccluded16" if table.packets else "rtcOccluded1"))

    def address_of(self, function: str) -> tuple[int, int]:
        """Addresses of one of Embree's functions and of the scene, for compiled loops that make their own rays."""
        self._require_open()
        return _address(function), self._scene

    def _require_open(self) -> None:
        if not self._scene:
            raise ValueError("this tracer was closed")
