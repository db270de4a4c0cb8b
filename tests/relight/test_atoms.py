"""Edits that multiply: their versions as sums over atoms, beside the same multiplied one by one."""

from __future__ import annotations

import numpy as np

from icheat_usd.edits.model import EditStack, KeyedPayload, Payload
from icheat_usd.relight import atoms
from icheat_usd.relight.products import Products
from tests.pipeline import select
from tests.relight.test_live import fresh
from tests.relight.test_operations import PARAMETERS, edit, pipeline, soft_mask

FLOOR = select("/floor")
PAINTED = Payload("scale", PARAMETERS["scale"], soft_mask("/floor", 5))
STACK = EditStack(
    "/stack",
    (
        edit("a", "scale", FLOOR, select("/red", "/back")),
        edit("b", "scale", FLOOR, select("/back", "/green"), amount=0.6),
        edit("c", "scale", FLOOR, select("/back"), keys=(KeyedPayload(PAINTED, 1.0),)),
        edit("d", "hsv", select("/back"), select("/green"), amount=0.5),
    ),
)
ONE = np.ones((2, 3), np.float32)


def test_sums_over_atoms_are_the_versions_themselves(monkeypatch):
    of = pipeline("full")
    by_atoms = fresh(of, STACK, ONE)
    found = by_atoms.relit()
    assert by_atoms._versions._sums.atoms
    monkeypatch.setattr(atoms, "MOST_ATOMS", -1)
    alone = fresh(of, STACK, ONE)
    expected = alone.relit()
    assert not alone._versions._sums.atoms
    change = np.abs(expected.indirect_edited - expected.indirect).max()
    assert change > 0.003
    np.testing.assert_allclose(found.indirect_edited, expected.indirect_edited, rtol=1e-5, atol=2e-6 * change)


def test_an_amount_of_edits_that_multiply_needs_no_product(monkeypatch):
    of = pipeline("full")
    shown = fresh(of, STACK, ONE)
    shown.frame()
    done: list[int] = []
    multiply = Products.multiply

    def counted(self, pairs, *rest, **more):
        done.append(len(pairs))
        multiply(self, pairs, *rest, **more)

    monkeypatch.setattr(Products, "multiply", counted)
    before = shown.relit().indirect_edited
    for path in ("/a", "/b"):
        shown.set_amount(path, 0.3)
    after = shown.relit().indirect_edited
    assert np.abs(after - before).max() > 0.001
    assert sum(done) == 0
    np.testing.assert_array_equal(after, fresh(of, shown.stack, ONE).relit().indirect_edited)
    done.clear()
    shown.set_amount("/d", 0.9)
    shown.relit()
    assert sum(done) > 0  # a turned hue looks at the light


def test_casters_that_are_acted_on_alike_are_one_atom():
    of = pipeline("full")
    stack = EditStack("/stack", (*STACK.edits, edit("e", "emit", FLOOR, select("/red"), amount=0.5)))
    shown = fresh(of, stack, ONE)
    found = shown._versions._atoms
    surface = of.snapshot.geometry.instance_surface[of.gather.points.instance]
    names = np.array([surface.path for surface in of.snapshot.surfaces])[surface]
    edited = np.isin(names, ["/red", "/back", "/green"])
    assert (found.of_cell[~edited] == -1).all()
    for name in ("/red", "/green"):
        assert len(np.unique(found.of_cell[names == name])) == 1
    rows = [bound.edit.path for bound in shown._stack.compiled.field.edits]
    assert not found.multiplies[rows.index("/d")] and not found.multiplies[rows.index("/e")]
