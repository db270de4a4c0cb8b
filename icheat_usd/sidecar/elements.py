"""Payloads to and from elements: one reader per (type, version), upgrades in steps, writers for the newest only."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from icheat_usd.edits.model import MaskedSurface, Payload, SurfaceMask, Value
from icheat_usd.errors import SidecarError
from icheat_usd.sidecar.canonical import Array, Element, digest_of

#: Elements this version understands, by name in the payload, and the type each must have.
SLOTS = {
    "recipe": "recipe",
    "receiver-mask": "surface-mask",
    "caster-mask": "surface-mask",
    "scale-delta": "scale-delta",
    "made-against": "made-against",
}

Reader = Callable[[Element, str], Any]
Step = Callable[[Element], Element]

_READERS: dict[tuple[str, int], Reader] = {}
_STEPS: dict[tuple[str, int], Step] = {}


def reads(type_: str, version: int) -> Callable[[Reader], Reader]:
    """Register the decoder of one element type at one version; it receives the element and the anchor."""

    def register(reader: Reader) -> Reader:
        _READERS[type_, version] = reader
        return reader

    return register


def upgrades(type_: str, version: int) -> Callable[[Step], Step]:
    """Register the step that turns an element of `version` into one of ``version + 1``.

    An element is stepped up as long as there are steps, then decoded; a new
    version needs one step and one reader, and no older reader changes.
    """

    def register(step: Step) -> Step:
        _STEPS[type_, version] = step
        return step

    return register


def newest_version(type_: str) -> int:
    """Highest version of an element type that can be read; 0 for an unknown type."""
    known = [version for name, version in (*_READERS, *_STEPS) if name == type_]
    return max(known, default=0)


def check_known(name: str, type_: str, version: int, where: str) -> None:
    """Refuse an element that has a known purpose but an unknown type, or a version newer than this package reads.

    Raises
    ------
    SidecarError
        It names the element and asks for an update.
    """
    if name in SLOTS and (type_ != SLOTS[name] or version > newest_version(type_)):
        raise SidecarError(
            f"{where}: element '{name}' is {type_} version {version}, and this icheat_usd reads {SLOTS[name]} up to "
            f"version {newest_version(SLOTS[name])}; update icheat_usd"
        )


def upgraded(element: Element) -> Element:
    """The element after every registered step from its version on."""
    while (step := _STEPS.get((element.type, element.version))) is not None:
        after = step(element)
        if (after.type, after.version) != (element.type, element.version + 1):
            raise AssertionError(
                f"the step from {element.type} {element.version} leads to {after.type} {after.version}"
            )
        element = after
    return element


def payload_digest(payload: Payload, *, anchor: str) -> str:
    """The token that names a payload in `icheat:payload`: SHA-256 of its canonical bytes.

    Raises
    ------
    SidecarError
        The payload cannot be written; see `encode_payload`.
    """
    return digest_of(encode_payload(payload, anchor=anchor))


def decode_payload(elements: Mapping[str, Element], *, anchor: str, where: str) -> Payload:
    """Elements to a payload with absolute surface paths.

    Parameters
    ----------
    elements : mapping of element name to Element
    anchor : str
        Absolute prim path that the surface paths of the file are relative to.
    where : str
        File and payload, for messages.

    Raises
    ------
    SidecarError
        An element is newer than this version, lacks a part or has a value out of range.
    """
    check_anchor(anchor)
    decoded: dict[str, Any] = {}
    unknown: dict[str, Element] = {}
    for name, element in elements.items():
        if name not in SLOTS:
            unknown[name] = element
            continue
        check_known(name, element.type, element.version, where)
        element = upgraded(element)
        try:
            decoded[name] = _READERS[element.type, element.version](element, anchor)
        except KeyError as problem:
            raise SidecarError(
                f"{where}: element '{name}' ({element.type} version {element.version}) lacks {problem}; "
                "restore the file from a copy"
            ) from problem
        except SidecarError as problem:
            raise SidecarError(f"{where}: element '{name}': {problem}") from problem
    if "recipe" not in decoded:
        raise SidecarError(f"{where}: the payload has no element 'recipe'; restore the file from a copy")
    operation, parameters = decoded["recipe"]
    return Payload(
        operation=operation,
        parameters=parameters,
        receiver_mask=decoded.get("receiver-mask"),
        caster_mask=decoded.get("caster-mask"),
        scale_delta=decoded.get("scale-delta"),
        made_against=decoded.get("made-against", MappingProxyType({})),
        unknown=MappingProxyType(unknown),
    )


def encode_payload(payload: Payload, *, anchor: str) -> dict[str, Element]:
    """A payload to elements of the newest versions, surface paths relative to the anchor.

    Raises
    ------
    SidecarError
        A surface lies outside the anchor, a number is not finite, a mask does
        not fit its surfaces, or a name or text cannot be stored.
    """
    check_anchor(anchor)
    elements: dict[str, Element] = {}
    recipe: dict[str, Array] = {"operation": text(payload.operation, "the operation")}
    for key, value in payload.parameters.items():
        recipe[f"parameters/{escaped(key)}"] = _parameter(key, value)
    elements["recipe"] = Element("recipe", 1, recipe)
    for name, mask in (("receiver-mask", payload.receiver_mask), ("caster-mask", payload.caster_mask)):
        if mask is not None:
            elements[name] = _surface_mask(name, mask, anchor)
    if payload.scale_delta is not None:
        rgb = _floats(payload.scale_delta, "scale_delta")
        if rgb.shape != (3,):
            raise SidecarError(f"scale_delta has {rgb.size} components; give red, green and blue")
        elements["scale-delta"] = Element("scale-delta", 1, {"rgb": rgb})
    if payload.made_against:
        facts = {escaped(key): _fact(key, value) for key, value in payload.made_against.items()}
        elements["made-against"] = Element("made-against", 1, facts)
    for name, element in payload.unknown.items():
        if name in SLOTS or not isinstance(element, Element):
            raise SidecarError(f"unknown element '{name}' is not one that a sidecar reader kept; leave it out")
        elements[name] = element
    return elements


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


# Writers, newest version of each type ---------------------------------------------------------------------------------


def _parameter(key: str, value: Value) -> Array:
    if isinstance(value, (bool, np.bool_)):
        return np.array(bool(value))
    if isinstance(value, str):
        return text(value, f"parameter '{key}'")
    if isinstance(value, (tuple, list)):
        return _floats(value, f"parameter '{key}'")
    return _floats(value, f"parameter '{key}'").reshape(())


def _fact(key: str, value: str | float | int) -> Array:
    if isinstance(value, str):
        return text(value, f"made_against '{key}'")
    if isinstance(value, (bool, np.bool_)):
        return np.array(bool(value))
    if isinstance(value, (int, np.integer)):
        if not -(2**63) <= value < 2**63:
            raise SidecarError(f"made_against '{key}' is {value}, beyond 64 bits; store it as text")
        return np.array(int(value), dtype=np.int64)
    return _floats(value, f"made_against '{key}'").reshape(())


def _floats(value: Any, what: str) -> NDArray[np.float64]:
    try:
        numbers = np.array([float(v) for v in (value if isinstance(value, (tuple, list)) else (value,))], np.float64)
    except (TypeError, ValueError, OverflowError) as problem:
        raise SidecarError(f"{what} is {value!r}; expected a number, a flag, text or a tuple of numbers") from problem
    if not np.isfinite(numbers).all():
        raise SidecarError(f"{what} is {value!r}; expected finite numbers")
    return numbers + 0.0  # -0.0 becomes 0.0


def _surface_mask(name: str, mask: SurfaceMask, anchor: str) -> Element:
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
        "surface-path": _texts(relative_paths([s.path for s in mask.surfaces], anchor), f"{name}: a surface path"),
        "surface-part": _texts([s.part for s in mask.surfaces], f"{name}: a part"),
        "surface-instance-id": np.array([s.instance_id for s in mask.surfaces], dtype=np.int64),
        "surface-n-faces": np.array([s.n_faces for s in mask.surfaces], dtype=np.int64),
        "surface-topology-digest": _texts([s.topology_digest for s in mask.surfaces], f"{name}: a topology digest"),
        "texels": _smallest_exact(texels),
    }
    return Element("surface-mask", 1, datasets)


def _smallest_exact(texels: NDArray[np.float32]) -> Array:
    for dtype, steps in ((np.uint8, 255), (np.uint16, 65535)):
        whole = np.rint(texels * np.float32(steps))
        if np.array_equal(whole / np.float32(steps), texels):
            return whole.astype(dtype)
    return texels + np.float32(0)  # -0.0 becomes 0.0


def text(value: str, what: str) -> Array:
    """Text as a NumPy bytes scalar array."""
    return _texts([value], what)[0:1].reshape(())


def _texts(values: list[str], what: str) -> Array:
    try:
        encoded = [value.encode() for value in values]
    except UnicodeEncodeError as problem:
        raise SidecarError(f"{what} is not valid text ({problem.reason}); use Unicode without surrogates") from problem
    if any(b"\0" in item for item in encoded):
        raise SidecarError(f"{what} contains a null character; remove it")
    return np.array(encoded, dtype=f"S{max([1, *map(len, encoded)])}")


def escaped(key: str) -> str:
    """A parameter's or fact's name as an HDF5 link name: '%', '/' and a lone '.' are percent-encoded."""
    if not key or "\0" in key:
        raise SidecarError(f"{key!r} cannot name a value; use at least one character and no null")
    try:
        key.encode()
    except UnicodeEncodeError as problem:
        raise SidecarError(f"{key!r} is not valid text; use Unicode without surrogates") from problem
    name = key.replace("%", "%25").replace("/", "%2F")
    return "%2E" if name == "." else name


def _unescaped(name: str) -> str:
    return name.replace("%2E", ".").replace("%2F", "/").replace("%25", "%")


# Readers --------------------------------------------------------------------------------------------------------------


@reads("recipe", 1)
def _read_recipe(element: Element, anchor: str) -> tuple[str, Mapping[str, Value]]:
    parameters: dict[str, Value] = {}
    for path, array in element.datasets.items():
        folder, _, name = path.partition("/")
        if folder == "parameters" and name:
            parameters[_unescaped(name)] = _read_value(path, array)
    return _read_text(element, "operation"), MappingProxyType(parameters)


@reads("scale-delta", 1)
def _read_scale_delta(element: Element, anchor: str) -> tuple[float, float, float]:
    rgb = element.datasets["rgb"]
    if rgb.shape != (3,) or rgb.dtype.kind != "f" or not np.isfinite(rgb).all():
        raise SidecarError(f"'rgb' is {rgb.dtype} {rgb.shape}; expected three finite numbers")
    return float(rgb[0]), float(rgb[1]), float(rgb[2])


@reads("made-against", 1)
def _read_made_against(element: Element, anchor: str) -> Mapping[str, str | float | int]:
    facts: dict[str, str | float | int] = {}
    for path, array in element.datasets.items():
        value = _read_value(path, array)
        if isinstance(value, tuple):
            raise SidecarError(f"'{path}' is a list; expected one text or number")
        facts[_unescaped(path)] = value
    return MappingProxyType(facts)


@reads("surface-mask", 1)
def _read_surface_mask(element: Element, anchor: str) -> SurfaceMask:
    paths = _read_texts(element, "surface-path")
    parts = _read_texts(element, "surface-part")
    digests = _read_texts(element, "surface-topology-digest")
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
    return SurfaceMask(surfaces, np.ascontiguousarray(texels))


def _read_value(path: str, array: Array) -> Value:
    if array.dtype.kind == "S" and array.ndim == 0:
        return _utf8(array.tobytes().rstrip(b"\0"), path)
    if array.dtype.kind == "b" and array.ndim == 0:
        return bool(array)
    if array.dtype.kind in "iu" and array.ndim == 0:
        return int(array)
    if array.dtype.kind == "f" and array.ndim <= 1 and np.isfinite(array).all():
        return float(array) if array.ndim == 0 else tuple(float(v) for v in array)
    raise SidecarError(f"'{path}' is {array.dtype} {array.shape}; expected a finite number, a flag, text or a list")


def _read_text(element: Element, path: str) -> str:
    values = _read_texts(element, path)
    if element.datasets[path].ndim != 0:
        raise SidecarError(f"'{path}' is a list; expected one text")
    return values[0]


def _read_texts(element: Element, path: str) -> list[str]:
    array = element.datasets[path]
    if array.dtype.kind != "S" or array.ndim > 1:
        raise SidecarError(f"'{path}' is {array.dtype} {array.shape}; expected text")
    return [_utf8(item, path) for item in array.reshape(-1).tolist()]


def _utf8(encoded: bytes, path: str) -> str:
    try:
        return encoded.decode()
    except UnicodeDecodeError as problem:
        raise SidecarError(f"'{path}' is not valid UTF-8; restore the file from a copy") from problem
