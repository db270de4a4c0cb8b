"""Renders what `luxcore_peer` describes: a program of its own, as LuxCore replaces the allocator of its process.

python luxcore_child.py DESCRIPTION IMAGES

It loads nothing of this project, and NumPy before LuxCore, which fails the other way round.
"""

from __future__ import annotations

import os
import pickle
import sys
import time
from typing import Any

import numpy as np
import pyluxcore


def main(description: str, images: str) -> None:
    with open(description, "rb") as file:
        told = pickle.load(file)
    pyluxcore.Init()
    scene = pyluxcore.Scene()
    scene.Parse(_properties(told["scene"]))
    for mesh in told["meshes"]:
        _define(scene, **mesh)
    found: dict[str, Any] = {"seconds": []}
    for i, settings in enumerate(told["renders"]):
        start = time.perf_counter()
        found[f"image{i}"] = _render(scene, settings)
        found["seconds"].append(time.perf_counter() - start)
    np.savez(images, **found)
    # What LuxCore does when it is unloaded may crash.
    sys.stdout.flush()
    os._exit(0)


def _define(scene: Any, name: str, corners: np.ndarray, colors: np.ndarray | None, material: str) -> None:
    points = [tuple(map(float, point)) for point in corners.reshape(-1, 3)]
    triangles = [(3 * i, 3 * i + 1, 3 * i + 2) for i in range(len(points) // 3)]
    of_points = None if colors is None else [tuple(map(float, x)) for x in colors]
    scene.DefineMesh(name, points, triangles, None, None, of_points, None)
    scene.Parse(_properties({f"scene.objects.{name}.shape": name, f"scene.objects.{name}.material": material}))


def _render(scene: Any, settings: dict[str, Any]) -> np.ndarray:
    """All light (height, width, 3), from the top."""
    session = pyluxcore.RenderSession(pyluxcore.RenderConfig(_properties(settings), scene))
    session.Start()
    while not session.HasDone():  # which is found out by looking at the statistics
        time.sleep(0.005)
        session.UpdateStats()
    width, height = settings["film.width"], settings["film.height"]
    image = np.zeros(width * height * 3, np.float32)
    session.GetFilm().GetOutputFloat(pyluxcore.FilmOutputType.RGB, image, 0)
    session.Stop()
    # From the bottom up, and one row too low: found by comparing with other renderers.
    rows = image.reshape(height, width, 3)[::-1]
    return np.concatenate([rows[1:], rows[-1:]])


def _properties(values: dict[str, Any]) -> Any:
    properties = pyluxcore.Properties()
    for name, value in values.items():
        properties.Set(pyluxcore.Property(name, value))
    return properties


if __name__ == "__main__":
    main(*sys.argv[1:])
