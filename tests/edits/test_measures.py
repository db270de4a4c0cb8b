"""Measures of scenes with known answers, and the agreement of areas with what gathers light."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.edits.measures import Measures
from icheat_usd.edits.model import Region, Selection, Shape
from icheat_usd.edits.painting import paint_mask, soft_sphere
from icheat_usd.edits.selection import BoundSelection, bind_selection
from icheat_usd.samples import gather_samples, view_samples
from icheat_usd.scene import SceneSnapshot
from icheat_usd.tracing import build_tracer
from tests.scenes import Mesh, cornell, make_snapshot, quad, translation


def select(snapshot: SceneSnapshot, *paths: str, region: Region | None = None, brush=None) -> BoundSelection:
    selection = Selection(frozenset(paths), () if region is None else (region,))
    mask = None if brush is None else paint_mask(snapshot, list(paths), brush, resolution=16)
    return bind_selection(selection, mask, snapshot, "/edit")


def ball(x: float, y: float, z: float, radius: float, softness: float = 0.0) -> Region:
    k = 1 / radius
    return Region(Shape.SPHERE, (k, 0, 0, -k * x, 0, k, 0, -k * y, 0, 0, k, -k * z), softness)


def plates(gap: float = 3.0) -> SceneSnapshot:
    """Two unit squares over each other, and a small one of side 0.1 far away."""
    places = {"/low": translation(0, 0, 0), "/high": translation(0, gap, 0)}
    meshes = [Mesh(quad(1.0), transforms=[place], path=path) for path, place in places.items()]
    return make_snapshot([*meshes, Mesh(quad(0.1), transforms=[translation(9, 0, 0)], path="/small")])


def test_the_area_of_whole_surfaces_is_exact_and_counts_once() -> None:
    snapshot = plates()
    low, both = select(snapshot, "/low"), select(snapshot, "/low", "/small")
    assert Measures(snapshot, low, low).caster_area() == pytest.approx(1.0, rel=1e-6)
    assert Measures(snapshot, low, both).caster_area() == pytest.approx(1.01, rel=1e-6)
    assert Measures(snapshot, low, select(snapshot)).caster_area() == 0


def test_the_area_within_a_region_is_that_of_the_disk_it_cuts() -> None:
    snapshot = plates()
    disk = select(snapshot, "/low", "/small", region=ball(0, 0.3, 0, 0.5))
    assert Measures(snapshot, disk, disk).caster_area() == pytest.approx(np.pi * (0.25 - 0.09), rel=5e-3)


def test_soft_weights_weigh_the_area() -> None:
    """The mean of 1 - smoothstep(r) over a disk of radius 1: the integral of 2 r (1 - 3 r^2 + 2 r^3) is 3/10."""
    snapshot = make_snapshot([Mesh(quad(2.0), path="/floor")])
    soft = select(snapshot, "/floor", region=ball(0, 0, 0, 1, softness=1.0))
    assert Measures(snapshot, soft, soft).caster_area() == pytest.approx(np.pi * 0.3, rel=5e-3)


def test_distance_of_two_small_surfaces_is_that_of_their_centres() -> None:
    snapshot = plates()
    distance = Measures(snapshot, select(snapshot, "/small"), select(snapshot, "/low")).mean_distance()
    assert distance == pytest.approx(9.0, rel=5e-3)


def test_mean_distance_of_two_plates_is_the_mean_over_all_pairs() -> None:
    snapshot = plates(gap=1.0)
    u = np.random.default_rng(0).uniform(size=(2, 2, 1_000_000))
    expected = np.sqrt(1 + np.square(u[0] - u[1]).sum(axis=0)).mean()
    found = Measures(snapshot, select(snapshot, "/low"), select(snapshot, "/high")).mean_distance()
    assert found == pytest.approx(expected, rel=3e-3)


def test_distance_to_nowhere_is_0() -> None:
    snapshot = plates()
    assert Measures(snapshot, select(snapshot, "/low"), select(snapshot)).mean_distance() == 0
    off = select(snapshot, "/low", region=ball(0, 50, 0, 1))
    assert Measures(snapshot, off, select(snapshot, "/high")).mean_distance() == 0


def test_measures_are_the_same_every_time() -> None:
    snapshot = plates()
    soft = select(snapshot, "/low", region=ball(0, 0.3, 0, 0.5, softness=0.5))
    first, second = (Measures(snapshot, soft, select(snapshot, "/high")) for _ in range(2))
    assert first.mean_distance() == second.mean_distance() and first.caster_area() == second.caster_area()


@pytest.mark.parametrize(
    "select_casters",
    [
        lambda s: select(s, "/red", "/tall"),
        lambda s: select(s, "/red", "/floor", "/back", region=ball(-0.9, -0.9, -0.9, 0.8, softness=0.5)),
        lambda s: select(s, "/back", "/low", brush=soft_sphere((0.2, -0.4, -0.5), 0.4, 1.0)),
    ],
    ids=["whole", "region", "painted"],
)
def test_the_area_is_what_gather_samples_hold_of_the_casters(select_casters) -> None:
    """So that paint, whose density is over this area, gives as much however the scene is sampled.

    Each side of a surface has as much; only the sides in sight have cells enough to tell a part of them.
    """
    snapshot = cornell(16, 16)
    tracer = build_tracer(snapshot, "embree")
    gather = gather_samples(snapshot, tracer, view_samples(snapshot, tracer), n=4096)
    casters = select_casters(snapshot)
    weighted = gather.area.astype(float) * casters.at(gather.points)
    front, back = (float(weighted[gather.points.side == side].sum()) for side in (0, 1))
    area = Measures(snapshot, casters, casters).caster_area()
    assert area == pytest.approx(front, rel=0.02)
    if casters.constant_on_instances:
        assert 2 * area == pytest.approx(front + back, rel=1e-5)
