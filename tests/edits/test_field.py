"""The fast stack evaluation against the slow definition, and the properties of composition."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from icheat_usd.edits.field import BoundEdit, BoundMask, EditField
from icheat_usd.edits.model import Blend, Edit, Selection, Value
from icheat_usd.edits.operations import Operation, PairCoefficients, Pairs, Parameter, find
from icheat_usd.edits.reference import pair_functions

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


def bound(operation: Operation, parameters=(), *, amount=1.0, blend=Blend.COMPOSE, key_weights=(1.0,)) -> BoundEdit:
    edit = Edit("/edit", operation.name, dict(parameters), NOWHERE, NOWHERE, amount=amount, blend=blend)
    empty = BoundMask(np.zeros(0, np.float32), None, np.zeros(0, np.int64))
    masks = (empty,) * len(key_weights)
    complete = (operation.complete(edit.parameters, "/edit"),) * len(key_weights)
    return BoundEdit(edit, operation, complete, (), masks, masks, key_weights)


def random_pairs(n: int, n_rows: int, seed: int = 1):
    rng = np.random.default_rng(seed)
    b = rng.uniform(0, 2, (n, 3)).astype(np.float32)
    b[: n // 8, 1] = 0  # purely coloured light takes the other branch of the division rule
    masks = rng.uniform(0, 1, (2, n_rows, n)).astype(np.float32)
    masks[rng.uniform(size=masks.shape) < 0.3] = 0
    masks[rng.uniform(size=masks.shape) < 0.3] = 1
    return b, masks[0], masks[1]


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
    "two keys": [bound(find("hsv"), {"hue": 40.0}, key_weights=(0.25, 0.75)), bound(find("scale"), {"gain": 2.0})],
}


@pytest.mark.parametrize("name", STACKS)
def test_fast_evaluation_equals_the_definition(name):
    field = EditField(tuple(STACKS[name]))
    b, u, w = random_pairs(200, field.n_rows)
    fast = field.evaluate(b, u, w)
    zero = np.zeros_like(b)
    for j in range(len(b)):
        expected = pair_functions(field, b[j].astype(float), u[:, j].astype(float), w[:, j].astype(float))
        found = (fast.scale, fast.emission, fast.offset_diffuse, fast.offset_paint)
        for slow, quick in zip(expected, found, strict=True):
            np.testing.assert_allclose((zero if quick is None else quick)[j], slow, rtol=2e-4, atol=2e-5)


def test_pairs_outside_the_masks_keep_exactly_the_identity():
    field = EditField(tuple(STACKS["hsv over scale"]))
    b, u, w = random_pairs(100, 2)
    u[:, :50] = 0
    w[:, 50:] = 0
    found = field.evaluate(b, u, w)
    assert (found.scale == 1).all() and (found.emission == 0).all()


def test_full_over_hides_the_weaker_edits():
    strong = bound(find("scale"), {"gain": 4.0}, blend=Blend.OVER)
    b, u, w = random_pairs(50, 1)
    both = EditField((bound(find("hsv"), {"hue": 90.0}), strong)).evaluate(
        b, np.ones((2, 50), np.float32), np.ones((2, 50), np.float32)
    )
    alone = EditField((strong,)).evaluate(b, np.ones((1, 50), np.float32), np.ones((1, 50), np.float32))
    np.testing.assert_allclose(both.scale, alone.scale, atol=1e-6)
    np.testing.assert_allclose(both.emission, alone.emission, atol=1e-6)


def test_order_matters_where_an_offset_is_present():
    ones = np.ones((2, 4), np.float32)
    b = np.ones((4, 3), np.float32)
    double, paint = bound(find("scale"), {"gain": 2.0}), bound(Paint())
    first = EditField((double, paint)).evaluate(b, ones, ones).offset_paint
    last = EditField((paint, double)).evaluate(b, ones, ones).offset_paint
    np.testing.assert_allclose(first, 0.5)
    np.testing.assert_allclose(last, 1.0)


def test_two_scales_are_the_scale_of_their_product():
    b, u, w = random_pairs(20, 2)
    ones = np.ones((2, 20), np.float32)
    two = EditField((bound(find("scale"), {"gain": 2.0}), bound(find("scale"), {"gain": 3.0}))).evaluate(b, ones, ones)
    np.testing.assert_array_equal(two.scale, np.full((20, 3), 6, np.float32))


def test_halfway_between_two_keys_is_the_mean_of_their_edits():
    halves = bound(find("hsv"), {"hue": 100.0, "value": 2.0}, key_weights=(0.5, 0.5))
    b, _, _ = random_pairs(30, 1)
    zero, one = np.zeros((1, 30), np.float32), np.ones((1, 30), np.float32)
    found = EditField((halves,)).evaluate(b, np.concatenate([one, zero]), np.ones((2, 30), np.float32))
    full = EditField((bound(find("hsv"), {"hue": 100.0, "value": 2.0}),)).evaluate(b, one, one)
    np.testing.assert_allclose(found.scale - 1, 0.5 * (full.scale - 1), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found.emission, 0.5 * full.emission, rtol=1e-5, atol=1e-6)
