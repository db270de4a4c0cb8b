"""Painted masks: weights per texel of control faces of surfaces that are named relative to an anchor."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from icheat_usd.edits.model import MaskedSurface, Payload, SurfaceMask
from icheat_usd.errors import SidecarError
from icheat_usd.sidecar.canonical import Array, Element
from icheat_usd.sidecar.registry import reads, upgrades, writes
from icheat_usd.sidecar.values import read_texts, texts

_DAMAGED = "restore the file from a copy"


@writes("receiver-mask", "surface-mask", "receiver_mask")
def _write_receiver_mask(payload: Payload, anchor: str) -> Element | None:
    return _surface_mask("receiver-mask", payload.receiver_mask, anchor)


@writes("caster-mask", "surface-mask", "caster_mask")
def _write_caster_mask(payload: Payload, anchor: str) -> Element | None:
    return _surface_mask("caster-mask", payload.caster_mask, anchor)


def _surface_mask(name: str, mask: SurfaceMask | None, anchor: str) -> Element | None:
    if mask is None:
        return None
    texels = mask.texels
    n_faces = sum(surface.n_faces for surface in mask.surfaces)
    if texels.ndim != 3 or texels.shape[0] != n_faces or texels.shape[1] != texels.shape[2] or texels.shape[1] < 1:
        raise SidecarError(
            f"{name}: texels of shape {texels.shape} do not fit {n_faces} faces; "
            "expected (faces, resolution, resolution)"
        )
    if texels.dtype != np.float32 or any(surface.n_faces < 0 for surface in mask.surfaces):
        raise SidecarError(f"{name}: texels are {texels.dtype}; expected float32")
    if not ((texels >= 0) & (texels <= 1)).all():
        raise SidecarError(f"{name}: a texel is outside [0, 1] or NaN; clamp the mask before writing")
    datasets = {
        "surface-path": texts(relative_paths([s.path for s in mask.surfaces], anchor), f"{name}: a surface path"),
        "surface-part": texts([s.part for s in mask.surfaces], f"{name}: a part"),
        "surface-instance-id": np.array([s.instance_id for s in mask.surfaces], dtype=np.int64),
        "surface-n-faces": np.array([s.n_faces for s in mask.surfaces], dtype=np.int64),
        "surface-topology-digest": texts([s.topology_digest for s in mask.surfaces], f"{name}: a topology digest"),
        "texels": _smallest_exact(texels),
    }
    if mask.rest is not None:
        datasets |= _write_rest(name, mask.rest, mask.surfaces)
    return Element("surface-mask", 2, datasets)


def _smallest_exact(texels: NDArray[np.float32]) -> Array:
    for dtype, steps in ((np.uint8, 255), (np.uint16, 65535)):
        whole = np.rint(texels * np.float32(steps))
        if np.array_equal(whole / np.float32(steps), texels):
            return whole.astype(dtype)
    return texels + np.float32(0)  # -0.0 becomes 0.0


# Where the faces lay when they were painted -------------------------------------------------------------------------


def _write_rest(name: str, rest: NDArray[np.float32], surfaces: tuple[MaskedSurface, ...]) -> dict[str, Array]:
    """Positions as 65,535ths of each surface's box where that can be done again without drift, else as they are."""
    if rest.shape != (sum(s.n_faces for s in surfaces), 2, 2, 3) or rest.dtype != np.float32:
        raise SidecarError(f"{name}: rest is {rest.dtype} {rest.shape}; expected float32 (faces, 2, 2, 3)")
    if not np.isfinite(rest).all():
        raise SidecarError(f"{name}: a rest position is not finite; leave rest out")
    counts = np.array([s.n_faces for s in surfaces], dtype=np.int64)
    steps, box = _quantised(rest, counts)
    positions = _positions(steps, box, counts)
    again, box_again = _quantised(positions, counts)
    # A small surface far from its origin: float32 is coarser there than the steps would be.
    if np.array_equal(steps, again) and np.array_equal(box, box_again):
        return {"rest": steps, "rest-box": box + np.float32(0)}
    return {"rest": rest + np.float32(0)}


def _quantised(rest: NDArray[np.float32], counts: NDArray[np.int64]) -> tuple[NDArray[np.uint16], NDArray[np.float32]]:
    """(F, 2, 2, 3) steps and (n_surfaces, 2, 3) lower and upper corners."""
    box = np.zeros((len(counts), 2, 3), np.float32)
    steps = np.zeros(rest.shape, np.uint16)
    begin = 0
    for number, count in enumerate(counts):
        part = rest[begin : begin + count].reshape(-1, 3).astype(np.float64)
        if count:
            low, high = part.min(0), part.max(0)
            box[number] = low, high
            size = np.where(high > low, high - low, 1.0)
            steps[begin : begin + count] = np.rint((part - low) / size * 65535.0).reshape(-1, 2, 2, 3)
        begin += count
    return steps, box


def _positions(steps: NDArray[np.uint16], box: NDArray[np.float32], counts: NDArray[np.int64]) -> NDArray[np.float32]:
    low, high = (np.repeat(box[:, side].astype(np.float64), counts, axis=0)[:, None, None] for side in (0, 1))
    return np.asarray(low + steps / 65535.0 * (high - low), dtype=np.float32)


def _read_rest(element: Element, n_faces: NDArray[np.int64]) -> NDArray[np.float32] | None:
    if "rest" not in element.datasets:
        return None
    rest = element.datasets["rest"]
    if rest.shape != (int(n_faces.sum()), 2, 2, 3):
        raise SidecarError(f"'rest' has shape {rest.shape} for {int(n_faces.sum())} faces; {_DAMAGED}")
    if rest.dtype == np.uint16:
        box = element.datasets["rest-box"]
        if box.dtype != np.float32 or box.shape != (len(n_faces), 2, 3) or not np.isfinite(box).all():
            raise SidecarError(f"'rest-box' is {box.dtype} {box.shape} for {len(n_faces)} surfaces; {_DAMAGED}")
        return _positions(rest, box, n_faces)
    if rest.dtype != np.float32 or not np.isfinite(rest).all():
        raise SidecarError(f"'rest' is {rest.dtype}; expected finite float32 or uint16 positions; {_DAMAGED}")
    return np.ascontiguousarray(rest)


@upgrades("surface-mask", 1)
def _without_rest(element: Element) -> Element:
    """Version 2 may say where the faces lay; version 1 never did."""
    datasets = {path: array for path, array in element.datasets.items() if path not in ("rest", "rest-box")}
    return Element("surface-mask", 2, datasets)


@reads("surface-mask", 2)
def _read_surface_mask(element: Element, anchor: str) -> SurfaceMask:
    paths = read_texts(element, "surface-path")
    parts = read_texts(element, "surface-part")
    digests = read_texts(element, "surface-topology-digest")
    ids, n_faces = element.datasets["surface-instance-id"], element.datasets["surface-n-faces"]
    texels = element.datasets["texels"]
    if not len(paths) == len(parts) == len(digests) or any(
        column.shape != (len(paths),) or column.dtype.kind != "i" for column in (ids, n_faces)
    ):
        raise SidecarError("the columns 'surface-...' differ in length or type; restore the file from a copy")
    total = sum(int(n) for n in n_faces)
    square = texels.ndim == 3 and texels.shape[1] == texels.shape[2] and texels.shape[1] >= 1
    if not square or texels.shape[0] != total or (n_faces < 0).any():
        raise SidecarError(f"'texels' has shape {texels.shape} for {total} faces; restore the file from a copy")
    if texels.dtype.kind == "u" and texels.dtype.itemsize <= 2:
        texels = texels.astype(np.float32) / np.float32(np.iinfo(texels.dtype).max)
    elif texels.dtype != np.float32 or not ((texels >= 0) & (texels <= 1)).all():
        raise SidecarError("'texels' holds other values than weights in [0, 1]; restore the file from a copy")
    surfaces = tuple(
        MaskedSurface(absolute_path(path, anchor), int(n), int(instance), part, digest)
        for path, n, instance, part, digest in zip(paths, n_faces, ids, parts, digests, strict=True)
    )
    return SurfaceMask(surfaces, np.ascontiguousarray(texels), _read_rest(element, n_faces))


# Anchored paths -------------------------------------------------------------------------------------------------------


def check_anchor(anchor: str) -> None:
    """Refuse an anchor that is no absolute prim path."""
    if not anchor.startswith("/") or (anchor != "/" and anchor.endswith("/")):
        raise SidecarError(f"the anchor '{anchor}' is not an absolute prim path; give one such as '/World'")


def relative_paths(paths: Iterable[str], anchor: str) -> list[str]:
    """Absolute paths as a file holds them; '.' is the anchor itself.

    Raises
    ------
    SidecarError
        Some paths are not below the anchor; the message names them.
    """
    prefix = anchor if anchor == "/" else anchor + "/"
    relative, outside = [], []
    for path in paths:
        if path == anchor:
            relative.append(".")
        elif path.startswith(prefix):
            relative.append(path[len(prefix) :])
        else:
            outside.append(path)
    if outside:
        shown = ", ".join(outside[:5]) + (f" and {len(outside) - 5} more" if len(outside) > 5 else "")
        raise SidecarError(f"{shown} outside the anchor {anchor}; choose an anchor above every painted surface")
    return relative


def absolute_path(path: str, anchor: str) -> str:
    """A path of a file below the anchor it is read with."""
    if path == ".":
        return anchor
    if not path or path.startswith("/") or ".." in path.split("/"):
        raise SidecarError(f"surface path '{path}' is not relative to the anchor; write the payload again")
    return (anchor if anchor == "/" else anchor + "/") + path
