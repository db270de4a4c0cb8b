"""Boxes around see-through triangles: all of these lie in them, and rays past them meet none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icheat_usd.kernels.embree import PACKET
from icheat_usd.kernels.shadow_lanes import keep_near_boxes
from icheat_usd.lighting.change import one_light
from icheat_usd.lighting.clear_boxes import boxes_around
from icheat_usd.lighting.quick import LastLook, build_shadows, direct_at, prepare_places
from icheat_usd.scene import F32
from tests.lighting.test_quick import LIGHTS, on_floor, scene, tracer_of
from tests.scenes import Material, Mesh, make_snapshot, rotation, scaling, sphere, translation


def surface(boxes: F32) -> float:
    x, y, z = (boxes[:, 3:] - boxes[:, :3]).astype(np.float64).T
    return float(np.sum(x * y + y * z + z * x))


def test_every_triangle_that_is_meant_lies_in_a_box() -> None:
    rng = np.random.default_rng(4)
    places = [
        [translation(5, 0, 1) @ rotation((1, 2, 0), 40) @ scaling(1, 3, 0.5), translation(-4, 2, 0), scaling(1, 1, 1)],
        [rotation((0, 1, 1), 70) @ translation(0, 0, 9)],
    ]
    meshes = [Mesh(sphere(0.5, n)[0], Material(0.5), some) for n, some in zip((6, 9), places, strict=True)]
    geometry = make_snapshot(meshes).geometry
    kept = rng.random(len(geometry.points)) < 0.3
    hidden = np.array([False, True, False, False])
    boxes = boxes_around(geometry, kept, hidden)
    assert 3 <= len(boxes) <= 16
    for instance in np.flatnonzero(~hidden):
        mesh = geometry.instance_mesh[instance]
        some = slice(geometry.mesh_begin[mesh], geometry.mesh_begin[mesh + 1])
        matrix = geometry.instance_to_world[instance].astype(np.float64)
        corners = geometry.points[some][kept[some]] @ matrix[:, :3].T + matrix[:, 3]
        inside = (corners[:, :, None] >= boxes[:, :3]) & (corners[:, :, None] <= boxes[:, 3:])
        assert inside.all(axis=(1, 3)).any(axis=1).all()
    # where the hidden one stands there is nothing
    assert not (boxes[:, 0] < -3).any()


def test_what_lies_apart_has_boxes_of_its_own() -> None:
    ball = sphere(0.1, 8)[0]
    meshes = [Mesh(ball, Material(0.5), [translation(x, y, 0) for x in (0, 5) for y in (0, 5)])]
    geometry = make_snapshot(meshes).geometry
    kept = np.ones(len(geometry.points), bool)
    boxes = boxes_around(geometry, kept)
    assert surface(boxes) < 4 * surface(np.array([[-0.101, -0.101, -0.101, 0.101, 0.101, 0.101]]))
    assert not len(boxes_around(geometry, ~kept))
    assert not len(boxes_around(geometry, kept, np.ones(4, bool)))


def test_many_triangles_are_taken_together() -> None:
    ball = sphere(1.0, 60)[0]
    geometry = make_snapshot([Mesh(ball, Material(0.5), [translation(3 * x, 0, 0) for x in range(3)])]).geometry
    boxes = boxes_around(geometry, np.ones(len(geometry.points), bool))
    np.testing.assert_allclose(boxes[:, :3].min(axis=0), [-1, -1, -1], atol=0.01)
    np.testing.assert_allclose(boxes[:, 3:].max(axis=0), [7, 1, 1], atol=0.01)


def test_rays_that_touch_no_box_are_taken_out() -> None:
    rng = np.random.default_rng(1)
    low = rng.uniform(-2, 1.5, (5, 3))
    boxes = np.concatenate([low, low + rng.uniform(0.3, 2, (5, 3))], axis=1).astype(np.float32)
    boxes[4, 3:] = boxes[4, :3]  # of no size
    taken = 0
    for turn in range(200):
        rays = np.zeros(PACKET, np.float32).reshape(22, 16)
        rays[:3], rays[4:7] = rng.uniform(-3, 3, (2, 3, 16))
        rays[5:7, :5] = 0  # along an axis
        rays[4:7, 8:] = (boxes[:4, :3] + boxes[:4, 3:]).T.repeat(2, axis=1) / 2 - rays[:3, 8:]  # to the middle
        rays[8] = np.inf if turn % 2 else 1.0
        rays[8, 3] = -np.inf  # blocked before
        valid = np.where(rng.random(16) < 0.9, -1, 0).astype(np.int32)
        was, touches, nearly = valid.copy(), np.zeros(16, bool), np.zeros(16, bool)
        for box in boxes.astype(np.float64):
            for slack, found in ((-1e-4, touches), (1e-4, nearly)):
                with np.errstate(divide="ignore", invalid="ignore"):
                    o, d = rays[:3].astype(np.float64), rays[4:7].astype(np.float64)
                    t = (np.stack([box[:3] - slack, box[3:] + slack])[:, :, None] - o) / d
                near, far = np.fmin(*t), np.fmax(*t)
                beside = (d == 0) & ((o < box[:3, None] - slack) | (o > box[3:, None] + slack))
                near, far = np.where(d == 0, -np.inf, near).max(axis=0), np.where(d == 0, np.inf, far).min(axis=0)
                found |= (np.maximum(near, 0) <= np.minimum(far, rays[8])) & ~beside.any(axis=0)
        left = keep_near_boxes(boxes, rays, valid)
        assert left == valid.any()
        assert (valid[touches] == was[touches]).all()
        assert not valid[~nearly].any()
        assert not valid[was == 0].any()
        taken += np.count_nonzero(was != valid)
    assert 500 < taken < 2500


@pytest.mark.parametrize("name", ["rect", "sun", "beam", "sphere"])
def test_light_through_holes_and_glass_is_the_same_to_the_bit_whatever_the_boxes(name: str) -> None:
    snapshot = scene(LIGHTS[name], Material(0.5))
    points, alone = on_floor(snapshot, 3000), one_light(snapshot, 0)
    shadows = build_shadows(snapshot, tracer_of(snapshot))
    places = prepare_places(snapshot, points, points.albedo, None)
    assert 1 < len(shadows.boxes) <= 16
    everything = np.array([[-9, -9, -9, 9, 9, 9]], np.float32)
    images = []
    for boxes in (shadows.boxes, everything, everything[:0]):
        last, some = LastLook(places), np.empty((3, 3000, 3), np.float32)
        for turn, out in enumerate(some):
            direct_at(alone, replace(shadows, boxes=boxes), places, 5, turn > 1, out, last=last)
        images.append(some)
    np.testing.assert_array_equal(images[0], images[1])
    assert (images[0] != images[2]).any()
