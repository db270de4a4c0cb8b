"""Selections against a slow evaluator that follows the words of the model, one point at a time."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from icheat_usd.edits.model import (
    Combination,
    Limit,
    MaskedSurface,
    Region,
    Rule,
    Selection,
    Shape,
    SurfaceMask,
    SurfacesAt,
    SurfacesOf,
)
from icheat_usd.edits.selection import bind_selection
from icheat_usd.materials import points_on_surface
from icheat_usd.scene import SceneSnapshot, SurfacePoints
from tests.scenes import Material, Mesh, box, make_snapshot, rotation, scaling, translation

IDENTITY = tuple(np.eye(4)[:3].ravel())
MATERIALS = ("", "/red", "/green", "/blue")


def scene() -> SceneSnapshot:
    red, green, blue = (Material(diffuse=colour) for colour in np.eye(3))
    meshes = [
        Mesh(box(1.0), red, path="/left", transforms=[translation(-1, 0, 0)]),
        Mesh(box(1.0), [green] * 4 + [blue] * 8, path="/right", transforms=[translation(1, 0, 0)]),
        Mesh(
            box(0.5), blue, path="/many", transforms=[translation(0, 1, z) @ rotation((0, 1, 0), 30) for z in (-1, 1)]
        ),
    ]
    snapshot = make_snapshot(meshes)
    assert len(snapshot.material_paths) == len(MATERIALS)
    return replace(snapshot, material_paths=MATERIALS, centre=np.array([10.0, -20.0, 5.0]))


SCENE = scene()
EVERYTHING = frozenset(surface.path for surface in SCENE.surfaces)


def some_points(snapshot: SceneSnapshot, n: int = 64, seed: int = 0) -> SurfacePoints:
    rng = np.random.default_rng(seed)
    geometry = snapshot.geometry
    instance = rng.integers(0, snapshot.n_instances, n).astype(np.int32)
    mesh = geometry.instance_mesh[instance]
    triangle = rng.integers(geometry.mesh_begin[mesh], geometry.mesh_begin[mesh + 1]).astype(np.int32)
    uv = rng.uniform(size=(n, 2)) * 0.5
    return points_on_surface(snapshot, instance, triangle, uv.astype(np.float32), np.zeros(n, np.uint8))


POINTS = some_points(SCENE)


# --------------------------------------------------------------------------- the slow evaluator


def naive(limit: Limit, snapshot: SceneSnapshot, points: SurfacePoints, i: int) -> float:
    geometry = snapshot.geometry
    if isinstance(limit, SurfacesAt):
        return float(snapshot.surfaces[geometry.instance_surface[points.instance[i]]].path in limit.paths)
    if isinstance(limit, SurfacesOf):
        return float(snapshot.material_paths[geometry.material[points.triangle[i]]] in limit.materials)
    if isinstance(limit, Region):
        matrix = np.reshape(limit.to_shape, (3, 4))
        local = matrix[:, :3] @ (points.position[i].astype(float) + snapshot.centre) + matrix[:, 3]
        distance = max(abs(local)) if limit.shape is Shape.BOX else float(np.sqrt((local**2).sum()))
        if distance >= 1:
            return 0.0
        if distance <= 1 - limit.softness:
            return 1.0
        x = (1 - distance) / limit.softness
        return float(3 * x**2 - 2 * x**3)
    weights = [naive(part, snapshot, points, i) for part in limit.parts]
    if not weights:
        return 0.0
    result = weights[0]
    for weight in weights[1:]:
        if limit.rule is Rule.INTERSECTION:
            result *= weight
        elif limit.rule is Rule.UNION:
            result = result + weight - result * weight
        else:
            result *= 1 - weight
    return result


@st.composite
def regions(draw: st.DrawFn) -> Region:
    number = st.floats(-2, 2)
    to_metres = (
        translation(*(SCENE.centre + [draw(number) for _ in range(3)]))
        @ rotation([draw(number), draw(number), 1.3], draw(st.floats(0, 360)))
        @ scaling(*(draw(st.floats(0.3, 3)) for _ in range(3)))
    )
    softness = draw(st.one_of(st.just(0.0), st.just(1.0), st.floats(0.05, 0.95)))
    return Region(draw(st.sampled_from(Shape)), tuple(np.linalg.inv(to_metres)[:3].ravel()), softness)


leaves = st.one_of(
    st.builds(SurfacesAt, st.frozensets(st.sampled_from([*sorted(EVERYTHING), "/elsewhere"]))),
    st.builds(SurfacesOf, st.frozensets(st.sampled_from(MATERIALS))),
    regions(),
)
limits = st.recursive(
    leaves,
    lambda part: st.builds(Combination, st.sampled_from(Rule), st.lists(part, max_size=3).map(tuple)),
    max_leaves=8,
)


@settings(max_examples=150, deadline=None)
@given(paths=st.frozensets(st.sampled_from(sorted(EVERYTHING))), given_limits=st.lists(limits, max_size=3))
def test_weights_are_what_the_model_says(paths: frozenset[str], given_limits: list[Limit]) -> None:
    bound = bind_selection(Selection(paths, tuple(given_limits)), None, SCENE, "/e")
    weights = bound.at(POINTS)
    assert weights.dtype == np.float32 and weights.min() >= 0 and weights.max() <= 1
    expected = [
        np.prod([naive(limit, SCENE, POINTS, i) for limit in (SurfacesAt(paths), *given_limits)])
        for i in range(len(POINTS.instance))
    ]
    # A hard border in single precision may fall on either side of a point that lies upon it.
    on_border = np.abs(weights - expected) > 1e-3
    assert not any(on_border & ~_near_a_hard_border(given_limits))
    np.testing.assert_allclose(weights[~on_border], np.asarray(expected)[~on_border], atol=2e-4)
    assert (weights <= bound.on_instances[POINTS.instance]).all()
    if bound.constant_on_instances:
        np.testing.assert_array_equal(weights, bound.on_instances[POINTS.instance])


def _near_a_hard_border(given_limits: list[Limit]) -> np.ndarray:
    near = np.zeros(len(POINTS.instance), bool)
    stack = list(given_limits)
    while stack:
        limit = stack.pop()
        if isinstance(limit, Combination):
            stack += limit.parts
        elif isinstance(limit, Region) and limit.softness == 0:
            matrix = np.reshape(limit.to_shape, (3, 4))
            local = (POINTS.position + SCENE.centre) @ matrix[:, :3].T + matrix[:, 3]
            distance = abs(local).max(1) if limit.shape is Shape.BOX else np.linalg.norm(local, axis=1)
            near |= abs(distance - 1) < 1e-4
    return near


# --------------------------------------------------------------------------- single properties


def test_points_that_are_no_hit_weigh_nothing() -> None:
    missed = POINTS._replace(instance=np.full_like(POINTS.instance, -1), triangle=np.full_like(POINTS.triangle, -1))
    for limit in (SurfacesAt(EVERYTHING), SurfacesOf(frozenset(["/green"])), Region(Shape.BOX, IDENTITY)):
        assert not bind_selection(Selection(EVERYTHING, (limit,)), None, SCENE, "/e").at(missed).any()


def test_a_material_on_some_faces_selects_those_faces() -> None:
    bound = bind_selection(Selection(EVERYTHING, (SurfacesOf(frozenset(["/green"])),)), None, SCENE, "/e")
    assert not bound.constant_on_instances
    first = SCENE.geometry.mesh_begin[1]
    expected = (POINTS.instance == 1) & (POINTS.triangle < first + 4)
    assert expected.any() and ((POINTS.instance == 1) & ~expected).any()
    np.testing.assert_array_equal(bound.at(POINTS), expected)


def test_a_material_on_whole_meshes_is_constant_on_instances() -> None:
    bound = bind_selection(Selection(EVERYTHING, (SurfacesOf(frozenset(["/red"])),)), None, SCENE, "/e")
    assert bound.constant_on_instances
    np.testing.assert_array_equal(bound.on_instances, [1, 0, 0, 0])


def test_a_region_ten_kilometres_out_keeps_its_border() -> None:
    far = replace(SCENE, centre=np.array([1e4, 0.0, 1e4]))
    to_metres = translation(*far.centre) @ translation(1, 0, 0) @ scaling(0.45)
    region = Region(Shape.BOX, tuple(np.linalg.inv(to_metres)[:3].ravel()))
    grown = Region(Shape.BOX, tuple(np.linalg.inv(to_metres @ scaling(0.5 / 0.45)).ravel()[:12]))
    of_right = Selection(frozenset(["/right"]), (region,))
    assert not bind_selection(of_right, None, far, "/e").at(POINTS).any()  # The cube's faces are at 0.5.
    inside = bind_selection(replace(of_right, limits=(grown,)), None, far, "/e").at(POINTS)
    np.testing.assert_array_equal(inside, POINTS.instance == 1)


def test_weights_fall_without_a_step_from_core_to_border() -> None:
    region = Region(Shape.SPHERE, IDENTITY, softness=0.4)
    line = np.linspace(0, 1.2, 500, dtype=np.float32)
    centred = replace(SCENE, centre=np.zeros(3))
    points = POINTS._replace(
        position=np.stack([line, 0 * line, 0 * line], 1).astype(np.float32),
        instance=np.zeros(500, np.int32),
        triangle=np.zeros(500, np.int32),
    )
    weights = bind_selection(Selection(EVERYTHING, (region,)), None, centred, "/e").at(points)
    assert (weights[line < 0.6] == 1).all() and (weights[line >= 1] == 0).all()
    assert all(a >= b for a, b in pairwise(weights)) and np.abs(np.diff(weights)).max() < 0.01


def test_a_painted_mask_multiplies_limits() -> None:
    masked = (MaskedSurface("/left", 12),)
    mask = SurfaceMask(masked, np.full((12, 1, 1), 0.25, np.float32))
    soft = Region(Shape.SPHERE, tuple(np.linalg.inv(translation(*SCENE.centre) @ scaling(3)).ravel()[:12]), 1.0)
    plain = bind_selection(Selection(EVERYTHING, (soft,)), None, SCENE, "/e").at(POINTS)
    painted = bind_selection(Selection(EVERYTHING, (soft,)), mask, SCENE, "/e").at(POINTS)
    np.testing.assert_allclose(painted, np.where(POINTS.instance == 0, 0.25 * plain, 0), rtol=1e-6)
    assert painted.any()


@pytest.mark.parametrize("rule", Rule)
def test_an_empty_combination_selects_nothing(rule: Rule) -> None:
    bound = bind_selection(Selection(EVERYTHING, (Combination(rule, ()),)), None, SCENE, "/e")
    assert bound.constant_on_instances and not bound.on_instances.any()
