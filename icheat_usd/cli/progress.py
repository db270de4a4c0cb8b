"""Progress on stderr: one line that rewrites itself on a terminal, a few plain lines in a log."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import TextIO

#: A step that ends sooner stays silent.
QUIET_SECONDS = 2.0
_REFRESH_SECONDS = 0.1
_LOG_SECONDS = 15.0


class ProgressLine:
    """A `Progress` that shows steps which take longer than `QUIET_SECONDS`; use it in a `with` block."""

    def __init__(self, stream: TextIO | None = None, prefix: str = "") -> None:
        self._stream = stream if stream is not None else sys.stderr
        self._is_terminal = self._stream.isatty()
        self.prefix = prefix
        self._step = ""
        self._began = self._shown_at = 0.0
        self._visible = False

    def __call__(self, step: str, fraction: float) -> None:
        now = time.monotonic()
        if step != self._step:
            self._end(now)
            self._step, self._began, self._shown_at = step, now, float("-inf")
        if now - self._began >= QUIET_SECONDS:
            pause = _REFRESH_SECONDS if self._is_terminal else _LOG_SECONDS
            if now - self._shown_at >= pause:
                self._shown_at = now
                self._show(
                    f"{self.prefix}{step} {100 * min(max(fraction, 0.0), 1.0):3.0f} %  {now - self._began:.0f} s"
                )
        if fraction >= 1.0:
            self._end(now)

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
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._visible and self._is_terminal:
            self._stream.write("\r\x1b[K")
            self._stream.flush()
        self._visible = False
