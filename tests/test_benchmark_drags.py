"""Lights that the benchmark drags from rest: where they go, and what of them is multiplied then."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from icheat_usd.scene import LightKind
from tools.benchmarking.errors import drag_lights
from tools.benchmarking.parts import Effort, Parts
from tools.benchmarking.test_lights import DRAG_ANGLE, DRAG_FRAMES, choose_lights, drag_to, with_lights

STAGE = Path(__file__).parents[1] / "sample_stages/cornell_box/scene.usda"


@pytest.fixture(scope="module")
def parts() -> Parts:
    parts = Parts(STAGE, Effort(width=64, height=48, n_gather=500))
    return parts.under(with_lights(parts.snapshot, choose_lights(parts.snapshot, parts.tracer, parts.view, 5)))


def test_a_drag_ends_where_the_light_stands_and_is_as_long_everywhere(parts: Parts) -> None:
    lights = choose_lights(parts.snapshot, parts.tracer, parts.view, 5)
    assert {light.kind for light in lights} >= {LightKind.SPHERE, LightKind.RECT, LightKind.DOME, LightKind.DISTANT}
    for light in lights:
        places = drag_to(light, parts.tracer)
        assert len(places) == DRAG_FRAMES + 1
        np.testing.assert_array_equal(places[-1], light.to_world)
        steps = np.diff(np.array(places), axis=0)
        lengths = np.linalg.norm(steps.reshape(DRAG_FRAMES, -1), axis=1)
        np.testing.assert_allclose(lengths, lengths[0], rtol=0.1)
        if light.kind not in (LightKind.DOME, LightKind.DISTANT):
            back = (places[0] - places[-1])[:, 3].astype(np.float32)
            length = np.linalg.norm(back)
            start = places[-1][None, :, 3].astype(np.float32)
            assert not parts.tracer.occluded(start, back[None] / length, np.float32(length))
        for place in places:
            np.testing.assert_allclose(place[:, :3].T @ place[:, :3], np.eye(3), atol=1e-6)
        if light.kind == LightKind.DOME:
            turn = places[-1][:, :3] @ places[0][:, :3].T
            angle = np.arccos((np.trace(turn) - 1) / 2)
            assert DRAG_FRAMES * DRAG_ANGLE < angle < 2 * DRAG_FRAMES * DRAG_ANGLE


def test_what_is_known_from_rest_is_exact_and_only_the_rest_is_multiplied(parts: Parts) -> None:
    lights = choose_lights(parts.snapshot, parts.tracer, parts.view, 5)
    dragged = drag_lights(parts, [drag_to(light, parts.tracer) for light in lights])
    # With the weights that were fitted at rest.
    exact, packed = (replace(rows, interpolation=dragged.spread) for rows in (parts.transport, parts.packed))
    assert parts.transport.interpolation is not None and dragged.spread is not None
    assert (dragged.spread.weights != parts.transport.interpolation.weights).any()
    for light in range(len(lights)):
        of_rest = dragged.rest[light]
        known = dragged.radiance[light] - of_rest
        # Each channel as near to what it was as a factor brings it.
        common = np.einsum("ic,ic->c", known.astype(np.float64), of_rest)
        assert (np.abs(common) < 1e-4 * np.square(known).sum(axis=0)).all() and known.any()
        shown = exact.to_view(known) + packed.to_view(of_rest)
        scale = np.sqrt(np.square(shown).mean())
        np.testing.assert_allclose(dragged.shown[light], np.maximum(shown, 0), rtol=0, atol=0.01 * scale)
        assert np.abs(packed.to_view(dragged.radiance[light]) - shown).max() > 0.01 * scale
