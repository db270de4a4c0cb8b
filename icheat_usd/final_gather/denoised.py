"""Denoising of a final gather."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from icheat_usd.final_gather.extras import Extras
from icheat_usd.final_gather.integrator import FinalGather
from icheat_usd.image.cryptomatte import name_id
from icheat_usd.image.denoise import EditImage, denoise, denoise_edited
from icheat_usd.progress import Progress, silent
from icheat_usd.scene import F32, F64


def with_denoising(extras: Extras, edits: Sequence[str]) -> Extras:
    """Extras and all that `denoised` needs for a stack with these active edits."""
    return replace(extras, contributions=True, objects=True, edits=True) if edits else extras


def denoised(result: FinalGather, edits: Sequence[str], *, progress: Progress = silent) -> FinalGather:
    """A final gather without its noise: direct light, indirect light, what edits contribute and light groups.

    The unedited light does not depend on the edits; where no edit has a mask above 0, edited light has its bits. The
    direct light of groups of lights is denoised one by one, so that it sums to the whole only about; of indirect
    light, which edits have borders in, they keep their shares.

    Parameters
    ----------
    result : FinalGather
        Rendered `with_denoising`.
    edits : sequence of str
        Paths of the stack's active edits, weakest first.

    Raises
    ------
    ImageError
        Open Image Denoise is not installed, or fails.
    ValueError
        The result lacks coverage of objects or edits.
    """
    if edits and not {"object", "edit"} <= result.coverage.keys():
        raise ValueError("a final gather can only be denoised if it was rendered with the extras of with_denoising()")
    progress("denoise", 0.0)
    albedo, normal = (np.ascontiguousarray(layer, np.float32) for layer in (result.albedo, result.normal))
    clean = partial(denoised_layer, result)
    there = [path for path in edits if path in result.contributions]
    images = [EditImage(mask_image(result, path), _whole(result, result.contributions[path])) for path in there]
    whole = denoise_edited(_whole(result, result.indirect), images, albedo, normal)
    unedited, edited, *edits_alone = (layer * result.seen for layer in (whole.unedited, whole.edited, *whole.changes))
    changes = dict(zip(there, edits_alone, strict=True))
    found = replace(
        result,
        direct=clean(result.direct),
        indirect=unedited,
        indirect_edited=edited,
        contributions={path: changes.get(path, old) for path, old in result.contributions.items()},
        light_groups=_groups(result, unedited, edited, clean),
    )
    progress("denoise", 1.0)
    return found


def denoised_layer(result: FinalGather, layer: F64) -> F64:
    """One layer of light, (height, width, 3), without its noise.

    Features are those of surfaces, and so must be the light: where a pixel shows some of the sky beside a surface,
    the denoiser sees the light that a whole pixel of it would have.
    """
    albedo, normal = (np.ascontiguousarray(feature, np.float32) for feature in (result.albedo, result.normal))
    return denoise(_whole(result, layer), albedo, normal) * result.seen


def _whole(result: FinalGather, layer: F64) -> F32:
    """Light of pixels as if what they show of surfaces filled them."""
    return np.divide(layer, result.seen, out=np.zeros_like(layer), where=result.seen > 0).astype(np.float32)


def _groups(result: FinalGather, unedited: F64, edited: F64, clean: Callable[[F64], F64]) -> dict[tuple[str, str], F64]:
    shares = {"indirect": (result.indirect, unedited), "indirect_edited": (result.indirect_edited, edited)}
    found = {}
    for (kind, name), layer in result.light_groups.items():
        if kind in shares:
            noisy, wanted = shares[kind]
            layer = layer * np.divide(wanted, noisy, out=np.zeros_like(noisy), where=noisy > 0)
        found[kind, name] = clean(layer) if kind == "direct" else layer
    return found


def mask_image(result: FinalGather, edit: str) -> F32:
    """Receiver mask of an edit, (height, width), averaged over the surfaces that each pixel shows."""
    height, width, _ = result.indirect.shape
    shown, covered = result.coverage["object"], result.coverage["edit"]
    surfaces = np.bincount(shown.pixel, shown.share, height * width)
    mine = covered.id == name_id(edit)
    mask = np.bincount(covered.pixel[mine], covered.share[mine], height * width).astype(np.float64)
    mask = np.divide(mask, surfaces, out=np.zeros_like(mask), where=surfaces > 0)
    return np.minimum(mask, 1.0).reshape(height, width).astype(np.float32)
