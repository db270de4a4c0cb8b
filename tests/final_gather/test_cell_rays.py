"""Rays to gather cells in one pass: against the same rays made, traced and looked up one step after another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icheat_usd.edits.model import Edit
from icheat_usd.final_gather import gatherer
from icheat_usd.final_gather.cell_rays import CellRays
from icheat_usd.final_gather.hits import trace_hemisphere, trace_hemisphere_to_cells, trace_specular
from icheat_usd.final_gather.lobe_rays import trace_lobe
from icheat_usd.materials import is_glossy, take_points
from tests.pipeline import TINY, Pipeline, select
from tests.relight.test_operations import room
from tests.scenes import Material, cornell_meshes, look_at, make_snapshot

N_RAYS, SEED = 16, 0x5EED
MIRROR, VEIL = Material(diffuse=0.9, metallic=1.0, roughness=0.0), Material(diffuse=0.3, opacity=0.5)


def with_detours():
    """The room with a mirror and a wall that lets half of the light through."""
    odd = {"/low": MIRROR, "/back": VEIL, "/floor": Material(diffuse=0.4, roughness=0.4, ior=1.5)}
    meshes = [replace(mesh, material=odd.get(mesh.path, mesh.material)) for mesh in cornell_meshes()]
    return make_snapshot(meshes, lights=[], camera=look_at((0.1, 0.05, 3.9), (0, 0, 0), fov=41, width=24, height=24))


@pytest.mark.parametrize("scene", [room(24), with_detours()], ids=["plain", "over mirrors and through a veil"])
def test_one_pass_finds_what_single_steps_find(scene):
    parts = Pipeline(scene, n_gather=256, samples_per_pixel=2)
    glossy = np.flatnonzero(is_glossy(parts.view.points))
    points, to_eye = take_points(parts.view.points, glossy), parts.view.to_eye[glossy]
    number = np.arange(len(glossy)) % 2
    draws = np.stack([parts.view.stream[glossy].astype(np.int64), number], axis=1)
    found = trace_lobe(scene, parts.tracer, parts.gather, points, to_eye, draws, N_RAYS, SEED)
    steps = trace_specular(scene, parts.tracer, points, to_eye, draws, N_RAYS, SEED)
    assert found is not None and len(glossy) > 50
    assert (len(found.detour) > 20) == (scene.materials.opacity.min() < 1)
    for name in ("origins", "directions", "reflectance", "throughput"):
        np.testing.assert_array_equal(getattr(found, name), getattr(steps, name), err_msg=name)
    lit = np.flatnonzero(found.throughput.any(axis=1))
    np.testing.assert_array_equal(found.cells(parts.gather)[lit], steps.cells(parts.gather)[lit])
    for one, other in zip(found.ends_of(scene, lit), steps.ends_of(scene, lit), strict=True):
        np.testing.assert_allclose(one, other, atol=2e-5)


@pytest.mark.parametrize("scene", [room(24), with_detours()], ids=["plain", "over mirrors and through a veil"])
def test_hemispheres_in_one_pass_are_those_of_single_steps(scene):
    parts = Pipeline(scene, n_gather=256, samples_per_pixel=2)
    points = parts.view.points
    stream = np.arange(len(points.instance))
    found = trace_hemisphere_to_cells(scene, parts.tracer, parts.gather, points, stream, 2, SEED)
    steps = trace_hemisphere(scene, parts.tracer, points, stream, 2, SEED)
    assert isinstance(found, CellRays) and (len(found.detour) > 20) == (scene.materials.opacity.min() < 1)
    for name in ("origins", "directions", "throughput"):
        np.testing.assert_array_equal(getattr(found, name), getattr(steps, name), err_msg=name)
    lit = np.flatnonzero(found.throughput.any(axis=1))
    assert len(lit) > 0.9 * len(stream)
    np.testing.assert_array_equal(found.cells(parts.gather)[lit], steps.cells(parts.gather)[lit])
    np.testing.assert_allclose(found.distances()[lit], steps.distances()[lit], rtol=1e-5, atol=1e-6)
    for one, other in zip(found.ends_of(scene, lit), steps.ends_of(scene, lit), strict=True):
        np.testing.assert_allclose(one, other, atol=2e-5)


def test_frames_are_those_of_single_steps(monkeypatch):
    edit = Edit("/bleed", "scale", {"color": (3.0, 2.0, 0.5)}, select("/floor", "/tall"), select("/red", "/back"))
    frames = []
    for trace in (trace_lobe, lambda *_: None):
        monkeypatch.setattr(gatherer, "trace_lobe", trace)
        frames.append(Pipeline(room(16), n_gather=256).final(edit, method="cached", samples=1, cache=TINY))
    for layer in ("indirect", "indirect_edited"):
        one, other = (getattr(frame, layer) for frame in frames)
        np.testing.assert_allclose(one, other, atol=1e-4 * other.mean())
    assert (frames[0].indirect != frames[0].indirect_edited).any()
