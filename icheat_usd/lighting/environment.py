"""Radiance that arrives from dome lights."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels.environment import dome_radiance
from icheat_usd.scene import F32, LightKind, SceneSnapshot


def environment_radiance_per_light(snapshot: SceneSnapshot, directions: F32) -> F32:
    """Radiance that each light sends against a ray that left the scene.

    Parameters
    ----------
    directions : (n, 3) float32, world space, any length
        Where the rays go.

    Returns
    -------
    (n_lights, n, 3) float32, radiance, scene-linear
        Zero for every light that is no dome: distant lights are invisible.

    Notes
    -----
    Lat-long images are looked up bilinearly; the direction +Z of the dome's own frame is the
    centre of the image and +X its left quarter, as OpenEXR and UsdLux define [1]_.

    References
    ----------
    .. [1] https://openusd.org/release/user_guides/schemas/usdLux/DomeLight.html
    """
    lights = snapshot.lights
    rays = np.require(directions, np.float32, ("C", "W"))
    out = np.zeros((len(lights.kind), len(rays), 3), np.float32)
    for light in np.flatnonzero(lights.kind == LightKind.DOME):
        _add_dome(snapshot, int(light), rays, out[light])
    return out


def environment_radiance(snapshot: SceneSnapshot, directions: F32) -> F32:
    """Radiance of all domes against rays that left the scene, (n, 3); see `environment_radiance_per_light`."""
    rays = np.require(directions, np.float32, ("C", "W"))
    out = np.zeros((len(rays), 3), np.float32)
    for light in np.flatnonzero(snapshot.lights.kind == LightKind.DOME):
        _add_dome(snapshot, int(light), rays, out)
    return out


def _add_dome(snapshot: SceneSnapshot, light: int, directions: F32, out: F32) -> None:
    lights = snapshot.lights
    linear = lights.to_world[light, :, :3].astype(np.float64)
    if np.linalg.det(linear) == 0.0:
        return
    dome_radiance(
        snapshot.textures,
        int(lights.texture[light]),
        lights.radiance[light],
        np.ascontiguousarray(np.linalg.inv(linear)),
        directions,
        out,
    )
