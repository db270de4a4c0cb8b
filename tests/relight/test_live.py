"""The live relighter with compression off against the exact one, and that only the state decides its bits."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest

from icheat_usd.edits.model import Edit, EditStack
from icheat_usd.relight.live import LiveRelighter
from icheat_usd.scene import F32
from icheat_usd.transport import sum_lights
from tests.pipeline import Pipeline
from tests.relight.test_operations import PARAMETERS, pipeline, stacks


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
    np.testing.assert_array_equal(found.indirect, expected.indirect)
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
