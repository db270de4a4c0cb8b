"""The fast stack evaluation against the slow definition, and the properties of composition."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from icheat_usd.edits.bound import BoundEdit, Ends
from icheat_usd.edits.field import EditField
from icheat_usd.edits.model import Blend, Edit, Selection, Value
from icheat_usd.edits.operations import Operation, PairCoefficients, PairEnd, Pairs, Parameter, find
from icheat_usd.edits.reference import pair_functions
from icheat_usd.edits.selection import BoundSelection

NOWHERE = Selection(frozenset())


class Paint(Operation):
    """An offset that depends on nothing, to exercise O."""

    name = "test-paint"
    doc = "Adds an offset."
    parameters = (Parameter("density", 0.5, "1/m^2"),)
    has_offset = True
    offset_times_albedo = False

    def evaluate(self, parameters: Mapping[str, Value], pairs: Pairs) -> PairCoefficients:
        n = len(pairs.incident)
        offset = np.full((n, 3), parameters["density"], np.float32)
        return PairCoefficients(np.full((n, 3), 0.8, np.float32), offset=offset)


def bound(
    operation: Operation, parameters=(), *, amount=1.0, blend=Blend.COMPOSE, key_weights=(1.0,), groups=(True,)
) -> BoundEdit:
    edit = Edit("/edit", operation.name, dict(parameters), NOWHERE, NOWHERE, amount=amount, blend=blend)
    nothing = (BoundSelection(np.zeros(0, np.float32)),) * len(key_weights)
    complete = (operation.complete(edit.parameters, "/edit"),) * len(key_weights)
    none = (None,) * len(key_weights)
    return BoundEdit(
        edit,
        operation,
        complete,
        none,
        none,
        nothing,
        nothing,
        key_weights,
        np.asarray(groups, np.bool_),
        np.zeros(0, np.bool_),
    )


def stack(*edits: BoundEdit) -> EditField:
    n_groups = len(edits[0].groups)
    return EditField(edits, np.arange(n_groups), n_groups)


def random_ends(n: int, n_rows: int, seed: int) -> Ends:
    rng = np.random.default_rng(seed)
    masks = rng.uniform(0, 1, (n_rows, n)).astype(np.float32)
    masks[rng.uniform(size=masks.shape) < 0.3] = 0
    masks[rng.uniform(size=masks.shape) < 0.3] = 1
    normal = rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    place = (rng.uniform(-1, 1, (n, 3)), normal, rng.uniform(0.1, 0.9, (n, 3)))
    return Ends(masks, PairEnd(*(column.astype(np.float32) for column in place)), ())


def full_ends(n: int, n_rows: int) -> Ends:
    return Ends(np.ones((n_rows, n), np.float32), None, ())


def random_light(n: int, n_groups: int = 1) -> np.ndarray:
    b = np.random.default_rng(1).uniform(0, 2, (n_groups, n, 3)).astype(np.float32)
    b[:, : n // 8, 1] = 0  # purely coloured light takes the other branch of the division rule
    return b


STACKS = {
    "scale": [bound(find("scale"), {"color": (2.0, 0.5, 1.0)}, amount=0.7)],
    "hsv over scale": [
        bound(find("scale"), {"color": (2.0, 0.5, 1.0)}),
        bound(find("hsv"), {"hue": 75.0, "saturation": 1.4}, amount=0.8),
    ],
    "scale over hsv": [
        bound(find("hsv"), {"hue": 75.0, "saturation": 0.4}),
        bound(find("scale"), {"gain": 3.0}),
    ],
    "offset between scales": [
        bound(find("scale"), {"gain": 2.0}),
        bound(Paint()),
        bound(find("scale"), {"gain": 0.5}, amount=0.9),
    ],
    "over replaces": [
        bound(find("scale"), {"gain": 4.0}),
        bound(Paint()),
        bound(find("hsv"), {"hue": 20.0}, blend=Blend.OVER),
    ],
    "add sums": [bound(find("hsv"), {"hue": 200.0}), bound(find("scale"), {"gain": 4.0}, blend=Blend.ADD)],
    "edits of one light": [
        bound(find("hsv"), {"hue": 75.0}, groups=(True, False)),
        bound(find("scale"), {"gain": 3.0}, groups=(True, True)),
        bound(find("hsv"), {"value": 0.5}, groups=(False, True), blend=Blend.OVER),
    ],
    "offsets of one light": [
        bound(find("scale"), {"gain": 2.0}, groups=(True, True)),
        bound(Paint(), groups=(False, True)),
        bound(find("scale"), {"gain": 0.5}, amount=0.9, groups=(True, False)),
    ],
    "receivers and casters by place": [
        bound(find("falloff"), {"exponent": 1.0, "pivot": 2.0}),
        bound(find("redirect"), {"target": (0.3, 0.4, 0.5)}, amount=0.6, blend=Blend.ADD),
        bound(find("direction"), {"strength": 1.5}),
        bound(find("albedo"), {"color": (0.9, 0.1, 0.5)}, blend=Blend.OVER, amount=0.5),
    ],
    "emission": [
        bound(find("emit"), {"color": (1.0, 0.5, 0.0)}),
        bound(find("hsv"), {"hue": 30.0}),
        bound(find("scale"), {"gain": 0.5}, blend=Blend.OVER, amount=0.5),
    ],
    "light behind occluders": [
        bound(find("unshadow"), {"color": (1.0, 0.5, 0.2)}, amount=0.8),
        bound(find("scale"), {"gain": 2.0}),
        bound(find("unshadow"), {"color": (0.1, 0.5, 1.0)}, blend=Blend.OVER),
    ],
    "two keys": [bound(find("hsv"), {"hue": 40.0}, key_weights=(0.25, 0.75)), bound(find("scale"), {"gain": 2.0})],
}


@pytest.mark.parametrize("name", STACKS)
def test_fast_evaluation_equals_the_definition(name):
    field = stack(*STACKS[name])
    n = 200
    b = random_light(n, field.n_groups)
    receivers, casters = random_ends(n, field.n_rows, 2), random_ends(n, field.n_rows, 3)
    fast = field.evaluate(b, receivers, casters)
    zero = np.zeros_like(b)
    found = (fast.scale, fast.emission, fast.offset_diffuse, fast.offset_paint, *fast.through)
    for j in range(n):
        one = np.array([j])
        expected = pair_functions(field, b[:, j].astype(float), receivers.take(one), casters.take(one))
        for slow, quick in zip((*expected[:4], *expected.through), found, strict=True):
            quick = zero if quick is None else quick
            np.testing.assert_allclose(quick[..., j, :], slow, rtol=2e-4, atol=2e-5)


def test_a_shared_receiver_is_one_for_each_pair():
    field = stack(*STACKS["receivers and casters by place"])
    receiver, casters, b = random_ends(1, field.n_rows, 2), random_ends(50, field.n_rows, 3), random_light(50)
    shared = field.evaluate(b, receiver, casters)
    each = field.evaluate(b, receiver.take(np.zeros(50, np.int64)), casters)
    np.testing.assert_array_equal(shared.scale, each.scale)


def test_pairs_outside_the_masks_keep_exactly_the_identity():
    field = stack(*STACKS["hsv over scale"])
    receivers, casters = random_ends(100, 2, 2), random_ends(100, 2, 3)
    receivers.masks[:, :50] = 0
    casters.masks[:, 50:] = 0
    found = field.evaluate(random_light(100), receivers, casters)
    assert (found.scale == 1).all() and (found.emission == 0).all()


def test_lights_that_an_edit_does_not_name_keep_exactly_the_identity():
    field = stack(bound(find("hsv"), {"hue": 75.0}, groups=(True, False)))
    found = field.evaluate(random_light(100, 2), full_ends(100, 1), full_ends(100, 1))
    assert (found.scale[1] == 1).all() and (found.scale[0] != 1).any()


def test_full_over_hides_the_weaker_edits():
    strong = bound(find("scale"), {"gain": 4.0}, blend=Blend.OVER)
    b = random_light(50)
    both = stack(bound(find("hsv"), {"hue": 90.0}), strong).evaluate(b, full_ends(50, 2), full_ends(50, 2))
    alone = stack(strong).evaluate(b, full_ends(50, 1), full_ends(50, 1))
    np.testing.assert_allclose(both.scale, alone.scale, atol=1e-6)
    np.testing.assert_allclose(both.emission, alone.emission, atol=1e-6)


def test_order_matters_where_an_offset_is_present():
    ends = full_ends(4, 2)
    b = np.ones((1, 4, 3), np.float32)
    double, paint = bound(find("scale"), {"gain": 2.0}), bound(Paint())
    first = stack(double, paint).evaluate(b, ends, ends).offset_paint
    last = stack(paint, double).evaluate(b, ends, ends).offset_paint
    np.testing.assert_allclose(first, 0.5)
    np.testing.assert_allclose(last, 1.0)


def test_two_scales_are_the_scale_of_their_product():
    ends = full_ends(20, 2)
    two = stack(bound(find("scale"), {"gain": 2.0}), bound(find("scale"), {"gain": 3.0})).evaluate(
        random_light(20), ends, ends
    )
    np.testing.assert_array_equal(two.scale, np.full((1, 20, 3), 6, np.float32))


def test_halfway_between_two_keys_is_the_mean_of_their_edits():
    halves = bound(find("hsv"), {"hue": 100.0, "value": 2.0}, key_weights=(0.5, 0.5))
    b = random_light(30)
    receivers = full_ends(30, 2)
    receivers.masks[1] = 0
    found = stack(halves).evaluate(b, receivers, full_ends(30, 2))
    one = full_ends(30, 1)
    full = stack(bound(find("hsv"), {"hue": 100.0, "value": 2.0})).evaluate(b, one, one)
    np.testing.assert_allclose(found.scale - 1, 0.5 * (full.scale - 1), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found.emission, 0.5 * full.emission, rtol=1e-5, atol=1e-6)
