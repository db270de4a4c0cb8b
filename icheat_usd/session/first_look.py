"""What can be shown before any light is known: the surfaces that the camera sees."""

from __future__ import annotations

import numpy as np

from icheat_usd.samples import ViewSamples
from icheat_usd.samples.develop import develop
from icheat_usd.scene import F32

#: Brightness of a surface seen edge-on, over one seen face-on.
_EDGE = 0.25


def surfaces_by_headlight(view: ViewSamples) -> F32:
    """The surfaces in their colours, darker towards their edges, (height, width, 3) scene-linear.

    Needs no kernel but those that placed the view samples.
    """
    facing = np.abs((view.points.normal * view.to_eye).sum(axis=1, keepdims=True))
    shade = view.points.albedo * (_EDGE + (1 - _EDGE) * facing)
    image: F32 = develop(view, shade.astype(np.float32)).reshape(view.height, view.width, 3).astype(np.float32)
    return image
