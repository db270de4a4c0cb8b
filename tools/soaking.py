"""Random commands at a live session, as fast as they go; what memory does meanwhile; and whether the end is right."""

from __future__ import annotations

import random
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from icheat_usd.errors import IcheatError
from icheat_usd.session import LiveSession

#: Lights that stand at most beside those of the stage.
_MOST_ADDED = 3


@dataclass
class Soaked:
    """What a soak saw."""

    commands: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)  #: commands that ended with a clear error
    seconds: float = 0.0
    memory: list[tuple[float, int]] = field(default_factory=list)  #: seconds since the start, resident bytes
    is_equal: bool = False  #: whether a fresh session at the final state shows the same bits
    difference: float = 0.0  #: largest, of the two images

    @property
    def growth(self) -> float:
        """Share by which memory of the last quarter exceeds that of the second: the first is warming up."""
        values = np.array([size for _, size in self.memory], float)
        if len(values) < 4:
            return 0.0
        quarter = len(values) // 4
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
    say: Callable[[str], None] = lambda _: None,
) -> Soaked:
    """Give commands for some time, then compare with a session that `again` opens.

    Parameters
    ----------
    frames
        That the playhead jumps between.
    every : seconds
        Between two looks at memory.
    """
    found, hand = Soaked(), _Hand(live, random.Random(seed), tuple(frames))
    began = looked = time.monotonic()
    while time.monotonic() - began < seconds:
        if most_commands is not None and sum(found.commands.values()) >= most_commands:
            break
        name = hand.choose()
        try:
            getattr(hand, name)()
            found.commands[name] += 1
        except IcheatError as error:
            found.refused[f"{name}: {error}"] += 1
        live.frame()
        now = time.monotonic()
        if now - looked >= every:
            looked = now
            found.memory.append((now - began, resident_bytes()))
            total = sum(found.commands.values())
            say(f"{now - began:7.0f} s  {total:9,} commands  {found.memory[-1][1] / 2**20:8.1f} MiB")
    found.seconds = time.monotonic() - began
    here = live.frame(level="rest")
    with again() as fresh:
        fresh.scrub(live.playhead)
        fresh.show(live.state)
        there = fresh.frame(level="rest")
    found.is_equal = bool(np.array_equal(here, there))
    found.difference = float(np.abs(here - there).max())
    return found


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
        names = ["gain", "gain", "move", "turn", "amount", "amount", "parameters", "mute", "reorder", "dab", "fill"]
        names += ["undo", "undo", "redo", "add", "remove", "drag"] + ["scrub"] * bool(self.frames)
        return self.rng.choice(names)

    def _edit(self) -> str:
        edits = self.live.stack.edits
        if not edits:
            raise IcheatError("the stage has no edits")
        return self.rng.choice(edits).path

    def _light(self) -> str:
        return self.rng.choice([path for path, light in self.live.lights.items() if not light.removed] or [""])

    def gain(self) -> None:
        self.live.set_light(self._light(), gain=[self.rng.uniform(0, 2) for _ in range(3)])

    def move(self) -> None:
        self.live.set_light(self._light(), move=[self.rng.uniform(-0.3, 0.3) for _ in range(3)])

    def turn(self) -> None:
        self.live.set_light(self._light(), turn=((0, 1, 0), self.rng.uniform(-40, 40)))

    def add(self) -> None:
        added = [path for path, light in self.live.lights.items() if light.added is not None]
        if len(added) >= _MOST_ADDED:
            self.live.remove_light(self.rng.choice(added))
        self.n_added += 1
        place = [self.rng.uniform(-0.5, 0.5) for _ in range(3)]
        self.live.add_light(f"/Soak/light_{self.n_added}", "sphere", at=place, radiance=2.0, size=(0.05,))

    def remove(self) -> None:
        self.live.remove_light(self._light())

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
