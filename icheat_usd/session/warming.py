"""Every kernel compiled before it is needed, by doing a little of everything on a small stage."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import IO

from icheat_usd.errors import IcheatError
from icheat_usd.resources import resource_path
from icheat_usd.session.document import Session
from icheat_usd.session.live import LiveSession
from icheat_usd.session.quality import DRAFT, LIVE

_WIDTH, _HEIGHT = 24, 18
_DRAFT = replace(DRAFT, n_gather=256, rays_per_row=16, rays_per_bounce_row=16, light_samples=1)
_LIVE = replace(LIVE, n_gather=256, record_rays=64, rays_per_bounce_row=16, light_samples=1)
#: A lamp and opaque walls; a sky, glass, metal and painted edits.
_STAGES = ("cornell_box", "glossy_set")


def _live() -> None:
    for name in _STAGES:
        with LiveSession.open(_stage(name), width=_WIDTH, height=_HEIGHT, quality=_LIVE) as live:
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


def _relight() -> None:
    for name in _STAGES:
        _open(name).relight()


def _render() -> None:
    from icheat_usd.final_gather import GatherSettings

    for name in _STAGES:
        _open(name).render(GatherSettings(samples_per_pixel=1, gather_rays=8, light_samples=1))


def _open(name: str) -> Session:
    return Session.open(_stage(name), width=_WIDTH, height=_HEIGHT, quality=_DRAFT)


def _stage(name: str) -> Path:
    return resource_path(f"sample_stages/{name}/shot.usda")


#: What is used, the longest first; each in a process of its own, as Numba compiles on one core.
TASKS: dict[str, Callable[[], None]] = {"live": _live, "render": _render, "relight": _relight}


def warm(jobs: int | None = None, say: Callable[[str, float], None] = lambda name, seconds: None) -> None:
    """Compile all kernels into the user's cache; seconds if they are there already, minutes if not.

    Parameters
    ----------
    jobs
        Processes at once; as many as there are cores by default.
    say
        Told of each task that is done, and how many seconds it took.

    Raises
    ------
    IcheatError
        A task failed.
    """
    limit = jobs or os.cpu_count() or 1
    waiting = list(TASKS)
    running: dict[str, tuple[subprocess.Popen[bytes], float, IO[bytes]]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < limit:
                name = waiting.pop(0)
                # A file, as a pipe that nobody reads from holds up a process that says much.
                log: IO[bytes] = tempfile.TemporaryFile()
                running[name] = _start(name, log), time.monotonic(), log
            time.sleep(0.1)
            for name, (process, began, errors) in list(running.items()):
                if process.poll() is None:
                    continue
                del running[name]
                last = _last_line(errors)
                if process.returncode:
                    raise IcheatError(f"compiling the kernels of '{name}' failed: {last}")
                say(name, time.monotonic() - began)
    finally:
        for process, _, errors in running.values():
            process.terminate()
            process.wait()
            errors.close()


def _last_line(errors: IO[bytes]) -> str:
    """What a process said last; closes the file."""
    with errors:
        errors.seek(0)
        lines = errors.read().decode(errors="replace").strip().splitlines()
    return (lines or ["no message"])[-1]


def _start(name: str, errors: IO[bytes]) -> subprocess.Popen[bytes]:
    # What is computed here is of no use to anybody.
    environment = os.environ | {"ICHEAT_CACHE_SIZE": "0"}
    code = f"from icheat_usd.session.warming import TASKS; TASKS[{name!r}]()"
    command = [sys.executable, "-c", code]
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, stderr=errors, stdin=subprocess.DEVNULL
    )
