"""What is installed from the wheel works in another folder, without the source tree."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

pytest.importorskip("build")
pytest.importorskip("hatchling")

REPOSITORY = Path(__file__).parents[1]

pytestmark = pytest.mark.slow


def run(arguments: list[str], folder: Path, **environment: str) -> str:
    result = subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=os.environ | environment, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the sdist, and the wheel that was built from it."""
    folder = tmp_path_factory.mktemp("dist")
    run(["-m", "build", "--no-isolation", "--outdir", str(folder), str(REPOSITORY)], folder)
    return folder


def test_wheel_and_sdist_carry_schemas_and_sample_stages(packages: Path) -> None:
    tracked = subprocess.run(
        ["git", "ls-files", "schemas", "sample_stages"], cwd=REPOSITORY, capture_output=True, text=True
    ).stdout.split()
    if not tracked:
        pytest.skip("not a git checkout")
    (wheel,) = packages.glob("*.whl")
    (sdist,) = packages.glob("*.tar.gz")
    in_wheel = set(zipfile.ZipFile(wheel).namelist())
    with tarfile.open(sdist) as archive:
        in_sdist = {name.partition("/")[2] for name in archive.getnames()}
    assert {f"icheat_usd/{path}" for path in tracked} <= in_wheel
    assert set(tracked) <= in_sdist


def test_an_installed_wheel_finds_its_own_data(packages: Path, tmp_path: Path) -> None:
    (wheel,) = packages.glob("*.whl")
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    icheat = ["-m", "icheat_usd"]
    path = run([*icheat, "plugin-path"], elsewhere, PYTHONPATH=str(site)).strip()
    schemas = site / "icheat_usd" / "schemas"
    assert path.split(os.pathsep) == [str(schemas / "usd"), str(schemas / "validation")]
    stage = site / "icheat_usd" / "sample_stages" / "cornell_box" / "shot.usda"
    assert run([*icheat, "check", str(stage)], elsewhere, PYTHONPATH=str(site), PXR_PLUGINPATH_NAME="") == ""
