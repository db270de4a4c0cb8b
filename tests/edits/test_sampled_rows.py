"""Sampled rows on scenes: baked, bound, moved, deformed, looked up between samples, and interpolated between keys."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from icheat_usd.edits.binding import bind
from icheat_usd.edits.encodings.bake import BakedRows, at_full_amount, bake_field, largest_error
from icheat_usd.edits.encodings.choose import choose, encodings_of
from icheat_usd.edits.encodings.pair_samples import PairSamples
from icheat_usd.edits.encodings.rows import BoundRows, Mixture, bind_rows
from icheat_usd.edits.model import Edit, EditStack, KeyedPayload, Payload, Region, Selection, Shape
from icheat_usd.edits.operations import Encoding
from icheat_usd.errors import EditError
from icheat_usd.materials import points_on_surface, take_points
from icheat_usd.scene import SceneSnapshot
from tests.pipeline import Pipeline
from tests.scenes import Mesh, cornell, cornell_meshes, look_at, make_snapshot, rotation, translation

ALL = ("/red", "/green", "/floor", "/ceiling", "/back", "/tall", "/low", "/lamp")


def ball(x: float, y: float, z: float, radius: float) -> Region:
    """A soft sphere."""
    m = np.concatenate([np.eye(3), -np.array([[x], [y], [z]])], axis=1) / radius
    return Region(Shape.SPHERE, tuple(float(v) for v in m.ravel()), softness=1.0)


def edit(
    operation: str, parameters=(), receivers=("/floor", "/back"), casters=("/red",), *, near=None, of=None
) -> Edit:
    return Edit(
        "/World/Edits/one",
        operation,
        dict(parameters),
        Selection(frozenset(receivers), () if near is None else (near,)),
        Selection(frozenset(casters), () if of is None else (of,)),
    )


OBJECT = edit("scale", {"gain": 0.2, "color": (1.0, 2.0, 0.5)})
BRUSH = edit("scale", {"gain": 3.0}, near=ball(0, -1, 0, 1.2), of=ball(-1, 0, 0, 1.0))
FALLOFF = edit("falloff", {"exponent": 1.0, "pivot": 1.5}, receivers=("/floor",))


@cache
def pipeline() -> Pipeline:
    return Pipeline(cornell(32, 32), n_gather=512, rays=256, bounce_rays=64, light_samples=4)


@cache
def baked(number: int, epsilon: float = 0.02, coefficients: int | None = None) -> BakedRows:
    one = (OBJECT, BRUSH, FALLOFF)[number]
    return bake(one, epsilon=epsilon, coefficients=coefficients)


def bake(one: Edit, **options) -> BakedRows:
    pipe = pipeline()
    field = bind(at_full_amount(one), pipe.snapshot)
    return bake_field(field, pipe.view, pipe.gather, pipe.snapshot, where=one.path, **options)


def samples(one: Edit) -> PairSamples:
    pipe = pipeline()
    return PairSamples(bind(at_full_amount(one), pipe.snapshot), pipe.view, pipe.gather)


def as_baked(one: Edit, *rows: tuple[BakedRows | None, float]) -> Edit:
    """The edit evaluated by rows alone."""
    keys = tuple(KeyedPayload(None if r is None else Payload("scale", {}, rows=r.rows), w) for r, w in rows)
    return replace(one, operation="baked", parameters={}, keys=keys)


def delta(bound: BoundRows, receivers, casters) -> np.ndarray:
    """S - 1 for all receivers and casters, (n, m, 3)."""
    mixture, leaf = bound.locate_receivers(receivers), bound.locate_casters(casters)
    found = []
    for i in range(len(mixture.rows)):
        one = Mixture._make(column[i : i + 1] for column in mixture)
        scale = bound.evaluate(one, leaf).scale - np.float32(1)
        found.append(np.broadcast_to(scale, (len(leaf), 3)))
    return np.stack(found)


def test_an_object_edit_takes_one_number_and_a_few_places():
    found = baked(0)
    rows = found.rows
    assert len(rows.indices) == 1 and len(rows.row_pattern) == 1
    assert rows.n_leaves <= 2, "sides on which nothing varies are one leaf"
    assert len(rows.site_row) < 0.1 * found.n_view
    assert rows.epsilon_scale < 1e-5 and found.measured < 1e-5
    assert rows.kinds == ("delta",)


@pytest.mark.parametrize("number", [0, 1, 2])
@pytest.mark.parametrize("epsilon", [0.1, 0.02])
def test_the_stated_bound_holds_at_every_site_and_leaf_and_the_whole_bound_at_every_view_sample(number, epsilon):
    found = baked(number, epsilon)
    one = (OBJECT, BRUSH, FALLOFF)[number]
    work, pipe = samples(one), pipeline()
    bound = bind_rows(found.rows, pipe.snapshot, "/e")
    touched = np.flatnonzero(work.touched)
    exact = work.pairs(touched, np.arange(work.n_leaves))[:, :, :3]
    casters = take_points(pipe.gather.points, work.leaf_numbers)
    off = np.abs(delta(bound, take_points(pipe.view.points, touched), casters) - exact).max(axis=(1, 2))
    site, distance = bound.nearest_site(take_points(pipe.view.points, touched))
    at_site = distance < 1e-4
    assert at_site.any()
    assert off[at_site].max() <= found.rows.epsilon_scale <= 0.5 * epsilon * 1.01
    assert off.max() <= epsilon * 1.05
    assert found.measured <= off.max() + 1e-6


def test_a_fixed_number_of_coefficients_states_the_error_that_it_has():
    few, many = baked(2, coefficients=5), baked(2, coefficients=100)
    for found, k in ((few, 5), (many, 100)):
        assert (np.diff(found.rows.indptr) <= k).all()
        assert found.measured <= found.rows.epsilon_scale + 0.011
    assert few.rows.epsilon_scale > many.rows.epsilon_scale > 0


def test_the_image_is_off_by_at_most_the_bound_of_the_unedited_indirect_light():
    pipe = pipeline()
    for one, number in ((OBJECT, 0), (BRUSH, 1), (FALLOFF, 2)):
        found = baked(number)
        exact, rows = pipe.relight(one), pipe.relight(as_baked(one, (found, 1.0)))
        assert np.abs(exact.indirect_edited - exact.indirect).max() > 0.01
        share = max(found.rows.epsilon_scale, found.measured) + 1e-5
        assert (np.abs(rows.indirect_edited - exact.indirect_edited) <= share * exact.indirect + 1e-6).all()
        bound = bind_rows(found.rows, pipe.snapshot, "/e")
        untouched = (bound.locate_receivers(pipe.view.points).rows < 0).all(axis=1)
        assert untouched[~np.isin(pipe.view.points.instance, [2, 4])].all() and untouched.any()
        assert np.array_equal(rows.indirect_edited[untouched], exact.indirect[untouched])


def final_error(one: Edit, found: BakedRows) -> float:
    """Mean difference of the final gather between rows and recipe, relative to what the recipe changes.

    Of magnitudes, not of squares: those are decided by a path or two that start close to the lamp, and which ones do
    depends on the last bits of a ray.
    """
    pipe = pipeline()
    changed, off = 0.0, 0.0
    for seed in range(3):
        exact = pipe.final(one, samples=1, rays=64, light_samples=2, seed=seed)
        rows = pipe.final(as_baked(one, (found, 1.0)), samples=1, rays=64, light_samples=2, seed=seed)
        assert np.array_equal(exact.indirect, rows.indirect)
        assert np.abs(exact.indirect_edited - exact.indirect).max() > 0.01
        changed += np.abs(exact.indirect_edited - exact.indirect).sum()
        off += np.abs(rows.indirect_edited - exact.indirect_edited).sum()
    return float(off / changed)


def test_the_final_gather_reads_rows_as_the_recipe():
    """Between whole objects to rounding; masks are cut into cells, whose error falls with their size."""
    assert final_error(OBJECT, baked(0)) < 1e-4
    fine = Pipeline(pipeline().snapshot, n_gather=8192)
    field = bind(at_full_amount(BRUSH), fine.snapshot)
    finer = bake_field(field, pipeline().view, fine.gather, fine.snapshot, where="/e", epsilon=0.005)
    coarse = final_error(BRUSH, baked(1))
    assert coarse < 0.15
    # A sixteenth of the area is a quarter of the distance.
    assert final_error(BRUSH, finer) < 0.4 * coarse


def test_amount_stays_live():
    pipe = pipeline()
    found = baked(1)
    for amount in (0.5, 1.7):
        exact = pipe.relight(replace(BRUSH, amount=amount)).indirect_edited
        rows = pipe.relight(replace(as_baked(BRUSH, (found, 1.0)), amount=amount))
        assert (np.abs(rows.indirect_edited - exact) <= amount * 0.021 * rows.indirect + 1e-6).all()


def test_operations_that_look_at_light_are_baked_for_it():
    pipe = pipeline()
    radiance = pipe.cell_light.total()
    for one in (edit("hsv", {"hue": 70.0, "saturation": 1.5}), edit("gamma", {"exponent": 1.5})):
        found = bake(one, radiance=radiance, transport=pipe.transport)
        exact, rows = pipe.relight(one), pipe.relight(as_baked(one, (found, 1.0)))
        off = np.abs(rows.indirect_edited - exact.indirect_edited)
        assert (off <= 0.021 * exact.indirect + 3 * found.rows.epsilon_emission + 1e-5).all()
        with pytest.raises(ValueError, match="light"):
            bake(one)


def test_emission_and_offsets_are_kinds_of_their_own():
    pipe = pipeline()
    for one, kind in (
        (edit("emit", {"color": (0.3, 0.2, 0.1)}, of=ball(-1, 0, 0, 1.0)), "emission"),
        (edit("paint", {"color": (0.3, 0.2, 0.1)}), "offset"),
    ):
        found = bake(one)
        assert found.rows.kinds == (kind,)
        exact, rows = pipe.relight(one), pipe.relight(as_baked(one, (found, 1.0)))
        added = np.abs(exact.indirect_edited - exact.indirect)
        assert added.max() > 0
        assert np.abs(rows.indirect_edited - exact.indirect_edited).max() <= 0.05 * added.max()


def test_what_rows_cannot_hold_is_refused_with_a_reason():
    with pytest.raises(EditError, match="exact as it"):
        bake(edit("receive", {"scale": (2.0, 2.0, 2.0)}))
    with pytest.raises(EditError, match="behind occluders"):
        bake(replace(edit("unshadow"), occluders=("/tall",)))
    with pytest.raises(EditError, match="no gather sample"):
        bake(edit("scale", {"gain": 2.0}, casters=("/nothing",)))
    with pytest.raises(EditError, match="none of its receivers"):
        bake(edit("scale", {"gain": 2.0}, receivers=("/nothing",)))
    lit = pipeline().snapshot.light_paths[0]
    field = bind(EditStack("", (OBJECT, replace(BRUSH, path="/b", lights=(lit,)))), pipeline().snapshot)
    if field.n_groups > 1:
        with pytest.raises(EditError, match="some lights only"):
            bake_field(field, pipeline().view, pipeline().gather, pipeline().snapshot, where="/s")


def test_two_runs_give_the_same_bits():
    a, b = bake(BRUSH).rows, bake(BRUSH).rows
    assert a.samples_digest == b.samples_digest
    for name in ("indices", "numbers", "row_step", "site_row", "site_reach"):
        assert np.array_equal(getattr(a, name), getattr(b, name))


# Between samples ------------------------------------------------------------------------------------------------------


def floor_points(snapshot: SceneSnapshot, x: np.ndarray, z: np.ndarray, surface: str = "/floor"):
    """Points of a horizontal surface that is cut into two triangles, by place."""
    instance = next(i for i, s in enumerate(snapshot.surfaces) if s.path == surface)
    mesh = snapshot.geometry.instance_mesh[instance]
    first, last = snapshot.geometry.mesh_begin[mesh : mesh + 2]
    to_world = snapshot.geometry.instance_to_world[instance]
    corners = snapshot.geometry.points[first:last] @ to_world[:, :3].T + to_world[:, 3]
    triangle, weight = np.full(len(x), -1, np.int32), np.zeros((len(x), 2))
    for t, (a, b, c) in enumerate(corners[:, :, [0, 2]]):
        solved = np.linalg.solve(np.column_stack([b - a, c - a]), (np.stack([x, z]) - a[:, None])).T
        inside = (solved >= -1e-6).all(axis=1) & (solved.sum(axis=1) <= 1 + 1e-6)
        triangle[inside], weight[inside] = first + t, solved[inside]
    assert (triangle >= 0).all()
    return points_on_surface(snapshot, np.full(len(x), instance), triangle, weight, np.zeros(len(x), np.uint8))


def test_nothing_pops_along_a_line():
    """Jumps show in steps that do not shrink with the spacing."""
    bound = bind_rows(baked(1).rows, pipeline().snapshot, "/e")
    casters = take_points(pipeline().gather.points, samples(BRUSH).leaf_numbers)
    steps = []
    for n in (2001, 8001):
        z = np.linspace(-0.95, 0.6, n)
        points = floor_points(pipeline().snapshot, 0.137 + 0.2 * z, z)
        value = delta(bound, points, casters)[:, :, 0]
        steps.append(np.abs(np.diff(value, axis=0)).max())
    assert value.max() > 0.2
    assert steps[1] < 0.4 * steps[0]


def test_rows_fade_to_the_identity_away_from_samples():
    """Sites on a quarter of the floor say nothing about its far corner, nor about other surfaces."""
    rows = baked(0).rows
    pipe = pipeline()
    floor = next(i for i, s in enumerate(rows.surfaces) if s.path == "/floor")
    # One site in the middle that reaches 0.2 m.
    which = np.flatnonzero(rows.sites.surface == floor)[:1]
    alone = replace(
        rows,
        sites=rows.sites.take(which),
        site_reach=np.full(1, 0.2, np.float32),
        site_row=np.zeros(1, np.int32),
    )
    bound = bind_rows(alone, pipe.snapshot, "/e")
    assert not bound.findings
    site = bound.search.key[0, :3]
    x = np.linspace(-0.99, 0.99, 399)
    points = floor_points(pipe.snapshot, x, np.full(399, site[2]))
    found = bound.locate_receivers(points)
    away = np.abs(points.position[:, 0] - site[0])
    assert (found.confidence[away < 0.19] == 1).all()
    assert (found.confidence[away > 0.41] == 0).all()
    assert (np.diff(found.confidence[np.argsort(away)]) <= 1e-6).all()
    assert np.abs(np.diff(found.confidence)).max() < 0.06
    assert np.allclose(found.weights.sum(axis=1), found.confidence, atol=1e-6)
    ceiling = floor_points(pipe.snapshot, x, np.full(399, site[2]), "/ceiling")
    assert (bound.locate_receivers(ceiling).confidence == 0).all()
    back = replace_side(points)
    assert (bound.locate_receivers(back).confidence == 0).all()


def replace_side(points):
    return points._replace(side=1 - points.side, normal=-points.normal, shading_normal=-points.shading_normal)


def test_where_one_key_has_no_samples_the_other_speaks_alone():
    pipe = pipeline()
    whole = baked(0).rows
    bound = bind_rows(whole, pipe.snapshot, "/e")
    position = np.empty((len(whole.site_row), 3))
    position[bound.search.site] = bound.search.key[:, :3]
    left = position[:, 0] < 0
    keys = []
    for gain, seen in ((2.0, left), (4.0, ~left)):
        rows = bake(replace(OBJECT, parameters={"gain": gain})).rows
        rows = replace(
            rows,
            sites=whole.sites.take(np.flatnonzero(seen)),
            site_reach=np.full(int(seen.sum()), 0.3, np.float32),
            site_row=np.zeros(int(seen.sum()), np.int32),
        )
        keys.append((baked(0)._replace(rows=rows), 0.5))
    field = bind(EditStack("", (as_baked(OBJECT, *keys),)), pipe.snapshot)
    points = pipe.view.points
    on_floor = np.flatnonzero(samples(OBJECT).touched)
    receivers = field.receivers(take_points(points, on_floor))
    confidence = np.stack([located.confidence for located in receivers.located])
    casters = field.casters(take_points(pipe.gather.points, samples(OBJECT).leaf_numbers[:1]))
    n = len(on_floor)
    found = field.evaluate(np.ones((1, n, 3), np.float32), receivers, casters.take(np.zeros(n, np.int64)))
    scale = found.scale[0, :, 0]
    for own, other, gain in ((0, 1, 2.0), (1, 0, 4.0)):
        alone = (confidence[own] > 0.999) & (confidence[other] == 0)
        assert alone.any()
        assert np.allclose(scale[alone], gain, atol=5e-3)
    both = (confidence > 0.999).all(axis=0)
    if both.any():
        assert np.allclose(scale[both], 3.0, atol=5e-3)


# Rows ride with surfaces ----------------------------------------------------------------------------------------------


def values_at(snapshot: SceneSnapshot, rows, view, gather) -> np.ndarray:
    """S - 1 between the same places of the surfaces, on another snapshot."""

    def moved(points):
        return points_on_surface(snapshot, points.instance, points.triangle, points.barycentric, points.side)

    return delta(bind_rows(rows, snapshot, "/e"), moved(view), moved(gather))


def cornell_with(change) -> SceneSnapshot:
    meshes = [change(mesh) for mesh in cornell_meshes()]
    lamp = cornell(8, 8)
    box = Mesh(np.asarray(lamp.geometry.points[lamp.geometry.mesh_begin[-2] :]), path="/lamp")
    return make_snapshot([*meshes, box], camera=look_at((1, 0.3, 3), (0, 0, 0), fov=60, width=16, height=16))


ON_BLOCK = edit("scale", {"gain": 3.0}, receivers=("/tall", "/floor"), casters=("/low",), near=ball(-0.3, -0.6, 0, 0.7))


def test_rows_do_not_depend_on_the_camera():
    pipe = pipeline()
    work = samples(BRUSH)
    view = take_points(pipe.view.points, np.flatnonzero(work.touched)[::3])
    gather = take_points(pipe.gather.points, work.leaf_numbers)
    before = values_at(pipe.snapshot, baked(1).rows, view, gather)
    other = replace(pipe.snapshot, camera=look_at((2, 1, 2), (0, 0, 0), width=8, height=8))
    assert np.array_equal(values_at(other, baked(1).rows, view, gather), before)


@pytest.mark.parametrize("how", ["object moves", "everything is ten times larger", "floor bends"])
def test_rows_ride_with_their_surfaces(how):
    pipe = pipeline()
    found = bake(ON_BLOCK)
    work = samples(ON_BLOCK)
    view = take_points(pipe.view.points, np.flatnonzero(work.touched))
    gather = take_points(pipe.gather.points, work.leaf_numbers)

    def change(mesh: Mesh) -> Mesh:
        own = np.eye(4)
        own[: len(mesh.transforms[0])] = np.asarray(mesh.transforms[0], float)
        if how == "object moves" and mesh.path in ("/tall", "/low"):
            return replace(mesh, transforms=[translation(0.3, 0.2, -0.1) @ rotation((0, 1, 0), 50) @ own])
        if how.startswith("everything"):
            return replace(mesh, transforms=[np.diag([10.0, 10, 10, 1]) @ own])
        if how == "floor bends" and mesh.path == "/floor":
            points = np.array(mesh.points)
            points[..., 1] += 0.15 * points[..., 0] + 0.1 * points[..., 2]
            return replace(mesh, points=points)
        return mesh

    before = values_at(pipe.snapshot, found.rows, view, gather)
    after = values_at(cornell_with(change), found.rows, view, gather)
    assert before.max() > 0.5
    # A rigid move changes nothing but rounding; a bend changes distances between samples a little.
    assert np.abs(after - before).max() < (0.03 if how == "floor bends" else 2e-3)


def test_the_unit_of_object_space_does_not_matter():
    """A floor modelled in micrometres and scaled down where it is placed."""

    def tiny(mesh: Mesh) -> Mesh:
        own = np.eye(4)
        own[: len(mesh.transforms[0])] = np.asarray(mesh.transforms[0], float)
        return replace(mesh, points=np.asarray(mesh.points) * 1e6, transforms=[own @ np.diag([1e-6, 1e-6, 1e-6, 1])])

    snapshot = cornell_with(tiny)
    pipe = Pipeline(snapshot, n_gather=256)
    field = bind(at_full_amount(BRUSH), snapshot)
    found = bake_field(field, pipe.view, pipe.gather, snapshot, where="/e")
    assert np.isfinite(found.rows.site_reach).all() and found.rows.site_reach.max() > 1e4
    assert found.rows.epsilon_scale <= 0.0101 and found.measured <= 0.021


def test_a_surface_that_is_gone_is_the_identity_and_a_finding():
    pipe = pipeline()
    kept = [mesh for mesh in cornell_meshes() if mesh.path != "/floor"]
    bound = bind_rows(baked(0).rows, make_snapshot(kept), "/World/Edits/one")
    (finding,) = bound.findings
    assert finding.prim == "/World/Edits/one" and "/floor" in finding.message and "bake it again" in finding.message
    assert len(pipe.view.points.instance)


def test_on_other_topology_rows_go_where_they_lay_with_a_finding():
    pipe = pipeline()
    work = samples(BRUSH)

    def finer(mesh: Mesh) -> Mesh:
        if mesh.path != "/floor":
            return mesh
        points = np.asarray(mesh.points)
        middle = 0.5 * (points + points[:, [1, 2, 0]])
        parts = [np.stack([points[:, i], middle[:, i], middle[:, i - 1]], axis=1) for i in range(3)]
        return replace(mesh, points=np.concatenate([*parts, middle]))

    snapshot = make_snapshot([finer(mesh) for mesh in cornell_meshes()], camera=pipe.snapshot.camera)
    bound = bind_rows(baked(1).rows, snapshot, "/e")
    assert any("topology of /floor" in finding.message for finding in bound.findings)
    z = np.linspace(-0.9, 0.5, 50)
    casters = take_points(pipe.gather.points, work.leaf_numbers)
    same = bind_rows(baked(1).rows, pipe.snapshot, "/e")
    before = delta(same, floor_points(pipe.snapshot, 0.1 * z, z), casters)
    after = delta(bound, floor_points(snapshot, 0.1 * z, z), casters)
    assert before.max() > 0.3
    assert np.abs(after - before).max() < 0.02


# Which form -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("operation", "parameters", "form"),
    [
        ("receive", {"scale": (2.0, 1.0, 1.0)}, Encoding.VECTOR),
        ("scale", {"gain": 2.0}, Encoding.RANK_1),
        ("emit", {"intensity": 2.0}, Encoding.RANK_1),
        ("falloff", {"exponent": 1.0}, Encoding.RECIPE),
        ("gamma", {"exponent": 2.0}, Encoding.RECIPE),
        ("baked", {}, Encoding.ROWS),
    ],
)
def test_the_cheapest_exact_form_wins(operation, parameters, form):
    assert choose(operation, parameters) is form


def test_a_payload_may_hold_several_forms():
    payload = Payload("scale", {"gain": 2.0}, scale_delta=(1.0, 1.0, 1.0), rows=baked(0).rows)
    assert encodings_of(payload) == (Encoding.RANK_1, Encoding.RECIPE, Encoding.ROWS)
    assert encodings_of(Payload("baked", {}, rows=baked(0).rows)) == (Encoding.ROWS,)


def test_errors_between_keys_are_measured_as_edits_interpolate():
    """Half way between gains 2 and 4 lies 3: exact for that edit, off by 1 for one of gain 2."""
    keys = [bake(replace(OBJECT, parameters={"gain": gain})).rows for gain in (2.0, 4.0)]
    weights = [(rows, 0.5) for rows in keys]
    pipe = pipeline()
    assert largest_error(samples(replace(OBJECT, parameters={"gain": 3.0})), weights, pipe.snapshot) < 1e-4
    off = largest_error(samples(replace(OBJECT, parameters={"gain": 2.0})), weights, pipe.snapshot)
    assert off == pytest.approx(1.0, abs=1e-3)
