"""Operations that look at where light comes from: falloff, direction and redirect, against what they promise."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import dblquad

from icheat_usd.edits.model import Value
from icheat_usd.edits.operations import PairEnd, Pairs, find
from icheat_usd.edits.operations.falloff import NEAREST
from icheat_usd.edits.operations.lobes import integrate_lobe, lobe, mean_lobe
from icheat_usd.scene import F32
from tests.edits.test_operation_colors import Room


def scale(name: str, given: Mapping[str, Value], receiver: PairEnd, caster: PairEnd) -> F32:
    operation = find(name)
    parameters = operation.complete(given, "/edit")
    n = max(len(receiver.position), len(caster.position))
    found = operation.evaluate(parameters, Pairs(np.ones((n, 3), np.float32), receiver, caster)).scale
    assert np.array_equal(found, found[:, :1].repeat(3, axis=1))
    return found[:, 0]


def at(position: object, normal: object = (0, 1, 0)) -> PairEnd:
    places = np.atleast_2d(np.asarray(position, np.float32))
    normals = np.broadcast_to(np.asarray(normal, np.float32), places.shape)
    return PairEnd(places, np.ascontiguousarray(normals), np.full_like(places, 0.5))


def hemisphere(normal: np.ndarray, n: int = 1 << 15) -> np.ndarray:
    """(n, 3) directions about a normal, cosine-weighted, evenly spread by a lattice."""
    k = np.arange(n)
    u, v = (k + 0.5) / n, (k * 0.6180339887498949) % 1
    radius, angle = np.sqrt(u), 2 * np.pi * v
    local = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - u)], axis=1)
    helper = np.array([1.0, 0, 0]) if abs(normal[0]) < 0.9 else np.array([0, 1.0, 0])
    x = np.cross(normal, helper)
    x /= np.linalg.norm(x)
    return local @ np.stack([x, np.cross(normal, x), normal])


unit = st.tuples(st.floats(-1, 1), st.floats(0, 2 * np.pi)).map(
    lambda za: np.array([np.sqrt(1 - za[0] ** 2) * np.cos(za[1]), np.sqrt(1 - za[0] ** 2) * np.sin(za[1]), za[0]])
)


# --------------------------------------------------------------------------- lobes


@pytest.mark.parametrize("exponent", [0.25, 1.0, 2.0, 7.5, 32.0])
@pytest.mark.parametrize("cosine", [-0.99, -0.6, -0.1, 0.0, 0.3, 0.8, 1.0])
def test_mean_of_a_lobe_is_its_integral_over_the_hemisphere(cosine: float, exponent: float) -> None:
    sine = np.sqrt(1 - cosine**2)

    def integrand(phi: float, theta: float) -> float:
        toward = sine * np.sin(theta) * np.cos(phi) + cosine * np.cos(theta)
        return max(toward, 0.0) ** exponent * (toward > 0) * np.cos(theta) * np.sin(theta) / np.pi

    expected = 2 * dblquad(integrand, 0, np.pi / 2, 0, np.pi, epsabs=1e-6, epsrel=1e-6)[0]
    found = mean_lobe(np.float32([cosine]), exponent)[0]
    assert found == pytest.approx(expected, abs=2e-5)
    assert found == pytest.approx(integrate_lobe(cosine, exponent), abs=1e-5)


@pytest.mark.parametrize("exponent", [0.0, 0.5, 2.0, 31.0, 4000.0])
def test_mean_of_a_lobe_along_the_normal_has_a_closed_form(exponent: float) -> None:
    np.testing.assert_allclose(integrate_lobe([1.0, -1.0], exponent), [2 / (exponent + 2), 0], rtol=1e-12, atol=1e-12)


def test_a_lobe_of_exponent_0_is_half_of_all_directions() -> None:
    np.testing.assert_array_equal(lobe(np.float32([1, 0.1, 0, -0.5]), 0.0), [1, 1, 0, 0])
    cosine = np.linspace(-1, 1, 101)
    np.testing.assert_allclose(mean_lobe(cosine.astype(np.float32), 0.0), (1 + cosine) / 2, atol=1e-6)


# --------------------------------------------------------------------------- falloff


@settings(deadline=None)
@given(st.floats(0.0, 100.0), st.floats(0.01, 50.0))
def test_the_physical_exponent_is_exactly_the_identity(distance, pivot):
    found = scale("falloff", {"exponent": 2.0, "pivot": pivot}, at((0, 0, 0)), at((distance, 0, 0)))
    assert found[0] == 1


@settings(deadline=None)
@given(st.floats(0, 4), st.floats(0.1, 10), st.floats(0.05, 20))
def test_falloff_is_a_power_of_the_distance_in_units_of_the_pivot(exponent, pivot, distance):
    found = scale("falloff", {"exponent": exponent, "pivot": pivot}, at((0, 1, 0)), at((0, 1, distance)))
    expected = max(distance / pivot, NEAREST) ** (2 - exponent)
    assert found[0] == pytest.approx(expected, rel=1e-4)


@settings(deadline=None)
@given(st.floats(-4, 8), st.floats(0.1, 10))
def test_light_at_the_pivot_distance_stays(exponent, pivot):
    found = scale("falloff", {"exponent": exponent, "pivot": pivot}, at((0, 0, 0)), at((0, pivot, 0)))
    assert found[0] == pytest.approx(1, rel=1e-5)


def test_points_that_touch_stay_finite() -> None:
    found = scale("falloff", {"exponent": 4.0, "pivot": 1.0}, at((1, 1, 1)), at((1, 1, 1)))
    assert found[0] == pytest.approx(1 / NEAREST**2)


def test_without_a_pivot_the_mean_distance_is_taken() -> None:
    falloff = find("falloff")
    parameters = falloff.complete({"exponent": 1.0}, "/edit")
    assert falloff.prepare(parameters, Room(distance=2.5))["pivot"] == 2.5
    assert falloff.prepare(parameters, Room(distance=0.0))["pivot"] == 1.0
    given = falloff.complete({"pivot": 3.0}, "/edit")
    assert falloff.prepare(given, Room())["pivot"] == 3.0


# --------------------------------------------------------------------------- direction


@settings(deadline=None)
@given(unit, unit, st.floats(0, 8), st.floats(-1, 3))
def test_a_white_surround_gives_every_receiver_as_much_as_before(normal, direction, sharpness, strength):
    parameters = {"direction": tuple(direction), "sharpness": sharpness, "strength": strength}
    casters = 7.0 * hemisphere(normal)
    found = scale("direction", parameters, at((0, 0, 0), normal), at(casters))
    assert found.astype(float).mean() == pytest.approx(1, abs=3e-3 * max(1, abs(strength)))


def test_direction_names_where_the_light_should_come_from() -> None:
    """At sharpness 2 the mean over a hemisphere about the direction is 1/2."""
    casters = at([(0, 5, 0), (5, 0, 0), (0, -5, 0), (3, 3, 0)])
    found = scale("direction", {"direction": (0.0, 2.0, 0.0)}, at((0, 0, 0)), casters)
    np.testing.assert_allclose(found, [1.5, 0.5, 0.5, 1.0], atol=1e-6)


def test_the_greatest_strength_that_takes_no_more_than_all_light() -> None:
    given: dict[str, Value] = {"sharpness": 6.0, "strength": 4.0}
    np.testing.assert_allclose(scale("direction", given, at((0, 0, 0)), at((1, 0, 0))), 0, atol=1e-5)


# --------------------------------------------------------------------------- redirect


@settings(deadline=None)
@given(unit, unit, st.floats(8, 90))
def test_redirected_light_keeps_the_power_that_a_caster_sends(normal, towards, spread):
    place = np.array([0.3, -0.2, 0.5])
    receivers = at(place + 4.0 * hemisphere(normal))
    parameters = {"target": tuple(place + 2.5 * towards), "spread": spread}
    found = scale("redirect", parameters, receivers, at(place, normal)).astype(float)
    assert (found >= 0).all()
    # A share of what a few of the directions carry: the sharper, the noisier.
    assert found.mean() == pytest.approx(1, abs=1e-3 + 1e-3 * found.max())


def test_the_lobe_falls_to_half_at_its_spread() -> None:
    angle = np.radians([0, 25])
    receivers = at(3 * np.stack([np.sin(angle), np.cos(angle), 0 * angle], axis=1))
    on_axis, aside = scale("redirect", {"target": (0.0, 1.0, 0.0), "spread": 25.0}, receivers, at((0, 0, 0)))
    exponent = np.log(0.5) / np.log(np.cos(np.radians(25)))
    assert on_axis == pytest.approx((exponent + 2) / 2, rel=1e-4)
    assert aside == pytest.approx(0.5 * on_axis, rel=1e-4)


def test_a_target_well_behind_a_caster_changes_nothing() -> None:
    receivers = at(3 * hemisphere(np.array([0.0, 1, 0]), 64))
    for target in ((0.0, -1.0, 0.0), (1.0, -0.6, 0.0)):  # 31 degrees below the horizon
        assert (scale("redirect", {"target": target, "spread": 30.0}, receivers, at((0, 0, 0))) == 1).all()


def test_the_edit_fades_smoothly_while_its_target_sinks_below_the_horizon() -> None:
    below = np.radians(np.linspace(-2, 32, 341))  # by 0.1 degrees
    receiver = at((3, 0.3, 0))
    found = np.array(
        [
            scale("redirect", {"target": (float(np.cos(b)), float(-np.sin(b)), 0.0)}, receiver, at((0, 0, 0)))[0]
            for b in below
        ]
    )
    assert np.isfinite(found).all() and found[-1] == 1
    # A lobe along the horizon sends the power of a whole hemisphere within few degrees of it.
    assert found.max() < 25
    assert (np.abs(np.diff(found)) < 0.05 * found[1:]).all()


def test_a_caster_at_the_target_sends_as_before() -> None:
    found = scale("redirect", {"target": (1.0, 2.0, 3.0)}, at((4, 5, 6)), at((1, 2, 3)))
    assert found[0] == 1
