"""Both renderers show the same image, bit for bit, of what layers compose to and of one layer written by hand."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from icheat_usd.image.film import Film
from icheat_usd.session import GatherSettings, Quality, Session
from tests.composition.reading import open_case
from tests.composition.stages import SCENE, Case, layer, retimed, write_case, write_flat
from tests.composition.test_composition import CASES

WIDTH, HEIGHT = 16, 12
QUALITY = Quality(n_gather=128, rays_per_row=16, rays_per_bounce_row=16, light_samples=2, n_bounces=2)
SETTINGS = GatherSettings(samples_per_pixel=1, gather_rays=8, light_samples=1)

#: What a session computes of a scene before it looks at edits.
SHARED = ("snapshot", "tracer", "view", "gather", "transport", "cell_light", "relighter")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("images")


@cache
def _scene(folder: Path, text: str) -> Session:
    """All that is computed of a scene without edits, once."""
    path = folder / f"scene{len(text)}.usda"
    path.write_text(layer(text))
    session = Session.open(path, width=WIDTH, height=HEIGHT, quality=QUALITY)
    for name in SHARED:
        getattr(session, name)
    return session


def films(opened: dict[str, Any], scene: Session | None = None) -> tuple[Film, Film]:
    """Preview and final frame; what is computed of the scene is taken from `scene`, if it is given."""
    session = Session.open(
        open_case(opened), frame=opened["time"], stack=opened["stack"], width=WIDTH, height=HEIGHT, quality=QUALITY
    )
    if scene is not None:
        session.__dict__.update({name: scene.__dict__[name] for name in SHARED})
    return session.relight(), session.render(SETTINGS)


def assert_equal(images: tuple[Film, Film], expected: tuple[Film, Film]) -> None:
    for image, wanted in zip(images, expected, strict=True):
        assert set(image.layers) == set(wanted.layers)
        for name in wanted.layers:
            np.testing.assert_array_equal(image.layer(name), wanted.layer(name), name)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_both_renderers_show_what_one_layer_by_hand_shows(case: Case, folder: Path) -> None:
    number = list(CASES).index(case.name)
    composed, flat = (write(case, folder / str(number)) for write in (write_case, write_flat))
    scene = _scene(folder, case.scene)
    expected = films(flat, scene)
    assert_equal(films(composed, scene), expected)
    assert_equal(films(retimed(composed, case.retimings[0]), scene), expected)
    acts = "stackEnabled = false" not in case.flat
    assert all(bool(np.any(film.layer("edit_delta"))) == acts for film in expected)


def test_what_the_images_share_is_what_each_stage_computes_for_itself(folder: Path) -> None:
    """The scene is composed and retimed like the edits, so one case is rendered from the start."""
    case = next(iter(CASES.values()))
    composed = write_case(case, folder / "alone")
    expected = films(composed, _scene(folder, SCENE))
    assert_equal(films(composed), expected)
    assert_equal(films(retimed(composed, "reference")), expected)
