"""Kernels compiled ahead: the list knows all that is called, callers come last, and what fails is named."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

import pytest
from numba.core import types

from icheat_usd.cli import main
from icheat_usd.errors import IcheatError
from icheat_usd.kernels._signatures import UnlistedTypeError, decode, dispatchers, encode, kernels_called
from icheat_usd.session import warming
from icheat_usd.session.warming import (
    LIVE_PURPOSES,
    PURPOSES,
    RARE,
    Listed,
    are_compiled,
    compile_ahead,
    compile_in_turn,
    listed,
)
from tools.kernel_list import TASKS, rare, recorded


class Pair(NamedTuple):
    first: object
    second: object


COLOURS = types.Array(types.float32, 2, "C")


@pytest.mark.parametrize(
    "kind",
    [
        types.int64,
        types.boolean,
        types.none,
        types.literal(6),
        COLOURS,
        types.Array(types.uint8, 1, "A", readonly=True),
        types.NamedTuple((COLOURS, types.float64), Pair),
        types.NamedUniTuple(COLOURS, 2, Pair),
        types.UniTuple(types.int64, 3),
        types.Tuple((types.int64, types.NamedTuple((COLOURS, types.float64), Pair))),
    ],
    ids=str,
)
def test_a_type_comes_back_from_the_list_as_it_was(kind: types.Type) -> None:
    assert decode(json.loads(json.dumps(encode(kind)))) == kind


def test_a_type_without_a_word_is_named() -> None:
    with pytest.raises(UnlistedTypeError, match="unicode_type"):
        encode(types.unicode_type)


def test_the_list_is_of_kernels_as_they_are() -> None:
    kernels = dict(dispatchers())
    for entry in listed():
        assert entry.kernel in kernels, f"{entry.kernel} has gone; run tools/list_kernels"
        code = kernels[entry.kernel].py_func.__code__
        assert len(entry.types) == code.co_argcount, f"{entry.kernel} has other arguments; run tools/list_kernels"
        assert entry.calls == kernels_called(kernels[entry.kernel]), f"{entry.kernel}: run tools/list_kernels"
        assert set(entry.purposes) <= set(PURPOSES) or entry.purposes == [RARE]


@pytest.mark.parametrize("purpose", PURPOSES)
def test_what_is_called_is_listed(purpose: str) -> None:
    known = {(entry.kernel, json.dumps(entry.types)) for entry in listed() if purpose in entry.purposes}
    found = [entry for entry in recorded(purpose) if (entry.kernel, json.dumps(entry.types)) not in known]
    assert not found, f"not in the list for '{purpose}', run tools/list_kernels: {[entry.kernel for entry in found]}"
    assert set(TASKS) == set(PURPOSES)


def test_what_few_stages_need_stays_listed_while_it_is_of_kernels_as_they_are() -> None:
    mine = [one for one in listed() if one.purposes == [RARE]]
    assert [one.kernel for one in rare(mine, [])] == [one.kernel for one in mine] and len(mine) > 100
    first, second = rare(mine[:2], [])
    changed = [
        first,
        second,  # called by something else now
        first._replace(kernel="random.gone"),
        first._replace(types=[*first.types, "int64"]),
        second._replace(purposes=["live"]),
    ]
    assert rare(changed, [second._replace(purposes=["render"])]) == [first]
    assert rare([first._replace(calls=["random.gone"], size=1)], []) == [first]


def entry(kernel: str, *calls: str, purposes: tuple[str, ...] = ("live",), size: int = 1) -> Listed:
    return Listed(kernel, ["int64"], list(purposes), list(calls), size)


@pytest.fixture
def listing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> pytest.MonkeyPatch:
    monkeypatch.setenv("ICHEAT_CACHE_DIR", str(tmp_path))
    (tmp_path / "kernels").mkdir()
    return monkeypatch


class FakeWorker:
    """Remembers what began and what ended, in order."""

    events: list[tuple[str, str]]

    def begin(self, entry: Listed, answers: SimpleQueue[tuple[object, str]]) -> None:
        self.events.append(("begins", entry.kernel))
        self.events.append(("ends", entry.kernel))
        answers.put((self, "its reason" if entry.kernel == "a.broken" else ""))

    def end(self) -> None:
        self.events.append(("stopped", ""))


@pytest.mark.parametrize("jobs", [1, 3])
def test_what_is_called_is_compiled_before_its_callers_and_the_rest_is_left(
    listing: pytest.MonkeyPatch, jobs: int
) -> None:
    entries = (
        entry("a.main", "b.part", "b.other"), entry("b.part", "c.least", purposes=("render",)), entry("b.other"),
        entry("c.least", purposes=("relight",)), entry("d.unneeded", purposes=("relight",)),
    )  # fmt: skip
    events: list[tuple[str, str]] = []
    listing.setattr(warming, "listed", lambda: entries)
    listing.setattr(warming, "_Worker", type("Worker", (FakeWorker,), {"events": events}))
    said: list[float] = []
    assert compile_ahead(("live",), jobs, lambda step, fraction: said.append(fraction)) == 4
    for caller in entries[:3]:
        for called in caller.calls:
            assert events.index(("ends", called)) < events.index(("begins", caller.kernel))
    assert ("begins", "d.unneeded") not in events
    assert events.count(("stopped", "")) == min(jobs, 4)
    assert said == sorted(said) and said[-1] == 1.0
    assert compile_ahead(("live",), jobs) == 0, "it is known to be complete"
    assert compile_ahead(("live", "relight"), jobs) == 5


def test_in_turn_the_first_purpose_comes_first_and_each_is_marked_when_it_is_done(
    listing: pytest.MonkeyPatch,
) -> None:
    entries = (
        entry("a.later", "b.shared", purposes=("live",), size=50),
        entry("b.shared", purposes=("live", "look"), size=3),
        entry("c.main", "b.shared", purposes=("live", "look")),
        entry("d.middle", "c.main", purposes=("live", "preview")),
        entry("e.other", purposes=("render",)),
    )
    events: list[tuple[str, str]] = []
    listing.setattr(warming, "listed", lambda: entries)
    listing.setattr(warming, "_Worker", type("Worker", (FakeWorker,), {"events": events}))
    listing.setattr(warming, "available_cores", lambda: 1)
    said: list[tuple[str, float]] = []
    compile_in_turn(LIVE_PURPOSES, lambda purpose, share: said.append((purpose, share)))
    begun = [kernel for event, kernel in events if event == "begins"]
    assert begun == ["b.shared", "c.main", "d.middle", "a.later"]
    shares = {purpose: [share for name, share in said if name == purpose] for purpose in LIVE_PURPOSES}
    assert shares["look"][:3] == [0.0, 0.75, 1.0] and all(found == sorted(found) for found in shares.values())
    assert all(found[-1] == 1.0 for found in shares.values())
    assert are_compiled(LIVE_PURPOSES) and not are_compiled(["render"])

    def close(purpose: str, share: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compile_in_turn(["render"], close)
    assert events[-1] == ("stopped", "") and not are_compiled(["render"])


def test_a_kernel_that_does_not_compile_is_named_and_nothing_is_marked_complete(
    listing: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    events: list[tuple[str, str]] = []
    listing.setattr(warming, "listed", lambda: (entry("a.fine"), entry("a.broken")))
    listing.setattr(warming, "_Worker", type("Worker", (FakeWorker,), {"events": events}))
    with pytest.raises(IcheatError, match="kernel a.broken of signatures.json does not compile: its reason"):
        compile_ahead(("live",), 2)
    assert events.count(("stopped", "")) == 2
    assert not list((tmp_path / "kernels").glob("*.complete"))


def test_processes_compile_into_the_cache_and_answer_for_what_they_can_not(
    listing: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    real = [one for one in listed() if one.kernel == "random.to_unit"]
    assert real
    listing.setattr(warming, "listed", lambda: tuple(real))
    # An interpreter may have something to say when it starts.
    (tmp_path / "sitecustomize.py").write_text("print('hello from the studio')")
    listing.setenv("PYTHONPATH", str(tmp_path))
    assert compile_ahead(real[0].purposes, 2) == len(real)
    listing.delenv("PYTHONPATH")
    words = json.dumps(real[0].types)
    code = (
        "import json; from icheat_usd.kernels.random import to_unit as kernel;"
        f"from icheat_usd.kernels._signatures import decode; kernel.compile(tuple(map(decode, json.loads({words!r}))));"
        "print(sum(kernel.stats.cache_hits.values()), sum(kernel.stats.cache_misses.values()))"
    )
    done = subprocess.run([sys.executable, "-c", code], env=os.environ, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1", "0"]

    for wrong, message in (
        (real[0]._replace(kernel="random.gone"), "random.gone .*there is no such kernel"),
        (real[0]._replace(types=[]), "random.to_unit .*"),
    ):
        listing.setattr(warming, "listed", lambda wrong=wrong: (wrong,))
        for mark in (tmp_path / "kernels").glob("*.complete"):
            mark.unlink()
        with pytest.raises(IcheatError, match=message):
            compile_ahead(real[0].purposes[:1], 1)


def test_a_process_that_ends_early_is_told(listing: pytest.MonkeyPatch) -> None:
    listing.setattr(warming, "listed", lambda: (entry("a.fine"),))
    listing.setattr(warming.sys, "executable", "/bin/false")
    with pytest.raises(IcheatError, match="a.fine .*its process ended with code 1"):
        compile_ahead(("live",), 1)


def test_a_process_that_can_not_be_started_is_told(listing: pytest.MonkeyPatch) -> None:
    listing.setattr(warming, "listed", lambda: (entry("a.fine"),))
    listing.setattr(warming.sys, "executable", "/there/is/no/python")
    with pytest.raises(IcheatError, match="no process can be started to compile kernels in: .*/there/is/no/python"):
        compile_ahead(("live",), 1)


def test_warm_says_where_kernels_are(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["warm", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert set(content) == {"version", "folder", "kernels", "seconds"} and content["folder"].endswith("kernels")
    assert main(["warm"]) == 0
    assert capsys.readouterr().out.startswith("all kernels had been compiled in ")
