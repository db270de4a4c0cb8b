"""Sampled rows: Haar rows of an edit's pair functions, between places on surfaces named relative to an anchor."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from icheat_usd.edits.encodings.sampled import KINDS, Places, SampledRows, tree_shape
from icheat_usd.edits.model import MaskedSurface, Payload
from icheat_usd.errors import SidecarError
from icheat_usd.samples.tree import build_tree
from icheat_usd.sidecar.canonical import Array, Element
from icheat_usd.sidecar.mask_elements import absolute_path, relative_paths
from icheat_usd.sidecar.registry import reads, writes
from icheat_usd.sidecar.values import read_texts, texts

_DAMAGED = "restore the file from a copy"

_UNSIGNED = (np.uint8, np.uint16, np.uint32)
_SIGNED = (np.int8, np.int16, np.int32)


# Writing --------------------------------------------------------------------------------------------------------------


@writes("rows", "sampled-rows", "rows")
def _write_rows(payload: Payload, anchor: str) -> Element | None:
    rows = payload.rows
    if rows is None:
        return None
    numbers, columns = _distinct_columns(rows.numbers)
    datasets: dict[str, Array] = {
        "surface-path": texts(relative_paths([s.path for s in rows.surfaces], anchor), "rows: a surface path"),
        "surface-part": texts([s.part for s in rows.surfaces], "rows: a part"),
        "surface-instance-id": np.array([s.instance_id for s in rows.surfaces], np.int64),
        "surface-n-faces": np.array([s.n_faces for s in rows.surfaces], np.int64),
        "surface-topology-digest": texts([s.topology_digest for s in rows.surfaces], "rows: a topology digest"),
        "surface-box": rows.bounds + np.float32(0),
        **_write_places("leaf", rows.leaves),
        "leaf-area": rows.leaf_area,
        "split-size": _smallest(rows.split_size, _UNSIGNED),
        "side-surface": _smallest(rows.side_surface, _UNSIGNED),
        "side": rows.side,
        "side-leaves": rows.side_leaves.astype(np.uint32),
        **_write_places("site", rows.sites),
        "site-reach": rows.site_reach,
        "site-row": _differences(rows.site_row),
        "row-pattern": _differences(rows.row_pattern),
        "row-step": rows.row_step + np.float32(0),
        "pattern-size": _smallest(np.diff(rows.indptr), _UNSIGNED),
        "index": _smallest(_gaps(rows.indptr, rows.indices), _UNSIGNED),
        "number": numbers,
        "number-column": columns,
        "kind": texts(list(rows.kinds), "rows: a kind"),
        "epsilon-scale": np.array(rows.epsilon_scale, np.float64),
        "epsilon-emission": np.array(rows.epsilon_emission, np.float64),
        "epsilon-offset": np.array(rows.epsilon_offset, np.float64),
    }
    element = Element("sampled-rows", 1, {path: np.asarray(array) for path, array in datasets.items()})
    # What is written can be read: a mistake here must not wait for whoever opens the file.
    _read_rows(element, anchor)
    return element


def _write_places(name: str, places: Places) -> dict[str, Array]:
    return {
        f"{name}-surface": _differences(places.surface),
        f"{name}-side": places.side,
        f"{name}-face": _differences(places.face),
        f"{name}-face-uv": places.face_uv,
        f"{name}-position": places.position,
    }


def _smallest(values: NDArray[Any], kinds: tuple[Any, ...]) -> Array:
    """Integers in the smallest of the types that holds them all."""
    low, high = int(values.min(initial=0)), int(values.max(initial=0))
    for kind in kinds:
        if np.iinfo(kind).min <= low and high <= np.iinfo(kind).max:
            return values.astype(kind)
    raise SidecarError(f"rows: {high} is beyond what sampled rows can number")


def _differences(values: NDArray[Any]) -> Array:
    return _smallest(np.diff(values.astype(np.int64), prepend=0), _SIGNED)


def _gaps(indptr: NDArray[np.int64], indices: NDArray[np.int32]) -> NDArray[np.int64]:
    """Indices as steps from one to the next in each pattern, the first as it is."""
    gaps: NDArray[np.int64] = np.asarray(np.diff(indices.astype(np.int64), prepend=0), np.int64)
    first = indptr[:-1][np.diff(indptr) > 0]
    gaps[first] = indices[first]
    return gaps


def _distinct_columns(numbers: NDArray[Any]) -> tuple[Array, NDArray[np.uint8]]:
    """Columns without repetition, and which one each is: grey edits have the same numbers in all channels."""
    kept: list[NDArray[Any]] = []
    which = []
    for column in numbers.T:
        same = [i for i, other in enumerate(kept) if np.array_equal(column, other)]
        which.append(same[0] if same else len(kept))
        if not same:
            kept.append(column)
    stored = np.stack(kept, axis=1) if kept else numbers
    return np.ascontiguousarray(stored), np.array(which, np.uint8)


# Reading: nothing is taken at its word, because kernels follow every index -------------------------------------------


@reads("sampled-rows", 1)
def _read_rows(element: Element, anchor: str) -> SampledRows:
    data = element.datasets
    surfaces = _read_surfaces(element, anchor)
    n_surfaces = len(surfaces)
    faces = np.array([s.n_faces for s in surfaces], np.int64)
    bounds = _floats(data, "surface-box", (n_surfaces, 2, 3))
    leaves = _read_places(data, "leaf", faces)
    n_leaves = len(leaves.surface)
    area = _floats(data, "leaf-area", (n_leaves,))
    if n_leaves == 0 or not (area > 0).all():
        raise SidecarError(f"'leaf-area' holds {n_leaves} areas, some not above 0; {_DAMAGED}")
    splits = _read_splits(data, n_leaves, area)
    side_surface, side, side_leaves = _read_sides(data, n_surfaces, n_leaves)
    sites = _read_places(data, "site", faces)
    reach = _floats(data, "site-reach", (len(sites.surface),))
    if (reach < 0).any():
        raise SidecarError(f"'site-reach' is negative somewhere; {_DAMAGED}")
    kinds = read_texts(element, "kind") if data["kind"].size else []
    if data["kind"].ndim != 1 or kinds != [kind for kind in KINDS if kind in kinds]:
        raise SidecarError(f"'kind' is {kinds}; expected some of {', '.join(KINDS)}, in this order; {_DAMAGED}")
    numbers = _read_numbers(data, 3 * len(kinds))
    indptr, indices = _read_patterns(data, len(numbers), n_leaves)
    row_pattern = _running(data, "row-pattern", 0, len(indptr) - 1)
    step = _floats(data, "row-step", (len(row_pattern), 3 * len(kinds)))
    site_row = _running(data, "site-row", -1, len(row_pattern))
    if len(site_row) != len(sites.surface):
        raise SidecarError(f"'site-row' has {len(site_row)} entries for {len(sites.surface)} sites; {_DAMAGED}")
    return SampledRows(
        surfaces=surfaces,
        bounds=bounds,
        leaves=leaves,
        leaf_area=area,
        split_size=splits,
        side_surface=side_surface,
        side=side,
        side_leaves=side_leaves,
        sites=sites,
        site_reach=reach,
        site_row=site_row,
        row_pattern=row_pattern,
        row_step=step,
        indptr=indptr,
        indices=indices,
        numbers=numbers,
        kinds=tuple(kinds),
        epsilon_scale=_bound(data, "epsilon-scale"),
        epsilon_emission=_bound(data, "epsilon-emission"),
        epsilon_offset=_bound(data, "epsilon-offset"),
    )


def _read_surfaces(element: Element, anchor: str) -> tuple[MaskedSurface, ...]:
    paths = read_texts(element, "surface-path")
    parts = read_texts(element, "surface-part")
    digests = read_texts(element, "surface-topology-digest")
    n = len(paths)
    ids, n_faces = (_integers(element.datasets, name, "i") for name in ("surface-instance-id", "surface-n-faces"))
    if not len(parts) == len(digests) == len(ids) == len(n_faces) == n:
        raise SidecarError(f"the columns 'surface-...' differ in length; {_DAMAGED}")
    if (n_faces < 0).any() or (n_faces >= 2**31).any():
        raise SidecarError(f"'surface-n-faces' is out of range; {_DAMAGED}")
    return tuple(
        MaskedSurface(absolute_path(path, anchor), int(count), int(instance), part, digest)
        for path, count, instance, part, digest in zip(paths, n_faces, ids, parts, digests, strict=True)
    )


def _read_places(data: Any, name: str, faces: NDArray[np.int64]) -> Places:
    surface = _running(data, f"{name}-surface", 0, len(faces))
    face = _running(data, f"{name}-face", 0, 2**31)
    side, uv, position = data[f"{name}-side"], data[f"{name}-face-uv"], data[f"{name}-position"]
    n = len(surface)
    fits = side.shape == (n,) and uv.shape == (n, 2) and position.shape == (n, 3) and face.shape == (n,)
    if not fits or side.dtype != np.uint8 or uv.dtype != np.uint16 or position.dtype != np.uint16:
        raise SidecarError(f"the columns '{name}-...' differ in length or have another type; {_DAMAGED}")
    if (side > 1).any() or (face >= faces[surface]).any():
        raise SidecarError(f"'{name}-side' or '{name}-face' is out of range; {_DAMAGED}")
    return Places(surface, np.ascontiguousarray(side), face, np.ascontiguousarray(uv), np.ascontiguousarray(position))


def _read_splits(data: Any, n_leaves: int, area: NDArray[np.float32]) -> NDArray[np.int32]:
    size = _integers(data, "split-size", "u")
    try:
        shape = tree_shape(size, n_leaves)
    except ValueError as problem:
        raise SidecarError(f"'split-size': {problem}; {_DAMAGED}") from problem
    if not np.isfinite(build_tree(shape, area.astype(np.float64), b"").node_weight).all():
        raise SidecarError(f"'leaf-area' sums to no finite area; {_DAMAGED}")
    return size.astype(np.int32)


def _read_sides(data: Any, n_surfaces: int, n_leaves: int) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    surface, side = _integers(data, "side-surface", "u"), data["side"]
    leaves = data["side-leaves"]
    n = len(surface)
    if side.dtype != np.uint8 or side.shape != (n,) or leaves.dtype != np.uint32 or leaves.shape != (n, 2):
        raise SidecarError(f"the columns 'side...' differ in length or have another type; {_DAMAGED}")
    ranges = np.unique(leaves.astype(np.int64), axis=0)
    # Sides may share leaves, but then all of them: the ranges lie one behind the other, from first to last leaf.
    ends = np.concatenate([[0], ranges[:, 1]])
    whole = n > 0 and (ranges[:, 0] == ends[:-1]).all() and (ranges[:, 1] > ranges[:, 0]).all() and ends[-1] == n_leaves
    if not whole or (surface >= n_surfaces).any() or (side > 1).any():
        raise SidecarError(f"'side-leaves' does not divide {n_leaves} leaves among sides of surfaces; {_DAMAGED}")
    return surface.astype(np.int32), np.ascontiguousarray(side), leaves.astype(np.int32)


def _read_numbers(data: Any, n_columns: int) -> NDArray[Any]:
    stored, columns = data["number"], data["number-column"]
    if stored.dtype not in (np.dtype(np.int8), np.dtype(np.int16)) or stored.ndim != 2 or columns.dtype != np.uint8:
        raise SidecarError(
            f"'number' is {stored.dtype} {stored.shape}; expected int8 or int16 (n, columns); {_DAMAGED}"
        )
    if columns.shape != (n_columns,) or (columns >= stored.shape[1]).any():
        raise SidecarError(f"'number-column' does not say where {n_columns} columns are stored; {_DAMAGED}")
    return np.ascontiguousarray(stored[:, columns])


def _read_patterns(data: Any, n_entries: int, n_leaves: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    sizes, gaps = _integers(data, "pattern-size", "u"), _integers(data, "index", "u")
    indptr = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    if len(gaps) != n_entries or indptr[-1] != n_entries:
        raise SidecarError(
            f"'pattern-size' sums to {indptr[-1]} for {len(gaps)} indices, {n_entries} numbers; {_DAMAGED}"
        )
    first = np.zeros(n_entries, np.bool_)
    first[indptr[:-1][sizes > 0]] = True
    total = np.cumsum(gaps)
    base = (total - gaps)[first]
    indices = total - np.repeat(base, sizes[sizes > 0])
    if (gaps[~first] < 1).any() or (indices >= n_leaves).any():
        raise SidecarError(f"'index' does not rise within a pattern, or passes {n_leaves} leaves; {_DAMAGED}")
    return indptr, indices.astype(np.int32)


def _bound(data: Any, name: str) -> float:
    value = data[name]
    if value.shape != () or value.dtype.kind != "f" or not np.isfinite(value) or value < 0:
        raise SidecarError(f"'{name}' is {value.dtype} {value.shape}; expected a number of at least 0; {_DAMAGED}")
    return float(value)


def _floats(data: Any, name: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
    array = data[name]
    if array.dtype != np.float32 or array.shape != shape or not np.isfinite(array).all():
        raise SidecarError(f"'{name}' is {array.dtype} {array.shape}; expected finite float32 {shape}; {_DAMAGED}")
    return np.ascontiguousarray(array)


def _integers(data: Any, name: str, kind: str) -> NDArray[np.int64]:
    """A column of integers of the kind, at most 32 bits if unsigned, so that sums stay in 64."""
    array = data[name]
    if array.dtype.kind != kind or array.ndim != 1 or (kind == "u" and array.dtype.itemsize > 4):
        raise SidecarError(f"'{name}' is {array.dtype} {array.shape}; expected a list of integers; {_DAMAGED}")
    return np.asarray(array, np.int64)


def _running(data: Any, name: str, low: int, high: int) -> NDArray[np.int32]:
    """Running sums of stored differences, all in ``low <= value < high``."""
    array = data[name]
    if array.dtype.kind != "i" or array.dtype.itemsize > 4 or array.ndim != 1:
        raise SidecarError(f"'{name}' is {array.dtype} {array.shape}; expected a list of differences; {_DAMAGED}")
    values = np.cumsum(array, dtype=np.int64)
    if (values < low).any() or (values >= high).any():
        raise SidecarError(f"'{name}' leaves the range from {low} to {high - 1}; {_DAMAGED}")
    return values.astype(np.int32)
