"""Light of near hits: in a furnace, and against brute force where cells are far too coarse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icheat_usd.edits.model import Edit
from icheat_usd.final_gather import near_hits
from icheat_usd.final_gather.near_hits import NearLight
from icheat_usd.lighting import build_light_sampler
from icheat_usd.materials import take_points
from icheat_usd.samples import gather_samples, view_samples
from icheat_usd.tracing import build_tracer
from tests.final_gather.test_edits import SCENE, SIDES, painted
from tests.final_gather.test_rows import glow
from tests.pipeline import TINY, Pipeline, select
from tests.scenes import closed_box

ALBEDO, EMISSION, N_PATHS = 0.5, 0.3, 4


def test_in_a_furnace_near_hits_send_the_light_of_the_furnace():
    snapshot = closed_box(ALBEDO, EMISSION)
    snapshot = replace(snapshot, camera=replace(snapshot.camera, width=48, height=48))
    tracer = build_tracer(snapshot)
    points = view_samples(snapshot, tracer, samples_per_pixel=1, seed=1).points
    gather = gather_samples(snapshot, tracer, view_samples(snapshot, tracer, samples_per_pixel=1, seed=1), n=64)
    reflected = ALBEDO * EMISSION / (1 - ALBEDO)
    cells = np.full((gather.n, 3), reflected, np.float32)
    near = NearLight(snapshot, tracer, build_light_sampler(snapshot, tracer, points, 0), gather, cells, N_PATHS, seed=2)

    n_patches = 16
    key = np.sort(np.arange(len(points.instance)) % n_patches).astype(np.uint64)
    assert len(key) // n_patches > N_PATHS
    chosen = np.flatnonzero(near.wanted(key))
    assert np.bincount(key[chosen].astype(np.int64)).tolist() == [N_PATHS] * n_patches
    near.learn(key[chosen], take_points(points, chosen), chosen)
    assert not near.wanted(key).any()

    every = np.arange(len(key), dtype=np.uint64)
    assert near.wanted(every + np.uint64(n_patches)).all()
    near.learn(every + np.uint64(n_patches), points, every.astype(np.int64))
    light = near.radiance(every + np.uint64(n_patches)).mean(axis=1)
    error = light.std() / np.sqrt(len(light))
    assert error < 0.02 * reflected
    assert abs(light.mean() - reflected) < 4 * error


def test_hits_are_near_only_where_light_changes_from_cell_to_cell():
    snapshot = closed_box(ALBEDO, EMISSION)
    tracer = build_tracer(snapshot)
    view = view_samples(snapshot, tracer, samples_per_pixel=1, seed=1)
    gather = gather_samples(snapshot, tracer, view, n=64)
    sampler = build_light_sampler(snapshot, tracer, view.points, 0)
    cell = np.arange(-1, gather.n, dtype=np.int32)
    close, far = np.float32(0.5), np.float32(2.0)
    width = np.append(np.float32(0), np.sqrt(gather.area))

    def near(cells: np.ndarray, widths: np.float32) -> np.ndarray:
        light = NearLight(snapshot, tracer, sampler, gather, cells, N_PATHS, seed=2)
        return light.is_near(widths * width + np.float32(1e-6), cell)

    even, uneven = np.ones((gather.n, 3), np.float32), np.ones((gather.n, 3), np.float32)
    uneven[gather.n // 2 :: 2] = 3.0
    assert not near(even, close).any()
    found = near(uneven, close)
    assert not found[: gather.n // 4].any()
    assert found[3 * gather.n // 4 :].all()
    assert not near(uneven, far).any()


def test_where_cells_are_coarse_near_hits_mend_contacts():
    scene = replace(SCENE, camera=replace(SCENE.camera, width=24, height=24))
    coarse = Pipeline(scene, n_gather=192)
    halves = [coarse.final(samples=4, rays=256, seed=seed).indirect for seed in (1, 2)]
    error = []
    for n_paths in (0, 4):
        cache = replace(TINY, near_paths=n_paths)
        found = coarse.final(method="cached", samples=4, cache=cache).indirect
        error.append(((found - halves[0]) * (found - halves[1])).mean())
    assert error[0] > 1.3 * error[1] > 0


@pytest.mark.parametrize(
    "kind", ["objects", "a painted mask", "painted masks", "pairs", "rows", "rows over each other"]
)
def test_what_edits_add_is_the_same_where_hits_are_near(kind, monkeypatch):
    monkeypatch.setattr(near_hits, "EVEN", 0.0)
    emission = {"color": (0.3, 0.1, 0.6)}
    ground = select("/floor", "/back")
    edits = {
        "objects": lambda: (Edit("/emit", "emit", emission, ground, SIDES),),
        "a painted mask": lambda: (painted("emit", emission),),
        "painted masks": lambda: (painted("emit", emission), replace(painted("emit", emission), path="/more")),
        "pairs": lambda: (
            Edit("/emit", "emit", emission, ground, SIDES),
            Edit("/near", "falloff", {"exponent": 1.5}, select("/ceiling"), SIDES),
        ),
        "rows": lambda: (glow(),),
        "rows over each other": lambda: (glow(), replace(glow(), path="/more", amount=0.5)),
    }[kind]()
    scene = replace(SCENE, camera=replace(SCENE.camera, width=24, height=24))
    coarse = Pipeline(scene, n_gather=192)
    unedited, added = [], []
    for n_paths in (0, 4):
        found = coarse.final(*edits, method="cached", samples=4, cache=replace(TINY, near_paths=n_paths))
        unedited.append(found.indirect.mean())
        # The lower half sees no ceiling, whose edit is one of the light as it is.
        added.append((found.indirect_edited - found.indirect)[12:].mean())
    assert abs(unedited[1] / unedited[0] - 1) > 2e-3
    assert added[1] == pytest.approx(added[0], rel=1e-4)
