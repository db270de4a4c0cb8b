"""Relighter and final gather against Mitsuba 3 on the same snapshot: direct light, one bounce, many.

Each renderer runs several times with other seeds; what their results differ
by is held against the noise that these show (`agreement.compare`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from icheat_usd.scene import LightKind, SceneSnapshot
from tests.agreement import Agreement, compare
from tests.pipeline import Pipeline
from tests.scenes import Image, Light, covered_cornell, rotation

pytest.importorskip("mitsuba")

from tools.peers import mitsuba_peer as peer  # noqa: E402

SAMPLE_STAGES = Path(__file__).parents[1] / "sample_stages"

#: Diffuse reflections before the last one in "many": Mitsuba's path depth less two.
MANY = 6
LAYERS = ("direct", "one", "many")


def sky() -> Image:
    """Smooth, and unlike itself under every turn and mirroring."""
    texels = np.full((8, 16, 3), 0.1)
    texels[1:4, 2:6] = (6.0, 4.0, 1.0)
    texels[2:5, 9:11] = (0.2, 2.0, 7.0)
    texels[6:, 13:] = (1.0, 0.1, 0.5)
    return Image(texels)


def sample_stage(name: str, variants: dict[str, str], keep: Callable[[SceneSnapshot], list[int]]) -> SceneSnapshot:
    from icheat_usd.stage import open_stage, take_snapshot

    stage = open_stage(SAMPLE_STAGES / name / "scene.usda")
    stage.SetEditTarget(stage.GetSessionLayer())  # others in this process may read the same file
    for variant_set, variant in variants.items():
        stage.GetDefaultPrim().GetVariantSet(variant_set).SetVariantSelection(variant)
    snapshot = peer.as_diffuse(take_snapshot(stage, width=24, height=24 if name == "cornell_box" else 20))
    return peer.with_lights(snapshot, keep(snapshot))


def all_lights(snapshot: SceneSnapshot) -> list[int]:
    return list(range(len(snapshot.lights.kind)))


def only_sky(snapshot: SceneSnapshot) -> list[int]:
    """The furnished room's sun has an angle and its lamp hangs in a shade: Mitsuba lacks the one and sees the other."""
    return [k for k, path in enumerate(snapshot.light_paths) if path.endswith("/Sky")]


SCENES: dict[str, Callable[[], SceneSnapshot]] = {
    "cornell, emissive mesh": lambda: covered_cornell("mesh"),
    "cornell, rect": lambda: covered_cornell("rect"),
    "cornell, plain dome": lambda: covered_cornell("none", (Light(LightKind.DOME, (1.0, 0.8, 0.6)),)),
    "cornell, turned textured dome": lambda: covered_cornell(
        "none",
        (
            Light(
                LightKind.DOME,
                (0.9, 1.0, 1.2),
                rotation((0, 1, 0), 130) @ rotation((1, 0, 0), 25),
                image=sky(),
            ),
        ),
    ),
    "sample cornell box": lambda: sample_stage("cornell_box", {"light": "mesh"}, all_lights),
    "sample furnished room": lambda: sample_stage("furnished_room", {"sky": "rect"}, only_sky),
}


@functools.cache
def scene(name: str) -> SceneSnapshot:
    return SCENES[name]()


#: Cells of the relighter, and how far single pixels and blocks may be off because light is even within a cell.
CELLS = {"sample furnished room": (32768, 0.03)}
USUAL_CELLS = (4096, 0.02)


@functools.cache
def mitsuba_layers(name: str, samples: int = 1024, renders: int = 4) -> dict[str, np.ndarray]:
    """Layers of several renders, (renders, h, w, 3) each, without lights that the camera sees."""
    mi = peer.load("fast")
    snapshot = scene(name)
    built = peer.mitsuba_scene(mi, snapshot)

    def images(depth: int) -> np.ndarray:
        # The same seed at each depth: the noise of the light that they have in common cancels where it can.
        return np.stack(
            [
                peer.render(mi, built, snapshot, depth=depth, samples=samples, seed=k, hide_emitters=True)
                for k in range(renders)
            ]
        )

    direct = images(peer.DIRECT)
    return {
        "direct": direct,
        "one": images(peer.ONE_BOUNCE) - direct,
        "many": images(MANY + 2) - direct,
    }


@functools.cache
def final_layers(name: str, renders: int = 5) -> dict[str, np.ndarray]:
    pipeline = Pipeline(scene(name))
    found: dict[str, list[np.ndarray]] = {layer: [] for layer in LAYERS}
    for seed in range(renders):
        pipeline.n_bounces = 1
        one = pipeline.final(samples=16, rays=16, light_samples=4, seed=seed)
        pipeline.n_bounces = MANY
        many = pipeline.final(samples=16, rays=16, light_samples=16, seed=100 + seed)
        found["direct"].append(many.direct)
        found["one"].append(one.indirect)
        found["many"].append(many.indirect)
    return {layer: np.stack(images) for layer, images in found.items()}


def relit_layers(name: str, renders: int = 3) -> dict[str, np.ndarray]:
    n_gather, _ = CELLS.get(name, USUAL_CELLS)
    found: dict[str, list[np.ndarray]] = {layer: [] for layer in LAYERS}
    for seed in range(renders):
        pipeline = Pipeline(
            scene(name), n_gather=n_gather, rays=64, light_samples=16, samples_per_pixel=16, seed=seed, n_bounces=MANY
        )
        relighter = pipeline.relighter
        found["direct"].append(pipeline.image(relighter.view_direct.sum(axis=0)))
        for layer, cells in (("one", pipeline.cell_light.direct), ("many", pipeline.cell_light.radiance)):
            found[layer].append(pipeline.image(pipeline.transport.to_view(cells.sum(axis=0))))
    return {layer: np.stack(images) for layer, images in found.items()}


def assert_agree(found: Agreement, slack: float) -> None:
    """Means within 2 %, given two standard errors of the measurement; within noise alone but for `slack`.

    The mean of z^2 over 400 pixels (25 blocks) with equal channels spreads by
    sqrt(2 / 400) = 0.07 (0.28), more as noise has tails: bounds at 5 times that.
    """
    off = np.abs(found.ratio - 1)
    assert (off < 0.02 + 2 * found.error).all(), found
    assert (off < 4 * found.error + slack).all(), found
    assert found.pixels < 1.35, found
    assert found.blocks < 2.4, found


@pytest.mark.slow
@pytest.mark.parametrize("layer", LAYERS)
@pytest.mark.parametrize("name", SCENES)
def test_final_gather_is_mitsuba_within_noise(name, layer):
    assert_agree(compare(final_layers(name)[layer], mitsuba_layers(name)[layer], tolerance=0.005), 0.002)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in SCENES if "rect" not in name and "room" not in name])
def test_camera_sees_the_lights_that_mitsuba_sees(name):
    """Emissive meshes and domes; analytic lights are shapes there and show themselves to no camera here."""
    mi = peer.load("fast")
    built = peer.mitsuba_scene(mi, scene(name))
    theirs = [peer.render(mi, built, scene(name), depth=peer.EMISSION, samples=2048, seed=seed) for seed in range(3)]
    pipeline = Pipeline(scene(name), n_bounces=1)
    finals = [pipeline.final(samples=512, rays=1, light_samples=1, seed=seed) for seed in range(3)]
    ours = [final.background + final.emission for final in finals]
    found = compare(ours, theirs)
    off = np.abs(found.ratio - 1)
    assert off.max() < 0.02 and (off < 4 * found.error + 0.002).all(), found
    # A lamp seen from the side covers a dozen pixels: too few for the statistics of z, enough for their places.
    difference = np.mean(ours, axis=0) - np.mean(theirs, axis=0)
    assert np.abs(difference).max() < 0.1 * np.mean(theirs, axis=0).max(), found


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_relighter_is_mitsuba_within_noise_and_the_size_of_its_cells(name):
    relit = relit_layers(name, 2 if "room" in name else 3)
    _, tolerance = CELLS.get(name, USUAL_CELLS)
    assert_agree(compare(relit["direct"], mitsuba_layers(name)["direct"], tolerance=0.005), 0.002)
    for layer in ("one", "many"):
        assert_agree(compare(relit[layer], mitsuba_layers(name)[layer], tolerance=tolerance), 0.02)
