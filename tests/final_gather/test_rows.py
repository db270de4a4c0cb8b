"""Sampled rows and cache records: sums, mixtures and derivatives against pairs that are looked at one by one."""

from __future__ import annotations

import functools
from dataclasses import replace

import numba
import numpy as np
import pytest

from icheat_usd.edits.bound import Ends
from icheat_usd.edits.encodings.bake import bake_field
from icheat_usd.edits.model import Blend, Edit, KeyedPayload, Payload, Selection
from icheat_usd.final_gather import CacheSettings
from icheat_usd.final_gather.gatherer import Gatherer, GatherSolution
from icheat_usd.final_gather.hemispheres import Hemispheres, Part
from icheat_usd.final_gather.irradiance_cache import IrradianceCache, Lookup, Places, RecordValues
from icheat_usd.final_gather.receiver_sets import Touched, touched
from icheat_usd.final_gather.record_rays import HemisphereTracer, take_rays
from icheat_usd.final_gather.row_records import RowRecords
from icheat_usd.final_gather.row_stack import is_of_rows
from icheat_usd.kernels.irradiance_cache import MAX_ENTRIES
from icheat_usd.lighting import build_light_sampler
from icheat_usd.materials import take_points
from tests.final_gather.test_edits import BLEED, EVERYTHING, SCENE, SIDES, WHITE, painted, previews
from tests.pipeline import select

SETTINGS = CacheSettings(n_theta=8, noise=0.2, most_hemispheres=3)
FLOOR = select("/floor", "/back")


@functools.cache
def baked(name: str, operation: str, receivers: Selection, casters: Selection, **values: object) -> Edit:
    """An edit as rows alone; it acts on what it was baked for, whatever is selected."""
    parts = previews()[0]
    field = parts.field(Edit(name, operation, values, receivers, casters))
    rows = bake_field(field, parts.view, parts.gather, parts.snapshot, where=name).rows
    return Edit(name, "baked", {}, EVERYTHING, EVERYTHING, keys=(KeyedPayload(Payload("baked", {}, rows=rows), 1.0),))


def far(**changed: object) -> Edit:
    return replace(baked("/far", "falloff", FLOOR, select("/red", "/green", "/ceiling"), exponent=1.0), **changed)


def near(**changed: object) -> Edit:
    return replace(baked("/near", "falloff", select("/floor", "/low"), SIDES, exponent=2.8), **changed)


def glow(**changed: object) -> Edit:
    return replace(baked("/glow", "emit", FLOOR, SIDES, color=(0.3, 0.1, 0.6)), **changed)


def between() -> Edit:
    """Half way from one key to another."""
    keys = tuple(KeyedPayload(edit.keys[0].payload, 0.5) for edit in (far(), near()))
    return replace(far(), path="/between", keys=keys)


def stack(name: str) -> tuple[Edit, ...]:
    found: dict[str, tuple[Edit, ...]] = {
        "one": (far(amount=0.7),),
        "colours and emission": (glow(),),
        "two keys": (between(),),
        "two edits": (far(), near(amount=0.8)),
        "grey blends": (far(), near(blend=Blend.OVER, amount=0.5), far(path="/more", blend=Blend.ADD)),
        "all blends": (glow(), far(), near(blend=Blend.OVER, amount=0.5), far(path="/more", blend=Blend.ADD)),
        "rows and masks": (BLEED, far(), painted("scale", {"gain": 4.0}), glow()),
    }
    return found[name]


ALONE = ("one", "colours and emission", "two keys")
SEVERAL = ("two edits", "grey blends", "all blends", "rows and masks")


class Built:
    """A cache with some records on the floor, the back wall and a block, under a stack."""

    def __init__(self, edits: tuple[Edit, ...]) -> None:
        parts = previews()[0]
        self.field, self.gather = parts.field(*edits), parts.gather
        assert is_of_rows(self.field)
        varied = [
            c.on_instances > 0 for bound in self.field.edits for c in bound.casters if not c.constant_on_instances
        ]
        self.is_varied = np.any([np.zeros(SCENE.n_instances, bool), *varied], axis=0)
        b = parts.cell_light.radiance.sum(axis=0, dtype=np.float32)[None]
        self.b = b
        sampler = build_light_sampler(SCENE, parts.tracer, parts.view.points)
        solution = GatherSolution(parts.gather, b, b[0], None)
        gatherer = Gatherer(SCENE, parts.tracer, sampler, 4, 1, self.field, solution, (), follows_paths=False)
        hemispheres = HemisphereTracer(SCENE, parts.tracer, parts.gather, SETTINGS.n_theta, SETTINGS.n_phi, seed=3)
        cells = np.concatenate([b[0], np.zeros((1, 3), np.float32)])
        self.cache = IrradianceCache(hemispheres, cells, SETTINGS, is_kept=True)
        self.points = take_points(parts.view.points, np.arange(0, parts.view.n, 31))
        n = len(self.points.instance)
        self.cache.add(Places(self.points, np.full(n, 0.05, np.float32), np.full(n, np.inf, np.float32)))
        hemispheres_of = Hemispheres([Part(*part) for part in self.cache.parts], self.cache.shrink)
        self.records = RowRecords(gatherer, self.cache, hemispheres_of)

    def touched(self, points) -> Touched:
        return touched(self.field, points)

    def change(self, points, receivers: Touched, record: np.ndarray) -> np.ndarray:
        """By one record for each of `receivers`."""
        n = len(points.instance)
        found = Lookup(
            np.zeros(n, np.int32), np.zeros((n, MAX_ENTRIES), np.int32), np.zeros((n, MAX_ENTRIES), np.float32),
            np.ones(n, np.float32),
        )  # fmt: skip
        found.number[receivers.where], found.record[receivers.where, 0] = 1, record
        found.weight[receivers.where, 0] = 1
        return self.records.change(found, points, receivers)

    def pair_by_pair(self, record: int, ends: Ends) -> RecordValues:
        """What the stack changes of one record's light, at a receiver that is looked at as it is."""
        found = None
        owners = np.concatenate([owner for _, _, owner in self.cache.parts])
        share = np.float32(1 / (owners == record).sum())
        for rays, _, owner in self.cache.parts:
            for row in np.flatnonzero(owner == record).tolist():
                one = take_rays(rays, np.array([row]))
                lit = np.flatnonzero(one.cell[0] >= 0)
                cell = one.cell[0][lit]
                hits = one.ends(SCENE, lit)
                casters = self.field.casters(hits)
                # Gather samples speak for the hits around them, but where edits look closer.
                of_cells = self.field.casters(take_points(self.gather.points, cell)).located
                closer = self.is_varied[hits.instance]
                located = tuple(np.where(closer, *pair) for pair in zip(casters.located, of_cells, strict=True))
                seen = np.take(self.b, cell, axis=1)
                light = np.zeros((1, one.n_rays, 3), np.float32)
                pairs = self.field.evaluate(seen, ends, casters._replace(located=located))
                light[0, lit] = pairs.light(seen) - seen[0]
                values, _ = self.cache.sums(one, light)
                parts = [share * column[0] for column in values]
                found = parts if found is None else [a + b for a, b in zip(found, parts, strict=True)]
        assert found is not None
        return RecordValues(found[0], found[1], self.cache.shrink[record] * found[2])


@functools.cache
def built(name: str) -> Built:
    return Built(stack(name))


def at(values: RecordValues, cache: IrradianceCache, record: int, position, normal) -> np.ndarray:
    turn = np.cross(cache.table.normal[record], normal)
    return values.irradiance + values.by_turn @ turn + values.by_move @ (position - cache.table.position[record])


@pytest.mark.parametrize("name", ALONE)
def test_one_edit_is_what_its_pairs_are_wherever_the_receiver_is(name):
    """Places far from the record, whose rows are others than those there."""
    there = built(name)
    points = take_points(previews()[0].view.points, np.arange(7, previews()[0].view.n, 41))
    receivers = there.touched(points)
    record = np.arange(len(receivers.where)) % there.cache.n
    found = there.change(points, receivers, record)
    expected = np.array(
        [
            at(
                there.pair_by_pair(r, receivers.ends().take(np.array([k]))),
                there.cache, r, points.position[p], points.shading_normal[p],
            )
            for k, (p, r) in enumerate(zip(receivers.where.tolist(), record.tolist(), strict=True))
        ]
    )  # fmt: skip
    size = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, atol=2e-5 * size)
    assert size > 0.03 and len(found) > 10


@pytest.mark.parametrize("name", SEVERAL)
def test_several_edits_are_what_their_pairs_are_at_the_records(name):
    there = built(name)
    receivers = there.touched(there.points)
    found = there.change(there.points, receivers, receivers.where)
    ends = receivers.ends()
    expected = np.array(
        [there.pair_by_pair(r, ends.take(np.array([k]))).irradiance for k, r in enumerate(receivers.where.tolist())]
    )
    size = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, atol=2e-5 * size)
    assert size > 0.03 and len(found) > 10


@pytest.mark.parametrize("name", SEVERAL)
def test_derivatives_by_the_weights_of_rows_are_finite_differences(name):
    """Of each row of each edit, at receivers that several edits have rows for."""
    there, step = built(name), np.float32(0.02)
    receivers = there.touched(there.points)
    whole = receivers.ends()
    several = np.flatnonzero(np.all([(mixture.rows >= 0).any(axis=1) for mixture in whole.located], axis=0))[:4]
    receivers = receivers.take(several)
    largest = 0.0
    for which in range(len(whole.located)):

        def moved(by, which=which):
            ends = receivers.ends()
            located = list(ends.located)
            weights = located[which].weights.copy()
            weights[:, 0] += by
            located[which] = located[which]._replace(weights=weights)
            return receivers._replace(whole=ends._replace(located=tuple(located)))

        found = there.change(there.points, moved(step), receivers.where)
        found -= there.change(there.points, receivers, receivers.where)
        sides = []
        for sign in (1, -1):
            ends = moved(sign * step).ends()
            values = [there.pair_by_pair(r, ends.take(np.array([k]))) for k, r in enumerate(receivers.where.tolist())]
            sides.append(np.array([value.irradiance for value in values]))
        expected = (sides[0] - sides[1]) / 2
        np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max() + 1e-6)
        largest = max(largest, float(np.abs(expected).max()))
    assert largest > 1e-3 and len(several) >= 2


RENDERED = {"samples": 4, "rays": 4, "light_samples": 1, "method": "cached", "edge_samples": 2}


def test_rows_have_the_same_bits_on_one_thread_and_on_two():
    found = []
    for threads in (1, 2):
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        try:
            found.append(previews()[0].final(*stack("rows and masks"), **RENDERED).indirect_edited)
        finally:
            numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    np.testing.assert_array_equal(*found)


def test_muted_rows_are_the_unedited_image_and_others_stay_on_their_receivers():
    plain = previews()[0].final(**RENDERED)
    for edit in (far(enabled=False), far(amount=0.0)):
        muted = previews()[0].final(edit, **RENDERED)
        np.testing.assert_array_equal(muted.indirect_edited, plain.indirect_edited)
    found = previews()[0].final(far(), **RENDERED)
    np.testing.assert_array_equal(found.indirect, plain.indirect)
    changed = (found.indirect_edited != plain.indirect_edited).any(axis=-1)
    assert 0.1 < changed.mean() < 0.8


def test_masks_of_other_stacks_are_none_of_rows():
    assert not is_of_rows(previews()[0].field(BLEED))
    assert not is_of_rows(previews()[0].field(Edit("/f", "falloff", {"exponent": 1.0}, WHITE, EVERYTHING), far()))
