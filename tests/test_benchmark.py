"""The benchmark runs: every suite, at tiny sizes, with a report that holds what README quotes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "tools/benchmark", *arguments], cwd=REPOSITORY, capture_output=True, text=True
    )


@pytest.mark.slow
def test_every_suite_reports(tmp_path: Path) -> None:
    done = run("relight", "--quick", "--only", "frames,peers,errors,growth,build,bits", "--output", str(tmp_path))
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["quick"] is True
    assert report["machine"]["cores"] >= 1
    assert {"numpy", "numba", "scipy"} <= report["machine"]["versions"].keys()
    results = {name: [one["result"] for one in suite] for name, suite in report["suites"].items()}
    assert all(one["peak_mib"] > 0 for suite in report["suites"].values() for one in suite)

    changes = results["frames"][0]["changes"]
    assert changes.keys() >= {"light colour", "amount", "light move", "dome rotation", "dab", "play"}
    for change in changes.values():
        for threads in ("1", "2"):
            times = change["threads"][threads]
            assert 0 < times["min"] <= times["quartile_1"] <= times["median"] <= times["quartile_3"] <= times["max"]
            assert len(times["samples"]) == times["n"]
        assert change["same_bits"]
    assert results["frames"][0]["edits"]["64 edits"]["all"] == 64

    lights = results["errors"][0]["lights"]
    assert lights.keys() >= {"spot", "grazing"}
    for light in lights.values():
        assert {"total", "at_rest", "dragged", "packing", "lossy_dragged", "lossy_at_rest", "what"} <= light.keys()
    assert all(edit["of_unedited"] > 0 for edit in results["errors"][0]["edits"].values())
    assert [(point["by"], point["setting"]) for point in results["errors"][0]["curve"]] == [
        ("tolerance of packing", 0.1), ("tolerance of packing", 0.02), ("share of samples with rows", 0.3)
    ]  # fmt: skip
    assert all(point["whole_seconds"] > 0 for point in results["errors"][0]["curve"])
    for image in results["errors"][0]["images"]:
        assert list((tmp_path / "images").rglob(image)), image

    assert results["peers"][0]["summary"][0]["times_best_peer"] > 0
    points = [point for one in results["growth"] for point in one["points"]]
    assert [(point["what"], point["size"]) for point in points if point["what"] in ("edits", "lights")] == [
        ("edits", 0), ("edits", 4), ("lights", 1), ("lights", 3)
    ]  # fmt: skip
    assert sum(point["what"] == "triangles" for point in points) == 2
    assert 0 < results["build"][0]["runs"]["kernels cached"]["preview"]["seconds"]
    assert results["bits"][0]["same_bits"]
    assert max(results["bits"][0]["differences"].values()) < 1e-4
    text = (tmp_path / "report.md").read_text()
    assert all(f"### {name}" in text for name in results)
    assert "failed" not in text


def test_what_cannot_be_measured_is_refused() -> None:
    done = run("relight", "--only", "nothing")
    assert done.returncode == 2
    assert "no suite nothing" in done.stderr
