"""Rows behind occluders: they complete the rows of the scene to those of the scene without the occluders."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icheat_usd.scene import SceneSnapshot
from icheat_usd.tracing import build_tracer
from icheat_usd.transport import HeldBack, build_transport
from icheat_usd.transport.sparse import SparseRows
from tests.pipeline import Pipeline
from tests.scenes import Material, cornell_meshes, look_at, make_snapshot, soup


def scene() -> SceneSnapshot:
    meshes = [
        replace(mesh, material=Material(0.4, roughness=0.4, ior=1.5)) if mesh.path == "/floor" else mesh
        for mesh in cornell_meshes()
    ]
    return make_snapshot(meshes, camera=look_at((0.1, 0.05, 3.9), (0, 0, 0), fov=41, width=8, height=8))


def hidden(snapshot: SceneSnapshot, path: str) -> np.ndarray:
    surface = [s.path for s in snapshot.surfaces].index(path)
    return snapshot.geometry.instance_surface == surface


def dense(rows: SparseRows) -> np.ndarray:
    result = np.zeros(rows.shape)
    for i in range(rows.n_rows):
        entries = slice(rows.indptr[i], rows.indptr[i + 1])
        np.add.at(result[i], rows.indices[entries], rows.weights[entries])
    return result


@pytest.mark.parametrize("engine", ["embree", "reference"])
@pytest.mark.parametrize("spacing", [1, 3])
def test_rows_and_what_is_held_back_are_the_rows_without_the_occluder(engine, spacing):
    parts = Pipeline(scene(), n_gather=300, rays=64, row_spacing=spacing, engine=engine)
    occluder = hidden(parts.snapshot, "/tall")
    samples = np.flatnonzero(~occluder[parts.view.points.instance])
    held = HeldBack(parts.snapshot, parts.tracer, parts.view, parts.gather, parts.transport).rows(samples, occluder)
    clear = build_transport(
        parts.snapshot,
        build_tracer(parts.snapshot, engine, hidden=occluder),
        parts.view,
        parts.gather,
        rays_per_row=64,
        row_spacing=spacing,
    )
    # Rows that start on the occluder itself, which is in sight of the camera, are those of neither.
    rows = np.flatnonzero(~occluder[parts.view.points.instance[parts.transport.row_view]])
    columns = dense_columns(parts, occluder)
    assert [lobe.name for lobe in held] == ["diffuse", "specular_base", "specular_edge"]
    assert sum(dense(lobe.rows)[rows].sum() for lobe in held) > 0.5
    for whole, behind, without in zip(parts.transport.lobes, held, clear.lobes, strict=True):
        seen = dense(whole.rows)
        seen[:, columns] = 0
        behind_rows = dense(behind.rows)
        np.testing.assert_allclose(seen[rows] + behind_rows[rows], dense(without.rows)[rows], atol=1e-6)


def dense_columns(parts: Pipeline, occluder: np.ndarray) -> np.ndarray:
    """Cells that lie on the occluder."""
    return np.flatnonzero(occluder[parts.gather.points.instance])


def test_hidden_instances_are_gone_and_the_others_keep_their_numbers():
    mesh = soup(60)
    shifts = [np.eye(4) + np.pad([[x], [0], [0]], ((0, 1), (3, 0))) for x in (-4, 0, 4)]
    snapshot = make_snapshot([replace(mesh, transforms=shifts, path="/soup")])
    origins = np.random.default_rng(1).uniform(-6, 6, (400, 3)).astype(np.float32)
    towards = np.random.default_rng(2).normal(size=(400, 3)).astype(np.float32)
    gone = np.array([False, True, False])
    found = [
        build_tracer(snapshot, engine, hidden=gone).intersect(origins, towards).instance
        for engine in ("embree", "reference")
    ]
    np.testing.assert_array_equal(*found)
    assert set(found[0]) == {-1, 0, 2}


def test_rows_are_kept_for_the_next_time():
    parts = Pipeline(scene(), n_gather=100, rays=16)
    held = HeldBack(parts.snapshot, parts.tracer, parts.view, parts.gather, parts.transport)
    occluder, samples = hidden(parts.snapshot, "/tall"), np.arange(parts.view.n)
    assert held.rows(samples, occluder) is held.rows(samples.copy(), occluder.copy())
    assert held.rows(samples, occluder) is not held.rows(samples[1:], occluder)
    assert held.rows(samples[:0], occluder) == ()
