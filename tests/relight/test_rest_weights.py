"""Weights fitted to lights at rest: the fit beside a plain one, and what it does to the image that is shown."""

from __future__ import annotations

import functools

import numba
import numpy as np
import pytest
from scipy.optimize import nnls

from icheat_usd.edits.model import EditStack
from icheat_usd.relight import rest_weights
from icheat_usd.relight.live import LiveRelighter
from icheat_usd.relight.rest_weights import PRIOR, TRAINING_SHARE, FitSource, fitted_weights
from icheat_usd.scene import F32, F64, I64
from icheat_usd.transport import Transport, build_transport, training_radiance
from tests.pipeline import Pipeline, select
from tests.relight.test_live import RestingLights, packed_rows, poor, refined
from tests.relight.test_operations import edit, room, soft

STACK = EditStack(
    "/stack",
    (edit("a", "scale", select("/floor", "/back"), select("/red", "/green")), soft("b", "scale", "/floor", "/red", 3)),
)


@pytest.fixture(autouse=True)
def effort(monkeypatch: pytest.MonkeyPatch) -> None:
    """Some tenth of so small an image, with few rays."""
    monkeypatch.setattr(rest_weights, "MOST_SHARE", 0.1)
    monkeypatch.setattr(rest_weights, "RAYS", 512)


@functools.cache
def sparse() -> Pipeline:
    """Rows at one pixel in 64, and where the block and the walls ask for more."""
    return Pipeline(room(32), n_gather=512, rays=4096, bounce_rays=64, light_samples=8, n_bounces=4, row_spacing=8)


@functools.cache
def converged() -> Transport:
    of = sparse()
    return build_transport(of.snapshot, of.tracer, of.view, of.gather, rays_per_row=8192, seed=77)


@functools.cache
def plausible() -> F32:
    """Light that plausible lights make leave the cells, (24, n_gather)."""
    of = sparse()
    return training_radiance(of.snapshot, of.tracer, of.gather, of.bounces, 24)


def relighter(*, fits: bool, stack: EditStack = STACK) -> LiveRelighter:
    of = sparse()
    rows = poor(packed_rows(of))
    source = FitSource(of.tracer, plausible()) if fits else None
    shown = LiveRelighter(of.snapshot, of.view, of.gather, rows, RestingLights(of), fit_source=source)
    shown.set_stack(stack)
    return shown


def fitted_samples(shown: LiveRelighter) -> I64:
    spread, given = shown.transport.interpolation, sparse().transport.interpolation
    assert spread is not None and given is not None
    entries = np.flatnonzero(spread.weights != given.weights)
    return np.unique(np.searchsorted(spread.indptr, entries, side="right") - 1)


def move_a_light(shown: LiveRelighter) -> None:
    shown.lights.radiance = 0.5 * shown.lights.radiance + 0.5 * shown.lights.radiance[:, ::-1]
    shown.lights.moves += 1
    shown.lights.revision += 1


def errors(image: F32, expected: F32, samples: I64) -> float:
    return float(np.square(image[samples] - expected[samples]).sum())


def test_the_fit_is_least_squares_with_a_prior_and_no_weight_below_0():
    rng = np.random.default_rng(1)
    given, shown = rng.uniform(0, 1, (40, 4)), rng.uniform(0, 2, (40, 4, 6))
    shown[2, 2:] = given[2, 2:] = 0  # a sample of two records
    seen = rng.uniform(0, 3, (40, 6)).astype(np.float32)
    found = fitted_weights(given, shown, seen, seen)
    for w, of, wanted, fitted in zip(given, shown, seen, found, strict=True):
        n_real = int((of != 0).any(axis=1).sum())
        pull = np.sqrt(PRIOR * np.square(of).sum() / n_real) * np.eye(4)
        sides = np.concatenate([of.T, pull]), np.concatenate([wanted, pull @ w])
        np.testing.assert_allclose(fitted, nnls(*sides)[0], rtol=1e-3, atol=1e-3)
    assert 0 < (found == 0).sum() < found.size / 2


def test_what_may_be_noise_changes_no_weight():
    given, shown = np.full((3, 2), 0.5), np.array([[[1.0], [3.0]]] * 3)
    one = np.array([[1.0], [3.0], [4.0]], np.float32)
    other = np.array([[3.0], [1.9], [4.0]], np.float32)
    same, some, whole = fitted_weights(given, shown, one, other) - given
    np.testing.assert_array_equal(same, 0)
    # Missing .45 with noise .55, and missing 2 without any.
    np.testing.assert_array_equal(some, 0)
    assert (whole > 0).all()


def test_records_that_show_nothing_keep_their_weights():
    given = np.array([[0.25, 0.75]])
    seen = np.ones((1, 3), np.float32)
    np.testing.assert_array_equal(fitted_weights(given, np.zeros((1, 2, 3)), seen, seen), given)


def test_at_rest_samples_with_other_weights_show_what_their_own_rays_would():
    before, shown = relighter(fits=False), relighter(fits=True)
    refined(before)
    refined(shown)
    samples = fitted_samples(shown)
    assert 20 < len(samples) <= 0.1 * sparse().view.n
    for light in (0, 1):
        gains = np.eye(2, dtype=np.float32)[light]
        for one in (before, shown):
            for k, gain in enumerate(gains):
                one.lights.set_gain(k, gain)
        expected = converged().to_view(sparse().cell_light.radiance[light])
        off = errors(before.relit().indirect, expected, samples)
        assert errors(shown.relit().indirect, expected, samples) < 0.4 * off


def test_weights_are_fitted_to_what_each_record_shows(monkeypatch):
    given = []

    def look(*asked: F64 | F32) -> F64:
        given.append(asked)
        return fitted_weights(*asked)

    monkeypatch.setattr(rest_weights, "fitted_weights", look)
    shown = relighter(fits=True)
    refined(shown)
    ((weights, at_records, one, other),) = given
    samples, exact, radiance = fitted_samples(shown), sparse().transport, sparse().cell_light.radiance
    spread = exact.interpolation
    scale = [np.sqrt(np.mean(exact.to_view(light).astype(np.float64) ** 2)) for light in radiance]
    # Beside the two lights there are plausible ones, each in units of its image, which have a share together.
    others = plausible().reshape(8, 3, -1).swapaxes(1, 2)
    squares = [np.square(exact.to_view(np.ascontiguousarray(light)), dtype=np.float64).mean(axis=0) for light in others]
    others = others * np.sqrt(TRAINING_SHARE / 8 / np.array(squares))[:, None]
    n_records = np.diff(spread.indptr)[samples]
    assert n_records.min() < n_records.max()
    shining = np.concatenate([radiance / np.array(scale)[:, None, None], others]).astype(np.float32)
    expected = np.zeros(at_records.shape)
    for i, sample in enumerate(samples):
        here = slice(*spread.indptr[sample : sample + 2])
        np.testing.assert_array_equal(weights[i, : n_records[i]], spread.weights[here])
        assert not weights[i, n_records[i] :].any()
        for j, record in enumerate(spread.indices[here]):
            parts = [[lobe.tint[sample] * lobe.rows.rows(record, record + 1).matmul(light)[0] for light in shining]
                     for lobe in exact.lobes]  # fmt: skip
            expected[i, j] = np.sum(parts, axis=0).ravel()
    np.testing.assert_allclose(at_records, expected, rtol=1e-4, atol=1e-6)


def test_weights_suit_plausible_lights_too(monkeypatch):
    """Two lights alone say little of what others would show: weights that fit them alone are worse for these."""
    others = np.ascontiguousarray(plausible().reshape(8, 3, -1).swapaxes(1, 2))
    exact = [converged().to_view(light) for light in others]
    off = []
    for share in (0.0, TRAINING_SHARE, 10.0):
        monkeypatch.setattr(rest_weights, "TRAINING_SHARE", share)
        shown = relighter(fits=True)
        refined(shown)
        samples, rows = fitted_samples(shown), shown.transport.source
        assert isinstance(rows, Transport)
        pairs = zip([rows.to_view(light) for light in others], exact, strict=True)
        off.append(sum(errors(one, other, samples) / np.mean(np.square(other)) for one, other in pairs))
    assert off[2] < off[1] < off[0]
    assert off[2] < 0.8 * off[0]


def test_lights_that_other_lights_do_not_reach_stay_at_0(monkeypatch):
    """A weight below 0 would leave less than nothing of one light, and no image of it."""
    monkeypatch.setattr(rest_weights, "PRIOR", 1e-6)
    shown = relighter(fits=True)
    refined(shown)
    spread = shown.transport.interpolation
    assert spread is not None and len(fitted_samples(shown)) and spread.weights.min() >= 0
    assert shown._films.hold(shown._moves_seen)


def test_nothing_else_changes():
    before, shown = relighter(fits=False), relighter(fits=True)
    refined(before)
    refined(shown)
    others = np.setdiff1d(np.arange(sparse().view.n), fitted_samples(shown))
    for layer in ("indirect", "indirect_edited", "direct"):
        one, other = (getattr(each.relit(), layer) for each in (before, shown))
        np.testing.assert_array_equal(one[others], other[others])


def test_edits_come_of_these_weights_too():
    """At rest the edited image is that of the exact evaluator with the same interpolation."""
    shown = relighter(fits=True)
    refined(shown)
    exact = LiveRelighter(shown._snapshot, shown.view, shown.gather, shown.transport.source, RestingLights(sparse()))
    exact.set_stack(STACK)
    expected = exact.frame()
    np.testing.assert_allclose(shown.frame(), expected, rtol=1e-4, atol=1e-5 * expected.max())
    assert np.abs(shown.relit().indirect_edited - shown.relit().indirect).max() > 0


def test_an_identity_has_the_bits_of_the_unedited_image():
    none, identity = EditStack("/none", ()), EditStack("/one", (edit("a", "scale", amount=0.0),))
    one, other = (relighter(fits=True, stack=stack) for stack in (none, identity))
    np.testing.assert_array_equal(refined(one), refined(other))


def weights_of(shown: LiveRelighter) -> F32:
    spread = shown.transport.interpolation
    assert spread is not None
    return spread.weights.copy()


def test_weights_stay_while_lights_move_and_until_others_fit():
    shown = relighter(fits=True)
    refined(shown)
    weights, seen = weights_of(shown), []
    assert len(fitted_samples(shown))
    for _ in range(3):
        move_a_light(shown)
        shown.frame()
        np.testing.assert_array_equal(weights_of(shown), weights)
    move_a_light(shown)
    while shown.refine():
        seen.append(weights_of(shown))
    changes = [not np.array_equal(one, other) for one, other in zip([weights, *seen], seen, strict=False)]
    assert sum(changes) == 1 and changes.index(True) > 5
    # As if there had been no lights before.
    expected = relighter(fits=True)
    for _ in range(4):
        move_a_light(expected)
    np.testing.assert_array_equal(refined(expected), shown.frame())
    np.testing.assert_array_equal(weights_of(expected), seen[-1])


def test_a_light_that_moves_a_little_is_nearer_to_what_rays_of_its_own_say():
    before, shown = relighter(fits=False), relighter(fits=True)
    refined(before)
    refined(shown)
    samples = fitted_samples(shown)
    for one in (before, shown):
        moved = 0.9 * one.lights.radiance + 0.1 * one.lights.radiance[:, ::-1]
        one.lights.radiance, one.lights.moves, one.lights.revision = moved, 1, 1
    expected = converged().to_view(shown.lights.radiance.sum(axis=0))
    off = errors(before.relit().indirect, expected, samples)
    assert errors(shown.relit().indirect, expected, samples) < 0.5 * off
    np.testing.assert_array_equal(fitted_samples(shown), samples)


def test_lights_that_need_no_fit_have_the_weights_that_there_were(monkeypatch):
    shown = relighter(fits=True)
    refined(shown)
    assert len(fitted_samples(shown))
    monkeypatch.setattr(rest_weights, "LEAST_DIFFERENCE", 1e3)
    move_a_light(shown)
    found = refined(shown)
    assert not len(fitted_samples(shown))
    again = relighter(fits=True)
    move_a_light(again)
    np.testing.assert_array_equal(found, refined(again))


def test_the_same_lights_have_the_same_weights_whatever_came_before():
    shown, again = relighter(fits=True), relighter(fits=True)
    refined(shown)
    move_a_light(shown)
    for _ in range(30):
        shown.refine()
    shown.set_amount("/a", 0.5)
    shown.lights.set_gain(0, (0.5, 1, 2))
    found = refined(shown)
    move_a_light(again)
    again.set_amount("/a", 0.5)
    again.lights.set_gain(0, (0.5, 1, 2))
    np.testing.assert_array_equal(found, refined(again))


def test_edits_and_gains_keep_the_weights():
    shown = relighter(fits=True)
    refined(shown)
    weights = shown.transport.interpolation.weights.copy()
    shown.lights.set_gain(0, 0.25)
    shown.set_amount("/a", 0.5)
    shown.frame()
    np.testing.assert_array_equal(shown.transport.interpolation.weights, weights)
    assert not np.array_equal(sparse().transport.interpolation.weights, weights)


def test_nothing_is_fitted_before_lights_stay():
    shown = relighter(fits=True)
    while shown.refine(fits=False):
        pass
    assert not len(fitted_samples(shown))
    shown.relit()
    found = refined(shown)
    assert len(fitted_samples(shown))
    again = relighter(fits=True)
    np.testing.assert_array_equal(found, refined(again))
    np.testing.assert_array_equal(shown.relit().indirect, again.relit().indirect)


def test_lights_that_differ_little_from_record_to_record_need_no_rays(monkeypatch):
    monkeypatch.setattr(rest_weights, "LEAST_DIFFERENCE", 1e3)
    monkeypatch.setattr(rest_weights, "rows_of_points", None)
    shown = relighter(fits=True)
    refined(shown)
    assert not len(fitted_samples(shown))


def test_one_thread_fits_the_bits_of_two():
    found = []
    for n in (1, 2):
        before = numba.get_num_threads()
        numba.set_num_threads(min(n, before))
        try:
            found.append(refined(relighter(fits=True)))
        finally:
            numba.set_num_threads(before)
    np.testing.assert_array_equal(*found)
