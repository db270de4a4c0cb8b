"""Fixtures that several test folders share."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

# What tests compute must not be found by the next run, and must not fill a user's disk.
os.environ["ICHEAT_CACHE_SIZE"] = "0"


@pytest.fixture(autouse=True)
def sample_stages_stay_as_they_are() -> Iterator[None]:
    """No test leaves a changed layer of a sample stage behind: USD would serve it to all later ones of the process."""
    yield
    if sdf := sys.modules.get("pxr.Sdf"):
        samples = Path(__file__).parents[1] / "sample_stages"
        layers = [layer for layer in sdf.Layer.GetLoadedLayers() if layer.dirty and layer.realPath]
        assert [layer.realPath for layer in layers if samples in Path(layer.realPath).parents] == []


@pytest.fixture(scope="session")
def shared_scenes() -> Path:
    """Folder of scenes that this project did not write; tests that need it skip where it is absent."""
    folder = Path(os.environ.get("ICHEAT_SHARED_SCENES") or Path(__file__).parents[2] / "shared" / "scenes")
    if not folder.is_dir():
        pytest.skip(f"no folder of outside scenes at {folder}; set ICHEAT_SHARED_SCENES")
    return folder


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with slow tests come first: begun last, one of them would keep a core busy while the others have no more.

    By itself, the scheduler of several processes begins with the files of the most tests, which are quick ones.
    """
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)
