"""Progress on stderr: one line that rewrites itself on a terminal, a few plain lines in a log."""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType
from typing import TextIO

#: A step that ends sooner stays silent.
QUIET_SECONDS = 2.0
_REFRESH_SECONDS = 0.1
_LOG_SECONDS = 15.0


class ProgressLine:
    """A `Progress` that shows steps which take longer than `QUIET_SECONDS`; use it in a `with` block.

    A clock of its own (left out with ``ticks=False``) keeps the line alive
    through a step that reports its beginning and its end alone.
    """

    def __init__(self, stream: TextIO | None = None, prefix: str = "", ticks: bool = True) -> None:
        self._ticks = ticks
        self._lock = threading.Lock()
        self._left = threading.Event()
        self._fraction = 0.0
        self._stream = stream if stream is not None else sys.stderr
        self._is_terminal = self._stream.isatty()
        self.prefix = prefix
        self._step = ""
        self._began = self._shown_at = 0.0
        self._visible = False

    def __call__(self, step: str, fraction: float) -> None:
        with self._lock:
            now = time.monotonic()
            if step != self._step:
                self._end(now)
                self._step, self._began, self._shown_at = step, now, float("-inf")
            self._fraction = min(max(fraction, 0.0), 1.0)
            self._refresh(now)
            if fraction >= 1.0:
                self._end(now)

    def _tick(self) -> None:
        while not self._left.wait(0.5):
            with self._lock:
                if self._step:
                    self._refresh(time.monotonic())

    def _refresh(self, now: float) -> None:
        pause = _REFRESH_SECONDS if self._is_terminal else _LOG_SECONDS
        if now - self._began >= QUIET_SECONDS and now - self._shown_at >= pause:
            self._shown_at = now
            percent = f" {100 * self._fraction:3.0f} %" if self._fraction > 0 else ""
            self._show(f"{self.prefix}{self._step}{percent}  {now - self._began:.0f} s")

    def _show(self, line: str) -> None:
        self._stream.write(f"\r\x1b[K{line}" if self._is_terminal else f"{line}\n")
        self._stream.flush()
        self._visible = True

    def _end(self, now: float) -> None:
        if self._visible and self._is_terminal:
            self._stream.write("\r\x1b[K")
            self._stream.flush()
        elif self._visible:
            self._show(f"{self.prefix}{self._step} done  {now - self._began:.0f} s")
        self._step, self._visible = "", False

    def __enter__(self) -> ProgressLine:
        self._left.clear()
        if self._ticks:
            threading.Thread(target=self._tick, name="progress", daemon=True).start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._left.set()
        with self._lock:
            if self._visible and self._is_terminal:
                self._stream.write("\r\x1b[K")
                self._stream.flush()
            self._step, self._visible = "", False
