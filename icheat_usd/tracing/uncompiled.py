"""Nearest triangles by embreex's own interface: slower than compiled loops, but there before any is compiled."""

from __future__ import annotations

import numpy as np

from icheat_usd.scene import F32, F64, I64


def nearest_triangles(corners: F32, origins: F32 | F64, directions: F32 | F64) -> I64:
    """Row of the triangle that each ray meets first, (n_rays,); -1 for none.

    Parameters
    ----------
    corners : (n, 3, 3) world space
    origins, directions : (n_rays, 3)
    """
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    mesh = TriangleMesh(scene, np.ascontiguousarray(corners, np.float32))
    found: I64 = scene.run(origins.astype(np.float32), directions.astype(np.float32)).astype(np.int64)
    del mesh  # not kept by the scene
    return found
