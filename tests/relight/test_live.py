"""The live relighter with compression off against the exact one, and that only the state decides its bits."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import numba
import numpy as np
import pytest

from icheat_usd import relight
from icheat_usd.edits.model import Blend, Edit, EditStack, KeyedPayload, Payload, SurfaceMask
from icheat_usd.errors import EditError
from icheat_usd.relight.live import LiveRelighter
from icheat_usd.relight.products import Products, _Tiles
from icheat_usd.scene import F32
from icheat_usd.transport import sum_lights
from icheat_usd.transport.packed import PackedLobe, PackedTransport
from icheat_usd.transport.packing import lossless
from tests.pipeline import Pipeline, select
from tests.relight.test_operations import MIXED, PARAMETERS, baked, edit, pipeline, room, soft, soft_mask, stacks


class StillLights:
    """Lights whose gains alone change."""

    def __init__(self, of: Pipeline) -> None:
        self.radiance: F32 = of.cell_light.radiance
        self.view_direct: F32 = of.relighter.view_direct
        self.gains: F32 = np.ones((len(self.radiance), 3), np.float32)
        self.revision = 0

    def total(self) -> F32:
        return sum_lights(self.radiance * self.gains[:, None])

    def direct(self) -> F32:
        return sum_lights(self.view_direct * self.gains[:, None])

    def set_gain(self, light: int, rgb: Any) -> None:
        self.gains[light] = rgb
        self.revision += 1

    def refine(self) -> bool:
        return False


@functools.cache
def live(kind: str) -> LiveRelighter:
    of = pipeline(kind)
    return LiveRelighter(
        of.snapshot, of.view, of.gather, of.transport, StillLights(of), held_back=of.relighter.held_back
    )


def assert_equals_the_exact_relighter(kind: str, edits: tuple[Edit, ...]) -> None:
    of, shown = pipeline(kind), live(kind)
    field = of.field(*edits)
    expected = of.relighter.relight(field)
    shown.set_stack(EditStack("/stack", edits))
    found = shown.relit()
    np.testing.assert_array_equal(found.direct, expected.direct)
    np.testing.assert_allclose(found.indirect, expected.indirect, rtol=1e-5, atol=1e-7)
    delta = expected.indirect_edited.astype(float) - expected.indirect
    assert np.abs(delta).max() > 0.003
    np.testing.assert_allclose(
        found.indirect_edited, expected.indirect_edited, rtol=2e-5, atol=5e-6 * np.abs(delta).max() + 1e-6
    )
    untouched = (field.receiver_masks(of.view.points) == 0).all(axis=0)
    np.testing.assert_array_equal(found.indirect_edited[untouched], found.indirect[untouched])


@pytest.mark.parametrize("stack", stacks("scale"))
@pytest.mark.parametrize("operation", PARAMETERS)
def test_operations_equal_the_exact_relighter(operation, stack):
    assert_equals_the_exact_relighter("full", stacks(operation)[stack])


@pytest.mark.parametrize("operation", ["falloff", "gamma", "unshadow", "paint", "hsv"])
def test_operations_on_interpolated_rows_equal_the_exact_relighter(operation):
    assert_equals_the_exact_relighter("coarse", stacks(operation)["between hard edits"])


@pytest.mark.parametrize("name", MIXED)
def test_levels_that_meet_equal_the_exact_relighter(name):
    edits = tuple(
        soft(f"e{k}", operation, "/floor", "/red", 3 * k) if k == 0 else edit(f"e{k}", operation, amount=0.8)
        for k, operation in enumerate(MIXED[name])
    )
    assert_equals_the_exact_relighter("full", edits)


def fresh(of: Pipeline, stack: EditStack, gains: F32) -> LiveRelighter:
    lights = StillLights(of)
    lights.gains[:] = gains
    shown = LiveRelighter(of.snapshot, of.view, of.gather, of.transport, lights, held_back=of.relighter.held_back)
    shown.set_stack(stack)
    return shown


def repainted(mask: SurfaceMask, rng: np.random.Generator) -> SurfaceMask:
    """The mask after a dab on a few of its texels; weights reach 0 and 1."""
    texels = mask.texels.copy()
    face = rng.integers(len(texels))
    y, x = rng.integers(0, texels.shape[1] - 1, 2)
    texels[face, y : y + 2, x : x + 2] = rng.choice([0.0, 1.0, rng.uniform()])
    return replace(mask, texels=texels)


#: Most of them leave what the next ones build on.
COMMANDS = ["amount"] * 6 + ["dab"] * 3 + ["mute", "reorder", "back", "gain", "keep", "refine"]
#: Nearly all of them change which edits there are, or what these are.
STRUCTURAL = [
    *("mute", "mute", "mute", "reorder", "reorder", "swap", "swap", "add", "remove", "mask", "mask", "dab", "dab"),
    *("dab and mute", "number", "number and mute", "blend", "amount", "back", "gain", "keep", "refine"),
]


def with_mask(one: Edit, side: str, mask: SurfaceMask | None) -> Edit:
    """The edit with a mask on one side, at all keys."""
    keys = one.keys or (KeyedPayload(Payload(one.operation, one.parameters), 1.0),)
    changed = tuple(replace(key, payload=replace(key.payload, **{side: mask})) for key in keys)
    return replace(one, keys=changed)


def changed_stack(stack: EditStack, command: str, rng: np.random.Generator) -> EditStack:
    """A stack that differs in which edits there are, or in what one of them is."""
    edits = list(stack.edits)
    k = int(rng.integers(len(edits)))
    if "mute" in command:
        edits[k] = replace(edits[k], enabled=not edits[k].enabled)
    if command == "swap":
        edits[k - 1], edits[k] = edits[k], edits[k - 1]
    elif command == "add" and len(edits) < 8:
        name = f"new{rng.integers(1000)}_{len(edits)}"
        casters = [["/red"], ["/back", "/red"], ["/green"]][rng.integers(3)]
        edits.insert(k, edit(name, str(rng.choice(["scale", "hsv", "paint"])), select("/floor"), select(*casters)))
    elif command == "remove" and len(edits) > 2:
        del edits[k]
    elif command == "blend":
        edits[k] = replace(edits[k], blend=Blend(rng.choice(list(Blend))))
    if command.startswith("number"):
        j = int(rng.integers(len(edits)))
        numbers = {name: v for name, v in edits[j].parameters.items() if isinstance(v, float)}
        if numbers and not edits[j].keys:
            name = str(rng.choice(sorted(numbers)))
            edits[j] = replace(edits[j], parameters={**edits[j].parameters, name: float(rng.uniform(0.5, 1.5))})
    if command in ("mask", "dab and mute"):
        side = str(rng.choice(["receiver_mask", "caster_mask"]))
        path = "/floor" if side == "receiver_mask" else "/red"
        j = int(rng.integers(len(edits)))
        edits[j] = with_mask(edits[j], side, None if rng.integers(3) == 0 else soft_mask(path, int(rng.integers(99))))
    return replace(stack, edits=tuple(edits))


def act_at_random(shown: LiveRelighter, rng: np.random.Generator, n_steps: int, commands: list[str] = COMMANDS) -> None:
    """Commands on a stack of edits, and frames and refinements between them."""
    kept = [shown.stack]
    for step in range(n_steps):
        path, command = str(rng.choice([edit.path for edit in shown.stack.edits])), str(rng.choice(commands))
        if command == "amount":
            shown.set_amount(path, float(rng.choice([0.0, 0.3, 0.5, 0.7, 0.9, 1.2])))
        elif command == "mute":
            shown.mute(path, bool(rng.integers(2)))
        elif command == "reorder":
            shown.reorder([shown.stack.edits[k].path for k in rng.permutation(len(shown.stack.edits))])
        elif command == "dab":
            side = str(rng.choice(["receivers", "casters"]))
            name = "receiver_mask" if side == "receivers" else "caster_mask"
            painted = [edit for edit in shown.stack.edits if edit.keys and getattr(edit.keys[-1].payload, name)]
            if painted:
                chosen = painted[rng.integers(len(painted))]
                mask = getattr(chosen.keys[-1].payload, name)
                shown.dab(chosen.path, side, repainted(mask, rng), key=len(chosen.keys) - 1)
        elif command == "back":
            shown.set_stack(kept[rng.integers(len(kept))])
        elif command == "gain":
            shown.lights.set_gain(int(rng.integers(2)), rng.uniform(0, 2, 3))
        elif command == "keep":
            kept.append(shown.stack)
        elif command == "refine":
            shown.refine()
        else:
            shown.set_stack(changed_stack(shown.stack, command, rng))
        if step % 3 == 0:
            shown.frame()


def painted_stack(*operations: str) -> EditStack:
    edits = tuple(soft(f"e{k}", name, "/floor", "/red", 3 * k) for k, name in enumerate(operations))
    return EditStack("/stack", (*edits, edit("hard", "scale", amount=0.5)))


def overlapping_stack() -> EditStack:
    """Edits of different casters that overlap partly; some add light that no transport brings."""
    floor = select("/floor")
    return EditStack(
        "/stack",
        (
            edit("paint", "paint", floor, select("/red", "/back", "/green")),
            edit("dark", "scale", floor, select("/red")),
            soft("soft_paint", "paint", "/floor", "/back", 3),
            soft("soft_scale", "scale", "/floor", "/back", 5),
        ),
    )


STACKS = {
    "scale and hsv": painted_stack("scale", "hsv", "scale"),
    "pairs": painted_stack("gamma", "paint", "falloff"),
    "curve and receive": painted_stack("emit", "curve", "receive"),
    "overlapping casters": overlapping_stack(),
}


@pytest.mark.parametrize("stack", STACKS)
def test_the_same_state_has_the_same_bits_whatever_led_to_it(stack):
    of = pipeline("full")
    shown = fresh(of, STACKS[stack], np.ones((2, 3), np.float32))
    rng = np.random.default_rng(len(stack))
    for _ in range(8):
        act_at_random(shown, rng, 4)
        again = fresh(of, shown.stack, shown.lights.gains)
        np.testing.assert_array_equal(shown.frame(), again.frame())
        for found, expected in zip(shown.relit(), again.relit(), strict=True):
            np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("stack", ["scale and hsv", "overlapping casters"])
@pytest.mark.parametrize("spare", [0, 1000])
def test_stacks_of_other_edits_have_the_bits_of_fresh_ones(stack, spare, monkeypatch):
    """Edits come, go, swap places and get masks, also while what is needed no more is forgotten at once."""
    monkeypatch.setattr("icheat_usd.relight.live.SPARE_GROUPS", spare - 10**6 * (spare == 0))
    monkeypatch.setattr("icheat_usd.relight.live.SPARE_VERSIONS", spare)
    monkeypatch.setattr("icheat_usd.relight.live.MOST_VERSIONS", 4 if spare == 0 else 192)
    of = pipeline("full")
    shown = fresh(of, STACKS[stack], np.ones((2, 3), np.float32))
    rng = np.random.default_rng(len(stack) + spare)
    for _ in range(20):
        act_at_random(shown, rng, 2, STRUCTURAL)
        again = fresh(of, shown.stack, shown.lights.gains)
        np.testing.assert_array_equal(shown.frame(), again.frame())
        for found, expected in zip(shown.relit(), again.relit(), strict=True):
            np.testing.assert_array_equal(found, expected)


def test_a_stroke_is_found_where_it_is_painted_alone(monkeypatch):
    """Masks that another command set, on other surfaces or with other places at rest, are dabs too."""
    of = pipeline("full")
    stack = EditStack("/stack", (soft("a", "scale", "/floor", "/red", 3), edit("b", "scale")))
    shown = fresh(of, stack, np.ones((2, 3), np.float32))
    shown.frame()
    monkeypatch.setattr(shown, "_regroup", None)
    rng = np.random.default_rng(5)
    before, seen, support = shown.stack, shown.frame(), shown._stack.compiled.support
    for path in ("/floor", "/floor", "/back"):
        mask = repainted(soft_mask(path, 3), rng)
        rest = np.full((len(mask.texels), 2, 2, 3), 7.0, np.float32)
        edits = (with_mask(shown.stack.edits[0], "receiver_mask", replace(mask, rest=rest)), shown.stack.edits[1])
        shown.set_stack(replace(stack, edits=edits))
        found = shown.frame()
        np.testing.assert_array_equal(found, fresh(of, shown.stack, np.ones((2, 3), np.float32)).frame())
        assert not np.array_equal(found, seen)
        assert shown._stack.compiled.support is support
    shown.set_stack(before)
    np.testing.assert_array_equal(shown.frame(), seen)


def test_offsets_of_all_casters_stay_when_the_edit_of_some_changes():
    """Each amount changed alone: a paint adds light for all of its casters, whatever the others act on."""
    stack, gains = overlapping_stack(), np.ones((2, 3), np.float32)
    of = pipeline("full")
    shown = fresh(of, stack, gains)
    before = shown.frame()
    for one in stack.edits:
        shown.set_amount(one.path, 0.4)
        found = shown.frame()
        assert np.abs(found - before).max() > 0.001
        np.testing.assert_array_equal(found, fresh(of, shown.stack, gains).frame())
        shown.set_amount(one.path, one.amount)
        np.testing.assert_array_equal(shown.frame(), before)


def test_baked_rows_equal_the_exact_relighter():
    payloads = [baked("falloff", select("/red", "/ceiling")), baked("direction", select("/red", "/green"))]
    keys = tuple(KeyedPayload(payload, 0.5) for payload in payloads)
    unknown = Edit("/baked", "theirs", {}, select("/floor", "/back"), select("/red", "/green", "/ceiling"), keys=keys)
    assert_equals_the_exact_relighter("full", (edit("warm", "scale"), unknown, edit("turn", "hsv")))


@functools.cache
def packed(kind: str) -> PackedTransport:
    return packed_rows(pipeline(kind))


def packed_rows(of: Pipeline) -> PackedTransport:
    """All coefficients of all rows, in floats."""
    exact = of.transport
    lobes = tuple(PackedLobe(lobe.name, lossless(lobe.rows, of.gather.tree), lobe.tint) for lobe in exact.lobes)
    return PackedTransport(lobes, exact.row_view, exact.interpolation, exact)


def test_a_dab_on_baked_rows_has_the_bits_of_a_fresh_start():
    of, ones = pipeline("full"), np.ones((2, 3), np.float32)
    payload = replace(baked("falloff", select("/red", "/ceiling")), receiver_mask=soft_mask("/floor", 3))
    receivers, casters = select("/floor", "/back"), select("/red", "/ceiling")
    one = Edit("/baked", "theirs", {}, receivers, casters, keys=(KeyedPayload(payload, 1.0),))
    shown = fresh(of, EditStack("/stack", (one,)), ones)
    shown.frame()
    shown.dab("/baked", "receivers", repainted(soft_mask("/floor", 3), np.random.default_rng(1)))
    np.testing.assert_array_equal(shown.frame(), fresh(of, shown.stack, ones).frame())


@pytest.mark.parametrize("operation", ["scale", "falloff", "gamma", "paint"])
def test_wavelets_that_lose_nothing_change_nothing(operation):
    of = pipeline("full")
    edits = stacks(operation)["strongest, on soft places"]
    shown = LiveRelighter(of.snapshot, of.view, of.gather, packed("full"), StillLights(of))
    shown.set_stack(EditStack("/stack", edits))
    expected = of.relighter.relight(of.field(*edits))
    np.testing.assert_allclose(shown.relit().indirect_edited, expected.indirect_edited, rtol=1e-4, atol=2e-6)
    shown.set_transport(of.transport)
    np.testing.assert_array_equal(shown.frame(), fresh(of, EditStack("/stack", edits), np.ones((2, 3))).frame())


OFF = {
    "hard": edit("off", "scale", select("/floor", "/back"), select("/green", "/ceiling")),
    "soft": soft("off", "scale", "/floor", "/ceiling", 3),
    "looks at receivers": edit("off", "falloff", select("/floor"), select("/red")),
    "adds light": edit("off", "paint", select("/floor"), select("/red")),
    "of one light": edit("off", "scale", lights=("/warm",)),
}


@pytest.mark.parametrize("is_packed", [False, True], ids=["exact", "packed"])
@pytest.mark.parametrize("kind", OFF)
def test_an_edit_that_is_off_is_skipped_bit_for_bit(kind, is_packed, monkeypatch):
    """Muted, at an amount of 0, and turned off while it is shown."""
    # Between the casters of the first edit and those of both: these are transformed in two ways.
    monkeypatch.setattr("icheat_usd.relight.products._MANY_CELLS", 15)
    of, gains = pipeline("full"), np.array([[0.3, 1.7, 0.9], [1.1, 0.7, 0.6]], np.float32)
    on, off = edit("on", "scale", select("/floor", "/back", "/tall"), select("/red")), OFF[kind]
    rows = packed("full") if is_packed else of.transport

    def image(*edits: Edit) -> F32:
        return fresh_packed(of, rows, EditStack("/stack", edits), gains).frame()

    expected = image(on)
    assert np.abs(image(on, off) - expected).max() > 0.001
    np.testing.assert_array_equal(image(on, replace(off, enabled=False)), expected)
    np.testing.assert_array_equal(image(on, replace(off, amount=0.0)), expected)
    shown = fresh_packed(of, rows, EditStack("/stack", (on, off)), gains)
    shown.frame()
    shown.mute(off.path)
    np.testing.assert_array_equal(shown.frame(), expected)


def test_many_versions_are_divided(monkeypatch):
    """Edits of different casters on the same receivers, with and without others between."""
    edits = tuple(
        edit(f"e{k}", operation, select("/floor", "/back"), select(*casters))
        for k, (operation, casters) in enumerate(
            [("scale", ("/red",)), ("hsv", ("/green",)), ("scale", ("/red", "/tall")), ("falloff", ("/ceiling",))]
        )
    )
    whole = fresh(pipeline("full"), EditStack("/stack", edits), np.ones((2, 3)))
    monkeypatch.setattr("icheat_usd.relight.live.MOST_VERSIONS", 0)
    divided = fresh(pipeline("full"), EditStack("/stack", edits), np.ones((2, 3)))
    whole_n, divided_n = (sum(not one.key.cells for one in shown._versions._versions) for shown in (whole, divided))
    assert (whole_n, divided_n) == (1, 3)
    np.testing.assert_allclose(divided.frame(), whole.frame(), rtol=1e-5, atol=1e-6)


class RestingLights(StillLights):
    moves = 0


def poor(of: PackedTransport) -> PackedTransport:
    """Int8 rows in few coefficients."""
    lobes = []
    for lobe in of.lobes:
        rows = lobe.rows
        scale = np.maximum(np.abs(rows.value).max(axis=1), 1e-20).astype(np.float32) / 127
        quanta = np.rint(rows.value / scale[:, None]).astype(np.int8)
        size = np.sqrt(np.square(rows.value).sum(axis=1))
        kept = size > np.quantile(size, 0.6)
        begin = np.concatenate([[0], np.cumsum(kept)]).astype(np.int64)[rows.tile_begin]
        columns = {"index": rows.index, "scale": scale, "worth": rows.worth, "value": quanta}
        rows = replace(rows, tile_begin=begin, **{name: column[kept] for name, column in columns.items()})
        lobes.append(replace(lobe, rows=rows))
    return replace(of, lobes=tuple(lobes))


def test_refining_takes_back_what_packing_loses():
    of = pipeline("full")
    good = packed("full")
    lobes = tuple(replace(lobe, rows=replace(lobe.rows, value=0.9 * lobe.rows.value)) for lobe in good.lobes)
    edits = stacks("falloff")["strongest, on soft places"]
    shown = LiveRelighter(of.snapshot, of.view, of.gather, replace(good, lobes=lobes), StillLights(of))
    shown.set_stack(EditStack("/stack", edits))
    expected = of.relighter.relight(of.field(*edits)).indirect_edited
    assert np.abs(shown.relit().indirect_edited / expected - 1).max() > 0.05
    while shown.refine():
        pass
    np.testing.assert_allclose(shown.relit().indirect_edited, expected, rtol=2e-5, atol=1e-6)
    refined = shown.frame()
    shown.set_amount("/op", 0.3)
    shown.frame()
    shown.set_amount("/op", 1.0)
    while shown.refine():
        pass
    np.testing.assert_array_equal(shown.frame(), refined)


def test_lights_at_rest_lose_nothing_in_a_narrowed_transport(monkeypatch):
    """Gains, and amounts of edits that scale, find the light of the exact rows."""
    of = pipeline("full")
    rows = poor(packed("full"))
    monkeypatch.setattr("icheat_usd.relight.narrow.NARROW_BYTES", rows.n_bytes // 4)
    lights = RestingLights(of)
    shown = LiveRelighter(of.snapshot, of.view, of.gather, rows, lights)
    edits = (soft("a", "scale", "/floor", "/red", 3), edit("b", "scale", select("/back"), select("/red", "/green")))
    shown.set_stack(EditStack("/stack", edits))
    while shown.refine():
        pass

    def error_of_edits(found: LiveRelighter) -> float:
        exact, seen = fresh(of, shown.stack, lights.gains).relit(), found.relit()
        # Light is rounded to 16 bits.
        if found is shown:
            np.testing.assert_allclose(seen.indirect, exact.indirect, rtol=1e-3, atol=1e-4 * exact.indirect.max())
        expected = exact.indirect_edited - exact.indirect
        return float(np.abs(seen.indirect_edited - seen.indirect - expected).max() / np.abs(expected).max())

    for light in (0, 1):
        lights.set_gain(light, (0.3, 1.2, 2.0))
    shown.set_amount("/a", 0.35)
    assert error_of_edits(shown) < 0.002
    lights.set_gain(1, 0.1)
    assert error_of_edits(shown) < error_of_edits(fresh_packed(of, rows, shown.stack, lights.gains))


def test_of_lights_that_move_only_what_they_change_is_multiplied_with_packed_rows():
    of = pipeline("full")
    rows = poor(packed("full"))
    lights, fast = RestingLights(of), StillLights(of)
    shown = LiveRelighter(of.snapshot, of.view, of.gather, rows, lights)
    stack = EditStack("/stack", (soft("a", "scale", "/floor", "/red", 3), edit("b", "hsv", select("/back"), select())))
    shown.set_stack(stack)
    while shown.refine():
        pass
    rested = shown.relit()
    # The one light slowly goes over into other light, the other stays.
    lights.radiance = lights.radiance.copy()
    other = lights.radiance[0, ::-1] * np.float32([1, 0.7, 0.4])
    for share in (0.0, 0.1, 1.0):
        fast.radiance = lights.radiance.copy()
        lights.radiance[0] = fast.radiance[0] = (1 - share) * of.cell_light.radiance[0] + share * other
        lights.moves += 1
        lights.revision += 1
        seen = shown.relit()
        if share == 0:
            np.testing.assert_allclose(seen.indirect, rested.indirect, rtol=1e-5)
            continue
        at_once, exact = (
            LiveRelighter(of.snapshot, of.view, of.gather, transport, fast) for transport in (rows, of.transport)
        )
        for found in (at_once, exact):
            found.set_stack(stack)
        for layer in ("indirect", "indirect_edited"):
            expected = getattr(exact.relit(), layer)
            errors = [np.abs(getattr(light, layer) - expected).mean() for light in (seen, at_once.relit())]
            assert 0 < errors[0] < (0.3 if share < 1 else 1.2) * errors[1], layer
    at_rest = refined(shown)
    again = LiveRelighter(of.snapshot, of.view, of.gather, rows, fast)
    again.set_stack(stack)
    np.testing.assert_array_equal(at_rest, refined(again))


def fresh_packed(
    of: Pipeline, rows: PackedTransport, stack: EditStack, gains: F32, moving_detail: float = 1.0
) -> LiveRelighter:
    lights = StillLights(of)
    lights.gains[:] = gains
    shown = LiveRelighter(of.snapshot, of.view, of.gather, rows, lights, moving_detail=moving_detail)
    shown.set_stack(stack)
    return shown


def test_a_large_transport_is_read_in_part_while_lights_move(monkeypatch):
    """What is left out are terms that are small in this light, up to the error that is allowed; bytes have a limit."""
    of, rows = pipeline("full"), poor(packed("full"))
    stack = EditStack("/stack", (edit("a", "scale", select("/floor"), select("/red", "/green")),))
    gains = np.ones((2, 3), np.float32)
    whole = fresh_packed(of, rows, stack, gains).relit()
    monkeypatch.setattr("icheat_usd.relight.products.SMALL_BYTES", 0)
    errors = []
    for left_out, limit in ((0.02, 10**9), (0.1, 10**9), (0.0, rows.n_bytes // 8)):
        monkeypatch.setattr("icheat_usd.relight.products.LEFT_OUT", left_out)
        monkeypatch.setattr("icheat_usd.relight.products.MOVING_BYTES", limit)
        shown = fresh_packed(of, rows, stack, gains)
        shown.frame()
        for light in (0, 1):
            shown.lights.set_gain(light, 0.5)
        seen = shown.relit()
        errors.append([rms_of(2 * getattr(seen, layer), getattr(whole, layer)) for layer in LAYERS])
    small, large, limited = np.array(errors)
    assert (small < 5 * 0.02).all()
    assert (large > 3 * small).all()
    assert (large < 5 * 0.1).all()
    assert (limited > large).all()


@pytest.mark.parametrize(
    ("of_version", "of_itself", "most"), [(0.005, 80.0, 10**9), (80.0, 0.08, 10**9), (0.08, 0.08, 120)]
)
def test_detail_while_moving_divides_what_is_left_out_and_raises_what_is_read(of_version, of_itself, most, monkeypatch):
    of, rows = pipeline("full"), poor(packed("full"))
    assert rows.n_bytes > 16 * 120
    stack = EditStack("/stack", (edit("a", "scale", select("/floor"), select("/back", "/floor")),))
    monkeypatch.setattr("icheat_usd.relight.products.SMALL_BYTES", 0)

    def frame(divisor: float, most_bytes: int, detail: float) -> F32:
        left_out = {"LEFT_OUT": 0.08, "LEFT_OUT_OF_VERSION": of_version, "LEFT_OUT_OF_ITSELF": of_itself}
        for name, value in left_out.items():
            monkeypatch.setattr(f"icheat_usd.relight.products.{name}", value / divisor)
        monkeypatch.setattr("icheat_usd.relight.products.MOVING_BYTES", most_bytes)
        return fresh_packed(of, rows, stack, np.ones((2, 3), np.float32), detail).frame()

    fine = frame(1, most, 4.0)
    assert not np.array_equal(fine, frame(1, most, 1.0))
    np.testing.assert_array_equal(fine, frame(4, 16 * most, 1.0))


def test_edits_of_few_cells_are_read_in_part_and_change_what_they_should(monkeypatch):
    """What is left out is a small share of each edit; its terms are found without a look at all others."""
    of, rows = pipeline("full"), poor(packed("full"))
    strong = EditStack("/stack", (edit("a", "scale", select("/floor"), select("/back", "/floor")),))
    weak = EditStack("/stack", (edit("a", "scale", select("/tall"), select("/red", "/green")),))

    def change(stack: EditStack, of_image: float, of_itself: float) -> F32:
        """Of light that moved since the first frame, which tells how bright the image is."""
        monkeypatch.setattr("icheat_usd.relight.products.LEFT_OUT_OF_VERSION", of_image)
        monkeypatch.setattr("icheat_usd.relight.products.LEFT_OUT_OF_ITSELF", of_itself)
        shown = fresh_packed(of, rows, stack, np.ones((2, 3), np.float32))
        shown.frame()
        shown.lights.set_gain(0, 0.7)
        seen = shown.relit()
        return seen.indirect_edited - seen.indirect

    monkeypatch.setattr("icheat_usd.relight.products.SMALL_BYTES", 0)
    monkeypatch.setattr("icheat_usd.relight.products.LEFT_OUT", 0.0)
    assert 0 < rms_of(change(strong, 1.0, 0.1), change(strong, 0.0, 0.0)) < 0.1
    # Beside the image, this edit is nothing: all of it could go.
    assert rms_of(change(weak, 1.0, 1.0), change(weak, 0.0, 0.0)) > 1
    assert rms_of(change(weak, 1.0, 0.1), change(weak, 0.0, 0.0)) < 0.1
    found, multiply = change(strong, 1.0, 0.1), _Tiles.multiply
    monkeypatch.setattr(_Tiles, "multiply", lambda tiles, *given: multiply(tiles, *given[:7]))
    np.testing.assert_array_equal(change(strong, 1.0, 0.1), found)


def after_rest(of: Pipeline, rows: PackedTransport, stack: EditStack) -> LiveRelighter:
    """One that was at rest, with one of its two lights a little different since."""
    lights = RestingLights(of)
    shown = LiveRelighter(of.snapshot, of.view, of.gather, rows, lights)
    shown.set_stack(stack)
    refined(shown)
    lights.radiance = lights.radiance.copy()
    lights.radiance[0] = 0.95 * lights.radiance[0] + 0.05 * lights.radiance[0, ::-1]
    lights.moves += 1
    lights.revision += 1
    return shown


def test_rows_in_floats_stay_floats_after_rest():
    """What edits change under other gains is not like what they changed at rest, and is multiplied."""
    of, lights = pipeline("full"), RestingLights(pipeline("full"))
    stack = EditStack("/stack", (edit("a", "scale", select("/floor"), select("/back", "/floor")),))
    shown = LiveRelighter(of.snapshot, of.view, of.gather, packed("full"), lights)
    shown.set_stack(stack)
    refined(shown)
    lights.set_gain(0, (0.3, 1.2, 2.0))
    expected = fresh(of, stack, lights.gains).relit().indirect_edited
    np.testing.assert_allclose(shown.relit().indirect_edited, expected, rtol=0, atol=1e-4 * expected.max())


def test_of_an_edit_beside_its_light_at_rest_as_much_is_left_out_as_of_all_of_it(monkeypatch):
    """What differs from light at rest is small, and need not be better than the edit that it is a part of."""
    of, rows = pipeline("full"), poor(packed("full"))
    stack = EditStack("/stack", (edit("a", "scale", select("/floor"), select("/back", "/floor")),))
    monkeypatch.setattr("icheat_usd.relight.products.SMALL_BYTES", 0)
    monkeypatch.setattr("icheat_usd.relight.products.LEFT_OUT", 0.0)
    monkeypatch.setattr("icheat_usd.relight.products.LEFT_OUT_OF_VERSION", 1.0)

    def change(of_itself: float) -> F32:
        monkeypatch.setattr("icheat_usd.relight.products.LEFT_OUT_OF_ITSELF", of_itself)
        seen = after_rest(of, rows, stack).relit()
        return seen.indirect_edited - seen.indirect

    whole, some, find = change(0.0), change(0.1), Products._find_least
    monkeypatch.setattr(Products, "_find_least", lambda of, at, part, least: find(of, at, np.ones_like(part), least))
    assert rms_of(change(0.1), whole) < 0.2 * rms_of(some, whole) < 0.2 * 0.1


@pytest.mark.parametrize("kernel", ["narrow.add_light_residuals", "products.squares_of_tiles"])
def test_kernels_get_arrays_without_gaps(kernel, monkeypatch):
    """Others would be compiled for once more, in the middle of a frame."""
    of = Pipeline(room(16), n_gather=48, rays=32, bounce_rays=32, light_samples=4, n_bounces=4)
    rows = poor(packed_rows(of))
    monkeypatch.setattr("icheat_usd.relight.products.SMALL_BYTES", 0)
    monkeypatch.setattr("icheat_usd.relight.products._TILES_LOOKED_AT", 2)
    assert len(rows.lobes) > 1 and rows.lobes[0].rows.n_tiles > 2 and len(RestingLights(of).radiance) > 1
    shown = after_rest(of, rows, EditStack("/none", ()))
    module, name = kernel.split(".")
    called = getattr(getattr(relight, module), name)
    given: list[bool] = []

    def look(*arrays: Any) -> Any:
        given.extend(array.flags.c_contiguous for array in arrays if isinstance(array, np.ndarray))
        return called(*arrays)

    monkeypatch.setattr(f"icheat_usd.relight.{kernel}", look)
    shown.relit()
    assert given and all(given)


def test_a_light_that_goes_down_at_once_has_the_terms_that_are_large_in_what_is_left(monkeypatch):
    """The limit of what is left out is that of the image as it is, not as it was one frame ago."""
    of, rows = pipeline("full"), poor(packed("full"))
    monkeypatch.setattr("icheat_usd.relight.products.SMALL_BYTES", 0)
    monkeypatch.setattr("icheat_usd.relight.products.LEFT_OUT", 0.01)
    shown = fresh_packed(of, rows, EditStack("/none", ()), np.ones((2, 3), np.float32))
    shown.frame()
    for light in (0, 1):
        shown.lights.set_gain(light, 1e-4)
    found = shown.relit().indirect
    exact = fresh_packed(of, rows, EditStack("/none", ()), shown.lights.gains)
    monkeypatch.setattr("icheat_usd.relight.products.LEFT_OUT", 0.0)
    assert rms_of(found, exact.relit().indirect) < 0.05


LAYERS = ("indirect", "indirect_edited")


def rms_of(found: F32, expected: F32) -> float:
    """Relative."""
    return float(np.sqrt(np.mean((found - expected) ** 2) / np.mean(expected**2)))


def refined(shown: LiveRelighter) -> F32:
    while shown.refine():
        pass
    return shown.frame()


@pytest.mark.parametrize("stack", STACKS)
def test_packed_light_ends_in_the_same_bits_whatever_led_to_it(stack, monkeypatch):
    """Also where commands come between the steps of a refinement, and whichever way the rows are packed."""
    of = pipeline("coarse")
    rows = poor(packed("coarse"))
    monkeypatch.setattr("icheat_usd.relight.narrow.NARROW_BYTES", rows.n_bytes // 4)
    shown = LiveRelighter(of.snapshot, of.view, of.gather, rows, RestingLights(of))
    shown.set_stack(STACKS[stack])
    with monkeypatch.context() as patch:
        patch.setattr("icheat_usd.relight.products._ENTRIES_AT_ONCE", 100)
        patch.setattr("icheat_usd.relight.versions._PAIRS_AT_ONCE", 1)
        rng = np.random.default_rng(len(stack))
        for _ in range(8):
            act_at_random(shown, rng, 3)
            for _ in range(rng.integers(20)):
                shown.refine()
        found = refined(shown)
    again = fresh_packed(of, rows, shown.stack, shown.lights.gains)
    packed_frame = again.frame()
    np.testing.assert_array_equal(found, refined(again))
    assert np.abs(found - packed_frame).max() > 0.001
    other = fresh_packed(of, packed("coarse"), shown.stack, shown.lights.gains)
    np.testing.assert_array_equal(found, refined(other))


def test_casters_painted_at_rest_have_all_rows(monkeypatch):
    of = pipeline("full")
    rows = poor(packed("full"))
    monkeypatch.setattr("icheat_usd.relight.narrow.NARROW_BYTES", rows.n_bytes // 8)
    shown = LiveRelighter(of.snapshot, of.view, of.gather, rows, RestingLights(of))
    stack = EditStack("/stack", (soft("a", "scale", "/floor", "/red", 3),))
    shown.set_stack(stack)
    while shown.refine():
        pass
    mask = stack.edits[0].keys[1].payload.caster_mask
    shown.dab("/a", "casters", repainted(mask, np.random.default_rng(1)), key=1)
    shown.frame()
    again = fresh_packed(of, rows, shown.stack, np.ones((2, 3)))
    again.frame()
    painted = shown._versions
    pairs = np.concatenate([painted._pairs.of_version[v] for v in range(painted.n) if 1 in painted._rows_of(v)])
    assert len(pairs)
    np.testing.assert_array_equal(painted.values[:, pairs], again._versions.values[:, pairs])
    while shown.refine():
        pass
    while again.refine():
        pass
    np.testing.assert_array_equal(shown.frame(), again.frame())


def test_one_thread_has_the_bits_of_two():
    of = pipeline("full")
    edits = (edit("a", "scale"), soft("b", "gamma", "/floor", "/red", 1), edit("c", "falloff"), edit("d", "paint"))
    found = []
    for n in (1, 2):
        before = numba.get_num_threads()
        numba.set_num_threads(min(n, before))
        try:
            found.append(fresh(of, EditStack("/stack", edits), np.ones((2, 3))).frame())
        finally:
            numba.set_num_threads(before)
    np.testing.assert_array_equal(*found)


def test_mistakes_are_told():
    of = pipeline("full")
    stack = EditStack("/stack", (soft("a", "scale", "/floor", "/red", 1),))
    shown = fresh(of, stack, np.ones((2, 3)))
    for command, message in (
        (lambda: shown.set_amount("/b", 1.0), "no edit /b"),
        (lambda: shown.set_amount("/a", float("nan")), "finite"),
        (lambda: shown.dab("/a", "lights", soft_mask("/floor", 1)), "'lights' cannot be painted"),
        (lambda: shown.dab("/a", "receivers", soft_mask("/floor", 1), key=2), "no painted key 2"),
        (lambda: shown.reorder(["/a", "/a"]), "names each of /a once"),
    ):
        with pytest.raises(EditError, match=message):
            command()
    assert shown.stack is stack


def test_a_stack_that_cannot_be_shown_changes_nothing():
    of = pipeline("full")
    good = EditStack("/stack", (edit("a", "scale"),))
    shown = LiveRelighter(of.snapshot, of.view, of.gather, packed("full"), StillLights(of))
    shown.set_stack(good)
    before = shown.frame()
    with pytest.raises(EditError, match="HeldBack"):
        shown.set_stack(EditStack("/stack", (edit("a", "scale"), edit("b", "unshadow"))))
    with pytest.raises(EditError, match="has no parameter"):
        shown.set_stack(EditStack("/stack", (replace(good.edits[0], parameters={"size": 1.0}),)))
    assert shown.stack is good
    np.testing.assert_array_equal(shown.frame(), before)
    shown.set_transport(replace(packed("full"), source=None))
    with pytest.raises(EditError, match="/c: the edit looks at receivers, which needs exact rows"):
        shown.set_stack(EditStack("/stack", (edit("c", "falloff"),)))
    np.testing.assert_array_equal(shown.frame(), before)


@pytest.mark.parametrize("collects", [False, True])
def test_what_is_known_of_versions_outlives_those_that_are_collected(collects, monkeypatch):
    """At rest a gain is exact for the edits that were there, whether or not others have come and gone since."""
    of, rows = pipeline("full"), poor(packed("full"))
    monkeypatch.setattr("icheat_usd.relight.narrow.NARROW_BYTES", rows.n_bytes // 8)
    if collects:
        monkeypatch.setattr("icheat_usd.relight.live.SPARE_VERSIONS", 0)
        monkeypatch.setattr("icheat_usd.relight.live.SPARE_GROUPS", -(10**6))
    shown = fresh_packed(of, rows, EditStack("/none", ()), np.ones((2, 3), np.float32))
    first = edit("a", "scale", select("/floor", "/back"), select("/red", "/green", "/ceiling"))
    shown.set_stack(EditStack("/stack", (first,)))
    refined(shown)
    both = EditStack("/stack", (first, edit("b", "scale", select("/tall"), select("/back"))))
    shown.set_stack(both)
    shown.frame()
    for light in (0, 1):
        shown.lights.set_gain(light, (0.4, 0.4, 0.4))
    found, exact = shown.relit(), fresh(of, both, shown.lights.gains).relit()
    mine = exact.indirect_edited - exact.indirect
    alone = fresh(of, EditStack("/stack", (first,)), shown.lights.gains).relit()
    of_first = ((alone.indirect_edited != alone.indirect) & (alone.indirect_edited == exact.indirect_edited)).all(
        axis=1
    )
    assert of_first.any()
    wrong = (found.indirect_edited - found.indirect - mine)[of_first]
    assert np.abs(wrong).max() < 1e-4 * np.abs(mine).max()


def test_products_do_not_depend_on_what_was_shown_before(monkeypatch):
    """Before the first rest, too: brightness is that of this light, and each edit is seen alone."""
    of, rows = pipeline("full"), poor(packed("full"))
    monkeypatch.setattr("icheat_usd.relight.products.SMALL_BYTES", 0)
    monkeypatch.setattr("icheat_usd.relight.products.LEFT_OUT", 0.05)
    monkeypatch.setattr("icheat_usd.relight.products.LEFT_OUT_OF_VERSION", 0.05)
    monkeypatch.setattr("icheat_usd.relight.products._MANY_CELLS", 16)
    stack = EditStack(
        "/stack",
        (
            edit("a", "scale", select("/floor"), select("/red", "/green")),
            edit("b", "scale", select("/tall"), select("/back", "/floor")),
        ),
    )
    gains = np.array([[0.01, 0.02, 0.01], [0.02, 0.01, 0.03]], np.float32)
    expected = fresh_packed(of, rows, stack, gains).frame()
    shown = fresh_packed(of, rows, stack, np.ones((2, 3), np.float32))
    shown.frame()
    for path in ("/a", "/b"):
        shown.set_amount(path, 0.3)
        shown.frame()
    for light in (0, 1):
        shown.lights.set_gain(light, gains[light])
        shown.frame()
    for path in ("/b", "/a"):
        shown.set_amount(path, 1.0)
        shown.frame()
    np.testing.assert_array_equal(shown.frame(), expected)
