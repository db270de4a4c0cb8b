"""Pieces of work that share Numba's workers."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from functools import partial

import numba
import numpy as np
import pytest

from icheat_usd.kernels._jit import kernels_may_overlap
from icheat_usd.kernels.compiling import told_of_compiling
from icheat_usd.kernels.workers import beside, overlapping, take_back


@numba.njit(parallel=True, nogil=True)
def doubled(values, out):  # type: ignore[no-untyped-def]
    for i in numba.prange(len(out)):
        out[i] = 2 * values[i]


def piece(i: int) -> list[float]:
    out = np.empty(100)
    doubled(np.full(100, float(i)), out)
    return out.tolist()


@pytest.fixture
def several_workers() -> Iterator[None]:
    doubled(np.zeros(1), np.zeros(1))
    if numba.get_num_threads() < 2 or not kernels_may_overlap():
        pytest.skip("pieces overlap with several workers alone, and not with Numba's own pool")
    yield


def test_pieces_come_in_their_order_whatever_takes_longest(several_workers: None) -> None:
    late = threading.Event()

    def make(i: int) -> int:
        if i == 0:
            assert late.wait(10), "the second piece was not begun before the first was done"
        late.set()
        return i

    assert list(overlapping([partial(make, i) for i in range(20)])) == list(range(20))


def test_overlapping_pieces_have_the_bits_of_those_one_by_one() -> None:
    makers = [partial(piece, i) for i in range(50)]
    assert list(overlapping(makers)) == [make() for make in makers]
    assert list(overlapping([])) == []


def test_the_workers_are_shared_out(several_workers: None) -> None:
    n = numba.get_num_threads()
    shares = list(overlapping([numba.get_num_threads] * 8))
    assert set(shares) == {n // min(n, 4)}
    assert numba.get_num_threads() == n


def test_pieces_within_a_piece_are_made_by_its_thread() -> None:
    def make() -> bool:
        inner = list(overlapping([threading.get_ident] * 3))
        return set(inner) == {threading.get_ident()}

    assert all(overlapping([make] * 4))


def test_with_one_worker_nothing_is_made_before_it_is_asked_for() -> None:
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        made: list[int] = []
        pieces = overlapping([partial(made.append, i) for i in range(3)])
        assert made == []
        next(pieces)
        assert made == [0]
    finally:
        numba.set_num_threads(before)


def test_the_first_piece_that_fails_ends_it_and_no_others_are_begun() -> None:
    begun: list[int] = []

    def make(i: int) -> int:
        begun.append(i)
        if i == 2:
            raise ValueError("the third piece")
        return i

    got = []
    with pytest.raises(ValueError, match="the third piece"):
        for i in overlapping([partial(make, i) for i in range(1000)]):
            got.append(i)
    assert got == [0, 1]
    assert len(begun) < 100


def test_who_stops_asking_waits_for_what_is_on_its_way(several_workers: None) -> None:
    running: list[int] = []

    def make(i: int) -> int:
        running.append(i)
        piece(i)
        running.remove(i)
        return i

    for i in overlapping([partial(make, i) for i in range(100)]):
        if i == 3:
            break
    assert running == []


def test_who_asked_is_told_of_kernels_that_pieces_compile(several_workers: None) -> None:
    def tripled(x: float) -> float:
        return 3 * x

    compiled = numba.njit(tripled)
    heard: list[str] = []
    with told_of_compiling(lambda n, name: heard.append(name)):
        list(overlapping([partial(compiled, float(i)) for i in range(8)]))
    assert heard == ["tripled"]


def test_pieces_beside_some_work_have_the_bits_of_those_after_it() -> None:
    found: list[list[float]] = [[] for _ in range(40)]

    def make(i: int) -> None:
        found[i] = piece(i)

    assert beside(lambda: piece(100), [partial(make, i) for i in range(40)]) == piece(100)
    assert found == [piece(i) for i in range(40)]


def test_another_thread_does_pieces_while_the_work_goes_on(several_workers: None) -> None:
    begun, n = threading.Event(), numba.get_num_threads()
    shares: list[int] = []

    def aside() -> None:
        shares.append(numba.get_num_threads())
        begun.set()

    def work() -> int:
        assert begun.wait(10), "no piece was begun while the work went on"
        return numba.get_num_threads()

    assert beside(work, [aside]) + shares[0] == n
    assert numba.get_num_threads() == n


def test_work_has_all_workers_again_once_the_pieces_are_done(several_workers: None) -> None:
    def work() -> int:
        deadline = time.monotonic() + 10
        while numba.get_num_threads() < n and time.monotonic() < deadline:
            take_back()
        return numba.get_num_threads()

    n = numba.get_num_threads()
    assert beside(work, [partial(piece, 1)]) == n
    take_back()  # which means nothing elsewhere
    assert numba.get_num_threads() == n


def test_a_piece_has_all_workers_once_nothing_but_it_is_left(several_workers: None) -> None:
    shares: list[int] = []
    begun = threading.Event()

    def aside() -> None:
        begun.set()
        deadline = time.monotonic() + 10
        while numba.get_num_threads() < n and time.monotonic() < deadline:
            take_back()
        shares.append(numba.get_num_threads())
        shares.append(len(piece(3)))

    n = numba.get_num_threads()
    assert beside(lambda: begun.wait(10), [aside])
    assert shares == [n, 100]
    assert numba.get_num_threads() == n


def test_with_one_worker_pieces_follow_the_work() -> None:
    done: list[str] = []
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        beside(lambda: done.append("work"), [partial(done.append, "first"), partial(done.append, "second")])
    finally:
        numba.set_num_threads(before)
    assert done == ["work", "first", "second"]


@pytest.mark.parametrize("n_threads", [1, 2])
def test_a_piece_may_wait_for_what_the_work_does(n_threads: int) -> None:
    made, waited = threading.Event(), []

    before = numba.get_num_threads()
    numba.set_num_threads(min(n_threads, before))
    try:
        for _ in range(50):
            made.clear()
            beside(made.set, [lambda: waited.append(made.wait(10))])
    finally:
        numba.set_num_threads(before)
    assert waited == 50 * [True]


@pytest.mark.parametrize("fails", ["work", "piece"])
def test_whoever_fails_beside_the_other_is_heard_of(fails: str) -> None:
    def maybe(name: str) -> None:
        if name == fails:
            raise IndexError(name)

    before = numba.get_num_threads()
    with pytest.raises(IndexError, match=fails):
        beside(partial(maybe, "work"), [partial(maybe, "piece")])
    assert numba.get_num_threads() == before
