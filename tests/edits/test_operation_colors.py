"""Operations on colours against independent implementations and the properties that define them."""

from __future__ import annotations

import colorsys
from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from icheat_usd.edits.model import Payload, Value
from icheat_usd.edits.operations import Operation, PairCoefficients, PairEnd, Pairs, find
from icheat_usd.edits.operations.constants import baked_constants
from icheat_usd.edits.operations.curve import LUMINANCE, monotone_curve
from icheat_usd.edits.operations.division import MAX_RATIO, divide
from icheat_usd.edits.operations.hsv import adjust_hsv
from icheat_usd.scene import F32

channel = st.floats(0, 1, width=32)
color = st.tuples(channel, channel, channel)
ONES = np.ones((1, 3), np.float32)
END = PairEnd(0 * ONES, np.float32([[0, 1, 0]]), 0.5 * ONES)


def operation(name: str) -> Operation:
    found = find(name)
    assert found is not None
    return found


def evaluate(name: str, given: Mapping[str, Value] = {}, caster: PairEnd = END) -> PairCoefficients:  # noqa: B006
    return operation(name).evaluate(operation(name).complete(given, "/edit"), Pairs(ONES, END, caster))


def remade(name: str, given: Mapping[str, Value], light: F32) -> F32:
    return operation(name).evaluate_aggregate(operation(name).complete(given, "/edit"), light)


# --------------------------------------------------------------------------- division rule and hsv


@pytest.mark.parametrize(
    ("incident", "wanted", "scale", "emission"),
    [
        ((1, 1, 1), (2, 1, 0), (2, 1, 0), (0, 0, 0)),
        ((1, 0, 0), (0, 1, 0), (0, 1, 1), (0, 1, 0)),  # a channel without light: added, the scale stays
        ((0, 0, 0), (1, 2, 3), (1, 1, 1), (1, 2, 3)),  # no light at all
        ((0, 0, 0), (0, 0, 0), (1, 1, 1), (0, 0, 0)),
        ((1, 1e-5, 1), (1, 1, 1), (1, 1, 1), (0, 1, 0)),  # faint beside another channel: as if none; rounded below
        ((1e-20, 1e-20, 0), (2e-20, 0, 0), (2, 0, 1), (0, 0, 0)),  # faint, but all of it: relative, not absolute
        ((1, 1, 1), (100, 1, 1), (64, 1, 1), (36, 0, 0)),  # a bounded ratio, the rest added
    ],
)
def test_division_table(
    incident: tuple[float, ...], wanted: tuple[float, ...], scale: tuple[float, ...], emission: tuple[float, ...]
) -> None:
    found = divide(np.array([incident], np.float32), np.array([wanted], np.float32))
    np.testing.assert_allclose(found.scale, [scale], rtol=1e-6)
    np.testing.assert_allclose(found.emission, [emission], rtol=2e-5, atol=1e-25)


@settings(deadline=None)
@given(color, color)
def test_division_reproduces_what_was_wanted(incident, wanted):
    have, want = np.array([incident], np.float32), np.array([wanted], np.float32)
    found = divide(have, want)
    np.testing.assert_allclose(found.scale * have + found.emission, want, atol=1e-6)
    assert (found.scale <= MAX_RATIO).all() and np.isfinite(found.scale).all()


@settings(deadline=None)
@given(color, st.floats(-720, 720), st.floats(0, 1), st.floats(0, 4))
def test_hsv_agrees_with_the_standard_library(rgb, hue, saturation, value):
    h, s, v = colorsys.rgb_to_hsv(*rgb)
    expected = np.array(colorsys.hsv_to_rgb((h + hue / 360.0) % 1.0, s * saturation, 1.0)) * v * value
    found = adjust_hsv(np.array([rgb], np.float32), hue, saturation, value)[0]
    # Hue of a nearly grey colour is ill-conditioned, but then it hardly shows: compare in absolute terms.
    np.testing.assert_allclose(found, expected, atol=2e-5 * max(1.0, value))


@settings(deadline=None)
@given(color, st.floats(0.001, 1000), st.floats(-180, 180), st.floats(0, 3))
def test_hsv_is_homogeneous_so_that_geometry_cancels(rgb, k, hue, saturation):
    rgb32 = np.array([rgb], np.float32)
    once = adjust_hsv(rgb32, hue, saturation, 1.0)
    scaled = adjust_hsv(rgb32 * np.float32(k), hue, saturation, 1.0)
    np.testing.assert_allclose(scaled, once * np.float32(k), atol=1e-5 * k, rtol=1e-4)


# --------------------------------------------------------------------------- gamma and curve


@settings(deadline=None)
@given(color, st.floats(0, 4), st.floats(0.001, 10))
def test_gamma_is_the_power_in_units_of_the_pivot(rgb, exponent, pivot):
    expected = [pivot * (c / pivot) ** exponent if c > 0 else 0.0 for c in rgb]
    found = remade("gamma", {"exponent": exponent, "pivot": pivot}, np.array([rgb], np.float32))
    np.testing.assert_allclose(found[0], expected, rtol=1e-5, atol=1e-30)


@settings(deadline=None)
@given(st.floats(0, 8), st.floats(0.001, 10))
def test_gamma_keeps_its_pivot_and_black(exponent, pivot):
    found = remade("gamma", {"exponent": exponent, "pivot": pivot}, np.array([[pivot, 0, 0]], np.float32))
    np.testing.assert_allclose(found, [[pivot, 0, 0]], rtol=1e-6)


def test_gamma_stays_finite() -> None:
    found = remade("gamma", {"exponent": 8.0, "pivot": 1e-6}, np.array([[1e30, -1.0, 1e-30]], np.float32))
    assert np.isfinite(found).all() and (found >= 0).all() and found[0, 1] == 0


@st.composite
def knots(draw):
    n = draw(st.integers(2, 6))
    inputs = np.cumsum([draw(st.floats(0, 1))] + [draw(st.floats(0.01, 2)) for _ in range(n - 1)])
    # Steps are 0, or large enough for scipy's own products of secants not to underflow.
    outputs = np.cumsum([draw(st.floats(0, 1))] + [draw(st.just(0.0) | st.floats(0.001, 2)) for _ in range(n - 1)])
    return tuple(inputs.tolist()), tuple(outputs.tolist())


@settings(deadline=None)
@given(knots())
def test_the_curve_is_scipys_and_never_falls(curve):
    inputs, outputs = curve
    x = np.linspace(inputs[0], inputs[-1], 301)
    np.testing.assert_allclose(monotone_curve(*curve, x), PchipInterpolator(inputs, outputs)(x), rtol=1e-9, atol=1e-9)
    wide = monotone_curve(*curve, np.linspace(0, inputs[-1] + 3, 400))
    assert (np.diff(wide) >= -1e-12).all() and (wide >= 0).all()


@settings(deadline=None)
@given(knots())
def test_the_curve_is_held_before_its_knots_and_goes_on_straight_after_them(curve):
    inputs, outputs = curve
    last = inputs[-1]
    slope = float(PchipInterpolator(inputs, outputs).derivative()(last))
    beyond = monotone_curve(*curve, np.array([last, last + 1, last + 5]))
    np.testing.assert_allclose(beyond, outputs[-1] + slope * np.array([0, 1, 5]), rtol=1e-9, atol=1e-9)
    assert monotone_curve(*curve, np.array([inputs[0] - 1]))[0] == pytest.approx(outputs[0])


def test_a_curve_through_the_diagonal_is_the_identity() -> None:
    light = np.random.default_rng(0).uniform(0, 5, (50, 3)).astype(np.float32)
    for on in ("channels", "luminance"):
        np.testing.assert_allclose(remade("curve", {"on": on}, light), light, rtol=1e-6)


def test_a_curve_on_luminance_keeps_the_ratios_of_the_channels() -> None:
    light = np.random.default_rng(0).uniform(0.01, 2, (50, 3)).astype(np.float32)
    shape: dict[str, Value] = {"inputs": (0.0, 0.5, 2.0), "outputs": (0.0, 0.2, 3.0)}
    found = remade("curve", {**shape, "on": "luminance"}, light)
    np.testing.assert_allclose(found / found[:, :1], light / light[:, :1], rtol=1e-5)
    grey = np.repeat((light @ LUMINANCE)[:, None], 3, axis=1).astype(np.float32)
    np.testing.assert_allclose(found @ LUMINANCE, remade("curve", shape, grey)[:, 0], rtol=1e-5)


def test_a_curve_that_lifts_black_makes_grey_of_no_light() -> None:
    lifting: dict[str, Value] = {"outputs": (0.25, 1.0)}
    for on in ("channels", "luminance"):
        np.testing.assert_allclose(remade("curve", {**lifting, "on": on}, 0 * ONES), 0.25 * ONES)


# --------------------------------------------------------------------------- the same for all pairs


def test_scale_multiplies_gain_and_color() -> None:
    found = evaluate("scale", {"color": (2.0, 1.0, 0.5), "gain": 3.0})
    np.testing.assert_array_equal(found.scale, [[6, 3, 1.5]])


def test_emit_adds_a_radiance_and_scales_nothing() -> None:
    found = evaluate("emit", {"color": (1.0, 0.5, 0.0), "intensity": 4.0})
    np.testing.assert_array_equal(found.scale, ONES)
    np.testing.assert_array_equal(found.emission, [[4, 2, 0]])


def test_unshadow_lets_light_pass_and_scales_nothing() -> None:
    found = evaluate("unshadow", {"color": (1.0, 0.5, 0.0)})
    np.testing.assert_array_equal(found.scale, ONES)
    np.testing.assert_array_equal(found.through, [[1, 0.5, 0]])
    assert found.offset is None and found.emission is None


def test_receive_scales_and_adds() -> None:
    found = operation("receive").evaluate_view({"scale": (2.0, 1.0, 0.5), "offset": (0.1, -0.2, 0.0)})
    np.testing.assert_allclose(found.scale, [2, 1, 0.5])
    np.testing.assert_allclose(found.offset, [0.1, -0.2, 0], rtol=1e-6)


class Room:
    """A scene whose measures are known."""

    def __init__(self, area: float = 4.0, distance: float = 2.5) -> None:
        self.area, self.distance = area, distance

    def mean_distance(self) -> float:
        return self.distance

    def caster_area(self) -> float:
        return self.area


def test_relative_paint_is_a_density_over_the_area_of_the_casters() -> None:
    paint = operation("paint")
    parameters = paint.complete({"color": (2.0, -1.0, 0.0)}, "/edit")
    prepared = paint.prepare(parameters, Room(area=4.0))
    np.testing.assert_array_equal(paint.evaluate(prepared, Pairs(ONES, END, END)).offset, [[0.5, -0.25, 0]])
    assert paint.prepare(prepared, Room(area=4.0)) == prepared
    assert paint.constants(parameters) is None
    nowhere = paint.prepare(parameters, Room(area=0.0))
    np.testing.assert_array_equal(paint.evaluate(nowhere, Pairs(ONES, END, END)).offset, 0 * ONES)


def test_absolute_paint_asks_nothing_of_the_scene() -> None:
    paint = operation("paint")
    parameters = paint.complete({"color": (2.0, 1.0, 0.0), "relative": False}, "/edit")
    assert paint.prepare(parameters, Room(area=4.0)) == parameters
    np.testing.assert_array_equal(paint.evaluate(parameters, Pairs(ONES, END, END)).offset, [[2, 1, 0]])


ALBEDO = PairEnd(0 * ONES, END.normal, np.float32([[0.5, 0.001, 0.0]]))


def test_albedo_is_replaced_up_to_a_bounded_ratio() -> None:
    """An albedo of 0 gives no light that a ratio could act on: it stays at 1."""
    found = evaluate("albedo", {"color": (0.25, 0.5, 0.5)}, ALBEDO)
    np.testing.assert_allclose(found.scale, [[0.5, MAX_RATIO, 1]])
    assert found.emission is None


def test_albedo_is_multiplied_whatever_it_is() -> None:
    found = evaluate("albedo", {"color": (0.25, 0.5, 2.0), "replace": False}, ALBEDO)
    np.testing.assert_array_equal(found.scale, [[0.25, 0.5, 2]])


@pytest.mark.parametrize(
    ("name", "given", "expected"),
    [
        ("scale", {"gain": 3.0}, {"scale_delta": (2, 2, 2)}),
        ("emit", {"intensity": 2.0}, {"scale_delta": (0, 0, 0), "emission": (2, 2, 2)}),
        (
            "paint",
            {"color": (1.0, 2.0, 3.0), "relative": False},
            {"scale_delta": (0, 0, 0), "offset": (1, 2, 3)},
        ),
        ("paint", {"color": (1.0, 2.0, 3.0)}, {}),
        ("albedo", {"color": (0.5, 0.5, 0.5), "replace": False}, {"scale_delta": (-0.5, -0.5, -0.5)}),
        ("albedo", {}, {}),
        ("unshadow", {}, {}),
        ("hsv", {}, {}),
        ("gamma", {}, {}),
        ("receive", {}, {}),
        ("falloff", {}, {}),
    ],
)
def test_what_is_the_same_for_all_pairs_of_any_scene_can_be_baked(
    name: str, given: dict[str, Value], expected: dict[str, tuple[float, ...]]
) -> None:
    complete = operation(name).complete(given, "/edit")
    baked = baked_constants(operation(name), complete)
    assert baked == expected
    assert Payload(name, complete, **baked).operation == name


@pytest.mark.parametrize("name", ["scale", "emit", "paint", "albedo"])
def test_constants_are_what_is_evaluated(name: str) -> None:
    given: dict[str, Value] = {"paint": {"relative": False}, "albedo": {"replace": False}}.get(name, {})  # type: ignore[assignment]
    parameters = operation(name).complete({**given, "color": (0.2, 0.4, 0.8)}, "/edit")
    constant = operation(name).constants(parameters)
    assert constant is not None
    for a, b in zip(constant, operation(name).evaluate(parameters, Pairs(ONES, END, ALBEDO)), strict=True):
        assert (a is None and b is None) or np.array_equal(a, b)
