"""The one place that decides how kernels are compiled and cached.

Numba's on-disk cache only looks at the file a kernel stands in: after a change
to a helper in another file it keeps serving the old machine code. Each kernel
is therefore cached in a folder named by the contents of its own module and of
every kernel module that it imports, constants included, and by all that turns
source into machine code (Python, NumPy, Numba, LLVM, the processor, Numba's
options), so a stale kernel cannot be found. Where the package lies is not in
the name: Numba would compile everything again for each checkout and each
virtual environment.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import os
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

# Idle workers sleep instead of spinning: with other programs on the cores, spinning made kernels up to ten times
# slower; on idle cores it cost a final gather 8 % and the transport nothing. Read when OpenMP loads, before numba.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
# They do spin for some tens of microseconds before, so that the short kernels of one live frame find them awake:
# starting one then takes 3 microseconds instead of 17 to 80. Five times as long made a frame 1.8 times slower where
# another program holds a core, this a tenth.
os.environ.setdefault("GOMP_SPINCOUNT", "2000")

import llvmlite  # noqa: E402
import llvmlite.binding  # noqa: E402
import numba  # noqa: E402
import numpy as np  # noqa: E402
from numba.core import caching  # noqa: E402

from icheat_usd.cache_folder import cache_folder  # noqa: E402

_KERNELS = Path(__file__).parent
_PACKAGE = "icheat_usd.kernels"

#: Options of Numba that change what it compiles; all others are about messages and places.
_OPTIONS = ("CPU_NAME", "CPU_FEATURES", "OPT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "ENABLE_AVX", "BOUNDSCHECK")

Function = TypeVar("Function", bound=Callable[..., Any])


def cache_directory() -> Path:
    """Folder for compiled kernels: ``$ICHEAT_CACHE_DIR``, else the user's cache folder."""
    return cache_folder("kernels")


def _imported_kernel_modules(source: str, package: str = _PACKAGE) -> set[str]:
    """Names of the kernel modules that a kernel module may import, however it says so."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom):
            # Kernel modules lie in one folder: a relative import from there can only start with one dot.
            module = ".".join(part for part in (package if node.level else "", node.module or "") if part)
            if module == package:
                names.update(alias.name for alias in node.names)
            elif module.startswith(package + "."):
                names.add(module.removeprefix(package + "."))
        elif isinstance(node, ast.Import):
            paths = (alias.name for alias in node.names)
            names.update(path.removeprefix(package + ".") for path in paths if path.startswith(package + "."))
    return names


@functools.cache
def compiler_facts() -> str:
    """Everything but the source that machine code depends on, as text."""
    options = [f"{name}={getattr(numba.config, name, None)}" for name in _OPTIONS]
    features = llvmlite.binding.get_host_cpu_features().flatten()
    facts = (
        platform.python_implementation(),
        platform.python_version(),
        platform.machine(),
        np.__version__,
        numba.__version__,
        llvmlite.__version__,
        llvmlite.binding.get_process_triple(),
        llvmlite.binding.get_host_cpu_name(),
        features,
        *options,
    )
    return "\n".join(facts)


def closure_digest(module: Path, folder: Path = _KERNELS, facts: str | None = None) -> str:
    """Digest of a module with kernels, of all kernel modules behind it, and of `compiler_facts`."""
    digest = hashlib.sha256((compiler_facts() if facts is None else facts).encode())
    pending, sources = [module], dict[Path, bytes]()
    while pending:
        path = pending.pop()
        if path in sources or not path.exists():
            continue
        sources[path] = path.read_bytes()
        pending.extend(folder / f"{name}.py" for name in _imported_kernel_modules(sources[path].decode()))
    for name, source in sorted((path.stem, source) for path, source in sources.items()):
        digest.update(f"{name} {len(source)}\n".encode() + source)
    return digest.hexdigest()[:16]


_digest_of_module = functools.cache(closure_digest)


class _FolderOfContents(caching._CacheLocator):  # type: ignore[misc]
    """Where Numba keeps what it compiles of one kernel."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._digest = _digest_of_module(Path(file))
        self._line = function.__code__.co_firstlineno
        self._py_file = file  # Numba names it in warnings.

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> _FolderOfContents | None:
        found = cls(py_func, py_file)
        try:
            found.ensure_cache_path()
        except OSError:  # Not to be written to: Numba goes on to its own folders.
            return None
        return found

    def get_cache_path(self) -> str:
        return str(cache_directory() / self._digest)

    def get_source_stamp(self) -> str:
        return self._digest

    def get_disambiguator(self) -> str:
        return str(self._line)


class _Compiled(caching.CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes = [_FolderOfContents, *caching.CompileResultCacheImpl._locator_classes]


class _Files(caching.IndexDataCacheFile):  # type: ignore[misc]
    """What is kept of one kernel: an index by types, and a file for each.

    Numba counts the files, and two processes that keep something at the same moment can give both the same name: one
    of the types is then served what was compiled for the other, for ever. Here the types make the name. The file is
    there before the index says so; what of the index gets lost is compiled again.
    """

    def save(self, key: Any, data: Any) -> None:
        digest = hashlib.sha256(caching.dumps(key)).digest()
        name = self._data_name(int.from_bytes(digest[:8], "big"))
        self._save_data(name, data)
        names = self._load_index()
        if names.get(key) != name:
            self._save_index({**names, key: name})


class _Cache(caching.FunctionCache):  # type: ignore[misc]
    _impl_class = _Compiled

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = _Files(self._cache_path, self._impl.filename_base, self._impl.locator.get_source_stamp())


def _compile(function: Function, **options: Any) -> Function:
    dispatcher = numba.njit(nogil=True, **options)(function)
    # What `cache=True` does, with a folder of our choice: Numba's own are named by where the source lies.
    dispatcher._cache = _Cache(function)
    return cast(Function, dispatcher)


def kernel(function: Function) -> Function:
    """Compile a serial kernel or a helper of kernels; strict IEEE arithmetic."""
    return _compile(function)


def parallel_kernel(function: Function) -> Function:
    """Compile a kernel whose ``prange`` iterations each own their output.

    No sums across iterations: the same bits for any number of threads.

    Numba takes the index for signed at first, and for unsigned when it compiles
    the loop. Kernels get it as ``np.int64(index)``: otherwise they, and all that
    they call, are compiled twice.
    """
    return _compile(function, parallel=True)


def kernels_may_overlap() -> bool:
    """Whether several threads may run parallel kernels at once: with Numba's own pool of workers they may not."""
    try:
        return str(numba.threading_layer()) in ("omp", "tbb")
    except ValueError:  # No parallel kernel has run yet.
        return False
