"""Frames made again with other edits: the bits of a render, and which light belongs to which caster."""

from __future__ import annotations

import functools
from dataclasses import replace

import numba
import numpy as np
import pytest

from icheat_usd.edits.model import Blend, Edit, KeyedPayload, Payload, SurfaceMask
from icheat_usd.final_gather import FinalGather, GatherSettings, final_gather, merged_light, slot_choices
from icheat_usd.final_gather.edited_records import EditedRecords
from tests.final_gather.test_edits import BLEED, DIM, EVERYTHING, GREY, SIDES, WHITE, painted, previews, soft
from tests.final_gather.test_rows import FLOOR, baked
from tests.pipeline import TINY, select

SETTINGS = GatherSettings(4, 16, 4, 4, edge_samples=2, cache=TINY)


def brushed(name: str, operation: str, color: tuple[float, float, float], seed: int) -> Edit:
    """From painted places on a side wall to everything."""
    payload = Payload(operation, {"color": color}, caster_mask=soft("/red", seed))
    return Edit(name, operation, {}, EVERYTHING, select("/red"), keys=(KeyedPayload(payload, 1.0),))


BRUSHED = (
    brushed("/a", "scale", (3.0, 0.5, 2.0), 3),
    brushed("/b", "emit", (0.2, 0.3, 0.1), 4),
    brushed("/c", "scale", (0.1, 2.0, 4.0), 5),
)


#: More on one caster than subsets are kept of, beside edits of the whole of it.
MANY = (*BRUSHED, *(brushed(f"/{k}", "scale", (0.5, 1.5, 1.0 + 0.2 * k), 6 + k) for k in range(3)), BLEED)


def take_rays_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Unless they end where masks weigh the same."""
    monkeypatch.setattr(merged_light, "LEAST_APART", 0.0)


def rows(**changed: object) -> Edit:
    return replace(baked("/far", "falloff", FLOOR, select("/red", "/green", "/ceiling"), exponent=1.0), **changed)


STACKS = {
    "nothing": (),
    "objects": (BLEED,),
    "other amount": (Edit("/bleed", "scale", {"color": (3.0, 2.0, 0.5)}, BLEED.receivers, BLEED.casters, amount=0.3),),
    "overlapping": (BLEED, DIM),
    "added light": (Edit("/emit", "emit", {"color": (0.2, 0.1, 0.3)}, select("/floor"), select("/tall")), BLEED),
    "hue": (GREY,),
    "soft masks": (painted("scale", {"gain": 4.0}), DIM),
    "painted casters": BRUSHED,
    "painted casters and objects": (BRUSHED[0], painted("scale", {"gain": 4.0}), BLEED, *BRUSHED[1:]),
    "direction": (Edit("/e", "falloff", {"exponent": 1.0}, WHITE, EVERYTHING),),
    "curve": (Edit("/g", "gamma", {"exponent": 0.7}, select("/floor"), EVERYTHING),),
}


#: Stacks that look at nothing but masks, and have few soft ones that overlap.
OF_MASKS = ("objects", "overlapping", "added light", "soft masks", "painted casters", "painted casters and objects")


def rendered(*edits: Edit, is_kept: bool = False):
    parts = previews()[0]
    return final_gather(
        parts.snapshot,
        parts.tracer,
        parts.field(*edits),
        settings=SETTINGS,
        gather=parts.gather,
        gather_radiance=parts.cell_light.radiance,
        is_kept=is_kept,
    )


@functools.cache
def rendered_stack(name: str) -> FinalGather:
    """Of `STACKS`, for tests that change nothing in how a frame is rendered."""
    return rendered(*STACKS[name])


@pytest.mark.parametrize("first", ["nothing", "overlapping"])
def test_a_replay_has_the_bits_of_a_render(first):
    kept = rendered(*STACKS[first], is_kept=True)
    changed = 0
    for name, stack in STACKS.items():
        replayed = kept.replay.edited(previews()[0].field(*stack))
        again = rendered_stack(name)
        np.testing.assert_array_equal(again.indirect, kept.indirect)
        np.testing.assert_array_equal(replayed, again.indirect_edited)
        changed += bool((replayed != kept.indirect).any())
    assert changed == len(STACKS) - 1


def test_a_render_that_is_not_kept_has_no_replay():
    assert rendered(BLEED).replay is None


@pytest.mark.parametrize("name", OF_MASKS)
@pytest.mark.parametrize("change, tolerance", [(0.0, 2e-4), (slot_choices.MOST_CHANGE, 5e-3)])
def test_light_under_masks_is_the_light_of_the_rays(name, change, tolerance, monkeypatch):
    """With masks for every place and every ray, and with those of places near it; and edited ray by ray."""
    monkeypatch.setattr(slot_choices, "MOST_CHANGE", change)
    if change == 0.0:
        take_rays_one_by_one(monkeypatch)
    fast = rendered(*STACKS[name]).indirect_edited
    for module in ("final_gather.edited_records", "edits.mask_stack"):
        monkeypatch.setattr(f"icheat_usd.{module}.is_of_masks", lambda field: False)
    slow = rendered(*STACKS[name]).indirect_edited
    assert (fast != slow).any()
    np.testing.assert_allclose(fast, slow, rtol=tolerance, atol=1e-6)


def smooth(path: str, seed: int) -> SurfaceMask:
    """A mask that falls from one side of each face to the other."""
    mask = soft(path, seed)
    a, b, c = np.random.default_rng(seed).uniform(0, 1, 3)
    x = np.linspace(0, 1, 4, dtype=np.float32)
    texels = np.clip(c + (a - 0.5) * x[:, None] + (b - 0.5) * x[None, :], 0, 1).astype(np.float32)
    return SurfaceMask(mask.surfaces, np.broadcast_to(texels, mask.texels.shape).copy())


def smoothly(n: int) -> list[Edit]:
    """From smoothly painted places on a side wall to everything."""
    edits = []
    for i in range(n):
        parameters = {"color": tuple(np.random.default_rng(i).uniform(0.4, 2.0, 3).tolist())}
        payload = Payload("scale", parameters, caster_mask=smooth("/red", i))
        edits.append(
            Edit(f"/smooth{i}", "scale", parameters, EVERYTHING, select("/red"), keys=(KeyedPayload(payload, 1.0),))
        )
    return edits


def rows_and_others() -> tuple[Edit, ...]:
    """Rows on the floor and the back wall, beside what is no row."""
    return (rows(), painted("scale", {"gain": 4.0}), BLEED)


def recipes() -> tuple[Edit, ...]:
    """Edits that look at where receivers and casters are, some over each other."""
    far = Edit("/far", "falloff", {"exponent": 1.0}, select("/floor", "/back"), SIDES)
    turned = Edit("/turned", "direction", {"sharpness": 2.0}, select("/floor"), EVERYTHING, amount=0.6)
    return (far, turned, replace(far, path="/over", casters=EVERYTHING, blend=Blend.OVER, amount=0.5), BLEED)


def changed_stacks(edits: tuple[Edit, ...]) -> list[tuple[Edit, ...]]:
    """Amounts twice, one edit muted, and all as they were."""
    first, *others = edits
    amounts = [(replace(first, amount=amount), *others) for amount in (0.4, 0.7)]
    muted = [(replace(first, enabled=False), *others)] if others else []
    return [*amounts, *muted, edits]


@pytest.mark.parametrize(
    "edits",
    [
        BRUSHED[:1],
        BRUSHED,
        MANY,
        (rows(),),
        (rows(), rows(path="/again", amount=0.5)),
        rows_and_others(),
        recipes()[:1],
        recipes(),
    ],
    ids=["brush", "brushes", "many brushes", "rows", "rows over rows", "rows and others", "recipe", "recipes"],
)
def test_changed_edits_replay_as_they_render(edits):
    kept = rendered(*edits, is_kept=True)
    for changed in changed_stacks(edits):
        again = rendered(*changed).indirect_edited
        np.testing.assert_array_equal(kept.replay.edited(previews()[0].field(*changed)), again)
        assert (again != kept.indirect).any()


@pytest.mark.parametrize(
    "edits",
    [
        recipes()[:1],
        recipes(),
        (replace(recipes()[0], blend=Blend.ADD), painted("falloff", {"exponent": 0.5}), *STACKS["added light"]),
        (rows(), *recipes()[:2]),
    ],
    ids=["one", "several", "added, masks and emission", "beside rows"],
)
def test_light_under_recipes_is_the_light_of_the_rays(edits, monkeypatch):
    fast = rendered(*edits)
    monkeypatch.setattr(EditedRecords, "_by_tables", EditedRecords._by_pairs)
    slow = rendered(*edits).indirect_edited
    assert (slow != fast.indirect).mean() > 0.1 and (fast.indirect_edited != slow).any()
    np.testing.assert_allclose(fast.indirect_edited, slow, rtol=2e-4, atol=1e-6)


def test_a_changed_mask_replays_as_it_renders():
    kept = rendered(*BRUSHED, is_kept=True)
    changed = (brushed("/a", "scale", (3.0, 0.5, 2.0), 9), *BRUSHED[1:])
    replayed = kept.replay.edited(previews()[0].field(*changed))
    assert (replayed != kept.indirect_edited).any()
    np.testing.assert_array_equal(replayed, rendered(*changed).indirect_edited)


@pytest.mark.parametrize(
    "edits", [BRUSHED, MANY, (rows(),), recipes()[:1]], ids=["brushes", "many brushes", "rows", "recipe"]
)
def test_rays_are_not_looked_at_again_for_a_changed_amount(edits, monkeypatch):
    kept = rendered(*edits, is_kept=True)

    def refuse(*_, **__):
        raise AssertionError("rays were looked at")

    monkeypatch.setattr("icheat_usd.kernels.painted_sums.painted_sums", refuse)
    monkeypatch.setattr("icheat_usd.kernels.merged_rays.merge_rays", refuse)
    monkeypatch.setattr("icheat_usd.kernels.merged_stack.stack_of_rays", refuse)
    monkeypatch.setattr("icheat_usd.kernels.row_light.row_sums", refuse)
    monkeypatch.setattr("icheat_usd.final_gather.pair_tables.pair_sums", refuse)
    for changed in changed_stacks(edits)[:2]:
        assert (kept.replay.edited(previews()[0].field(*changed)) != kept.indirect_edited).any()


@pytest.mark.parametrize("exactly, tolerance", [(True, 2e-4), (False, 1e-2)])
@pytest.mark.parametrize("edits", [MANY, tuple(smoothly(6))], ids=["rough masks", "smooth masks"])
def test_rays_taken_together_bring_the_light_of_the_rays(edits, exactly, tolerance, monkeypatch):
    if exactly:
        take_rays_one_by_one(monkeypatch)
    fast = rendered(*edits).indirect_edited
    for module in ("final_gather.edited_records", "edits.mask_stack"):
        monkeypatch.setattr(f"icheat_usd.{module}.is_of_masks", lambda field: False)
    slow = rendered(*edits).indirect_edited
    assert np.abs(slow - rendered().indirect).max() > 0.05 * slow.max()
    np.testing.assert_allclose(fast, slow, rtol=tolerance, atol=1e-6)


def test_light_that_there_is_no_room_for_is_found_again(monkeypatch):
    """Rays under rough masks are kept apart: what they bring is many times what their records hold."""
    whole = rendered(*MANY, is_kept=True)
    changed = replace(MANY[0], amount=0.4), *MANY[1:]
    again = whole.replay.edited(previews()[0].field(*changed))
    room = 1 << 18
    monkeypatch.setattr(merged_light, "MOST_BYTES", room)
    monkeypatch.setattr(merged_light, "_MOST_OF_TABLE", room // 4)
    monkeypatch.setattr(merged_light, "_PILOT", 1 << 12)
    kept, tables = [], merged_light.MergedLight.tables

    def watched(self, of, *others):
        yield from tables(self, of, *others)
        kept.append(sum(one.n_bytes for one in of.merged))

    monkeypatch.setattr(merged_light.MergedLight, "tables", watched)
    bounded = rendered(*MANY, is_kept=True)
    np.testing.assert_array_equal(bounded.indirect_edited, whole.indirect_edited)
    np.testing.assert_array_equal(bounded.replay.edited(previews()[0].field(*changed)), again)
    assert (again != whole.indirect_edited).any()
    assert room / 4 < max(kept) <= room


def overlapping_brushes(n: int) -> tuple[Edit, ...]:
    """From soft places on a side wall to soft places on the back wall, all over each other."""
    edits = []
    for i in range(n):
        masks = {"receiver_mask": smooth("/back", i), "caster_mask": smooth("/red", n + i)}
        parameters = {"color": tuple(np.random.default_rng(i).uniform(0.6, 1.6, 3).tolist())}
        keys = (KeyedPayload(Payload("scale", parameters, **masks), 1.0),)
        edits.append(Edit(f"/brush{i}", "scale", parameters, select("/back"), select("/red"), keys=keys))
    return tuple(edits)


def test_brushes_that_overlap_are_those_of_places_with_masks_of_their_own(monkeypatch):
    """Twelve soft masks a receiver, and twelve a caster: more than sets of edits could be mixed for."""
    edits = overlapping_brushes(12)
    near = rendered(*edits)
    monkeypatch.setattr(slot_choices, "MOST_CHANGE", 0.0)
    exact = rendered(*edits)
    changed = np.abs(exact.indirect_edited - exact.indirect)
    assert changed.max() > 0.05 * exact.indirect.max()
    assert (near.indirect_edited != exact.indirect_edited).any()
    np.testing.assert_allclose(near.indirect_edited, exact.indirect_edited, rtol=2e-3)


def test_slots_are_not_chosen_again_for_a_changed_amount(monkeypatch):
    edits = overlapping_brushes(5)
    kept = rendered(*edits, is_kept=True)

    def refuse(*_, **__):
        raise AssertionError("slots were chosen")

    amounts = ((0.4, 1.0, 1.0, 1.0, 0.2), (1.0, 0.7, 0.5, 1.0, 1.0))
    stacks = [[replace(edit, amount=x) for edit, x in zip(edits, some, strict=True)] for some in amounts]
    with monkeypatch.context() as patch:
        patch.setattr("icheat_usd.kernels.record_slots.choose_slots", refuse)
        replayed = [kept.replay.edited(previews()[0].field(*changed)) for changed in stacks]
    for changed, found in zip(stacks, replayed, strict=True):
        np.testing.assert_array_equal(found, rendered(*changed).indirect_edited)


def test_a_replay_has_the_same_bits_on_one_thread_and_on_two():
    found = []
    for threads in (1, 2):
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        try:
            kept = rendered(is_kept=True)
            replayed = [kept.replay.edited(previews()[0].field(*edits)) for edits in ((BLEED, DIM), MANY)]
            found.append(np.stack(replayed))
        finally:
            numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    np.testing.assert_array_equal(*found)


def test_no_ray_is_traced_for_edits_of_objects_masks_and_colours(monkeypatch):
    parts = previews()[0]
    kept = rendered(is_kept=True)

    def refuse(*_, **__):
        raise AssertionError("a ray was traced")

    monkeypatch.setattr(type(parts.tracer), "intersect", refuse)
    monkeypatch.setattr(type(parts.tracer), "compiled", refuse)
    for name in ("objects", "overlapping", "added light", "hue", "soft masks", "direction"):
        assert (kept.replay.edited(parts.field(*STACKS[name])) != kept.indirect).any()
