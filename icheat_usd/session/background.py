"""One thread that makes things better while commands are served.

Commands go first: while one runs, the background waits at the next place where
its work reports progress, though never for long, so that a script without a
pause gets better images too. There, too, it stops when the session is closed or
something more urgent has come up.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

#: Work that is to be done in the background; it calls `Background.progress` on the way.
Job = Callable[[], None]

#: Longest that a piece of work is put off for commands.
_PATIENCE_SECONDS = 0.5

#: From one `tidy` to the next: with a minute, memory followed how many commands went through in it.
_TIDY_SECONDS = 10.0


class Stopped(BaseException):
    """Raised out of background work that is not wanted any more; nobody but `Background` catches it."""


class Background:
    """Runs one job after another until closed.

    Parameters
    ----------
    next_job
        Asked, without the lock, for what to do now; None is nothing until `wake`.
    on_error
        Told of an exception that a job raised; the next job is asked for then, so it must not be the same again.
    may_overlap
        Whether work and commands may run at the same time; else the work holds the lock between its reports.
    tidy
        Called now and then, without the lock, and a last time when nothing is left to do.
    """

    def __init__(
        self,
        next_job: Callable[[], Job | None],
        on_error: Callable[[Exception], None],
        may_overlap: Callable[[], bool] = lambda: True,
        tidy: Callable[[], None] = lambda: None,
    ) -> None:
        self.lock = threading.RLock()  #: held by every command, and by jobs while they touch what commands use
        self._changed = threading.Condition()
        self._closing = False
        self._obsolete = False
        self._exclusive = False
        self._commands = 0
        self._wakes = 0
        self._next_job, self._on_error, self._may_overlap = next_job, on_error, may_overlap
        self._tidy, self._tidied, self._is_tidy = tidy, time.monotonic(), True
        self._thread = threading.Thread(target=self._run, name="icheat background", daemon=True)

    def start(self) -> None:
        self._thread.start()

    @property
    def is_closing(self) -> bool:
        return self._closing

    @contextmanager
    def command(self) -> Iterator[None]:
        """Hold the lock; the background waits meanwhile wherever it reports progress."""
        with self._changed:
            self._commands += 1
        try:
            with self.lock:
                yield
        finally:
            with self._changed:
                self._commands -= 1
                if self._commands == 0:
                    self._changed.notify_all()

    def progress(self) -> None:
        """Called by jobs between pieces of work: waits for commands, and raises `Stopped` when the job is to end."""
        if self._exclusive:
            self.lock.release()
        try:
            with self._changed:
                until = time.monotonic() + _PATIENCE_SECONDS
                while self._commands and not self._closing and (left := until - time.monotonic()) > 0:
                    self._changed.wait(left)
                if self._closing or self._obsolete:
                    raise Stopped
        finally:
            if self._exclusive:
                self.lock.acquire()

    def wake(self, *, stop_job: bool = False) -> None:
        """Ask for the next job again; with `stop_job` leave the one that runs."""
        with self._changed:
            self._wakes += 1
            self._obsolete = self._obsolete or stop_job
            self._changed.notify_all()

    def notify(self) -> None:
        """Tell those in `wait_for` to look again."""
        with self._changed:
            self._changed.notify_all()

    def wait_for(self, condition: Callable[[], bool], timeout: float | None = None) -> bool:
        """Wait until something holds; false after `timeout` seconds. Ctrl-C comes through."""
        with self._changed:
            remaining = timeout
            while not condition():
                if self._closing or (remaining is not None and remaining <= 0):
                    return condition()
                step = 0.2 if remaining is None else min(0.2, remaining)
                self._changed.wait(step)
                remaining = None if remaining is None else remaining - step
            return True

    def close(self) -> None:
        """Stop the job that runs at its next piece of work, and wait for that; closing twice does nothing."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        if threading.current_thread() is not self._thread:
            if self._thread.is_alive():
                self._thread.join()
            # They hold the session, which holds this: its stage would stay open until garbage is collected.
            self._next_job, self._on_error = lambda: None, lambda error: None

    def _run(self) -> None:
        while not self._closing:
            with self._changed:
                wakes = self._wakes
                self._obsolete = False
            try:
                self._tidy_up()
                job = self._next_job()
                if job is None:
                    self._wait_for_wake(wakes)
                    continue
                self._is_tidy = False
                self._do(job)
            except Stopped:
                continue
            except Exception as error:
                self._on_error(error)
            self.notify()

    def _wait_for_wake(self, wakes: int) -> None:
        """Wait for one after so many, or for the time to tidy up."""
        with self._changed:
            while self._wakes == wakes and not self._closing:
                left = None if self._is_tidy else self._tidied + _TIDY_SECONDS - time.monotonic()
                if left is not None and left <= 0:
                    return
                self._changed.wait(left)
            self._is_tidy = False

    def _tidy_up(self) -> None:
        if not self._is_tidy and time.monotonic() >= self._tidied + _TIDY_SECONDS:
            self._tidy()
            self._tidied, self._is_tidy = time.monotonic(), True

    def _do(self, job: Job) -> None:
        self.progress()
        if self._may_overlap():
            job()
            return
        with self.lock:
            self._exclusive = True
            try:
                job()
            finally:
                self._exclusive = False
