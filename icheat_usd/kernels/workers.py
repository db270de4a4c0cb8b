"""Numba's workers, and how several kernels share them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import ContextVar, copy_context
from typing import TypeVar

import numba

from icheat_usd.kernels._jit import kernels_may_overlap

Made = TypeVar("Made")

_MOST_AT_ONCE = 4  # pieces, each with an equal share of the workers: each holds memory
_is_one_of_many: ContextVar[bool] = ContextVar("_is_one_of_many", default=False)


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


def _one_of_many(make: Callable[[], Made]) -> Made:
    _is_one_of_many.set(True)
    return make()
