"""Numba's workers, and how several kernels share them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextvars import ContextVar, copy_context
from functools import cache
from typing import TypeVar

import numba

from icheat_usd.kernels._jit import kernels_may_overlap

Made = TypeVar("Made")

_MOST_AT_ONCE = 4  # pieces, each with an equal share of the workers: each holds memory
_pair: ContextVar[_Pair | None] = ContextVar("_pair", default=None)
_is_one_of_many: ContextVar[bool] = ContextVar("_is_one_of_many", default=False)


class _Pair:
    """Two threads beside each other."""

    def __init__(self, n_threads: int, pieces: Sequence[Callable[[], None]]) -> None:
        self.n_threads = n_threads  #: that they share
        self.left = deque(pieces)
        self.aside: Future[None] | None = None  #: the other thread's work; None: there is one thread
        self.is_waited_for = False  #: whether pieces that have begun are all that is not done


def start_workers() -> None:
    """Start them before a parallel kernel does, so that it is known from the first one on whether kernels overlap."""
    numba.get_num_threads()


def overlapping(makers: Sequence[Callable[[], Made]]) -> Iterator[Made]:
    """What independent pieces of work make, in their order, some of them at a time where kernels may overlap.

    For pieces that run parallel kernels with serial steps between them: each has some of the workers to itself, so
    that no worker waits for the slowest one or for a serial step. With one worker, with Numba's own pool, or
    within a piece of another such iteration they are made one by one, by the thread that asks. Whoever stops asking
    waits for the pieces that are on their way.

    Raises
    ------
    Exception
        Of the first piece, in their order, that fails.
    """
    start_workers()
    n_threads = numba.get_num_threads()
    if len(makers) < 2 or n_threads < 2 or _is_one_of_many.get() or not kernels_may_overlap():
        for make in makers:
            yield make()
        return
    at_once = min(n_threads, _MOST_AT_ONCE)
    with ThreadPoolExecutor(at_once, "icheat piece", numba.set_num_threads, (n_threads // at_once,)) as threads:
        waiting: deque[Future[Made]] = deque()
        try:
            for make in makers:
                # The context says who is told of kernels that are compiled.
                waiting.append(threads.submit(copy_context().run, _one_of_many, make))
                if len(waiting) > at_once:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def beside(work: Callable[[], Made], pieces: Sequence[Callable[[], None]]) -> Made:
    """Do some work while another thread does pieces beside it; at last this one helps with the pieces.

    For frames, where chains of short steps leave workers idle: each of the two threads has half of the workers until
    the other has nothing to do, of which it hears where it asks `take_back`. Where kernels may not overlap, all is done
    one after the other: the work, and then the pieces.

    Parameters
    ----------
    pieces
        Independent of one another, of a fraction of a millisecond and more. One may wait for what the work does, if
        that comes also where the work fails; the work waits for none.

    Raises
    ------
    Exception
        Of the work, else of a piece; every piece that was begun has then ended.
    """
    start_workers()
    n_threads = numba.get_num_threads()
    pair = _Pair(n_threads, pieces)
    outer = _pair.set(pair)
    try:
        if n_threads < 2 or _is_one_of_many.get() or not kernels_may_overlap():
            made = work()
            _do_what_is_left(pair.left)
            return made
        pair.aside = _beside().submit(copy_context().run, _with_workers, n_threads // 2, pair.left)
        numba.set_num_threads(n_threads - n_threads // 2)
        try:
            made = work()
            _do_what_is_left(pair.left)
        finally:
            pair.left.clear()
            pair.is_waited_for = True
            wait([pair.aside])
            numba.set_num_threads(n_threads)
        pair.aside.result()
        return made
    finally:
        _pair.reset(outer)


def take_back() -> None:
    """Within the work or a piece of `beside`: have all workers from here on, if the other thread has nothing to do."""
    pair = _pair.get()
    if pair is not None and pair.aside is not None and (pair.is_waited_for or pair.aside.done()):
        numba.set_num_threads(pair.n_threads)


@cache
def _beside() -> ThreadPoolExecutor:
    """The other thread, which stays: to start one takes as long as a piece."""
    return ThreadPoolExecutor(1, "icheat beside")


def _with_workers(n: int, left: deque[Callable[[], None]]) -> None:
    numba.set_num_threads(n)
    _do_what_is_left(left)


def _do_what_is_left(left: deque[Callable[[], None]]) -> None:
    """Take pieces until there are none; another thread may do the same."""
    while True:
        try:
            piece = left.popleft()
        except IndexError:
            return
        piece()


def _one_of_many(make: Callable[[], Made]) -> Made:
    _is_one_of_many.set(True)
    return make()
