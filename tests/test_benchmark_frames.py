"""What the suite of frames compares, and what it leaves out."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import pytest

from tools.benchmarking import frames
from tools.benchmarking.pace import Pace


def amounts_of(n_edits: int, last: Callable[[], float] = lambda: 0.0) -> Callable[[], Callable[[int], Any]]:
    """A change as that of 64 amounts, where a frame depends on the amounts set before."""
    amounts = np.ones(n_edits)

    def step(i: int) -> Any:
        amounts[i % n_edits] = 0.3 + 0.05 * (i % 11)
        return np.append(amounts, last())

    return lambda: step


def test_bits_of_one_thread_and_two_are_compared_from_the_same_state() -> None:
    assert frames._measured("64 edits: amount", amounts_of(64), False)["same_bits"]
    told_apart = amounts_of(64, lambda: float(numba.get_num_threads()))
    assert not frames._measured("64 edits: amount", told_apart, False)["same_bits"]


def test_what_comes_to_rest_is_compared_too() -> None:
    def begin() -> Callable[[int], Any]:
        prepared_with = numba.get_num_threads()
        return lambda i: np.array([i, prepared_with])

    assert not frames._measured("light move", begin, False)["same_bits"]


def test_what_does_not_come_to_rest_is_left_out_and_said_so(monkeypatch: pytest.MonkeyPatch) -> None:
    class Restless:
        def refine(self) -> bool:
            return True

    def begin() -> Callable[[int], Any]:
        frames.come_to_rest(Restless())  # type: ignore[arg-type]
        raise AssertionError("it never ends")

    monkeypatch.setattr(frames, "REST_SECONDS", 0.02)
    found = frames._measured("dab", begin, False)
    assert found["same_bits"] is None and "threads" not in found
    size = {"width": 640, "height": 480, "build_rays": 8}
    done = frames._measured("amount", amounts_of(1), True)
    results = [{"case": {"name": "room"}, "result": size | {"changes": {"dab": found, "amount": done}}}]
    text = "\n".join(frames.markdown(results))
    assert "| dab | 60 | not at rest in 0 s |" in text and "all of 1 changes" in text


def test_what_takes_too_long_is_broken_off() -> None:
    before = signal.getsignal(signal.SIGALRM)
    start = time.perf_counter()
    with pytest.raises(frames.TooSlow), frames.at_most(0.05):
        while time.perf_counter() < start + 30:
            pass
    assert time.perf_counter() < start + 10
    with frames.at_most(0.0):
        pass
    assert signal.getsignal(signal.SIGALRM) is before
    assert frames._cell({"broken_off_after": 240.0}) == "slower than 240 s"


def test_speed_of_the_machine_stands_beside_frames() -> None:
    pace = Pace()
    assert pace.as_dict() == {"2": {}, "1": {}}
    pace.look()
    speeds = pace.as_dict()
    for threads in ("2", "1"):
        # One lane at 0.1 GHz, and sixteen at 10 with two units: what is outside is an error of units.
        assert 0.1 < speeds[threads]["GFLOP/s"] < 2 * 640 and 0.1 < speeds[threads]["GB/s"] < 2000
    done = frames._measured("amount", amounts_of(1), True)
    size = {"width": 640, "height": 480, "build_rays": 8, "changes": {"amount": done}}
    results = [{"case": {"name": "room"}, "result": size | {"pace": {"2": {"GB/s": 18.04}, "1": {"GB/s": 10.0}}}}]
    text = "\n".join(frames.markdown(results))
    assert "GB/s* |  | 18 / 10 |" in text and "GFLOP/s* |  |  |" in text
