"""Random commands at a live session, as fast as they go; what memory does meanwhile; and whether the end is right.

Memory is flat when it is not larger in the last quarter of the time than in the second: the first one fills what is
bounded (the frames in memory, the steps that can be undone) and is left out. Before it starts, every frame is visited,
as each takes memory of its own for as long as there is room for it. Before each look what was freed is given back,
which a session does every few seconds: else what is looked at would go with the pace of the commands.
"""

from __future__ import annotations

import random
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from icheat_usd.errors import IcheatError
from icheat_usd.freed_memory import give_freed_memory_back
from icheat_usd.scene import LightKind
from icheat_usd.session import LiveSession

#: Lights that stand at most beside those of the stage.
_MOST_ADDED = 3

#: Commands, and how often each comes.
_WEIGHTS = {
    "gain": 2, "recolour": 1, "move": 2, "turn": 2, "add": 1, "remove": 1, "bring_back": 1,
    "amount": 2, "parameters": 1, "mute": 1, "reorder": 1, "dab": 2, "fill": 1,
    "undo": 3, "redo": 2, "drag": 1, "rest": 1, "scrub": 1,
}  # fmt: skip

#: Sizes of lights that are added, in shares of the scene's radius; a dome has an image.
_SIZES = {"sphere": (0.02,), "rect": (0.2, 0.1), "disk": (0.1,), "distant": (0.01,), "dome": ()}


@dataclass
class Soaked:
    """What a soak saw."""

    commands: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)  #: commands that ended with a clear error
    seconds: float = 0.0
    memory: list[tuple[float, int]] = field(default_factory=list)  #: seconds since the start, resident bytes
    pace: list[tuple[float, int]] = field(default_factory=list)  #: seconds since the start, commands so far
    differences: list[float] = field(default_factory=list)  #: to a fresh session at the same state, largest value

    @property
    def growth(self) -> float:
        """Share by which memory of the last quarter exceeds that of the second: the first is warming up."""
        return _change([size for _, size in self.memory])

    @property
    def slowdown(self) -> float:
        """Share by which a command takes longer in the last quarter than in the second."""
        seconds, commands = np.diff(np.array(self.pace, float).reshape(-1, 2), axis=0).T
        return _change((seconds / np.maximum(commands, 1)).tolist())

    @property
    def is_equal(self) -> bool:
        """Whether every state that was compared has the same bits in a fresh session."""
        return bool(self.differences) and not any(self.differences)


def _change(values: Sequence[float]) -> float:
    """Median of the last quarter over that of the second, less 1."""
    quarter = len(values) // 4
    if quarter == 0:
        return 0.0
    return float(np.median(values[-quarter:]) / np.median(values[quarter : 2 * quarter]) - 1)


def soak(
    live: LiveSession,
    again: Callable[[], LiveSession],
    *,
    seconds: float,
    most_commands: int | None = None,
    frames: Sequence[float] = (),
    seed: int = 0,
    every: float = 1.0,
    comparisons: int = 4,
    say: Callable[[str], None] = lambda _: None,
) -> Soaked:
    """Give commands for some time, then compare with a session that `again` opens.

    Parameters
    ----------
    frames
        That the playhead jumps between.
    every : seconds
        Between two looks at memory.
    comparisons
        States to compare: the last one, and others that more commands lead to.
    """
    found, hand = Soaked(), _Hand(live, random.Random(seed), tuple(frames))
    for frame in frames:
        live.scrub(frame)
        live.wait("full")
    began = looked = time.monotonic()
    total = 0
    while time.monotonic() - began < seconds and (most_commands is None or total < most_commands):
        _give(hand, found)
        total += 1
        now = time.monotonic()
        if now - looked >= every:
            looked = now
            give_freed_memory_back()
            found.memory.append((now - began, resident_bytes()))
            found.pace.append((now - began, total))
            say(f"{now - began:7.0f} s  {total:9,} commands  {found.memory[-1][1] / 2**20:8.1f} MiB")
    found.seconds = time.monotonic() - began
    for i in range(comparisons):
        for _ in range(25 if i else 0):
            _give(hand, None)
        here = live.frame(level="rest")
        with again() as fresh:
            fresh.scrub(live.playhead)
            fresh.show(live.state)
            there = fresh.frame(level="rest")
        found.differences.append(0.0 if np.array_equal(here, there) else float(np.abs(here - there).max()))
        say(f"state {i + 1}: {'same bits' if found.differences[-1] == 0 else 'OTHER bits'} as in a fresh session")
    return found


def _give(hand: _Hand, found: Soaked | None) -> None:
    """One command, and a look at what it makes."""
    name = hand.choose()
    try:
        getattr(hand, name)()
        if found is not None:
            found.commands[name] += 1
    except IcheatError as error:
        if found is not None:
            found.refused[f"{name}: {error}"] += 1
    hand.live.frame()


def resident_bytes() -> int:
    """Memory of this process that is in use now."""
    text = Path("/proc/self/statm")
    if text.exists():
        import os

        return int(text.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    import psutil

    return int(psutil.Process().memory_info().rss)


class _Hand:
    """An artist without a plan."""

    def __init__(self, live: LiveSession, rng: random.Random, frames: tuple[float, ...]) -> None:
        self.live, self.rng, self.frames = live, rng, frames
        self.n_added = 0

    def choose(self) -> str:
        names = [name for name in _WEIGHTS if name != "scrub" or self.frames]
        return self.rng.choices(names, [_WEIGHTS[name] for name in names])[0]

    def _edit(self) -> str:
        edits = self.live.stack.edits
        if not edits:
            raise IcheatError("the stage has no edits")
        return self.rng.choice(edits).path

    def _lights(self) -> list[str]:
        return [path for path, light in self.live.lights.items() if not light.removed]

    def _light(self) -> str:
        if not self._lights():
            self.add()
        return self.rng.choice(self._lights())

    def gain(self) -> None:
        self.live.set_light(self._light(), gain=[self.rng.uniform(0, 2) for _ in range(3)])

    def recolour(self) -> None:
        self.live.set_light(self._light(), radiance=[self.rng.uniform(0, 5) for _ in range(3)])

    def move(self) -> None:
        self.live.set_light(self._light(), move=[self.rng.uniform(-0.3, 0.3) for _ in range(3)])

    def turn(self) -> None:
        """A dome, if there is one."""
        domes = [path for path in self._lights() if self._kind(path) == LightKind.DOME]
        self.live.set_light(self.rng.choice(domes or [self._light()]), turn=((0, 1, 0), self.rng.uniform(-40, 40)))

    def _kind(self, path: str) -> LightKind:
        added = self.live.lights[path].added
        snapshot = self.live.snapshot
        return added if added is not None else LightKind(int(snapshot.lights.kind[snapshot.light_paths.index(path)]))

    def add(self) -> None:
        added = [path for path, light in self.live.lights.items() if light.added is not None]
        if len(added) >= _MOST_ADDED:
            self.live.remove_light(self.rng.choice(added))
        self.n_added += 1
        kind = self.rng.choice(list(_SIZES))
        snapshot = self.live.snapshot
        size = [snapshot.radius * share for share in _SIZES[kind]]
        place = [float(c) + self.rng.uniform(-0.3, 0.3) * snapshot.radius for c in snapshot.centre]
        image = np.random.default_rng(self.rng.randrange(1000)).random((8, 16, 3)).astype(np.float32)
        self.live.add_light(
            f"/Soak/light_{self.n_added}",
            kind,
            at=place,
            radiance=2.0,
            size=size or (0.0, 0.0),
            texture=image if kind == "dome" else None,
        )

    def remove(self) -> None:
        self.live.remove_light(self._light())

    def bring_back(self) -> None:
        """A light of the stage, as the stage has it."""
        changed = [path for path, light in self.live.lights.items() if light.added is None and light.removed]
        if changed:
            self.live.show(self.live.state.without_light(self.rng.choice(changed)), "bring back")

    def rest(self) -> None:
        """A pause, in which the background gets on."""
        time.sleep(0.05)

    def amount(self) -> None:
        self.live.set_amount(self._edit(), self.rng.uniform(0, 1.5))

    def parameters(self) -> None:
        path = self._edit()
        edit = next(edit for edit in self.live.stack.edits if edit.path == path)
        numbers = {name: v for name, v in edit.parameters.items() if isinstance(v, float)}
        if numbers:
            name = self.rng.choice(sorted(numbers))
            self.live.set_parameters(path, **{name: numbers[name] * self.rng.uniform(0.7, 1.4)})

    def mute(self) -> None:
        path = self._edit()
        edit = next(edit for edit in self.live.stack.edits if edit.path == path)
        self.live.mute(path, edit.enabled)

    def reorder(self) -> None:
        self.live.move_edit(self._edit(), before=self._edit())

    def fill(self) -> None:
        self.live.fill_mask(self._edit(), self.rng.choice([0.0, 0.5, 1.0]), side=self._side())

    def dab(self) -> None:
        film = self.live.snapshot.camera
        found = self.live.pick(self.rng.randrange(film.width), self.rng.randrange(film.height))
        if found is not None:
            strength = self.rng.choice([-1.0, 0.5, 1.0])
            self.live.dab(self._edit(), found[1], self.rng.uniform(0.05, 0.5), side=self._side(), strength=strength)

    def _side(self) -> str:
        return self.rng.choice(["receivers", "receivers", "casters"])

    def drag(self) -> None:
        with self.live.gesture("drag"):
            for _ in range(4):
                self.rng.choice([self.gain, self.move, self.amount])()

    def undo(self) -> None:
        self.live.undo()

    def redo(self) -> None:
        self.live.redo()

    def scrub(self) -> None:
        self.live.scrub(self.rng.choice(self.frames))
