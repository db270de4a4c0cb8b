"""Operations against independent implementations and the properties that define them."""

from __future__ import annotations

import colorsys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from icheat_usd.edits import operations
from icheat_usd.edits.operations import Pairs
from icheat_usd.edits.operations.hsv import MAX_RATIO, adjust_hsv, divide
from icheat_usd.errors import EditError

channel = st.floats(0, 1, width=32)
color = st.tuples(channel, channel, channel)


@given(color, st.floats(-720, 720), st.floats(0, 1), st.floats(0, 4))
def test_hsv_agrees_with_the_standard_library(rgb, hue, saturation, value):
    h, s, v = colorsys.rgb_to_hsv(*rgb)
    expected = np.array(colorsys.hsv_to_rgb((h + hue / 360.0) % 1.0, s * saturation, 1.0)) * v * value
    found = adjust_hsv(np.array([rgb], np.float32), hue, saturation, value)[0]
    # Hue of a nearly grey colour is ill-conditioned, but then it hardly shows: compare in absolute terms.
    np.testing.assert_allclose(found, expected, atol=2e-5 * max(1.0, value))


@given(color, st.floats(0.001, 1000), st.floats(-180, 180), st.floats(0, 3))
def test_hsv_is_homogeneous_so_that_geometry_cancels(rgb, k, hue, saturation):
    rgb32 = np.array([rgb], np.float32)
    once = adjust_hsv(rgb32, hue, saturation, 1.0)
    scaled = adjust_hsv(rgb32 * np.float32(k), hue, saturation, 1.0)
    np.testing.assert_allclose(scaled, once * np.float32(k), atol=1e-5 * k, rtol=1e-4)


@given(color, color)
def test_division_reproduces_what_was_wanted(incident, wanted):
    have, want = np.array([incident], np.float32), np.array([wanted], np.float32)
    found = divide(have, want)
    np.testing.assert_allclose(found.scale * have + found.emission, want, atol=1e-6)
    assert (found.scale <= MAX_RATIO).all() and np.isfinite(found.scale).all()


def test_division_of_a_dark_channel_adds_light_and_leaves_the_scale_at_one():
    found = divide(np.array([[1, 0, 0]], np.float32), np.array([[0, 1, 0]], np.float32))
    np.testing.assert_array_equal(found.scale, [[0, 1, 1]])
    np.testing.assert_array_equal(found.emission, [[0, 1, 0]])


def test_scale_multiplies_gain_and_color():
    scale = operations.find("scale")
    parameters = scale.complete({"color": (2.0, 1.0, 0.5), "gain": 3.0}, "/edit")
    found = scale.evaluate(parameters, Pairs(np.ones((1, 3), np.float32)))
    np.testing.assert_array_equal(found.scale, [[6, 3, 1.5]])


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ({"colour": (1.0, 1.0, 1.0)}, "no parameter 'colour'"),
        ({"color": 2.0}, "parameter 'color'"),
        ({"gain": float("nan")}, "parameter 'gain'"),
        ({"gain": -1.0}, "at least 0.0"),
        ({"gain": True}, "parameter 'gain'"),
    ],
)
def test_wrong_parameters_are_named(given, complaint):
    with pytest.raises(EditError, match=complaint):
        operations.find("scale").complete(given, "/World/Edits/warm")


def test_a_second_operation_of_the_same_name_is_refused():
    with pytest.raises(EditError, match="registered already"):
        operations.register(type(operations.find("scale"))())
