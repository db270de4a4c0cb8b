"""The one place that decides how kernels are compiled and cached.

Numba's on-disk cache only looks at the file a kernel stands in: after a change
to a helper in another file it keeps serving the old machine code. Each kernel
is therefore cached in a folder named by the contents of its own module and of
every kernel module that it imports, so a stale kernel cannot be found.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

# Idle workers sleep instead of spinning: with other programs on the cores, spinning made kernels up to ten times
# slower; on idle cores it cost a final gather 8 % and the transport nothing. Read when OpenMP loads, before numba.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numba  # noqa: E402

_KERNELS = Path(__file__).parent
_PACKAGE = "icheat_usd.kernels"

Function = TypeVar("Function", bound=Callable[..., Any])


def cache_directory() -> Path:
    """Folder for compiled kernels: ``$ICHEAT_CACHE_DIR``, else the user's cache folder."""
    if configured := os.environ.get("ICHEAT_CACHE_DIR"):
        return Path(configured) / "kernels"
    if sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    elif sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home()))
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "icheat_usd" / "kernels"


def _imported_kernel_modules(source: str) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module:
            if node.module == _PACKAGE:
                names.update(alias.name for alias in node.names)
            elif node.module.startswith(_PACKAGE + "."):
                names.add(node.module.removeprefix(_PACKAGE + "."))
    return names


@functools.cache
def _closure_digest(module: str) -> str:
    digest = hashlib.sha256(numba.__version__.encode())
    pending, seen = [module], set()
    while pending:
        name = pending.pop()
        path = _KERNELS / f"{name}.py"
        if name in seen or not path.exists():
            continue
        seen.add(name)
        pending.extend(sorted(_imported_kernel_modules(path.read_text())))
    for name in sorted(seen):
        digest.update(name.encode() + (_KERNELS / f"{name}.py").read_bytes())
    return digest.hexdigest()[:16]


def _compile(function: Function, **options: Any) -> Function:
    module = function.__module__.rpartition(".")[2]
    previous = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(cache_directory() / _closure_digest(module))
    try:
        return cast(Function, numba.njit(cache=True, nogil=True, **options)(function))
    finally:
        numba.config.CACHE_DIR = previous


def kernel(function: Function) -> Function:
    """Compile a serial kernel or a helper of kernels; strict IEEE arithmetic."""
    return _compile(function)


def parallel_kernel(function: Function) -> Function:
    """Compile a kernel whose ``prange`` iterations each own their output.

    No sums across iterations: the same bits for any number of threads.
    """
    return _compile(function, parallel=True)
