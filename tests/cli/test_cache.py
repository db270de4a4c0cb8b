"""`icheat cache`, and a preview that finds what another one kept."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from icheat_usd.cli import main
from icheat_usd.kernels._jit import cache_directory
from icheat_usd.resources import resource_path
from icheat_usd.session import Quality, Session, shot_parts
from icheat_usd.session.disk_cache import DiskCache

QUALITY = Quality(n_gather=128, rays_per_row=16, rays_per_bounce_row=16, light_samples=1, n_bounces=2)


def preview(cache: DiskCache, quality: Quality = QUALITY) -> tuple[np.ndarray, list[str]]:
    steps: list[str] = []
    stage = resource_path("sample_stages/cornell_box/shot.usda")
    session = Session.open(
        stage, width=16, height=16, quality=quality, disk=cache, progress=lambda step, _: steps.append(step)
    )
    return session.relight().layer("beauty"), steps


def test_a_preview_finds_what_another_one_kept_and_damage_costs_time_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(shot_parts, "WORTH_KEEPING_SECONDS", 0.0)
    # Compiled kernels stay where they are: it is not they that are looked for here.
    cache_directory().mkdir(parents=True, exist_ok=True)
    (tmp_path / "kernels").symlink_to(cache_directory())
    monkeypatch.setenv("ICHEAT_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("ICHEAT_CACHE_SIZE", "1G")
    cache = DiskCache()
    first, steps = preview(cache)
    assert "gather rays" in steps
    second, steps = preview(cache)
    np.testing.assert_array_equal(second, first)
    assert not {"gather rays", "bounce rays", "place view samples", "light the view samples"} & set(steps)

    for file in cache.folder.rglob("whole-*.npz"):
        file.write_bytes(file.read_bytes()[:-100])
    third, steps = preview(cache)
    np.testing.assert_array_equal(third, first)
    assert "gather rays" in steps

    capsys.readouterr()
    assert main(["cache", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert {item["kind"] for item in listed["items"]} == {
        "view", "gather", "transport", "bounces", "cell_light", "view_light"
    }  # fmt: skip
    assert listed["bytes"] == sum(file.stat().st_size for file in cache.folder.rglob("*.*"))
    assert all(item["stage"].endswith("shot.usda") and item["width"] == 16 for item in listed["items"])
    assert main(["cache", "--trim", "0"]) == 0
    assert "freed" in capsys.readouterr().out and cache.list() == ()
    assert main(["cache"]) == 0
    assert capsys.readouterr().out == f"0 B of at most 1 GB in {cache.folder}\n"


def test_a_size_that_is_none_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["cache", "--trim", "much"]) == 2
    assert capsys.readouterr().err.startswith("icheat: error: --trim is 'much', which is no size")
