"""The irradiance cache: against known light, finite differences and brute force, and what its records must not do."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from icheat_usd.edits.model import Edit, KeyedPayload, MaskedSurface, Payload, SurfaceMask
from icheat_usd.final_gather import CacheSettings
from icheat_usd.final_gather.irradiance_cache import IrradianceCache, Places, overture
from icheat_usd.final_gather.places import near_of, pixel_extent
from icheat_usd.final_gather.record_rays import HemisphereTracer
from icheat_usd.kernels.irradiance_cache import MAX_ENTRIES
from icheat_usd.materials import points_on_surface
from icheat_usd.samples import gather_samples, view_samples
from icheat_usd.scene import SceneSnapshot
from icheat_usd.tracing import build_tracer
from tests.agreement import compare
from tests.final_gather.test_edits import EVERYTHING, SCENE, previews
from tests.pipeline import Pipeline, select
from tests.scenes import Material, Mesh, box, closed_box, look_at, make_snapshot, quads


class Built:
    """A scene with gather cells and records at what its camera sees."""

    def __init__(self, snapshot: SceneSnapshot, radiance, settings: CacheSettings, n_gather: int = 512) -> None:
        self.snapshot, self.tracer = snapshot, build_tracer(snapshot)
        self.view = view_samples(snapshot, self.tracer, samples_per_pixel=2, seed=3)
        self.gather = gather_samples(snapshot, self.tracer, self.view, n=n_gather)
        cells = np.zeros((self.gather.n + 1, 3), np.float32)
        cells[:-1] = radiance(self.gather.points)
        self.hemispheres = HemisphereTracer(
            snapshot, self.tracer, self.gather, settings.n_theta, settings.n_phi, seed=5
        )
        self.cache = IrradianceCache(self.hemispheres, cells, settings)
        near = near_of(snapshot, self.tracer, self.view, seed=1)
        self.places = Places(self.view.points, pixel_extent(snapshot.camera, self.view), near)
        overture(self.cache, self.places, self.view.pixel, snapshot.camera.width)

    def irradiance(self, which=slice(None)):
        places = self.places.take(np.arange(self.view.n)[which])
        found = self.cache.find(places)
        assert (found.number > 0).all()
        return self.cache.interpolate(found, places.points.position, places.points.shading_normal)


def sized(snapshot: SceneSnapshot, size: int) -> SceneSnapshot:
    return replace(snapshot, camera=replace(snapshot.camera, width=size, height=size))


def test_where_everything_sends_the_same_light_irradiance_is_that_times_pi():
    built = Built(sized(closed_box(), 24), lambda points: np.float32(0.7), CacheSettings(n_theta=8))
    np.testing.assert_allclose(built.irradiance(), 0.7 * np.pi, rtol=1e-4)
    values = built.cache.values
    np.testing.assert_allclose(values.by_turn, 0, atol=1e-4)
    # What a few rays of a record beside a wall meet there is no gradient of the light.
    np.testing.assert_allclose(values.by_move, 0, atol=1e-3)
    assert 10 < built.cache.n < built.view.n / 4


def smooth(points):
    """Radiance that varies over a box of side 2."""
    x, y, z = points.position.T
    return np.stack([1 + 0.5 * x, 1 + 0.4 * np.sin(2 * y), 1 + 0.3 * x * z], axis=1)


@functools.cache
def in_cornell() -> Built:
    return Built(SCENE, smooth, CacheSettings(n_theta=8), n_gather=16384)


@pytest.mark.parametrize("how", ["move", "turn"])
def test_gradients_are_the_differences_of_neighbours(how):
    """Beside the blocks, which hide part of the walls; the rays of all places are alike but for their jitter."""
    built = in_cornell()
    settings = CacheSettings(n_theta=96)
    floor = next(i for i, surface in enumerate(SCENE.surfaces) if surface.path == "/floor")
    instance = int(np.flatnonzero(SCENE.geometry.instance_surface == floor)[0])
    first = SCENE.geometry.mesh_begin[SCENE.geometry.instance_mesh[instance]]
    centre = points_on_surface(SCENE, [instance] * 3, [first] * 3, [[0.3, 0.4], [0.55, 0.4], [0.5, 0.1]], 0)
    hemispheres = HemisphereTracer(SCENE, built.tracer, built.gather, settings.n_theta, settings.n_phi, seed=5)
    cache = IrradianceCache(hemispheres, built.cache.cells, settings)

    def light(points):
        rays = hemispheres.trace(points, np.arange(3))
        return cache.sums(rays, rays.radiance(cache.cells))[0]

    here, step = light(centre), np.float32(0.02 if how == "move" else 0.05)
    gradient = here.by_move if how == "move" else here.by_turn
    for axis in (np.array([1, 0, 0], np.float32), np.array([0, 0, 1], np.float32)):
        sides = []
        for sign in (1, -1):
            if how == "move":
                moved = centre._replace(position=centre.position + sign * step * axis)
            else:
                turned = centre.shading_normal + sign * step * axis
                turned /= np.linalg.norm(turned, axis=1, keepdims=True)
                moved = centre._replace(shading_normal=turned, normal=turned)
            sides.append(light(moved).irradiance)
        found = (sides[0] - sides[1]) / (2 * step)
        along = axis if how == "move" else np.cross(centre.shading_normal[0], axis)
        expected = gradient @ along
        size = here.irradiance.mean()
        np.testing.assert_allclose(found, expected, atol=0.05 * size)
        assert np.abs(expected).max() > 0.25 * size


def test_no_record_reaches_beyond_what_its_neighbours_know():
    built = in_cornell()
    table = built.cache.table
    apart = np.linalg.norm(table.position[:, None] - table.position[None], axis=2)
    least = built.cache._least
    allowed = np.minimum.reduce(table.reach[None] + apart, axis=1)
    # Records that were made later may have shrunk since.
    last = np.arange(built.cache.n) > 0.9 * built.cache.n
    assert (table.reach <= np.maximum(allowed, least) * 1.0001)[last].all()
    assert (table.reach >= least * 0.9999).all()


def test_light_does_not_leak_through_a_wall():
    """Two halves of a box, dark and bright, with a wall of no thickness between them."""
    wall = Mesh(quads([[[0, -1, -1], [0, -1, 1], [0, 1, 1], [0, 1, -1]]]), Material(), path="/wall", double_sided=True)
    room = Mesh(box(2, inward=True), Material(), path="/room")
    camera = look_at((-0.9, 0.6, 0.9), (0.2, -1, -0.3), fov=80, width=48, height=48)
    snapshot = make_snapshot([room, wall], camera=camera)

    def bright(points):
        return np.where((points.position[:, :1] > 0) & (points.instance[:, None] == 0), np.float32(1), np.float32(0))

    dark = Built(snapshot, bright, CacheSettings(n_theta=8), n_gather=8192)
    assert dark.cache.n > 20
    seen = dark.view.points.position[:, 0] < -1e-3
    # A cell of the room may lie on both sides of the wall, a cell being about 6 cm wide.
    assert dark.irradiance(seen).mean() < 0.01 * np.pi


def test_a_place_knows_no_more_records_than_there_is_room_for():
    built = in_cornell()
    crowded = CacheSettings(n_theta=4, coverage=1e9)
    hemispheres = HemisphereTracer(SCENE, built.tracer, built.gather, crowded.n_theta, crowded.n_phi, seed=5)
    cache = IrradianceCache(hemispheres, built.cache.cells, crowded)
    wide = built.places._replace(extent=np.full(built.view.n, 0.3, np.float32))
    overture(cache, wide, built.view.pixel, SCENE.camera.width)
    assert cache.n == built.view.n
    found = cache.find(wide)
    assert found.number.max() == MAX_ENTRIES
    np.testing.assert_allclose(found.weight.sum(axis=1), 1, rtol=1e-5)


def test_the_picture_is_that_of_brute_force():
    """Cells are 5 cm across in a box of 2 m: 3 % of tolerance for the light of a place, 2 % in the mean."""
    parts = previews()[0]
    cached = [parts.final(method="cached", samples=16, light_samples=1, seed=seed).indirect for seed in range(3)]
    brute = [parts.final(samples=16, rays=16, light_samples=1, seed=seed).indirect for seed in range(4)]
    found = compare(cached, brute, tolerance=0.03)
    assert (np.abs(found.ratio - 1) < 4 * found.error + 0.02).all(), found
    assert found.pixels < 1.4 and found.blocks < 2.4, found


def test_a_hard_edge_within_the_reach_of_records_stays_hard():
    """Where all of the light is edited, the edit is a factor, whatever records lie around."""
    surface = next(one for one in SCENE.surfaces if one.path == "/back")
    texels = np.zeros((surface.n_faces, 8, 8), np.float32)
    texels[:, :, ::2] = 1
    mask = SurfaceMask((MaskedSurface("/back", surface.n_faces, surface.instance_id),), texels)
    payload = Payload("scale", {"gain": 4.0}, receiver_mask=mask)
    edit = Edit("/stripes", "scale", {"gain": 4.0}, select("/back"), EVERYTHING, keys=(KeyedPayload(payload, 1.0),))
    parts = Pipeline(sized(SCENE, 32), n_gather=1024, light_samples=4, bounce_rays=32, n_bounces=2)
    final = parts.final(edit, method="cached", samples=1)
    view = view_samples(parts.snapshot, parts.tracer, samples_per_pixel=1, max_splits=0)
    factor = np.ones(32 * 32)
    factor[view.pixel] = 1 + 3 * parts.field(edit).receiver_masks(view.points)[0]
    shown = factor.reshape(32, 32, 1) * final.indirect
    np.testing.assert_allclose(final.indirect_edited, shown, rtol=1e-4)
    between = (factor > 1) & (factor < 4)
    assert (factor == 1).mean() > 0.3 and (factor == 4).mean() > 0.02 and between.mean() > 0.02


@pytest.mark.parametrize("bad", [{"n_theta": 6}, {"n_theta": 0}, {"least_reach": 0.0}, {"least_reach": 30.0}])
def test_settings_that_make_no_sense_are_refused(bad):
    with pytest.raises(ValueError):
        CacheSettings(**bad)
