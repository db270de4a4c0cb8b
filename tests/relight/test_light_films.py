"""Images of lights at rest: their sums against the exact relighter, and that only the state decides their bits."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.edits.model import Edit, EditStack
from icheat_usd.relight import light_films
from icheat_usd.relight.live import LiveRelighter
from icheat_usd.scene import F32
from tests.pipeline import Pipeline, select
from tests.relight.test_live import RestingLights, packed, poor, refined
from tests.relight.test_operations import edit, pipeline, soft

NONE = ()
SCALES = (
    edit("a", "scale", select("/floor", "/back"), select("/red", "/green")),
    soft("b", "scale", "/floor", "/red", 3),
    edit("c", "scale", select("/back"), select("/red", "/ceiling")),
)
GAINS = ((0.3, 1.2, 2.0), (0.0, 0.5, 0.1))


def shown_at_rest(of: Pipeline, edits: tuple[Edit, ...]) -> LiveRelighter:
    shown = LiveRelighter(of.snapshot, of.view, of.gather, poor(packed("full")), RestingLights(of))
    shown.set_stack(EditStack("/stack", edits))
    refined(shown)
    return shown


def set_gains(shown: LiveRelighter) -> None:
    for light, gain in enumerate(GAINS):
        shown.lights.set_gain(light, gain)


def has_films(shown: LiveRelighter) -> bool:
    return shown._films.hold(shown._moves_seen)


def exact_image(of: Pipeline, edits: tuple[Edit, ...], gains: F32) -> F32:
    exact = LiveRelighter(of.snapshot, of.view, of.gather, of.transport, RestingLights(of))
    exact.lights.gains[:] = gains
    exact.set_stack(EditStack("/stack", edits))
    return exact.frame()


@pytest.mark.parametrize("edits", [NONE, SCALES])
def test_gains_at_rest_make_the_image_of_the_exact_rows(edits):
    of = pipeline("full")
    shown = shown_at_rest(of, edits)
    assert has_films(shown)
    set_gains(shown)
    shown.set_stack(EditStack("/stack", edits))  # as sessions do whatever has changed
    assert has_films(shown)
    expected = exact_image(of, edits, shown.lights.gains)
    np.testing.assert_allclose(shown.frame(), expected, rtol=2e-5, atol=1e-6 * expected.max())


@pytest.mark.parametrize("edits", [NONE, SCALES])
def test_the_same_gains_have_the_same_bits_before_and_after_they_come_to_rest(edits):
    of = pipeline("full")
    shown = shown_at_rest(of, edits)
    set_gains(shown)
    at_once = shown.frame()
    np.testing.assert_array_equal(at_once, refined(shown))
    again = LiveRelighter(of.snapshot, of.view, of.gather, poor(packed("full")), RestingLights(of))
    set_gains(again)
    again.set_stack(shown.stack)
    np.testing.assert_array_equal(at_once, refined(again))


def test_other_commands_than_gains_end_them():
    of = pipeline("full")
    shown = shown_at_rest(of, SCALES)
    before = shown.frame()
    shown.set_amount("/a", 0.25)
    assert not has_films(shown)
    assert np.abs(shown.frame() - before).max() > 0.01
    refined(shown)
    shown.lights.radiance = 2 * shown.lights.radiance
    shown.lights.view_direct = 2 * shown.lights.view_direct
    dim = shown.frame()
    shown.lights.moves = 1
    shown.lights.revision += 1
    bright = shown.frame()
    assert not has_films(shown)
    assert (bright - dim).mean() > 0.5 * dim.mean()


@pytest.mark.parametrize(
    "stop",
    [
        edit("hue", "hsv", select("/floor"), select("/red")),
        edit("less", "scale", select("/floor"), select("/red", "/back"), amount=-50.0),
        edit("more", "scale", select("/floor"), select("/red", "/back"), amount=50.0),
    ],
)
def test_light_that_is_not_a_sum_over_lights_has_none(stop):
    """Light that one light would take away from another one is held at 0 in their sum alone."""
    of = pipeline("full")
    shown = shown_at_rest(of, (stop,))
    assert not has_films(shown)
    set_gains(shown)
    expected = exact_image(of, (stop,), shown.lights.gains)
    np.testing.assert_allclose(refined(shown), expected, rtol=1e-4, atol=1e-4 * expected.max())


@pytest.mark.parametrize("limit", ["MOST_BYTES", "MOST_PRODUCTS"])
def test_what_would_take_too_much_is_not_made(limit, monkeypatch):
    monkeypatch.setattr(light_films, limit, 0)
    assert not has_films(shown_at_rest(pipeline("full"), SCALES))
