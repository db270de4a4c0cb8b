"""Films to and from OpenEXR.

Channels: `beauty` is R, G, B and `alpha` A; `depth` is Z; `normal` is N.X, N.Y, N.Z; any
other colour layer is ``<layer>.R``, ``.G``, ``.B`` and any other scalar layer
the channel ``<layer>``. Channels have the same names in one part and in many,
so that parts can be put together. Metadata are string attributes ``icheat:<key>``,
and ``cryptomatte/...`` for ID mattes.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from icheat_usd.errors import ImageError
from icheat_usd.image.cryptomatte import Cryptomatte
from icheat_usd.image.film import F32, Film
from icheat_usd.image.replacing import replacing

#: Rec.709 primaries and the D65 white point: red, green, blue, white (x, y); ITU-R BT.709-6, item 1.3.
CHROMATICITIES_REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
COLOR_INTEROP_ID = "lin_rec709_scene"
METADATA_PREFIX = "icheat:"
MATTE_PREFIX = "cryptomatte/"

_HALF_MAX = 65504.0
_LAYER_NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*", re.ASCII)
#: Channels of scalar layers that have names of their own.
_SCALARS = {"depth": "Z", "alpha": "A"}
_RESERVED = {"R", "G", "B", "A", "X", "Y", "Z", "N"}


def write_exr(
    film: Film, path: str | os.PathLike[str], *, half: bool | Collection[str] = False, multipart: bool = False
) -> Path:
    """Write every layer, every matte and all metadata of a film.

    Parameters
    ----------
    film : Film
    path : path
        An existing file is replaced only once the new one is complete.
    half : bool or names of layers
        Store 16-bit floats, clamped to +-65504; depth stays 32-bit, because
        16 bits resolve a room's depth to centimetres only, and so do mattes, whose ids are bits.
    multipart : bool
        A part of its own for each layer and each matte, named like it, so that programs read only what
        they need; programs that know one part only find the first layer.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    ImageError
        The folder is missing or cannot be written, or a layer's name cannot be a channel name.
    """
    target = Path(path)
    parts: dict[str, dict[str, np.ndarray[Any, Any]]] = {}
    for name, pixels in film.layers.items():
        is_half = half if isinstance(half, bool) else name in half
        parts[name] = {channel: _stored(plane, is_half and channel != "Z") for channel, plane in _planes(name, pixels)}
    if "beauty" in parts and "alpha" in parts:
        parts["beauty"] |= parts.pop("alpha")  # where compositors look for it
    for matte in film.mattes:
        parts[matte.name] = {channel: _stored(plane, False) for channel, plane in matte.planes.items()}
    if not parts:
        raise ImageError(f"{target}: the film has no layers; render at least one before writing")
    if not multipart:
        parts = {"": {channel: plane for planes in parts.values() for channel, plane in planes.items()}}
    header: dict[str, Any] = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "chromaticities": CHROMATICITIES_REC709,
        "colorInteropID": COLOR_INTEROP_ID,
        "pixelAspectRatio": float(film.pixel_aspect),
    }
    header.update({METADATA_PREFIX + key: text for key, text in film.metadata.items()})
    mattes = {matte.name: matte.metadata for matte in film.mattes}
    with replacing(target) as temporary:
        try:
            written = []
            for index, (name, channels) in enumerate(parts.items()):
                # In the first part too: many programs take metadata from there alone.
                about = {
                    key: text for of, found in mattes.items() if index == 0 or of == name for key, text in found.items()
                }
                written.append(OpenEXR.Part({**header, **about}, channels, name))
            OpenEXR.File(written).write(str(temporary))
        except (RuntimeError, ValueError, TypeError) as problem:
            raise ImageError(f"{target}: OpenEXR could not write the image ({problem})") from problem
    return target


def _stored(plane: F32, half: bool) -> np.ndarray[Any, Any]:
    # OpenEXR 3.5 ignores NumPy strides: a slice or a flip would be written as other pixels, silently.
    return np.ascontiguousarray(np.clip(plane, -_HALF_MAX, _HALF_MAX).astype(np.float16) if half else plane)


def read_exr(path: str | os.PathLike[str]) -> Film:
    """Read an OpenEXR image, also one that another program wrote.

    Parameters
    ----------
    path : path

    Returns
    -------
    Film
        Pixels of the data window as float32; values are not converted from
        the file's chromaticities. Alpha channels of other programs are left out.
        Parts of the first part's size are put together; a channel
        whose name is taken gets the part's before its own.

    Raises
    ------
    ImageError
        The file is missing, not OpenEXR, damaged, deep or subsampled.
    """
    source = Path(path)
    if not source.is_file():
        raise ImageError(f"{source}: there is no such image; check the path")
    try:
        if not OpenEXR.isOpenExrFile(str(source)):
            raise ImageError(f"{source}: not an OpenEXR file; convert it to .exr first")
        with OpenEXR.File(str(source), separate_channels=True) as file:
            parts = [
                (part.name() or "", dict(part.header), {name: c.pixels for name, c in part.channels.items()})
                for part in file.parts
            ]
    except (RuntimeError, ValueError, OSError, MemoryError) as problem:
        raise ImageError(f"{source}: OpenEXR could not read the image ({problem}); write it again") from problem
    channels: dict[str, np.ndarray[Any, Any]] = {}
    metadata: dict[str, str] = {}
    for part, header, planes in parts:
        for name, plane in planes.items():
            if plane is None or plane.ndim != 2 or plane.dtype.kind not in "fu":
                raise ImageError(f"{source}: channel '{name}' is deep or of an unknown type; flatten the image first")
            first = next(iter(channels.values()), plane)
            if plane.shape == first.shape:
                own = f"{part}.{name}" if name in channels and part else name
                channels.setdefault(own, np.asarray(plane, dtype=np.float32))
            elif planes is parts[0][2]:
                raise ImageError(f"{source}: channel '{name}' is subsampled; store every channel at full size")
        for key, value in header.items():
            if isinstance(value, str) and key.startswith((METADATA_PREFIX, MATTE_PREFIX)):
                metadata.setdefault(key, value)
    # Where pixels are damaged, OpenEXR 3.5 prints a warning and returns a part without channels.
    if not channels or any(len(planes) < len(header["channels"]) for _, header, planes in parts):
        raise ImageError(f"{source}: the pixels are damaged or cut short; write or copy the image again")
    height, width = next(iter(channels.values())).shape
    mattes = tuple(_mattes(metadata, channels))
    alpha = channels.pop("A", None) if any(key.startswith(METADATA_PREFIX) for key in metadata) else None
    own = {key.removeprefix(METADATA_PREFIX): text for key, text in metadata.items() if key.startswith(METADATA_PREFIX)}
    aspect = float(parts[0][1].get("pixelAspectRatio", 1.0))
    layers = _layers(channels) | ({} if alpha is None else {"alpha": alpha})
    return Film(width, height, layers, own, mattes, aspect)


def _planes(name: str, pixels: F32) -> Iterator[tuple[str, F32]]:
    if not _LAYER_NAME.fullmatch(name) or name.rpartition(".")[2] in _RESERVED:
        raise ImageError(
            f"layer name '{name}' cannot be an EXR channel; use letters, digits, '_' and '.', and do not end in one of "
            f"{', '.join(sorted(_RESERVED))}"
        )
    if pixels.ndim == 2:
        yield _SCALARS.get(name, name), pixels
        return
    if name in _SCALARS:
        raise ImageError(f"layer '{name}' has three components; {name} is one number per pixel")
    prefix, components = {"beauty": ("", "RGB"), "normal": ("N.", "XYZ")}.get(name, (name + ".", "RGB"))
    for index, component in enumerate(components):
        yield prefix + component, pixels[..., index]


def _mattes(metadata: Mapping[str, str], channels: dict[str, np.ndarray[Any, Any]]) -> Iterator[Cryptomatte]:
    """Take the channels of ID mattes out of those of an image."""
    for key, name in metadata.items():
        if not (key.startswith(MATTE_PREFIX) and key.endswith("/name")):
            continue
        own = sorted(
            (found for found in channels if re.fullmatch(re.escape(name) + r"\d\d\.[RGBA]", found)),
            key=lambda found: (found[:-1], "RGBA".index(found[-1])),
        )
        if own and len(own) % 2 == 0:
            flat = np.stack([channels.pop(found) for found in own], axis=-1)
            yield Cryptomatte(name, flat.reshape(*flat.shape[:2], -1, 2), _manifest(metadata, key))


def _manifest(metadata: Mapping[str, str], key: str) -> dict[str, str]:
    try:
        found = json.loads(metadata.get(key.removesuffix("name") + "manifest", "{}"))
    except ValueError:
        return {}  # Names are a service: ids work without them.
    return {str(name): str(bits) for name, bits in found.items()} if isinstance(found, dict) else {}


def _layers(channels: dict[str, np.ndarray[Any, Any]]) -> dict[str, F32]:
    """Group flat channels into layers; what forms no colour or vector stays a scalar layer of its own name."""
    layers: dict[str, F32] = {}
    groups: dict[str, set[str]] = {}
    for name in channels:
        prefix, _, component = name.rpartition(".")
        groups.setdefault(prefix, set()).add(component)
    taken: set[str] = set()
    for prefix, components in groups.items():
        dot = prefix + "." if prefix else ""
        for triple in ("RGB", "XYZ"):
            if components >= set(triple):
                layer = {("", "RGB"): "beauty", ("N", "XYZ"): "normal"}.get((prefix, triple), prefix or triple)
                names = [dot + component for component in triple]
                layers[layer] = np.stack([channels[name] for name in names], axis=-1)
                taken.update(names)
                if triple == "RGB":
                    taken.add(dot + "A")
    for name, plane in channels.items():
        if name not in taken:
            layers["depth" if name == "Z" else name] = np.ascontiguousarray(plane)
    return layers
