"""Several images of one size as one."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from icheat_usd.image.film import F32

#: Grey between the images, and where a difference is zero; scene-linear.
GREY = np.float32(0.18)


def contact_sheet(images: Sequence[F32], *, gap: int = 2) -> F32:
    """Put (height, width, 3) images side by side, row by row, as square as it gets.

    Raises
    ------
    ValueError
        There are none, or they differ in size.
    """
    if not images or len({image.shape for image in images}) != 1:
        raise ValueError("a contact sheet needs images of one size")
    height, width, _ = images[0].shape
    columns = math.ceil(math.sqrt(len(images)))
    rows = math.ceil(len(images) / columns)
    sheet = np.full((rows * (height + gap) - gap, columns * (width + gap) - gap, 3), GREY, np.float32)
    for index, image in enumerate(images):
        top, left = index // columns * (height + gap), index % columns * (width + gap)
        sheet[top : top + height, left : left + width] = image
    return sheet


def signed_image(difference: F32, full: float | None = None) -> F32:
    """A difference as a picture: grey where it is zero, lighter where light is added, darker where it is taken away.

    Parameters
    ----------
    full
        Difference shown as black or white; by default what 99.5 % of the channels stay below.
    """
    if full is None:
        full = float(np.quantile(np.abs(difference), 0.995))
        full = full if full > 0 else float(np.abs(difference).max())
    scale = np.float32(1 / full if full > 0 else 0)
    shown: F32 = np.clip(GREY * (1 + scale * difference), 0, None).astype(np.float32)
    return shown
