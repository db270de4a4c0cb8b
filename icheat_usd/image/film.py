"""A rendered image: named layers of one size, and text that says where they come from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from icheat_usd.errors import ImageError
from icheat_usd.image.cryptomatte import Cryptomatte

F32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Film:
    """Layers of one image, row 0 at the top.

    Parameters
    ----------
    width, height : int, pixels
    layers : mapping of name to (height, width) or (height, width, 3) float32
        Colour layers are scene-linear Rec.709; `depth` is in metres, `normal` a unit vector in world space.
    metadata : mapping of str to str
        Written into files as it is: stage, camera, frame, stack digest, versions.
    mattes : tuple of Cryptomatte
        What each pixel shows, by name.
    pixel_aspect : float
        Width of a pixel over its height.

    Raises
    ------
    ImageError
        A layer or a matte is not float32 or does not have the film's size.
    """

    width: int
    height: int
    layers: Mapping[str, F32]
    metadata: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    mattes: tuple[Cryptomatte, ...] = ()
    pixel_aspect: float = 1.0

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ImageError(f"a film of {self.width} x {self.height} pixels has no pixels; use at least 1 x 1")
        for name, pixels in self.layers.items():
            sizes = ((self.height, self.width), (self.height, self.width, 3))
            if not isinstance(pixels, np.ndarray) or pixels.dtype != np.float32 or pixels.shape not in sizes:
                found = f"{pixels.dtype} {pixels.shape}" if isinstance(pixels, np.ndarray) else type(pixels).__name__
                raise ImageError(
                    f"layer '{name}' is {found}; a {self.width} x {self.height} film holds float32 arrays of shape "
                    f"{sizes[0]} or {sizes[1]}"
                )
        for matte in self.mattes:
            if matte.ranks.dtype != np.float32 or matte.ranks.shape[:2] != (self.height, self.width):
                raise ImageError(
                    f"matte '{matte.name}' is {matte.ranks.dtype} {matte.ranks.shape}; a {self.width} x {self.height}"
                    " film holds float32 arrays of (height, width, ranks, 2)"
                )
        for key, text in self.metadata.items():
            if not isinstance(key, str) or not isinstance(text, str):
                raise ImageError(f"film metadata '{key}' is {type(text).__name__}; convert it to text first")
            if "\0" in key + text or not key:
                raise ImageError(
                    f"film metadata {key!r} is empty or contains a null character, which files cannot hold"
                )
        # The film is frozen: what the caller does with its own dictionaries later stays outside.
        object.__setattr__(self, "layers", MappingProxyType(dict(self.layers)))
        object.__setattr__(self, "metadata", MappingProxyType(dict(self.metadata)))

    def layer(self, name: str) -> F32:
        """One layer by name.

        Raises
        ------
        ImageError
            There is no such layer; the message lists those there are.
        """
        if name not in self.layers:
            raise ImageError(f"the image has no layer '{name}'; it has {', '.join(sorted(self.layers)) or 'none'}")
        return self.layers[name]
