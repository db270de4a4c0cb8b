"""Finds which kernels are called, with which types, by doing a little of everything on small stages."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from icheat_usd.final_gather import GatherSettings
from icheat_usd.kernels._signatures import UnlistedTypeError, dispatchers, encode, kernels_called
from icheat_usd.relight import products
from icheat_usd.resources import resource_path
from icheat_usd.session import first_use
from icheat_usd.session.document import Session
from icheat_usd.session.live import LiveSession
from icheat_usd.session.live_events import LiveEvent
from icheat_usd.session.quality import DRAFT, LIVE, PREVIEW, QUICK, RECORDS, Quality
from icheat_usd.session.warming import RARE, Listed
from tools.kernel_stage import write_stage

_ROOT = Path(__file__).parents[1]
_WIDTH, _HEIGHT = 64, 48
_LITTLE: dict[str, Any] = {"n_gather": 1024, "rays_per_row": 16, "rays_per_bounce_row": 16, "light_samples": 2}
_LIVE = replace(LIVE, **_LITTLE, record_rays=128)
#: What `icheat relight` does, with `--draft` and with `--exact`.
_RELIGHT = (replace(RECORDS, **_LITTLE, record_rays=128), replace(DRAFT, **_LITTLE), replace(PREVIEW, **_LITTLE))
#: Not those that call kernels by themselves, with types that nothing else has.
_WHOLE_PICTURES = ("tests/final_gather", "tests/relight", "tests/session", "tests/cli", "tests/test_known_answers.py")
#: A lamp and diffuse walls; metal and painted edits.
_STAGES = ("cornell_box", "glossy_set")


def _look() -> None:
    _live_until("surfaces")


def _preview() -> None:
    _live_until("better")


def _live_until(kind: str) -> None:
    """Open live sessions, and close each from within its background when listeners hear that."""
    for stage in _live_stages():
        heard = threading.Event()
        with LiveSession.open(stage, width=_WIDTH, height=_HEIGHT, quality=_LIVE) as live:

            def listen(event: LiveEvent, live: LiveSession = live, heard: threading.Event = heard) -> None:
                if event.kind in (kind, "error"):
                    live.close()
                    heard.set()

            live.listen(listen)
            heard.wait()


def _live() -> None:
    _change_a_little()
    # As on stages that are not little.
    products.SMALL_BYTES = 0
    _change_a_little()


def _change_a_little() -> None:
    for stage in _live_stages():
        with LiveSession.open(stage, width=_WIDTH, height=_HEIGHT, quality=_LIVE) as live:
            live.frame()
            light = next(iter(live.lights))
            live.set_light(light, gain=0.5, move=(0.01, 0.0, 0.0))
            for edit in live.stack.edits:
                live.set_amount(edit.path, 0.5)
            live.frame()
            live.film()
            # What lights at rest have under other gains, where nothing keeps it from being a sum over them.
            for edit in live.stack.edits:
                live.mute(edit.path)
            live.film()
            live.set_light(light, gain=0.4)
            live.frame()
            # What is known of lights at rest when they move on; of suns it is looked at in other ways.
            live.set_light(light, move=(0.02, 0.0, 0.0))
            for sun in (path for path in live.lights if path.endswith("/Sun")):
                live.set_light(sun, turn=((0.0, 1.0, 0.0), 1.0))
            live.frame()


def _live_stages() -> Iterator[Path]:
    yield from map(_stage, _STAGES)
    with tempfile.TemporaryDirectory() as folder:
        yield write_stage(Path(folder))


def _relight() -> None:
    for name in _STAGES:
        for quality in _RELIGHT:
            _open(name, quality).relight()


def _render() -> None:
    for name in _STAGES:
        session = _open(name, replace(PREVIEW, **_LITTLE))
        session.render(GatherSettings(samples_per_pixel=1, light_samples=1))
        session.render(replace(QUICK, denoise=False))


def _open(name: str, quality: Quality) -> Session:
    return Session.open(_stage(name), width=_WIDTH, height=_HEIGHT, quality=quality)


def _stage(name: str) -> Path:
    return resource_path(f"sample_stages/{name}/shot.usda")


#: What is done for each purpose of `icheat_usd.session.warming`.
TASKS: dict[str, Callable[[], None]] = {
    "look": _look,
    "preview": _preview,
    "live": _live,
    "relight": _relight,
    "render": _render,
}


def record(purpose: str) -> None:
    """Do what a purpose does, and print the kernels that this process has compiled or loaded, as JSON."""
    # Each is compiled in this process when it is called: only so does it tell what it calls.
    first_use.may_help = lambda: False
    TASKS[purpose]()
    print(json.dumps(_entries(purpose, lambda dispatcher: dispatcher.overloads)))


def record_cache() -> None:
    """Print the kernels that the cache has, as JSON, whichever process put them there."""
    # Keys of Numba's index begin with the types of the arguments.
    print(json.dumps(_entries(RARE, lambda kernel: [key[0] for key in kernel._cache._cache_file._load_index()])))


def _entries(purpose: str, types_of: Callable[[Any], Iterable[Any]]) -> list[Listed]:
    found = []
    for name, dispatcher in dispatchers():
        for types in types_of(dispatcher):
            try:
                words = [encode(kind) for kind in types]
            except UnlistedTypeError as error:  # it is compiled with its caller
                print(f"{name} is left out: the list has no word for the type {error}", file=sys.stderr)
                continue
            size = len(dispatcher.py_func.__code__.co_code)
            found.append(Listed(name, words, [purpose], kernels_called(dispatcher), size))
    return found


def recorded(purpose: str, cache: str | None = None, keeps: bool = False) -> list[Listed]:
    """What `record` prints in a process of its own.

    Parameters
    ----------
    cache : str, optional
        Folder for what is compiled; by default the user's. A kernel that is found there does not tell which others it
        calls with which types.
    keeps
        Whether what is computed is kept there, too: what is found on disk may be of other types than what is made.
    """
    environment = {} if cache is None else {"ICHEAT_CACHE_DIR": cache}
    return _printed(f"record({purpose!r})", environment | {"ICHEAT_CACHE_SIZE": "1G" if keeps else "0"})


def recorded_in_tests(cache: str) -> list[Listed]:
    """All that a folder for what is compiled has after the tests of whole pictures, which have what few stages have."""
    environment = {"ICHEAT_CACHE_DIR": cache}
    command = [sys.executable, "-m", "pytest", "-q", "-n", "auto", "--dist", "loadfile", *_WHOLE_PICTURES]
    # Whether the list is up to date, which it is about to be.
    command.append("--ignore=tests/session/test_warming.py")
    subprocess.run(command, cwd=_ROOT, env=os.environ | environment, check=True)
    return _printed("record_cache()", environment)


def _printed(call: str, environment: dict[str, str]) -> list[Listed]:
    command = [sys.executable, "-c", f"from tools import kernel_list; kernel_list.{call}"]
    environment = os.environ | environment
    done = subprocess.run(command, cwd=_ROOT, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    return [Listed(*entry) for entry in json.loads(done.stdout.splitlines()[-1])]


def rare(entries: Iterable[Listed], others: Iterable[Listed]) -> list[Listed]:
    """Entries for what few stages have, as far as they are still of kernels as these are, and of no other purpose."""
    known, kernels = {(entry.kernel, json.dumps(entry.types)) for entry in others}, dict(dispatchers())
    found = []
    for entry in entries:
        kernel = kernels.get(entry.kernel)
        if RARE not in entry.purposes or (entry.kernel, json.dumps(entry.types)) in known or kernel is None:
            continue
        code = kernel.py_func.__code__
        if len(entry.types) == code.co_argcount:
            found.append(entry._replace(calls=kernels_called(kernel), size=len(code.co_code)))
    return found


def merged(entries: list[Listed]) -> list[Listed]:
    """Every kernel and choice of types once, for all purposes that have it, by name."""
    found: dict[tuple[str, str], Listed] = {}
    for entry in entries:
        key = entry.kernel, json.dumps(entry.types)
        purposes = {*entry.purposes, *(found[key].purposes if key in found else ())}
        found[key] = entry._replace(purposes=sorted(purposes))
    return [found[key] for key in sorted(found)]


def text_of(entries: list[Listed]) -> str:
    """A line for each, so that a change shows what it changes."""
    lines: list[Any] = [json.dumps(entry, separators=(",", ":")) for entry in entries]
    return "[\n" + ",\n".join(lines) + "\n]\n"
