"""The relighter against the slow evaluator, and what an edit must leave alone."""

from __future__ import annotations

from collections.abc import Mapping

import numba
import numpy as np
import pytest

from icheat_usd.edits import reference
from icheat_usd.edits.field import EditField
from icheat_usd.edits.model import Blend, Edit, KeyedPayload, MaskedSurface, Payload, SurfaceMask, Value
from icheat_usd.relight import receivers as grouping
from icheat_usd.scene import LightKind
from icheat_usd.transport import SparseRows
from tests.edits.test_field import Paint
from tests.pipeline import Pipeline, select
from tests.scenes import Light, Material, Mesh, box, cornell, look_at, make_snapshot, rotation, translation

EVERYTHING = select("/red", "/green", "/floor", "/ceiling", "/back", "/tall", "/low", "/lamp")


@pytest.fixture(scope="module")
def small() -> Pipeline:
    return Pipeline(cornell(8, 8), n_gather=80, rays=64, bounce_rays=64, light_samples=4, n_bounces=6)


@pytest.fixture(scope="module")
def coarse() -> Pipeline:
    """Rows only at some of the view samples, the rest interpolated."""
    return Pipeline(cornell(10, 10), n_gather=80, rays=64, bounce_rays=64, light_samples=4, n_bounces=6, row_spacing=3)


def soft_mask(pipeline: Pipeline, path: str, seed: int = 0) -> SurfaceMask:
    surface = next(s for s in pipeline.snapshot.surfaces if s.path == path)
    texels = np.random.default_rng(seed).uniform(0, 1, (surface.n_faces, 4, 4)).astype(np.float32)
    texels[texels < 0.3] = 0
    return SurfaceMask((MaskedSurface(path, surface.n_faces, surface.instance_id),), texels)


def painted(operation: str, parameters: Mapping[str, Value], receivers, casters, **masks) -> Edit:
    payload = Payload(operation, parameters, **masks)
    return Edit("/soft", operation, parameters, receivers, casters, keys=(KeyedPayload(payload, 1.0),))


def stacks(pipeline: Pipeline) -> dict[str, tuple[Edit, ...]]:
    floor, walls = select("/floor"), select("/red", "/green")
    warm = Edit("/warm", "scale", {"color": (2.0, 1.0, 0.5)}, floor, walls)
    turn = Edit(
        "/turn",
        "hsv",
        {"hue": 120.0, "saturation": 0.8, "value": 1.5},
        select("/floor", "/low"),
        EVERYTHING,
        amount=0.6,
    )
    return {
        "scale between objects": (warm,),
        "hsv over scale": (warm, turn),
        "scale over hsv": (turn, warm),
        "soft receivers": (
            painted("scale", {"gain": 3.0}, floor, walls, receiver_mask=soft_mask(pipeline, "/floor")),
            turn,
        ),
        "soft casters": (
            turn,
            painted("hsv", {"hue": 50.0}, floor, select("/red"), caster_mask=soft_mask(pipeline, "/red", 1)),
        ),
        "over": (warm, Edit("/o", "scale", {"gain": 0.2}, floor, EVERYTHING, amount=0.5, blend=Blend.OVER)),
        "add": (warm, Edit("/a", "hsv", {"hue": 90.0}, floor, EVERYTHING, blend=Blend.ADD)),
    }


NAMES = ["scale between objects", "hsv over scale", "scale over hsv", "soft receivers", "soft casters", "over", "add"]


def dense(rows: SparseRows) -> np.ndarray:
    result = np.zeros(rows.shape)
    for i in range(rows.n_rows):
        entries = slice(rows.indptr[i], rows.indptr[i + 1])
        np.add.at(result[i], rows.indices[entries], rows.weights[entries])
    return result


def slow(pipeline: Pipeline, field: EditField) -> np.ndarray:
    """The defining loop on the relighter's own matrix, written out densely."""
    transport, view, gather = pipeline.transport, pipeline.view, pipeline.gather
    matrix = np.zeros((view.n, len(gather.area), 3))
    weights = None if transport.interpolation is None else dense(transport.interpolation)
    for lobe in transport.lobes:
        rows = dense(lobe.rows)
        matrix += (rows if weights is None else weights @ rows)[:, :, None] * lobe.tint[:, None, :]
    return reference.edited_radiance(
        field,
        matrix,
        pipeline.cell_light.radiance if field.n_groups > 1 else pipeline.relighter.radiance()[None],
        gather.area,
        view.points.albedo,
        field.receivers(view.points),
        field.casters(gather.points),
    )


@pytest.mark.parametrize("kind", ["small", "coarse"])
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("group", [1, 10_000], ids=["grouped", "pair by pair"])
def test_edit_differences_equal_the_slow_evaluator(kind, name, group, request, monkeypatch):
    """Compared are the differences that the edits make, which a good unedited image cannot hide."""
    monkeypatch.setattr(grouping, "SMALLEST_GROUP", group)
    pipeline = request.getfixturevalue(kind)
    field = pipeline.field(*stacks(pipeline)[name])
    fast = pipeline.relighter.relight(field)
    difference = fast.indirect_edited.astype(float) - fast.indirect
    expected = slow(pipeline, field) - slow(pipeline, pipeline.field())
    assert np.abs(expected).max() > 0.01
    np.testing.assert_allclose(difference, expected, atol=2e-5 * np.abs(expected).max() + 1e-6)


def test_offsets_equal_the_slow_evaluator(small, monkeypatch):
    from icheat_usd.edits import operations

    monkeypatch.setitem(operations._OPERATIONS, "test-paint", Paint())
    paint = Edit("/paint", "test-paint", {"density": 0.2}, select("/floor"), select("/back"))
    double = Edit("/double", "scale", {"gain": 2.0}, select("/floor"), EVERYTHING)
    for edits in [(paint, double), (double, paint)]:
        field = small.field(*edits)
        fast = small.relighter.relight(field).indirect_edited
        np.testing.assert_allclose(fast, slow(small, field), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("threads", [1, 2])
def test_no_edit_muted_edit_and_amount_zero_are_the_unedited_image_bit_for_bit(small, threads):
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    try:
        floor = select("/floor")
        plain = small.relight()
        muted = Edit("/e", "scale", {"gain": 3.0}, floor, EVERYTHING, enabled=False)
        zero = Edit("/e", "scale", {"gain": 3.0}, floor, EVERYTHING, amount=0.0)
        unreached = Edit("/e", "scale", {"gain": 3.0}, select("/nothing"), EVERYTHING)
        for edit in (muted, zero, unreached):
            light = small.relight(edit)
            np.testing.assert_array_equal(light.indirect_edited, plain.indirect)
            np.testing.assert_array_equal(light.indirect, plain.indirect)
    finally:
        numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)


def test_samples_outside_the_receivers_keep_their_bits_and_those_inside_change(small):
    light = small.relight(Edit("/e", "hsv", {"value": 3.0}, select("/floor"), EVERYTHING))
    on_floor = (
        small.field(Edit("/e", "scale", {}, select("/floor"), EVERYTHING)).receiver_masks(small.view.points)[0] > 0
    )
    np.testing.assert_array_equal(light.indirect_edited[~on_floor], light.indirect[~on_floor])
    assert on_floor.sum() > 5
    np.testing.assert_allclose(light.indirect_edited[on_floor], 3 * light.indirect[on_floor], rtol=1e-4)


def test_scaling_everything_by_k_scales_the_indirect_image(small):
    light = small.relight(Edit("/e", "scale", {"gain": 2.5}, EVERYTHING, EVERYTHING))
    np.testing.assert_allclose(light.indirect_edited, 2.5 * light.indirect, rtol=1e-5)


def test_lights_add_up_and_gains_scale_them():
    room = box((4, 3, 4), inward=True)
    down = rotation((1, 0, 0), -90)
    lights = [
        Light(LightKind.RECT, (9, 5, 2), translation(-1, 1.4, 0) @ down, (0.5, 0.5)),
        Light(LightKind.RECT, (1, 4, 8), translation(1, 1.4, 0) @ down, (0.5, 0.5)),
    ]
    camera = look_at((0, 0, 1.8), (0, -0.5, -1), fov=70, width=12, height=12)
    both = make_snapshot([Mesh(room, Material(0.6), path="/room")], lights=lights, camera=camera)
    pipeline = Pipeline(both, n_gather=200, rays=64, bounce_rays=64, n_bounces=6)
    field = pipeline.field()
    first, second = (
        pipeline.relighter.relight(field, np.array(gains, np.float32))
        for gains in ([[1] * 3, [0] * 3], [[0] * 3, [1] * 3])
    )
    np.testing.assert_allclose(first.indirect + second.indirect, pipeline.relight().indirect, rtol=1e-5)
    doubled = pipeline.relighter.relight(field, np.array([[2] * 3, [0] * 3], np.float32))
    np.testing.assert_allclose(doubled.indirect, 2 * first.indirect, rtol=1e-6)


def test_key_halfway_is_the_mean_of_its_neighbours(small):
    def keyed(weights):
        keys = tuple(
            KeyedPayload(Payload("scale", {"gain": 3.0}, receiver_mask=soft_mask(small, "/floor", seed)), weight)
            for seed, weight in enumerate(weights)
            if weight
        )
        edit = Edit("/k", "scale", {"gain": 3.0}, select("/floor"), EVERYTHING, keys=keys)
        return small.relight(edit).indirect_edited

    def at(seed):
        payload = Payload("scale", {"gain": 3.0}, receiver_mask=soft_mask(small, "/floor", seed))
        edit = Edit("/k", "scale", {"gain": 3.0}, select("/floor"), EVERYTHING, keys=(KeyedPayload(payload, 1.0),))
        return small.relight(edit).indirect_edited

    np.testing.assert_allclose(keyed((0.25, 0.75)), 0.25 * at(0) + 0.75 * at(1), rtol=1e-4, atol=1e-6)
