"""Photons of every light, density estimates against closed forms, and both ways to solve the earlier bounces."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from icheat_usd.final_gather.photon_map import build_photon_map, indirect_photon_map, photon_cell_radiance
from icheat_usd.final_gather.photons import Photons, PhotonSettings, trace_photons
from icheat_usd.lighting import build_light_sampler, irradiance
from icheat_usd.materials import points_on_surface
from icheat_usd.samples import GatherSamples, cell_direct, gather_samples, view_samples
from icheat_usd.scene import LightControls, LightKind, SceneSnapshot, Shaping, SurfacePoints, Texture
from icheat_usd.tracing import Tracer, build_tracer
from icheat_usd.transport import build_bounces, solve_bounces
from tests.scenes import (
    Image,
    Light,
    Material,
    Mesh,
    TextureUse,
    box,
    closed_box,
    cornell_meshes,
    covered_cornell,
    look_at,
    make_snapshot,
    quad,
    rotation,
    scaling,
    translation,
)

Array = NDArray[np.float32]
THREADS = numba.get_num_threads()
DOWN = rotation((1, 0, 0), -90)  #: turns local -Z, where rects and disks shine, to world -Y
SHEAR = np.array([[1, 0.4, 0, 0], [0, 1, 0.3, 0], [0.2, 0, 1, 0], [0, 0, 0, 1.0]])
PICTURE = Image(np.random.default_rng(3).uniform(0.0, 2.0, (4, 8, 3)).astype(np.float32), wrap=(1, 1))


def photons_of(snapshot: SceneSnapshot, **settings: int) -> tuple[Photons, Tracer, PhotonSettings]:
    tracer, made = build_tracer(snapshot), PhotonSettings(**settings)
    return trace_photons(snapshot, tracer, build_light_sampler(snapshot), made), tracer, made


def places_on(snapshot: SceneSnapshot, instance: int, n: int) -> SurfacePoints:
    """n^2 places spread evenly over a square of two triangles, front side."""
    u, v = (np.stack(np.meshgrid(*[np.arange(n)] * 2, indexing="ij"), -1).reshape(-1, 2).T + 0.5) / n
    first = u >= v  # (u, v) of the square: corner 0 + u e1 + v e2
    mesh = snapshot.geometry.instance_mesh[instance]
    triangle = snapshot.geometry.mesh_begin[mesh] + np.where(first, 0, 1)
    weights = np.where(first[:, None], np.stack([u - v, v], 1), np.stack([u, v - u], 1))
    return points_on_surface(snapshot, np.full(n * n, instance), triangle, weights, 0)


# Emission ------------------------------------------------------------------------------------------

OVERHEAD = translation(0.2, 1.5, -0.1)
LAMP = {Texture.EMISSION: TextureUse(PICTURE)}
LIGHTS = {
    "rect": Light(LightKind.RECT, (4, 2, 1), OVERHEAD @ DOWN, (0.8, 0.5)),
    "rect with an image": Light(LightKind.RECT, (4, 2, 1), OVERHEAD @ DOWN @ scaling(1, 2, 1), (0.8, 0.5), PICTURE),
    "mirrored rect": Light(LightKind.RECT, 5, OVERHEAD @ DOWN @ scaling(1, 1, -1) @ scaling(-1), (0.8, 0.5)),
    "disk": Light(LightKind.DISK, 5, OVERHEAD @ rotation((0, 0, 1), 30) @ DOWN @ scaling(2, 0.5, 1), (0.4, 0)),
    "sheared sphere": Light(LightKind.SPHERE, 5, OVERHEAD @ SHEAR @ scaling(-1, 1, 2), (0.2, 0)),
    "cylinder": Light(LightKind.CYLINDER, 5, OVERHEAD @ rotation((0, 0, 1), 30) @ SHEAR, (0.1, 0.9)),
    "sun": Light(LightKind.DISTANT, 3, rotation((1, 0, 0), -60), (0.0, 0)),
    "wide sun": Light(LightKind.DISTANT, 9, rotation((1, 0, 0), -60) @ scaling(2), (0.4, 0)),
    "dome": Light(LightKind.DOME, (1, 0.7, 0.4)),
    "dome with an image": Light(LightKind.DOME, 1, rotation((1, 1, 0), 50), image=PICTURE),
}


def floor_with(light: Light | None, lamp: Material | None = None) -> SceneSnapshot:
    meshes = [Mesh(quad(2.0), Material(0.5), path="/floor")]
    if lamp is not None:
        turned = OVERHEAD @ rotation((1, 0, 1), 130)
        meshes.append(Mesh(quad(0.5), lamp, transforms=[turned], path="/lamp"))
    else:
        meshes.append(Mesh(quad(0.5, y=0.7), Material(0.0), path="/shade"))
    return make_snapshot(meshes, lights=[] if light is None else [light])


@pytest.mark.parametrize("name", [*LIGHTS, "mesh"])
def test_photons_bring_the_floor_what_shadow_rays_find(name: str) -> None:
    snapshot = floor_with(LIGHTS.get(name), None if name in LIGHTS else Material(0.0, 6.0, textures=LAMP))
    photons, tracer, _ = photons_of(snapshot, n_emitted=1 << 16, n_bounces=1)
    floor = (photons.position[:, 1] < 1e-3) & (photons.normal[:, 1] > 0)
    flux = photons.power[floor].sum(axis=0, dtype=np.float64)
    found = irradiance(snapshot, tracer, build_light_sampler(snapshot), places_on(snapshot, 0, 32), 5, 64)
    exact = 4.0 * found[0].mean(axis=0, dtype=np.float64)
    # Independent photons would scatter by one in the root of their number; these are stratified.
    assert floor.sum() > 2000
    np.testing.assert_allclose(flux, exact, rtol=3 / np.sqrt(floor.sum()) + 0.004)


@pytest.mark.parametrize("kind", ["rect", "sun", "mesh"])
def test_photons_follow_the_controls_of_their_light(kind: str) -> None:
    """A cone, a multiplier, a surface that is not lit and still blocks, and one that is lit and blocks nothing."""
    lamp = {
        "rect": Light(LightKind.RECT, (4, 2, 1), OVERHEAD @ DOWN, (0.8, 0.5)),
        "sun": Light(LightKind.DISTANT, 9, rotation((1, 0, 0), -70), (0.4, 0)),
    }
    meshes = [
        Mesh(quad(2.0), Material(0.5), path="/floor"),
        Mesh(quad(0.5, y=0.7), Material(0.5), path="/ghost"),
        Mesh(quad(0.4, y=0.3), Material(0.5), transforms=[translation(0.5, 0, 0.2)], path="/unlit"),
    ]
    if kind == "mesh":
        meshes.append(Mesh(quad(0.5), Material(0.0, 6.0), transforms=[OVERHEAD], path="/lamp"))
    plain = make_snapshot(meshes, lights=[lamp[kind]] if kind in lamp else [])
    blocks, lit = np.ones((2, plain.n_instances), np.uint8)
    blocks[1] = lit[2] = 0
    cone = Shaping(
        np.array([0.3, 0.7]), 2.0, np.array([0.2, 0.1, 0.9]), 0.0, np.zeros(0), np.zeros(0), np.zeros((0, 0))
    )
    controls = LightControls(lit, blocks, diffuse=0.4, shaping=None if kind == "mesh" else cone)
    snapshot = replace(plain, light_controls=(controls,))
    photons, tracer, _ = photons_of(snapshot, n_emitted=1 << 16, n_bounces=1)
    sampler = build_light_sampler(snapshot)
    for instance, (height, area) in enumerate(((0.0, 4.0), (0.7, 0.25), (0.3, 0.16))):
        there = (np.abs(photons.position[:, 1] - height) < 1e-3) & (photons.normal[:, 1] > 0)
        flux = photons.power[there].sum(axis=0, dtype=np.float64)
        found = irradiance(snapshot, tracer, sampler, places_on(snapshot, instance, 32), 5, 64)[0]
        np.testing.assert_allclose(flux, area * found.mean(axis=0, dtype=np.float64), rtol=0.03)
        assert flux.any() == (instance != 2)


def test_each_light_has_its_share_of_the_photons() -> None:
    lamps = [Light(LightKind.RECT, power, OVERHEAD @ DOWN, (0.5, 0.5)) for power in (30.0, 0.0, 1.0)]
    snapshot = make_snapshot([Mesh(quad(40.0), Material(0.5))], lights=lamps)
    photons, _, _ = photons_of(snapshot, n_emitted=4096, n_bounces=1)
    number = np.bincount(photons.light, minlength=3)
    assert number[1] == 0
    assert 500 < number[2] < number[0]
    power = [photons.power[photons.light == light].sum() for light in (0, 2)]
    assert power[0] / power[1] == pytest.approx(30.0, rel=0.1)


# Paths ---------------------------------------------------------------------------------------------


def test_a_furnace_keeps_its_energy() -> None:
    albedo, size = np.array([0.3, 0.5, 0.8]), 2.0
    photons, tracer, settings = photons_of(closed_box(albedo, 1.0, size=size), n_emitted=1 << 17, n_bounces=64)
    area = 6 * size**2
    for bounce in range(4):
        arrived = photons.power[photons.bounce == bounce].sum(axis=0, dtype=np.float64)
        np.testing.assert_allclose(arrived, np.pi * area * albedo**bounce, rtol=0.02)
    total = photons.power.sum(axis=0, dtype=np.float64)
    np.testing.assert_allclose(total, np.pi * area / (1 - albedo), rtol=0.02)
    # Also where walls meet: the mean over a whole wall, irradiance of everything but direct light.
    snapshot = closed_box(albedo, 1.0, size=size)
    photon_map = build_photon_map(snapshot, tracer, photons.take(photons.bounce > 0), settings)
    wall = places_on(snapshot, 0, 24)
    found = photon_map.estimate(wall.position, wall.normal)[0]
    exact = np.pi * albedo / (1 - albedo)
    np.testing.assert_allclose(found.mean(axis=0, dtype=np.float64), exact, rtol=0.02)
    rim = np.abs(wall.position[:, 1:]).max(axis=1) > 0.94 * size / 2
    assert rim.sum() > 40
    np.testing.assert_allclose(found[rim].mean(axis=0, dtype=np.float64), exact, rtol=0.06)


def test_density_gives_the_irradiance_under_a_lamp() -> None:
    height = 1.2
    lamp = Light(LightKind.DISK, 400.0, translation(0, height, 0) @ DOWN, (0.02, 0))
    snapshot = make_snapshot([Mesh(quad(2.0), Material(0.5))], lights=[lamp])
    photons, tracer, settings = photons_of(snapshot, n_emitted=1 << 17, n_bounces=1, n_nearest=80)
    places = places_on(snapshot, 0, 24)
    found = build_photon_map(snapshot, tracer, photons, settings).estimate(places.position, places.normal)[0, :, 0]
    r2 = (places.position.astype(np.float64) ** 2).sum(axis=1) + height**2
    exact = 400.0 * np.pi * 0.02**2 * height**2 / r2**2
    ratio = found / exact
    assert abs(ratio.mean() - 1) < 0.01
    # 80 photons under an Epanechnikov kernel scatter by sqrt(4 / 3 / 80) = 0.13.
    assert ratio.std() < 0.17
    edge = np.abs(places.position[:, [0, 2]]).max(axis=1) > 0.94
    assert abs(ratio[edge].mean() - 1) < 0.05


def test_kept_irradiance_is_that_of_the_density_nearby() -> None:
    snapshot = covered_cornell("rect")
    tracer = build_tracer(snapshot)
    photon_map = indirect_photon_map(snapshot, tracer, PhotonSettings(n_emitted=1 << 16))
    places = places_on(snapshot, 2, 24)
    kept = photon_map.irradiance(places)[0]
    dense = photon_map.estimate(places.position, places.normal)[0]
    np.testing.assert_allclose(kept.mean(axis=0), dense.mean(axis=0), rtol=0.03)
    assert np.corrcoef(kept[:, 0], dense[:, 0])[0, 1] > 0.8
    missed = places._replace(instance=np.full_like(places.instance, -1))
    assert not photon_map.irradiance(missed).any()


def divided_room(thickness: float) -> SceneSnapshot:
    """A lamp in the left half of a box that a wall divides; floor and ceiling run through below the wall."""
    white = Material(0.7)
    if thickness:
        wall = Mesh(box((thickness, 2, 2)), white, path="/wall")
    else:
        wall = Mesh(quad(2.0), white, transforms=[rotation((0, 0, 1), 90)], path="/wall", double_sided=True)
    lamp = Light(LightKind.RECT, 10, translation(-0.5, 0.9, 0) @ DOWN, (0.3, 0.3))
    return make_snapshot([Mesh(box(2, inward=True), white, path="/room"), wall], lights=[lamp])


@pytest.mark.parametrize("thickness", [0.0, 0.01])
def test_no_light_leaks_through_a_thin_wall(thickness: float) -> None:
    snapshot = divided_room(thickness)
    photon_map = indirect_photon_map(snapshot, build_tracer(snapshot), PhotonSettings(n_emitted=1 << 15))
    y = np.linspace(-0.9, 0.9, 40, dtype=np.float32)
    for x in (0.011, 0.05, 0.12):
        sides = {}
        for sign in (-1.0, 1.0):
            floor = np.stack([np.full_like(y, sign * x), np.full_like(y, -1), y], 1)
            up = np.broadcast_to(np.array([0, 1, 0], np.float32), floor.shape)
            sides[sign] = photon_map.estimate(floor, np.ascontiguousarray(up)).mean()
            places = places_on(snapshot, 0, 1)
            columns = {"position": floor, "normal": up, "instance": np.zeros(len(y), np.int32)}
            places = places._replace(**{name: np.ascontiguousarray(column) for name, column in columns.items()})
            sides[2 * sign] = photon_map.irradiance(places).mean()
        assert sides[-1.0] > 0.3
        assert sides[-2.0] > 0.3
        assert sides[1.0] < 0.01 * sides[-1.0]
        assert sides[2.0] < 0.01 * sides[-2.0]
    wall = np.stack([np.full_like(y, thickness / 2), y, np.zeros_like(y)], 1)
    there = np.zeros_like(wall)
    there[:, 0] = 1
    assert photon_map.estimate(wall, there).max() == 0
    assert photon_map.estimate(wall * (-1, 1, 1), -there).mean() > 0.1


# Both solutions ------------------------------------------------------------------------------------


def cells(snapshot: SceneSnapshot, n: int = 3000) -> tuple[Tracer, GatherSamples, Array]:
    tracer = build_tracer(snapshot)
    gather = gather_samples(snapshot, tracer, view_samples(snapshot, tracer, samples_per_pixel=1), n=n)
    sampler = build_light_sampler(snapshot)
    return tracer, gather, cell_direct(snapshot, tracer, sampler, gather, 4, 0)


def mirror_room() -> SceneSnapshot:
    """A box with a mirror for a wall, a glass pane under its lamp and a see-through screen."""
    steel = Material(0.9, metallic=1.0, roughness=0.0, ior=1.5)
    glass = Material(0.0, opacity=0.0, roughness=0.0, ior=1.5)
    screen = Material(0.6, opacity=0.5)
    meshes = [mesh for mesh in cornell_meshes() if mesh.path not in ("/back", "/tall")]
    meshes += [
        Mesh(cornell_meshes()[4].points, steel, path="/mirror"),
        Mesh(quad(0.9), glass, transforms=[translation(0, 0.6, 0)], path="/pane"),
        Mesh(quad(0.8), screen, transforms=[translation(-0.4, 0, 0) @ rotation((1, 0, 0), 70)], path="/screen"),
    ]
    lamp = Light(LightKind.RECT, (17, 12, 4), translation(0.02, 0.985, 0.03) @ DOWN, (0.5, 0.4))
    window = Light(LightKind.SPHERE, (2, 3, 9), translation(0.4, 0.1, 0.2), (0.1, 0))
    return make_snapshot(meshes, lights=[lamp, window], camera=look_at((0, 0, 3.9), fov=39.3))


@pytest.mark.parametrize("scene", ["cornell box", "mirrors, glass and a screen"])
def test_photons_and_bounces_agree(scene: str) -> None:
    snapshot = covered_cornell("rect") if scene == "cornell box" else mirror_room()
    # With nothing in sight, cells hold the mean over their areas, as photons bring it.
    snapshot = replace(snapshot, camera=look_at((0, 0, 50), (0, 0, 100)))
    tracer, gather, direct = cells(snapshot)
    rows = solve_bounces(build_bounces(snapshot, tracer, gather, rays_per_row=128), direct, 16)
    photons = photon_cell_radiance(snapshot, tracer, gather, direct, PhotonSettings(n_emitted=1 << 18))
    instance = gather.points.instance
    for light in range(len(direct)):
        ours, theirs = (
            np.array(
                [((b - direct)[light] * gather.area[:, None])[instance == i].sum(axis=0) for i in np.unique(instance)]
            )
            for b in (photons, rows)
        )
        np.testing.assert_allclose(ours.sum(axis=0), theirs.sum(axis=0), rtol=0.02)
        # Surface by surface; what is darker than a hundredth of the brightest only counts for as much.
        np.testing.assert_allclose(ours, theirs, rtol=0.06, atol=0.01 * theirs.max())


def test_one_reflection_is_direct_light() -> None:
    snapshot = covered_cornell("rect")
    tracer, gather, direct = cells(snapshot, 300)
    same = photon_cell_radiance(snapshot, tracer, gather, direct, PhotonSettings(n_emitted=1 << 10, n_bounces=1))
    np.testing.assert_array_equal(same, direct)
    with pytest.raises(ValueError, match="gather cells"):
        photon_cell_radiance(snapshot, tracer, gather, direct[:, :-1], PhotonSettings())


def test_fewer_bounces_are_darker_by_what_they_leave_out() -> None:
    snapshot = closed_box(0.5, 1.0)
    tracer, gather, direct = cells(snapshot, 300)
    for n_bounces, exact in ((2, 0.75), (3, 0.875)):  # radiance after 1..n reflections, without emission
        settings = PhotonSettings(n_emitted=1 << 16, n_bounces=n_bounces)
        found = photon_cell_radiance(snapshot, tracer, gather, direct, settings)[0]
        inside = gather.points.side == 0
        assert np.average(found[inside, 0], weights=gather.area[inside]) == pytest.approx(exact, rel=0.02)


def test_threads_do_not_change_a_bit() -> None:
    snapshot = mirror_room()
    tracer = build_tracer(snapshot)
    settings = PhotonSettings(n_emitted=1 << 13, seed=7)
    places = places_on(snapshot, 2, 24)
    results = []
    for threads in (1, 2, 2):
        if threads > THREADS:
            pytest.skip("this machine has one thread")
        numba.set_num_threads(threads)
        try:
            photon_map = indirect_photon_map(snapshot, tracer, settings)
            results.append((photon_map.photons.power, photon_map.irradiance(places)))
        finally:
            numba.set_num_threads(THREADS)
    for one, other in zip(results[0], results[1], strict=True):
        np.testing.assert_array_equal(one, other)
    assert results[0][1].any()
    other_seed = indirect_photon_map(snapshot, tracer, PhotonSettings(n_emitted=1 << 13, seed=8))
    assert not np.array_equal(other_seed.irradiance(places), results[0][1])


def test_a_scene_without_light_has_no_photons() -> None:
    snapshot = make_snapshot([Mesh(quad(2.0), Material(0.5))], lights=[Light(LightKind.DOME, 0.0)])
    tracer = build_tracer(snapshot)
    photon_map = indirect_photon_map(snapshot, tracer, PhotonSettings(n_emitted=1 << 10))
    places = places_on(snapshot, 0, 4)
    assert photon_map.irradiance(places).shape == (1, 16, 3)
    assert not photon_map.irradiance(places).any()
