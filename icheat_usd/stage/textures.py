"""Texture files named by a stage, decoded to scene-linear texels."""

from __future__ import annotations

import os

import numpy as np
from pxr import Ar, Sdf

from icheat_usd.errors import ImageError
from icheat_usd.image.texture import StoredImage, read_texture
from icheat_usd.scene import F32, F64, Textures
from icheat_usd.stage.reporting import Reporter

#: UsdUVTexture's wrap tokens as the codes of `Textures.wrap`.
WRAP = {"repeat": 0, "clamp": 1, "mirror": 2, "black": 3}

#: Infinite texels (a sun in a half-float sky) are held at the largest half float, so that sums stay finite.
LARGEST = 65504.0


def decode_srgb(encoded: F32) -> F32:
    """Linear values of sRGB-encoded ones: the piecewise curve of IEC 61966-2-1, odd about zero."""
    magnitude = np.abs(encoded)
    curve = ((np.maximum(magnitude, 0.04045) + 0.055) / 1.055) ** 2.4
    return np.copysign(np.where(magnitude <= 0.04045, magnitude / 12.92, curve), encoded).astype(np.float32)


def to_linear_rgba(image: StoredImage, color_space: str) -> F32:
    """Texels as ``(height, width, 4) float32``, scene-linear Rec.709 with alpha as stored.

    Parameters
    ----------
    image
        One channel becomes grey, two become grey and alpha, missing alpha is 1.
    color_space
        UsdUVTexture's sourceColorSpace: "raw", "sRGB" or "auto", which decodes images of
        8 bits and three or four channels unless the file says that it is linear.
    """
    pixels = image.pixels
    channels = pixels.shape[2]
    rgba = np.ones((*pixels.shape[:2], 4), np.float32)
    rgba[..., :3] = pixels[..., :3] if channels >= 3 else pixels[..., :1]
    if channels in (2, 4) or channels > 4:
        rgba[..., 3] = pixels[..., 1 if channels == 2 else 3]
    automatic = image.is_8bit and channels in (3, 4) and image.color_space != "linear"
    if color_space == "sRGB" or (color_space != "raw" and automatic):
        if image.is_8bit:
            lookup = decode_srgb(np.arange(256, dtype=np.float32) / np.float32(255.0))
            for channel in range(3):
                codes = rgba[..., channel] * np.float32(255.0) + np.float32(0.5)  # truncation below then rounds
                rgba[..., channel] = lookup[codes.astype(np.uint8)]
        else:
            rgba[..., :3] = decode_srgb(rgba[..., :3])
    if not image.is_8bit:
        np.nan_to_num(rgba, copy=False, nan=0.0, posinf=LARGEST, neginf=-LARGEST)
    return rgba


class TextureLibrary:
    """Texture images of one snapshot: each file and colour space is read once.

    Parameters
    ----------
    report
        Where files that cannot be read are noted.
    """

    def __init__(self, report: Reporter | None = None) -> None:
        self.report = Reporter() if report is None else report
        self._images: list[F32] = []
        self._means: dict[int, F64] = {}
        self._file_wrap: list[tuple[str, str]] = []
        self._image_of: dict[tuple[object, ...], int] = {}
        self._rows: list[tuple[int, int, int]] = []  # image, wrap s, wrap t
        self._row_of: dict[tuple[int, int, int], int] = {}
        self._table: Textures | None = None  # the texels of a scene are worth copying once only

    def __len__(self) -> int:
        return len(self._rows)

    def add(
        self,
        asset: Sdf.AssetPath | str,
        color_space: str = "auto",
        wrap_s: str = "useMetadata",
        wrap_t: str = "useMetadata",
        fallback: tuple[float, float, float, float] | None = None,
        *,
        prim_path: str = "",
    ) -> int:
        """Row of `Textures` for one file, colour space and pair of wrap modes.

        Parameters
        ----------
        asset
            The file; an asset path must come from its attribute, so that it is resolved there.
        color_space
            "auto", "raw" or "sRGB", see `to_linear_rgba`.
        wrap_s, wrap_t
            UsdUVTexture tokens; "useMetadata" asks the file, and is "black" where the file has no answer.
        fallback
            Linear RGBA of the single texel that stands in for a file that cannot be read.
        prim_path
            Who asks, for findings.

        Returns
        -------
        int
            -1 where the file cannot be read and there is no `fallback`; a finding says why.
        """
        image = self._image(asset, color_space if color_space in ("raw", "sRGB") else "auto", prim_path)
        if image < 0:
            if fallback is None:
                return -1
            image = self._store(
                ("fallback", *fallback), np.array(fallback, np.float32).reshape(1, 1, 4), ("repeat", "repeat")
            )
            wrap_s = wrap_t = "repeat"
        modes = [
            WRAP.get(token or "black", WRAP["black"])
            for token in (
                self._file_wrap[image][axis] if mode in ("", "useMetadata") else mode
                for axis, mode in enumerate((wrap_s, wrap_t))
            )
        ]
        row = (image, modes[0], modes[1])
        if row not in self._row_of:
            self._row_of[row] = len(self._rows)
            self._rows.append(row)
            self._table = None
        return self._row_of[row]

    def mean(self, row: int) -> F64:
        """Mean texel of a row as ``(4,) float64``, linear RGBA."""
        image = self._rows[row][0]
        if image not in self._means:
            # Row by row, so that no double-precision copy of the image is made.
            self._means[image] = self._images[image].mean(axis=1).mean(axis=0, dtype=np.float64)
        return self._means[image]

    def table(self) -> Textures:
        """Everything added so far; rows that differ only in wrapping share their texels."""
        if self._table is None:
            self._table = self._join()
        return self._table

    def _join(self) -> Textures:
        sizes = [image.shape[0] * image.shape[1] for image in self._images]
        first = np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)])
        images = [row[0] for row in self._rows]
        return Textures(
            texels=np.concatenate([np.zeros((0, 4), np.float32), *(image.reshape(-1, 4) for image in self._images)]),
            begin=np.array([first[image] for image in images], np.int64),
            width=np.array([self._images[image].shape[1] for image in images], np.int32),
            height=np.array([self._images[image].shape[0] for image in images], np.int32),
            wrap=np.array([row[1:] for row in self._rows], np.int32).reshape(-1, 2),
        )

    def _image(self, asset: Sdf.AssetPath | str, color_space: str, prim_path: str) -> int:
        authored = asset.path if isinstance(asset, Sdf.AssetPath) else asset
        resolved = asset.resolvedPath if isinstance(asset, Sdf.AssetPath) else asset
        key = (resolved or authored, color_space)
        if key in self._image_of:
            return self._image_of[key]
        if not authored:
            self.report(prim_path, "texture file", "it names no texture file; its fallback is used.")
            return -1
        if "<UDIM>" in authored:
            self.report(
                prim_path, "udim", f"{authored} is a set of UDIM tiles, which are not supported; the fallback is used."
            )
            return self._remember(key, -1)
        if not resolved:
            self.report(
                prim_path,
                f"texture {authored}",
                f"the texture file {authored} does not exist; the fallback is used. Restore the file or its path.",
            )
            return self._remember(key, -1)
        try:
            stored = read_texture(asset_content(resolved), resolved)
        except ImageError as error:
            self.report(prim_path, f"texture {authored}", f"{error} The fallback is used.")
            return self._remember(key, -1)
        return self._store(key, to_linear_rgba(stored, color_space), stored.wrap)

    def _store(self, key: tuple[object, ...], texels: F32, wrap: tuple[str, str]) -> int:
        if key not in self._image_of:
            self._images.append(np.ascontiguousarray(texels))
            self._file_wrap.append(wrap)
            self._remember(key, len(self._images) - 1)
        return self._image_of[key]

    def _remember(self, key: tuple[object, ...], image: int) -> int:
        self._image_of[key] = image
        return image


def asset_content(resolved: str) -> str | bytes:
    """A path to read from disk, or the bytes of an asset that lives elsewhere, such as in a usdz package."""
    if os.path.exists(resolved):
        return resolved
    asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(resolved))
    if not asset:
        raise ImageError(f"{resolved} cannot be opened; check the asset or package.")
    return bytes(asset.GetBuffer())
