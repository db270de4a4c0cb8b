"""From radiance to a film with layers and metadata."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from typing import Any

import numpy as np

from icheat_usd import __version__
from icheat_usd.edits.model import EditStack
from icheat_usd.image.film import Film
from icheat_usd.relight import RelitView
from icheat_usd.samples import ViewSamples
from icheat_usd.samples.develop import average, develop
from icheat_usd.scene import SceneSnapshot


def relit_film(view: ViewSamples, light: RelitView, metadata: Mapping[str, str]) -> Film:
    """The relighter's result as a film."""
    direct = view.background + develop(view, view.points.emission) + develop(view, light.direct)
    indirect, indirect_edited = develop(view, light.indirect), develop(view, light.indirect_edited)
    layers = {
        "beauty": direct + indirect_edited,
        "direct": direct,
        "indirect": indirect,
        "indirect_edited": indirect_edited,
        "edit_delta": indirect_edited - indirect,
        "albedo": average(view, view.points.albedo),
        "normal": average(view, view.points.shading_normal),
        "depth": average(view, view.depth[:, None]),
    }
    shape = (view.height, view.width, 3)
    pixels = {
        name: np.ascontiguousarray(values.reshape(shape[:2] if name == "depth" else shape), np.float32)
        for name, values in layers.items()
    }
    return Film(view.width, view.height, pixels, metadata)


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
        "payloads": ", ".join(dict.fromkeys(key.digest for edit in stack.active for key in edit.keys if key.digest)),
        "colorSpace": "lin_rec709_scene",
        "version": __version__,
        "software": f"icheat_usd {__version__}, Python {platform.python_version()}, NumPy {np.__version__}",
    }
