"""From radiance to a film with layers and metadata."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from typing import Any

import numpy as np

from icheat_usd import __version__
from icheat_usd.edits.model import EditStack
from icheat_usd.final_gather import FinalGather
from icheat_usd.image.film import Film
from icheat_usd.relight import RelitView
from icheat_usd.samples import ViewSamples
from icheat_usd.samples.develop import average, develop
from icheat_usd.scene import F64, SceneSnapshot


def relit_film(view: ViewSamples, light: RelitView, metadata: Mapping[str, str]) -> Film:
    """The relighter's result as a film."""
    seen = view.background + develop(view, view.points.emission)
    return _film(
        view.width,
        view.height,
        direct=seen + develop(view, light.direct),
        indirect=develop(view, light.indirect),
        indirect_edited=develop(view, light.indirect_edited),
        albedo=average(view, view.points.albedo),
        normal=average(view, view.points.shading_normal),
        depth=average(view, view.depth[:, None]),
        metadata=metadata,
    )


def final_film(result: FinalGather, metadata: Mapping[str, str]) -> Film:
    """The final gather's result as a film."""
    height, width, _ = result.indirect.shape
    return _film(
        width,
        height,
        direct=result.background + result.emission + result.direct,
        indirect=result.indirect,
        indirect_edited=result.indirect_edited,
        albedo=result.albedo,
        normal=result.normal,
        depth=result.depth,
        metadata=metadata,
    )


def image_metadata(
    snapshot: SceneSnapshot, renderer: str, stack: EditStack, settings: Mapping[str, Any]
) -> dict[str, str]:
    """What made an image, as text."""
    return {
        "stage": snapshot.stage_path,
        "camera": snapshot.camera.path,
        "frame": "default" if snapshot.time_code is None else f"{snapshot.time_code:g}",
        "renderer": renderer,
        "settings": ", ".join(f"{name}={value}" for name, value in settings.items()),
        "stack": stack.path,
        "stackDigest": stack.digest,
        "edits": ", ".join(edit.path for edit in stack.active),
        "colorSpace": "lin_rec709_scene",
        "version": __version__,
        "software": f"icheat_usd {__version__}, Python {platform.python_version()}, NumPy {np.__version__}",
    }


def _film(
    width: int,
    height: int,
    *,
    direct: F64,
    indirect: F64,
    indirect_edited: F64,
    albedo: F64,
    normal: F64,
    depth: F64,
    metadata: Mapping[str, str],
) -> Film:
    layers = {
        "beauty": direct + indirect_edited,
        "direct": direct,
        "indirect": indirect,
        "indirect_edited": indirect_edited,
        "edit_delta": indirect_edited - indirect,
        "albedo": albedo,
        "normal": normal,
        "depth": depth,
    }
    shape = (height, width, 3)
    pixels = {
        name: np.ascontiguousarray(values.reshape(shape[:2] if name == "depth" else shape), np.float32)
        for name, values in layers.items()
    }
    return Film(width, height, pixels, metadata)
