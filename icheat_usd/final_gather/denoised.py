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
    clean = partial(denoised_layer, result)
    there = [path for path in edits if path in result.contributions]
    images = [EditImage(mask_image(result, path), result.contributions[path].astype(np.float32)) for path in there]
    light = denoise_edited(result.indirect.astype(np.float32), images, *_features(result))
    changes = dict(zip(there, light.changes, strict=True))
    found = replace(
        result,
        direct=clean(result.direct),
        indirect=light.unedited.astype(np.float64),
        indirect_edited=light.edited.astype(np.float64),
        contributions={path: changes.get(path, old).astype(np.float64) for path, old in result.contributions.items()},
        light_groups=_groups(result, light.unedited, light.edited, clean),
    )
    progress("denoise", 1.0)
    return found


def denoised_layer(result: FinalGather, layer: F64) -> F64:
    """One layer of light, (height, width, 3), without its noise."""
    return denoise(layer.astype(np.float32), *_features(result)).astype(np.float64)


def _features(result: FinalGather) -> tuple[F32, F32]:
    """Albedo and normal, where a pixel shows the sky beside a surface as little of them as there is of its light."""
    albedo, normal = ((feature * result.seen).astype(np.float32) for feature in (result.albedo, result.normal))
    return albedo, normal


def _groups(result: FinalGather, unedited: F32, edited: F32, clean: Callable[[F64], F64]) -> dict[tuple[str, str], F64]:
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
