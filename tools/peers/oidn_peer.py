"""Open Image Denoise, as one runs it after a path tracer."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from icheat_usd.scene import F32, F64


def denoiser(albedo: F32, normal: F32) -> Callable[[F64], F64] | None:
    """Denoises images with these features, which have no noise, both (height, width, 3); None without `pyoidn`.

    It has run once when it is returned, so that loading it is not timed.
    """
    try:
        import pyoidn
    except ImportError:
        return None
    albedo, normal = (np.ascontiguousarray(x, np.float32) for x in (np.clip(albedo, 0, 1), normal))

    def denoise(image: F64) -> F64:
        color = np.ascontiguousarray(np.maximum(image, 0), np.float32)
        return np.asarray(pyoidn.denoise(color, albedo, normal, hdr=True, clean_aux=True), np.float64)

    denoise(np.ones(albedo.shape))
    return denoise
