"""Suite `frames`: frames per second of each kind of change; no frame is one that was shown before.

At rest a frame keeps to what matters to these lights and edits: another gain is a sum of the lights' images, a dragged
amount lies between two. So that the table is honest about that, light colour and amount are measured before anything
is at rest, too: the product with all that is packed.
"""

from __future__ import annotations

import hashlib
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from icheat_usd.edits.model import EditStack
from icheat_usd.relight.lights import LiveLights
from icheat_usd.relight.live import LiveRelighter
from icheat_usd.scene import LightKind
from tools.benchmarking.made_up_edits import many_edits, one_edit, ranked_paths
from tools.benchmarking.meter import Threads, repeat, summary
from tools.benchmarking.pace import Pace, said
from tools.benchmarking.parts import AREA_KINDS, Effort, Parts, with_movable_lights
from tools.benchmarking.play import frames_of, measure_play
from tools.benchmarking.strokes import Stroke

#: Frames per second that are hoped for on two cores, by size and change.
GOALS = {
    (640, 480): {
        "light colour": 500,
        "amount": 500,
        "light move": 60,
        "dome rotation": 30,
        "dab": 60,
        "64 edits: amount": 100,
        "64 edits: light move": 20,
    },
    (1920, 1080): {"light colour": 100, "amount": 100},
}
DOME = "dome rotation"
MIXED = "64 mixed edits"  #: of which some turn hues: where many of these overlap, an image takes seconds
NOT_AT_REST = ", before rest"
#: Longest that is waited for rest before a change is measured; what takes longer is left out, and the table says so.
REST_SECONDS = 60.0
#: Longest for one change with its preparation; after that the case ends, as what was broken off is in no known state.
MOST_SECONDS = 240.0
_LARGE = {"width": 1920, "height": 1080}
#: A large image is measured for its frames, not for its build, which has fewer rays.
_LARGE_RAYS = {
    "record_rays": 512,
    "rays_per_bounce_row": 32,
    "rest_bounce_rays": None,
    "light_samples": 4,
    "dome_samples": 4,
}
#: Changes whose images depend on what was shown before: a light that moves is not at rest.
_FROM_BEFORE = ("light move", "64 edits: light move", f"{MIXED}: light move", DOME)


def cases(stages: list[str], quick: bool) -> list[dict[str, Any]]:
    """Every stage at the size that was asked for, and large; those that are animated are played too."""
    found: list[dict[str, Any]] = [{"stage": stage} for stage in stages]
    if not quick:
        found += [{"stage": stage, **_LARGE} for stage in stages]
    return found + [{"stage": stage, "play": len(frames_of(stage))} for stage in stages if frames_of(stage)]


class NotAtRest(Exception):
    """Nothing to be measured from: it takes too long to get there."""


class TooSlow(Exception):
    """A change was broken off."""


@dataclass
class Scene:
    """A relit stage and what is changed in it."""

    parts: Parts
    area_light: int
    dome: int
    stack: EditStack  #: one edit

    @cached_property
    def many(self) -> EditStack:
        """64 that scale, 16 of them on the same receivers."""
        return many_edits(self.parts)

    @cached_property
    def mixed(self) -> EditStack:
        """The same, a quarter of them turning hues."""
        return many_edits(self.parts, mixed=True)

    @cached_property
    def stroke(self) -> Stroke:
        return Stroke(self.parts)


def measure(case: dict[str, Any], effort: Effort, quick: bool, folder: Path) -> dict[str, Any]:
    """Times of every change with two threads and with one, and whether both gave the same bits."""
    if "play" in case:
        return {"play": measure_play(case["stage"], effort, quick)}
    large = "width" in case
    if large:
        effort = replace(effort, width=case["width"], height=case["height"])
        effort = replace(effort, changes=tuple(_LARGE_RAYS.items()))
    began = time.perf_counter()
    parts, added = with_movable_lights(Parts(case["stage"], effort))
    with suppress(NotAtRest):
        come_to_rest(parts.lights)  # what is left is done where a change starts from rest
    scene = make_scene(parts)
    changes = _changes(scene, quick)
    if large:
        changes = {name: changes[name] for name in changes if name.removesuffix(NOT_AT_REST) in GOALS[1920, 1080]}
    elif not quick and not case.get("mixed"):
        changes = {name: changes[name] for name in changes if not name.startswith(MIXED)}
    found: dict[str, Any] = {
        "width": effort.width,
        "height": effort.height,
        "build_rays": parts.effort.settings().record_rays,
        "view_samples": parts.view.n,
        "gather_samples": parts.gather.n,
        "records": len(parts.packed.row_view),
        "transport_bytes": getattr(parts.packed, "n_bytes", None),
        "lights": list(parts.snapshot.light_paths),
        "added_lights": added,
        "edits": {"one": 1},
        "build_seconds": time.perf_counter() - began,
        "changes": {},
    }
    if not large:
        found["edits"] |= {"64 edits": kinds_of(scene.many), MIXED: kinds_of(scene.mixed)}
    pace = Pace()
    for name, begin in changes.items():
        pace.look()
        try:
            with at_most(0.0 if quick else MOST_SECONDS):
                found["changes"][name] = _measured(name, begin, quick)
        except TooSlow:
            found["changes"][name] = {"broken_off_after": MOST_SECONDS, "same_bits": None}
            print(f"  {name:<28} broken off after {MOST_SECONDS:.0f} s, and with it the rest of this case", flush=True)
            break
        print(f"  {name:<28} {_cell(found['changes'][name])} frames/s", flush=True)
    return found | {"pace": pace.as_dict()}


def _measured(name: str, begin: Callable[[], Callable[[int], Any]], quick: bool) -> dict[str, Any]:
    """Times with two threads and with one, from one preparation, and whether both make the same bits."""
    limits = {"least": 2, "most": 2} if quick else {"least": 11, "most": 201}
    try:
        step = begin()
    except NotAtRest:
        return {"not_at_rest_in": REST_SECONDS, "same_bits": None}
    times = {}
    for threads in (2, 1):
        with Threads(threads):
            samples = repeat(step, seconds=1.5, **limits)
        times[str(threads)] = summary(samples) | {"samples": samples}
    same_bits = None  # not asked of all that has to begin again for each number of threads: that takes long
    if name not in _FROM_BEFORE:
        same_bits = _digest(lambda: step, 1) == _digest(lambda: step, 2)
    elif quick or name == "light move":
        with suppress(NotAtRest):
            same_bits = _digest(begin, 1) == _digest(begin, 2)
    return {"threads": times, "fps": 1 / times["2"]["median"], "same_bits": same_bits}


@contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """Raise `TooSlow` in the block after so long, between kernels; 0 is never, and so it is where there is no alarm."""
    if not seconds or not hasattr(signal, "setitimer"):
        yield
        return

    def stop(*_: object) -> None:
        raise TooSlow

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def make_scene(parts: Parts) -> Scene:
    """The changes need an area light, a dome and edits."""
    kinds = parts.snapshot.lights.kind
    area = int(np.flatnonzero(np.isin(kinds, [int(kind) for kind in AREA_KINDS]))[0])
    dome = int(np.flatnonzero(kinds == int(LightKind.DOME))[0])
    seen, sending = ranked_paths(parts)
    edit = one_edit("edit", "scale", {"gain": 1.5, "color": (1.2, 1.0, 0.8)}, seen[:2], sending[:3])
    return Scene(parts, area, dome, EditStack("/Edits", (edit,)))


def _changes(scene: Scene, quick: bool) -> dict[str, Callable[[], Callable[[int], Any]]]:
    """By name: prepares, and returns what makes frame i.

    Every change starts from rest but the first two, and those of mixed edits and of a dome, which take minutes to come
    to rest in a large scene. Mixed edits are last: where edits look at receivers, one image can take minutes.
    """
    live, lights = scene.parts.live, scene.parts.lights
    image = np.empty((scene.parts.view.height, scene.parts.view.width, 3), np.float32)
    start = lights_as_they_are(scene.parts)

    def prepared(
        stack: EditStack | Callable[[], EditStack], change: Callable[[int], None], *, rests: bool = True
    ) -> Callable[[], Callable[[int], Any]]:
        def begin() -> Callable[[int], Any]:
            restore(scene.parts, start)
            live.set_stack(stack if isinstance(stack, EditStack) else stack())
            live.frame(image)
            if rests:
                come_to_rest(live)

            def step(i: int) -> Any:
                change(i)
                return live.frame(image)

            return step

        return begin

    def colour(i: int) -> None:
        lights.set_gain(scene.area_light, (1 + 0.1 * (i % 7), 1, 0.9))

    def move(i: int) -> None:
        lights.change(scene.area_light, to_world=_shifted(start[scene.area_light], 0.01 * (1 + i % 11)))

    def turn(i: int) -> None:
        lights.change(scene.dome, to_world=_turned(start[scene.dome], np.radians(3.0 * (1 + i))))

    def amount(i: int) -> None:
        live.set_amount("/edit", 0.3 + 0.05 * (i % 11))

    def many_amount(i: int) -> None:
        edits = live.stack.edits
        live.set_amount(edits[i % len(edits)].path, 0.3 + 0.05 * (i % 11))

    keyed = [with_amount(scene.stack, "/edit", amount) for amount in np.linspace(0.1, 1, 24)]

    def play(i: int) -> None:
        live.set_stack(keyed[i % len(keyed)])

    return {
        # First: what was once at rest keeps some of it.
        f"light colour{NOT_AT_REST}": prepared(scene.stack, colour, rests=False),
        f"amount{NOT_AT_REST}": prepared(scene.stack, amount, rests=False),
        "light colour": prepared(scene.stack, colour),
        "amount": prepared(scene.stack, amount),
        "light move": prepared(scene.stack, move),
        "dab": prepared(lambda: scene.stroke.stack, lambda i: scene.stroke.dab(i)),
        "play": prepared(scene.stack, play),
        "64 edits: amount": prepared(lambda: scene.many, many_amount),
        "64 edits: light move": prepared(lambda: scene.many, move),
        DOME: prepared(scene.stack, turn, rests=quick),
        f"{MIXED}: amount": prepared(lambda: scene.mixed, many_amount, rests=quick),
        f"{MIXED}: light move": prepared(lambda: scene.mixed, move, rests=quick),
    }


def come_to_rest(live: LiveRelighter | LiveLights) -> None:
    """Work on a relighter, or on its lights alone, until nothing is left.

    Raises
    ------
    NotAtRest
        That takes longer than `REST_SECONDS`.
    """
    start = time.perf_counter()
    while live.refine():
        if time.perf_counter() - start > REST_SECONDS:
            raise NotAtRest


def kinds_of(stack: EditStack) -> dict[str, int]:
    """Edits by operation, and how many have a painted mask."""
    found = dict(Counter(edit.operation for edit in stack.edits))
    return found | {"all": len(stack.edits), "painted": sum(bool(edit.keys) for edit in stack.edits)}


def lights_as_they_are(parts: Parts) -> list[np.ndarray]:
    """Where each light stands."""
    return [np.asarray(matrix, np.float64) for matrix in parts.snapshot.lights.to_world]


def restore(parts: Parts, start: list[np.ndarray]) -> None:
    """Put every light that moved back where it was, and all at gain 1."""
    now = parts.lights.snapshot().lights.to_world
    for light, matrix in enumerate(start):
        parts.lights.set_gain(light, (1, 1, 1))
        if not np.allclose(now[light], matrix, rtol=0, atol=1e-6):
            parts.lights.change(light, to_world=matrix)


def with_amount(stack: EditStack, path: str, amount: float) -> EditStack:
    """The stack with another amount of one edit."""
    edits = tuple(replace(edit, amount=float(amount)) if edit.path == path else edit for edit in stack.edits)
    return replace(stack, edits=edits)


def _digest(begin: Callable[[], Callable[[int], Any]], threads: int) -> bytes:
    """Of three frames, after the same three: what came before is not to matter."""
    with Threads(threads):
        step = begin()
        for _ in range(2):
            digest = hashlib.sha256()
            for i in range(3):
                digest.update(np.ascontiguousarray(step(i)).tobytes())
    return digest.digest()


def _shifted(matrix: np.ndarray, share: float) -> np.ndarray:
    """A few centimetres to the side."""
    moved = matrix.copy()
    moved[:, 3] += share * np.array([1.0, 0.3, -0.5])
    return moved


def _turned(matrix: np.ndarray, angle: float) -> np.ndarray:
    """Turned about the light's own Y, a dome's pole."""
    cos, sin = np.cos(angle), np.sin(angle)
    turned = matrix.copy()
    turned[:, :3] = matrix[:, :3] @ np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    return turned


def markdown(results: list[dict[str, Any]]) -> list[str]:
    """Table for README: frames per second, two threads / one, spread as quartiles."""
    every = [result["result"] | {"name": result["case"]["name"]} for result in results if "result" in result]
    played = [_played(one) for one in every if "play" in one]
    found = [one for one in every if "changes" in one]
    if not found:
        return played
    lines = [
        "| change | goal | " + " | ".join(f"{one['name']} {one['width']} x {one['height']}" for one in found) + " |",
        "| --- | ---: |" + " ---: |" * len(found),
    ]
    for change in dict.fromkeys(name for one in found for name in one["changes"]):
        goals = {GOALS.get((one["width"], one["height"]), {}).get(change) for one in found} - {None}
        cells = [_cell(one["changes"].get(change)) for one in found]
        lines.append(f"| {change} | {', '.join(str(goal) for goal in sorted(goals))} | " + " | ".join(cells) + " |")
    for unit, what in (("GFLOP/s", "multiply-adds in registers"), ("GB/s", "reading 64 MiB")):
        cells = [said(one.get("pace"), unit) for one in found]
        lines.append(f"| *meanwhile: {what}, {unit}* |  | " + " | ".join(cells) + " |")
    rays = {(one["width"], one["height"]): one["build_rays"] for one in found}
    built = ", ".join(f"{n:,} rays a row at {width} x {height}" for (width, height), n in rays.items())
    bits = [change["same_bits"] for one in found for change in one["changes"].values()]
    bits = [same for same in bits if same is not None]
    lines += [
        "",
        *played,
        f"Frames/s with two threads (quartiles) / one thread; built with {built}.",
        "Everything starts at rest but what says so, mixed edits, and domes; what is not at rest in"
        f" {REST_SECONDS:.0f} s is left out.",
        f"Same bits for one thread and two: {'all' if all(bits) else 'NOT all'} of {len(bits)} changes.",
    ]
    return lines


def _played(one: dict[str, Any]) -> str:
    play = one["play"]
    return (
        f"Playing {play['frames']} resident frames of {one['name']} under changing light: {play['fps']:.0f} frames/s;"
        f" the first takes {play['bytes_of_first'] / 2**20:.0f} MiB,"
        f" each other {play['bytes_of_each_more'] / 2**20:.0f} MiB."
    )


def _cell(change: dict[str, Any] | None) -> str:
    if change is None:
        return ""
    if "broken_off_after" in change:
        return f"slower than {change['broken_off_after']:.0f} s"
    if "not_at_rest_in" in change:
        return f"not at rest in {change['not_at_rest_in']:.0f} s"
    two, one = change["threads"]["2"], change["threads"]["1"]
    median, low, high, alone = (
        f"{1 / seconds:.0f}" if seconds < 0.1 else f"{1 / seconds:.1f}"
        for seconds in (two["median"], two["quartile_3"], two["quartile_1"], one["median"])
    )
    return f"{median} ({low}-{high}) / {alone}"
