"""Films to and from OpenEXR.

Channels: `beauty` is R, G, B; `depth` is Z; `normal` is N.X, N.Y, N.Z; any
other colour layer is ``<layer>.R``, ``.G``, ``.B`` and any other scalar layer
the channel ``<layer>``. Metadata are string attributes ``icheat:<key>``.
"""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from icheat_usd.errors import ImageError
from icheat_usd.image.film import F32, Film

#: Rec.709 primaries and the D65 white point: red, green, blue, white (x, y); ITU-R BT.709-6, item 1.3.
CHROMATICITIES_REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
COLOR_INTEROP_ID = "lin_rec709_scene"
METADATA_PREFIX = "icheat:"

_HALF_MAX = 65504.0
_LAYER_NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*", re.ASCII)
_RESERVED = {"R", "G", "B", "A", "X", "Y", "Z", "N"}


def write_exr(film: Film, path: str | os.PathLike[str], *, half: bool = False) -> Path:
    """Write every layer and all metadata of a film.

    Parameters
    ----------
    film : Film
    path : path
        An existing file is replaced only once the new one is complete.
    half : bool
        Store 16-bit floats, clamped to +-65504; depth stays 32-bit, because
        16 bits resolve a room's depth to centimetres only.

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
    channels: dict[str, np.ndarray[Any, Any]] = {}
    for name, pixels in film.layers.items():
        for channel, plane in _planes(name, pixels):
            if half and channel != "Z":
                plane = np.clip(plane, -_HALF_MAX, _HALF_MAX).astype(np.float16)
            # OpenEXR 3.5 ignores NumPy strides: a slice or a flip would be written as other pixels, silently.
            channels[channel] = np.ascontiguousarray(plane)
    if not channels:
        raise ImageError(f"{target}: the film has no layers; render at least one before writing")
    header: dict[str, Any] = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "chromaticities": CHROMATICITIES_REC709,
        "colorInteropID": COLOR_INTEROP_ID,
    }
    header.update({METADATA_PREFIX + key: text for key, text in film.metadata.items()})
    with replacing(target) as temporary:
        try:
            OpenEXR.File(header, channels).write(str(temporary))
        except (RuntimeError, ValueError, TypeError) as problem:
            raise ImageError(f"{target}: OpenEXR could not write the image ({problem})") from problem
    return target


def read_exr(path: str | os.PathLike[str]) -> Film:
    """Read an OpenEXR image, also one that another program wrote.

    Parameters
    ----------
    path : path

    Returns
    -------
    Film
        Pixels of the data window as float32; values are not converted from
        the file's chromaticities. Alpha channels are left out. Of several
        parts, those of the first part's size are merged, the first wins.

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
            parts = [(dict(part.header), {name: c.pixels for name, c in part.channels.items()}) for part in file.parts]
    except (RuntimeError, ValueError, OSError, MemoryError) as problem:
        raise ImageError(f"{source}: OpenEXR could not read the image ({problem}); write it again") from problem
    channels: dict[str, np.ndarray[Any, Any]] = {}
    metadata: dict[str, str] = {}
    for header, planes in parts:
        for name, plane in planes.items():
            if plane is None or plane.ndim != 2 or plane.dtype.kind not in "fu":
                raise ImageError(f"{source}: channel '{name}' is deep or of an unknown type; flatten the image first")
            first = next(iter(channels.values()), plane)
            if plane.shape == first.shape:
                channels.setdefault(name, np.asarray(plane, dtype=np.float32))
            elif planes is parts[0][1]:
                raise ImageError(f"{source}: channel '{name}' is subsampled; store every channel at full size")
        for key, value in header.items():
            if key.startswith(METADATA_PREFIX) and isinstance(value, str):
                metadata.setdefault(key[len(METADATA_PREFIX) :], value)
    # Where pixels are damaged, OpenEXR 3.5 prints a warning and returns a part without channels.
    if not channels or any(len(planes) < len(header["channels"]) for header, planes in parts):
        raise ImageError(f"{source}: the pixels are damaged or cut short; write or copy the image again")
    height, width = next(iter(channels.values())).shape
    return Film(width, height, _layers(channels), metadata)


def _planes(name: str, pixels: F32) -> Iterator[tuple[str, F32]]:
    if not _LAYER_NAME.fullmatch(name) or name.rpartition(".")[2] in _RESERVED:
        raise ImageError(
            f"layer name '{name}' cannot be an EXR channel; use letters, digits, '_' and '.', and do not end in one of "
            f"{', '.join(sorted(_RESERVED))}"
        )
    if pixels.ndim == 2:
        yield ("Z" if name == "depth" else name), pixels
        return
    if name == "depth":
        raise ImageError("layer 'depth' has three components; depth is one number per pixel")
    prefix, components = {"beauty": ("", "RGB"), "normal": ("N.", "XYZ")}.get(name, (name + ".", "RGB"))
    for index, component in enumerate(components):
        yield prefix + component, pixels[..., index]


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


@contextmanager
def replacing(target: Path) -> Iterator[Path]:
    """A temporary file beside `target` that takes its place when the block ends well and vanishes otherwise.

    Raises
    ------
    ImageError
        The folder is missing or cannot be written.
    """
    if not target.parent.is_dir():
        raise ImageError(f"{target}: there is no folder '{target.parent}'; make it first or choose another path")
    if target.is_dir():
        raise ImageError(f"{target}: is a folder; name a file in it")
    try:
        # Opened by name with the usual mode, not by mkstemp, so that the umask decides who may read the image.
        temporary = target.parent / f".{target.name}.{secrets.token_hex(4)}.tmp"
        temporary.touch(exist_ok=False)
    except OSError as problem:
        raise ImageError(
            f"{target}: cannot write in this folder ({problem.strerror}); choose another path"
        ) from problem
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as problem:
        raise ImageError(f"{target}: cannot write the image ({problem.strerror or problem})") from problem
    finally:
        temporary.unlink(missing_ok=True)
