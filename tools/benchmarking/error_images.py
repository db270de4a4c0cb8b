"""Errors as images to look at: red is too bright, blue too dark."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from icheat_usd.image.png import encode_png
from icheat_usd.samples import ViewSamples
from icheat_usd.scene import F32
from tools.benchmarking.converged import Probe

_BLOCK = 4  # pixels along a side, in sheets

_FULL = 0.08  # relative to the root mean square of the light: four times the goal for compression


def write_error_image(path: Path, off: F32, probe: Probe) -> str:
    """Relative errors (n_pixels, 3) of a probe, one block each."""
    rows, columns = probe.grid
    grid = np.zeros((rows, columns, 3), np.float32)
    seen = np.zeros((rows, columns), bool)
    y, x = probe.pixel // probe.width // probe.block, probe.pixel % probe.width // probe.block
    grid[y, x] = off
    seen[y, x] = True
    image = _signed(grid.mean(axis=2))
    image[~seen] = 40
    return _write(path, np.repeat(np.repeat(image, probe.block, axis=0), probe.block, axis=1))


def write_signed_image(path: Path, values: F32, view: ViewSamples) -> str:
    """Relative errors (n_view, 3) of every view sample."""
    return _write(path, _signed(_developed(view, values).mean(axis=2)))


def write_sheet(path: Path, reference: F32, preview: F32, view: ViewSamples) -> str:
    """Reference, preview and signed difference beside one another at full size, from light of the view samples.

    Both are (n_view, 3), relative. The difference is that of means over blocks of pixels: the reference is noisy.
    """
    images = [_developed(view, values) for values in (reference, preview)]
    off = _block_means((images[1] - images[0]).mean(axis=2), _BLOCK)
    gap = np.full((view.height, 4, 3), 255, np.uint8)
    return _write(path, np.concatenate([_as_light(images[0]), gap, _as_light(images[1]), gap, _signed(off)], axis=1))


def _developed(view: ViewSamples, values: F32) -> np.ndarray:
    """(height, width, 3) of values at the view samples."""
    film = np.zeros((view.width * view.height, 3))
    weight = view.throughput * values
    for channel in range(3):
        film[:, channel] = np.bincount(view.pixel, weight[:, channel], len(film))
    return film.reshape(view.height, view.width, 3)


def _as_light(film: np.ndarray) -> np.ndarray:
    return (255 * np.clip(film / 3, 0, 1) ** (1 / 2.2)).astype(np.uint8)


def _block_means(values: np.ndarray, side: int) -> np.ndarray:
    """Every value in place of the mean of its block."""
    rows, columns = (np.arange(n) // side for n in values.shape)
    block = rows[:, None] * (columns[-1] + 1) + columns
    means = np.bincount(block.reshape(-1), values.reshape(-1)) / np.bincount(block.reshape(-1))
    return np.asarray(means[block])


def _signed(values: F32) -> np.ndarray:
    """White is 0, red above, blue below."""
    share = np.clip(values / _FULL, -1, 1)[..., None]
    red, blue = np.array([202.0, 0.0, 32.0]), np.array([5.0, 113.0, 176.0])
    colour = np.where(share > 0, red, blue)
    return (255 + np.abs(share) * (colour - 255)).astype(np.uint8)


def _write(path: Path, pixels: np.ndarray) -> str:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode_png(np.ascontiguousarray(pixels), srgb=True, text={}))
    return path.name
