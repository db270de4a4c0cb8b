"""The kernel cache never serves code that another source, library or processor would not have made."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from icheat_usd.kernels import _jit

PACKAGE = Path(_jit.__file__).parent

CALLER = """
from icheat_usd.kernels import helper
from icheat_usd.kernels._jit import kernel

@kernel
def answer():
    return helper.twice(helper.NUMBER)
"""
HELPER = """
from icheat_usd.kernels._jit import kernel

NUMBER = {number}

@kernel
def twice(x):
    return {factor} * x
"""


def make_package(root: Path) -> None:
    kernels = root / "icheat_usd" / "kernels"
    kernels.mkdir(parents=True)
    for package in (kernels.parent, kernels):
        (package / "__init__.py").touch()
    shutil.copy(PACKAGE / "_jit.py", kernels)
    shutil.copy(PACKAGE.parent / "cache_folder.py", kernels.parent)
    (kernels / "caller.py").write_text(CALLER)


def answer_of(root: Path, number: int, factor: int) -> tuple[int, int]:
    """What the kernel says in a process of its own, and how many compiled kernels it found in the cache."""
    (root / "icheat_usd" / "kernels" / "helper.py").write_text(HELPER.format(number=number, factor=factor))
    code = "from icheat_usd.kernels.caller import answer; print(answer(), sum(answer.stats.cache_hits.values()))"
    result = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": str(root), "ICHEAT_CACHE_DIR": str(root.parent / "cache")},
        cwd=root,
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    value, hits = result.stdout.split()
    return int(value), int(hits)


def test_a_changed_constant_or_helper_in_another_file_is_seen_and_the_same_source_is_not_compiled_again(
    tmp_path: Path,
) -> None:
    make_package(tmp_path / "a")
    assert answer_of(tmp_path / "a", 10, 2) == (20, 0)
    assert answer_of(tmp_path / "a", 10, 2) == (20, 1)
    assert answer_of(tmp_path / "a", 11, 2) == (22, 0)
    assert answer_of(tmp_path / "a", 11, 3) == (33, 0)
    assert answer_of(tmp_path / "a", 10, 2) == (20, 1)


def test_another_installation_of_the_same_sources_finds_what_was_compiled(tmp_path: Path) -> None:
    for name in ("a", "b"):
        make_package(tmp_path / name)
    assert answer_of(tmp_path / "a", 10, 2) == (20, 0)
    assert answer_of(tmp_path / "b", 10, 2) == (20, 1)


@pytest.mark.parametrize(
    "line",
    [
        "from icheat_usd.kernels import helper",
        "from icheat_usd.kernels import helper as other",
        "from icheat_usd.kernels.helper import twice",
        "import icheat_usd.kernels.helper",
        "import icheat_usd.kernels.helper as other",
        "from . import helper",
        "from .helper import twice",
        "def f():\n    from icheat_usd.kernels.helper import twice",
    ],
)
def test_every_way_to_import_a_helper_counts(tmp_path: Path, line: str) -> None:
    (tmp_path / "caller.py").write_text(line)
    (tmp_path / "helper.py").write_text("from icheat_usd.kernels import deeper")
    (tmp_path / "deeper.py").write_text("x = 1")
    before = _jit.closure_digest(tmp_path / "caller.py", tmp_path)
    (tmp_path / "deeper.py").write_text("x = 2")
    assert _jit.closure_digest(tmp_path / "caller.py", tmp_path) != before


def test_libraries_options_and_the_processor_are_in_the_digest() -> None:
    facts = _jit.compiler_facts()
    llvmlite = pytest.importorskip("llvmlite")
    numpy = pytest.importorskip("numpy")
    for part in (numpy.__version__, llvmlite.__version__, "CPU_NAME", "OPT=", sys.version.split()[0].rstrip("+")):
        assert part in facts
    rows = Path(_jit.__file__).with_name("rows.py")
    assert _jit.closure_digest(rows, facts=facts) == _jit.closure_digest(rows)
    assert _jit.closure_digest(rows, facts=facts + "+avx9") != _jit.closure_digest(rows)


def test_a_module_elsewhere_counts_with_the_kernel_modules_that_it_imports(tmp_path: Path) -> None:
    folder = tmp_path / "kernels"
    folder.mkdir()
    (tmp_path / "other.py").write_text("from icheat_usd.kernels.helper import twice")
    (folder / "helper.py").write_text("x = 1")
    digests = [_jit.closure_digest(tmp_path / "other.py", folder)]
    for file in (folder / "helper.py", tmp_path / "other.py"):
        file.write_text(file.read_text() + "\ny = 1")
        digests.append(_jit.closure_digest(tmp_path / "other.py", folder))
    assert len(set(digests)) == 3


@pytest.mark.parametrize("step", ["_save_index", "_save_data", "_load_index"])
def test_what_two_processes_keep_at_the_same_moment_is_not_mixed_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    """One comes between two steps of the other; each has looked at the index before the other wrote to it."""
    first, second = (_jit._Files(str(tmp_path), "kernel-1.py311", "digest") for _ in range(2))
    as_it_is = getattr(first, step)

    def interrupted(*arguments: object) -> object:
        done = as_it_is(*arguments)
        with monkeypatch.context() as patch:
            patch.setattr(second, "_load_index", dict)
            second.save(("float64",), "compiled for float64")
        return done

    with monkeypatch.context() as patch:
        patch.setattr(first, step, interrupted)
        first.save(("int64",), "compiled for int64")
    for kind in ("int64", "float64"):
        assert first.load((kind,)) in (None, f"compiled for {kind}")
        first.save((kind,), f"compiled for {kind}")
    for kind in ("int64", "float64"):
        assert second.load((kind,)) == f"compiled for {kind}"
