"""The benchmark of the final gather runs at tiny sizes, and its sums are right."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.scenes import closed_box
from tools.benchmarking import references, rival_summary
from tools.benchmarking.goals import Goal, at_least, at_most
from tools.benchmarking.mitsuba_layers import Layers, MitsubaLayers
from tools.benchmarking.references import Reference
from tools.benchmarking.render_sequence import flicker, flicker_of_median
from tools.benchmarking.rival_errors import squared_errors, trimmed_rel_mse
from tools.benchmarking.rival_scenes import rival_scene

REPOSITORY = Path(__file__).parents[1]


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "tools/benchmark", *arguments], cwd=REPOSITORY, capture_output=True, text=True
    )


@pytest.mark.slow
def test_suites_of_the_final_gather_report(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba")
    folders = ("--output", str(tmp_path), "--references", str(tmp_path / "references"))
    done = run("render", "--quick", "--only", "rivals,edits,properties,scale,sequence,killed", *folders)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    report = json.loads((tmp_path / "report.json").read_text())
    results = {name: [one["result"] for one in suite] for name, suite in report["suites"].items()}

    assert results["rivals"][0]["reference"]["samples_per_half"] > 0
    curves = rival_summary.curves_of(report["suites"]["rivals"])["cornell_box"]
    assert {"ours", "mitsuba scalar"} <= curves.keys()
    absent = {name for one in results["rivals"] for name in one.get("absent", {})}
    rivals = {"mitsuba llvm", "mitsuba scalar", "LuxCore PhotonGI"}
    assert curves.keys() | absent >= rivals and not curves.keys() & absent
    cached = next(point for point in curves["ours"] if point["label"] == "cached")
    # Both renderers render the same light: a scene that one of them got wrong is off by far more.
    assert cached["mean_ratio"] == pytest.approx(1, abs=0.1)
    assert curves["mitsuba scalar"][-1]["rel_mse"] < curves["mitsuba scalar"][0]["rel_mse"] / 2
    for points in curves.values():
        assert all(point["seconds"] > 0 and np.isfinite(point["rel_mse"]) for point in points)
        assert any((tmp_path / "images" / "rivals" / point.get("image", "-")).exists() for point in points)

    times = results["edits"][0]["times"]
    assert times.keys() == {"none", "1", "3", "3 apart"}
    assert all(share["least"] >= 0.3 for n in ("1", "3") for share in times[n]["shares"].values())

    properties = {one["case"]["property"]: one["result"] for one in report["suites"]["properties"]}
    assert properties["bits"]["same_bits"]
    assert properties["offset"]["mean"] == pytest.approx(0.70, rel=1e-4)
    assert properties["edge"]["pixels"] > 10
    assert {point["what"] for point in results["scale"]} == {"triangles", "lights", "pixels", "stage"}
    assert all(one["touched_share"] > 0 for one in results["sequence"])
    killed = results["killed"][0]
    assert killed["same_pixels"] == killed["same_files"] == killed["frames"] == 2 and killed["half_written"] == 0
    assert [kill["status"] for kill in killed["kills"] if kill["while_writing"]] == [-9]
    assert not killed["left_behind"]
    for one in results["sequence"]:
        assert {one["sheet"], one["slice"]} <= {path.name for path in (tmp_path / "images" / "sequence").iterdir()}
    text = (tmp_path / "report.md").read_text()
    assert all(f"### {name}" in text for name in results)
    # The path tracer that ours has a goal against needs a library that a machine may lack.
    assert "failed" not in text and text.count("Goal, ") >= (6 if rival_summary.RAW in curves else 5)


def test_errors_do_not_hold_the_noise_of_the_reference() -> None:
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.linspace(0, 3, 160), np.linspace(0, 2, 120))
    truth = (1.2 + np.sin(2 * x) * np.cos(3 * y))[..., None] * np.array([1.0, 0.7, 0.4])
    halves = [truth * (1 + 0.2 * rng.normal(size=truth.shape)) for _ in range(2)]
    image = truth * (1 + 0.1 * rng.choice([-1, 1], truth.shape))
    noise_free = squared_errors(image, truth, truth).mean()
    assert squared_errors(image, *halves).mean() == pytest.approx(noise_free, rel=0.1)
    assert squared_errors(image, halves[0], halves[0]).mean() > 3 * noise_free
    # An exact image has no error, trimmed or not; a trim of the largest alone would make it better than exact.
    exact = squared_errors(truth, *halves).ravel()
    assert abs(exact.mean()) < 0.05 * noise_free
    assert abs(trimmed_rel_mse(exact)) < 0.05 * noise_free
    leaks = image.copy()
    leaks[:2, :5] *= 30
    squares = squared_errors(leaks, truth, truth).ravel()
    assert squares.mean() > 10 * noise_free
    assert trimmed_rel_mse(squares) == pytest.approx(noise_free, rel=0.05)


def test_curves_are_compared_at_equal_time() -> None:
    def point(label: str, seconds: float, error: float, noise: float = 0.0) -> dict[str, object]:
        errors = {"rel_mse": error, "rel_mse_trimmed": error / 2, "standard_error": noise}
        return {"label": label, "seconds": seconds, **errors}

    raw = [point(f"{n}", 0.1 * n, 1.0 / n) for n in (1, 4, 16, 64, 256, 1024)]
    denoised = [point(f"{n}", 0.1 * n, 0.1 / n) for n in (1, 4, 16, 64, 256, 1024)]
    ours = [point("low", 1.0, 0.005), point("worse", 2.0, 0.006), point("high", 16.0, 0.001)]
    found = rival_summary.comparison({"mitsuba llvm": raw, "mitsuba llvm + OIDN": denoised, "ours": ours})
    assert found["efficiency"]["rel_mse"]["low"] == pytest.approx(0.1 / 0.005)
    over = found["over_denoised"]["rel_mse"]
    assert over.keys() == {"1", "4", "16", "64"}
    assert over["64"] == pytest.approx(0.001 / (0.01 / 64))  # What was done after 16 s is still there.
    short = rival_summary.comparison({"mitsuba llvm + OIDN": denoised[:-1], "ours": ours})
    assert short["over_denoised"]["rel_mse"].keys() == {"1", "4", "16"}  # Nobody knows about the denoiser.
    assert over["1"] == pytest.approx(0.005 / 0.01)
    # Between 1 s and 16 s on a straight line in the logarithms, past the point that is worse than a quicker one.
    assert over["4"] == pytest.approx(np.sqrt(0.005 * 0.001) / 0.0025)
    # What the noise of the reference drowns is no error: ours counts as that noise, and the other's is not known.
    drowned = [*denoised[:4], point("drowned", 25.6, 1e-9, 0.001)]
    known = rival_summary.comparison(
        {"mitsuba llvm + OIDN": drowned, "ours": [*ours[:1], point("low", 2.0, 1e-9, 0.001)]}
    )
    assert known["over_denoised"]["rel_mse"].keys() == {"1", "4"}
    assert known["over_denoised"]["rel_mse"]["4"] == pytest.approx(0.001 / 0.0025)


def test_goals_say_what_was_met_and_what_was_missed() -> None:
    goals = [Goal("1 edit", 1.02, 1.05), Goal("8 edits", 1.4, 1.1)]
    assert at_most("time", goals) == "Goal, time at most 1.05 / 1.1; met: 1 edit 1.02; missed: 8 edits 1.4."
    assert at_least("speed", goals) == "Goal, speed at least 1.05 / 1.1; met: 8 edits 1.4; missed: 1 edit 1.02."
    assert at_most("time", []).endswith("not measured.")


@pytest.mark.parametrize("n_pixels", [320 * 240, 640 * 480, 1920 * 1080])
def test_halves_of_a_reference_and_what_is_measured_have_random_numbers_of_their_own(n_pixels: int) -> None:
    # as Mitsuba's scalar variant makes streams of seeds
    streams = {(first + n) * n_pixels % 2**32 for first in (0, *references._FIRST_SEED) for n in range(4096)}
    assert len(streams) == 3 * 4096


def test_halves_that_are_one_are_no_reference(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Alike:
        most_samples = 1

        def __init__(self, *_: object) -> None: ...

        def layers(self, samples: int, seed: int) -> Layers:
            return Layers(np.ones((2, 2, 3)), np.ones((2, 2, 3)), 0.0)

    monkeypatch.setattr(references, "MitsubaLayers", Alike)
    monkeypatch.setattr(references, "scene_key", lambda *_: "key")
    with pytest.raises(ValueError, match="the same random numbers"):
        references.reference("box", closed_box(), 2, tmp_path, minutes=0)
    assert not any(tmp_path.iterdir())

    # Files of before that was refused are no reference either.
    shot = closed_box()
    kept = tmp_path / f"box-{shot.camera.width}x{shot.camera.height}-key.npz"
    np.savez(kept, sums=np.ones((2, 2, 2, 2, 3)), samples=1, seconds=0.0, passes=1)
    with pytest.raises(ValueError, match=f"{kept.name}, which is to be deleted.*the same random numbers"):
        references.reference("box", shot, 2, tmp_path, minutes=0)


def test_noise_of_a_reference_with_and_without_its_fireflies() -> None:
    rng = np.random.default_rng(3)
    halves = [1 + 0.1 * rng.normal(size=(60, 80, 3)) for _ in range(2)]
    bright = halves[0].copy()
    bright[7, 9] += 50
    found = Reference((bright, halves[1]), (bright, halves[1]), 16, 1.0)
    assert found.noise(0.001) == pytest.approx(0.1**2 / 2, rel=0.05)
    assert found.noise() > 10 * found.noise(0.001)


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"])
def test_what_is_subtracted_has_the_same_random_numbers(variant: str) -> None:
    """Nearly black surfaces send nearly nothing but direct light, and so does what is left without it."""
    pytest.importorskip("mitsuba")
    scene = rival_scene(REPOSITORY / "sample_stages/cornell_box/scene.usda", 16, 12).snapshot
    black = np.full_like(scene.materials.diffuse, 1e-4)
    dark = replace(
        scene,
        materials=scene.materials._replace(diffuse=black, use_display_color=0 * scene.materials.use_display_color),
    )
    layers = MitsubaLayers(dark, 18, "fast" if variant.startswith("llvm") else variant)
    found = layers.layers(min(layers.most_samples, 64), 5)
    assert found.whole.mean() > 0
    assert np.abs(found.indirect).mean() < 0.01 * found.whole.mean()


def test_flicker_is_nothing_where_light_changes_evenly() -> None:
    frame = np.linspace(0, 1, 6)[:, None, None, None]
    even = np.exp(frame) * np.ones((6, 4, 4, 3))
    assert flicker(even) == pytest.approx(0, abs=1e-12)
    moving = even.copy()
    moving[::2, 0] *= 3
    assert flicker(moving) > 0.1 and flicker_of_median(moving) == pytest.approx(0, abs=1e-12)
    jumping = even * np.where(np.arange(6) % 2, 1.1, 1.0)[:, None, None, None]
    assert flicker(jumping) == pytest.approx(2 * np.log(1.1), rel=1e-6)


def test_help_needs_no_package_and_a_missing_one_is_named(tmp_path: Path) -> None:
    (tmp_path / "numpy.py").write_text("raise ModuleNotFoundError(\"No module named 'numpy'\", name='numpy')\n")
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    command = [sys.executable, str(REPOSITORY / "tools" / "benchmark"), "render"]
    done = subprocess.run([*command, "--help"], env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and "--references" in done.stdout
    done = subprocess.run(
        [*command, "--quick", "--output", str(tmp_path)], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and "numpy is not installed" in done.stderr and "make lint" in done.stderr
