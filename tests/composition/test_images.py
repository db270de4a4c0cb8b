"""Both renderers show the same image, bit for bit, of what layers compose to and of one layer written by hand."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from icheat_usd.image.film import Film
from icheat_usd.session import GatherSettings, Quality, Session
from icheat_usd.stage import schema
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


#: Cases that ask most of a host without the schemas: list edits of collections, keys, variants, libraries, limits.
UNREGISTERED = (
    "a shot changes what an edit selects",
    "a shot overrides one key",
    "the day grade of a stack, chosen by the shot",
    "a library's edits, referenced by the sequence and aimed by the shot",
    "limits, lights and a target of a library follow the reference, the layers' times and the shot",
)


def digests(images: tuple[Film, Film]) -> list[str]:
    """SHA-256 of all layers of both films."""
    pixels = [b"".join(film.layer(name).tobytes() for name in sorted(film.layers)) for film in images]
    return [hashlib.sha256(each).hexdigest() for each in pixels]


def main() -> None:
    """Print the digests of stages that standard input says how to open."""
    print(json.dumps([schema.is_registered(), *(digests(films(opened)) for opened in json.load(sys.stdin))]))


def test_a_host_that_composed_first_shows_the_same(folder: Path) -> None:
    composed = [write_case(CASES[name], folder / f"late{index}") for index, name in enumerate(UNREGISTERED)]
    code = (
        "from pxr import Usd\nUsd.Stage.CreateInMemory().DefinePrim('/composed/before', 'Scope')\n"
        "from tests.composition.test_images import main\nmain()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        input=json.dumps(composed),
        capture_output=True,
        text=True,
        cwd=Path(__file__).parents[2],
        env={name: value for name, value in os.environ.items() if name != "PXR_PLUGINPATH_NAME"},
    )
    assert done.returncode == 0, done.stderr
    registered, *late = json.loads(done.stdout)
    assert not registered
    here = [digests(films(opened, _scene(folder, SCENE))) for opened in composed]
    assert late == here and len({tuple(each) for each in here}) == len(UNREGISTERED)


def test_what_the_images_share_is_what_each_stage_computes_for_itself(folder: Path) -> None:
    """The scene is composed and retimed like the edits, so one case is rendered from the start."""
    case = next(iter(CASES.values()))
    composed = write_case(case, folder / "alone")
    expected = films(composed, _scene(folder, SCENE))
    assert_equal(films(composed), expected)
    assert_equal(films(retimed(composed, "reference")), expected)
