"""Images between which an amount moves, against images of the same amounts evaluated anew."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.edits.model import Blend, Edit, EditStack
from icheat_usd.relight.live import LiveRelighter
from tests.pipeline import select
from tests.relight.test_light_films import SCALES, exact_image
from tests.relight.test_live import RestingLights, packed, poor, refined
from tests.relight.test_operations import edit, pipeline

DRAGGED = (0.8, 0.6, 0.35, 0.05, 1.0, 0.5)
OVER = (*SCALES[:2], edit("d", "scale", select("/floor"), select("/red"), blend=Blend.OVER))


def shown_at_rest(edits: tuple[Edit, ...]) -> LiveRelighter:
    of = pipeline("full")
    shown = LiveRelighter(of.snapshot, of.view, of.gather, poor(packed("full")), RestingLights(of))
    shown.set_stack(EditStack("/stack", edits))
    refined(shown)
    return shown


def is_between(shown: LiveRelighter) -> bool:
    return bool(shown._amounts.path) and shown._amounts.hold(0.5)


@pytest.mark.parametrize("path", ["/a", "/b", "/c"])
def test_an_amount_that_is_dragged_shows_the_exact_image(path):
    shown = shown_at_rest(SCALES)
    for k, amount in enumerate(DRAGGED):
        shown.set_amount(path, amount)
        found = shown.frame()
        assert is_between(shown) == (k >= 2)
        expected = exact_image(pipeline("full"), shown.stack.edits, np.ones((2, 3), np.float32))
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5 * expected.max())
    at_rest = refined(shown)
    np.testing.assert_array_equal(at_rest, refined(shown_at_rest(shown.stack.edits)))


@pytest.mark.parametrize("path", ["/a", "/b", "/d"])
def test_an_amount_that_is_dragged_shows_what_each_frame_would_by_itself(path, monkeypatch):
    """Edits over others have a remainder, which is multiplied with packed rows."""
    shown, other = shown_at_rest(OVER), shown_at_rest(OVER)
    monkeypatch.setattr(other._amounts, "are_wanted", lambda: False)
    for amount in DRAGGED:
        for one in (shown, other):
            one.set_amount(path, amount)
        expected = other.frame()
        np.testing.assert_allclose(shown.frame(), expected, rtol=1e-4, atol=2e-4 * expected.max())
    assert is_between(shown)
    assert not is_between(other)


def test_a_frame_that_is_shown_again_is_the_same():
    shown = shown_at_rest(SCALES)
    for amount in DRAGGED:
        shown.set_amount("/a", amount)
        once = shown.frame()
        for _ in range(4):
            np.testing.assert_array_equal(shown.frame(), once)
    assert is_between(shown)


def test_what_an_edit_does_not_touch_keeps_its_bits():
    one = edit("a", "scale", select("/floor"), select("/red", "/green"))
    nothing = Edit("/none", "scale", {"gain": 1.0}, select("/back"), select("/red", "/green"))
    for path, edits in (("/a", (one,)), ("/none", (one, nothing))):
        shown = shown_at_rest(edits)
        shown.set_amount(path, 0.9)
        before = shown.frame()
        for amount in DRAGGED:
            shown.set_amount(path, amount)
            found = shown.frame()
        assert is_between(shown)
        same = (found == before).all(axis=2)
        assert same.any()
        assert same.all() == (path == "/none")


def do(shown: LiveRelighter, what: str) -> None:
    if what == "gain":
        shown.lights.set_gain(0, (0.5, 0.5, 0.5))
    elif what == "mute":
        shown.mute("/a")
    else:
        path, amount = {"other edit": ("/c", 0.5), "zero": ("/a", 0.0), "beyond": ("/a", 2.0)}[what]
        shown.set_amount(path, amount)


@pytest.mark.parametrize("what", ["gain", "other edit", "mute", "zero", "beyond"])
def test_other_commands_than_amounts_end_them(what, monkeypatch):
    shown, other = shown_at_rest(SCALES), shown_at_rest(SCALES)
    monkeypatch.setattr(other._amounts, "are_wanted", lambda: False)
    for one in (shown, other):
        for amount in DRAGGED:
            one.set_amount("/a", amount)
            one.frame()
        assert is_between(one) == (one is shown)
        do(one, what)
    np.testing.assert_array_equal(shown.frame(), other.frame())


@pytest.mark.parametrize("edits", [(edit("hue", "hsv", select("/floor"), select("/red")),), "less"])
def test_light_that_is_not_affine_in_an_amount_has_none(edits):
    """Light that edits take away is held at 0."""
    if edits == "less":
        less = edit("less", "scale", select("/floor"), select("/red", "/back"), amount=-50.0)
        edits = (edit("hue", "scale", select("/floor"), select("/red")), less)
    shown = shown_at_rest(edits)
    for amount in DRAGGED:
        shown.set_amount("/hue", amount)
        shown.frame()
    assert not is_between(shown)


def test_nothing_lies_between_before_light_comes_to_rest():
    of = pipeline("full")
    shown = LiveRelighter(of.snapshot, of.view, of.gather, poor(packed("full")), RestingLights(of))
    shown.set_stack(EditStack("/stack", SCALES))
    for amount in DRAGGED:
        shown.set_amount("/a", amount)
        shown.frame()
    assert not is_between(shown)
