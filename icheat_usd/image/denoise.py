"""Denoising with Open Image Denoise, and of what edits change without blurring their edges.

An edit's mask is sharp where the artist made it so, and a denoiser takes any edge that no
feature explains for noise. So masks are taken out before, and put back after: what an edit
changes is divided by its mask, carried on beyond the mask as if there were none, denoised, and
multiplied by the mask again.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from icheat_usd.errors import ImageError

F32 = NDArray[np.float32]
Bool = NDArray[np.bool_]

#: Below this a mask says too little about what it hides; there, too, its neighbours are carried on.
_LEAST_MASK = 1e-3

#: Between neighbouring pixels, more than this of a mask is an edge of it.
_HARD = 0.5

#: Pixels about what an edit changes that the denoiser gets to see; it looks about as far.
_MARGIN = 64


class EditImage(NamedTuple):
    """What one edit of a stack changes."""

    mask: F32  #: (height, width) 0..1, the edit's receivers; share of what the pixel shows of surfaces
    change: F32  #: (height, width, 3) over the edits before it, in stack order


class Denoised(NamedTuple):
    """Indirect light without noise."""

    unedited: F32  #: (height, width, 3)
    edited: F32  #: (height, width, 3) the same bits as `unedited` where all masks are 0
    changes: tuple[F32, ...]  #: (height, width, 3) of each edit


def denoiser() -> Any:
    """The package that denoises.

    Raises
    ------
    ImageError
        It is not installed.
    """
    try:
        import pyoidn
    except (ImportError, OSError) as error:
        raise ImageError(
            f"denoising needs Open Image Denoise, which cannot be used here ({error}); install it with "
            "pip install 'icheat-usd[denoise]', or render without denoising"
        ) from None
    return pyoidn


def denoise(color: F32, albedo: F32 | None = None, normal: F32 | None = None) -> F32:
    """An image without its noise; the same bits every time, with any number of threads.

    Parameters
    ----------
    color : (height, width, 3)
        Scene-linear, not negative.
    albedo, normal : (height, width, 3), optional
        Features: edges in them stay. Albedo needs a normal and no less than 0; normals are unit vectors, or shorter.

    Raises
    ------
    ImageError
        Open Image Denoise is not installed or fails, or the images differ in size.
    """
    pyoidn = denoiser()
    if normal is not None and albedo is None:
        raise ImageError("denoising uses normals only together with albedo; give both or neither")
    for name, image in (("albedo", albedo), ("normal", normal)):
        if image is not None and image.shape != color.shape:
            raise ImageError(f"the {name} of shape {image.shape} is of another image than one of shape {color.shape}")
    if not color.any():
        return np.zeros(color.shape, np.float32)
    features = [None if image is None else np.ascontiguousarray(image, np.float32) for image in (albedo, normal)]
    try:
        found = pyoidn.denoise(np.ascontiguousarray(color, np.float32), *features, hdr=True)
    except (RuntimeError, TypeError, ValueError, OSError) as error:
        raise ImageError(
            f"Open Image Denoise failed on an image of shape {color.shape}: {error}; render without denoising"
        ) from error
    return np.asarray(np.maximum(found, 0), np.float32)


def denoise_edited(
    unedited: F32, edits: Sequence[EditImage], albedo: F32 | None = None, normal: F32 | None = None
) -> Denoised:
    """Indirect light without noise, unedited and under a stack of edits.

    The unedited image does not depend on the edits. Edges of masks stay as sharp as the masks are, also those of
    weaker edits within stronger ones.

    Parameters
    ----------
    unedited : (height, width, 3) float32
        Indirect light, scene-linear.
    edits : sequence of EditImage
        Weakest first; ``unedited`` plus all changes is the edited light.

    Raises
    ------
    ImageError
        As `denoise`, or an edit's images differ in size.
    """
    for edit in edits:
        if edit.mask.shape != unedited.shape[:2] or edit.change.shape != unedited.shape:
            raise ImageError(
                f"the mask of shape {edit.mask.shape} and the change of shape {edit.change.shape} are of another "
                f"image than one of shape {unedited.shape}"
            )
    base = denoise(unedited, albedo, normal)
    before, edited = unedited.astype(np.float32), base.copy()
    changes: list[F32] = []
    weaker: list[F32] = []
    for edit in edits:
        touched = np.asarray((edit.mask > 0) & bool(edit.change.any()), np.bool_)
        total, weights = np.zeros_like(base), np.zeros_like(edit.mask)
        for region in _regions(touched, weaker):
            window = _window(region.known)
            features = [None if image is None else image[window] for image in (albedo, normal)]
            mask = edit.mask[window]
            known = region.known[window] & (mask >= _LEAST_MASK)
            if not known.any():
                known = region.known[window]
            whole = before[window] + edit.change[window] / np.maximum(mask, _LEAST_MASK)[..., None]
            after, first = (
                denoise(_carried_on(np.maximum(image, 0), unedited[window], known), *features)
                for image in (whole, before[window])
            )
            total[window] += region.weight[window][..., None] * (after - first)
            weights[window] += region.weight[window]
        # A mask so thin that pixels only show its edges keeps its noise.
        found = np.where(weights[..., None] > 0, total / np.maximum(weights, np.float32(1e-6))[..., None], 0)
        change = np.where(weights[..., None] > 0, edit.mask[..., None] * found, edit.change)
        changes.append(np.where(touched[..., None], change, 0).astype(np.float32))
        edited[touched] += changes[-1][touched]
        before = before + edit.change
        weaker.append(edit.mask)
    return Denoised(base, np.maximum(edited, 0), tuple(changes))


class _Region(NamedTuple):
    """Where an edit meets the same weaker edits."""

    known: Bool  #: (height, width) pixels that show nothing else
    weight: F32  #: (height, width) share of each pixel that shows it


def _regions(touched: Bool, weaker: Sequence[F32]) -> list[_Region]:
    """Parts of what an edit touches by the weaker edits that are there: their edges are in its change."""
    signature = np.zeros(touched.shape, np.int64)
    crossed = np.zeros(touched.shape, np.bool_)
    edges: list[tuple[F32, Bool, Bool]] = []
    for mask in weaker:
        edge = (mask > 0) & (mask < 1) & (_local_range(mask) > _HARD)
        edges.append((mask, edge, np.asarray(mask > 0, np.bool_)))
        crossed |= edge
        # Numbers of combinations that are there, so that they do not grow with the stack.
        signature = np.unique(2 * signature + (mask > 0), return_inverse=True)[1].reshape(touched.shape)
    found = []
    for one in np.unique(signature[touched & ~crossed]):
        known = touched & ~crossed & (signature == one)
        place = tuple(np.argwhere(known)[0])
        weight = touched.astype(np.float32)
        for mask, edge, inside in edges:
            share = np.where(edge, mask, inside)
            weight = weight * (share if inside[place] else 1 - share)
        found.append(_Region(known, weight.astype(np.float32)))
    return found


def _local_range(mask: F32) -> F32:
    """Largest less smallest value of each pixel and its eight neighbours."""
    padded = np.pad(mask, 1, mode="edge")
    height, width = mask.shape
    near = [padded[y : y + height, x : x + width] for y in range(3) for x in range(3)]
    return np.asarray(np.max(near, axis=0) - np.min(near, axis=0), np.float32)


def _window(region: Bool) -> tuple[slice, slice]:
    """Rows and columns about a region."""
    slices = []
    for axis in (1, 0):
        there = np.flatnonzero(region.any(axis=axis))
        slices.append(slice(max(int(there[0]) - _MARGIN, 0), int(there[-1]) + 1 + _MARGIN))
    return slices[0], slices[1]


def _carried_on(values: F32, guide: F32, known: Bool) -> F32:
    """`values` where they are known; elsewhere the guide, at the ratio that values nearby have to it."""
    if known.all():
        return values
    weight = known[..., None].astype(np.float32)
    above, below = _spread(values * weight, weight), _spread(guide * weight, weight)
    little = np.float32(1e-6) * max(float(guide.max()), 1e-30)
    ratio = above / np.maximum(below, little)
    # Where the guide is dark the values themselves are carried on.
    beyond = np.where(below > little, np.minimum(ratio * guide, above * 8), above)
    return np.where(known[..., None], values, beyond).astype(np.float32)


def _spread(weighted: F32, weight: F32) -> F32:
    """Fill an image where its weights are 0 from what is nearest, ever more coarsely (Gortler et al. 1996, pull-push).

    Parameters
    ----------
    weighted : (height, width, 3)
        Values times weights.
    weight : (height, width, 1), 0..1
    """
    height, width = weight.shape[:2]
    if height == 1 and width == 1:
        return np.asarray(weighted / np.maximum(weight, np.float32(1e-30)), np.float32)
    padded = [np.pad(image, ((0, height % 2), (0, width % 2), (0, 0))) for image in (weighted, weight)]
    sums = [image[::2, ::2] + image[1::2, ::2] + image[::2, 1::2] + image[1::2, 1::2] for image in padded]
    total = np.maximum(sums[1], np.float32(1))
    coarse = _spread(sums[0] / total, sums[1] / total)
    fine = coarse.repeat(2, axis=0)[:height].repeat(2, axis=1)[:, :width]
    return weighted + (1 - weight) * fine
