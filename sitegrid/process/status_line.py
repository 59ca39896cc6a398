"""A status that changes: one line at the bottom of a terminal, below what is logged; elsewhere events in the log."""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr
from typing import TextIO

from sitegrid.process import streams

EVERY_S = 10.0  # between two events of a status that stays the same
CLEAR = "\r\x1b[K"  # ANSI: back to the start of the line, and erase it
WIDTH = 80  # of a terminal that does not say


class StatusLine:
    """The last line of a terminal. As a stream it takes what others write, which appears above the line."""

    def __init__(self, terminal: TextIO) -> None:
        self._terminal, self._text = terminal, ""
        self._begun = ""  # a line that others have not ended

    def show(self, text: str) -> None:
        """Show a text, cut to the width of the terminal; an empty one leaves a clean line."""
        self._text = "".join(c if c.isprintable() else " " for c in text)
        self._draw("")

    def write(self, text: str) -> int:
        """Write above the line, once a line is whole."""
        whole, end, self._begun = (self._begun + text).rpartition("\n")
        if end:
            self._draw(whole + end)
        return len(text)

    def close(self) -> None:
        """Leave a clean line, behind what others have written."""
        self._text = ""
        self._draw(self._begun)

    def _draw(self, above: str) -> None:
        width = self._columns() - 1  # a full line would wrap
        cut = self._text if len(self._text) <= width else f"{self._text[: width - 1]}…"
        streams.write(self._terminal, CLEAR + above + cut)

    def flush(self) -> None:
        """Nothing waits."""

    def isatty(self) -> bool:
        """It is a terminal."""
        return True

    def _columns(self) -> int:
        try:
            return os.get_terminal_size(self._terminal.fileno()).columns or WIDTH
        except (OSError, ValueError):
            return WIDTH


class Due:
    """When a status is an event: when it changes, and now and then."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._key, self._next_s = clock, "", 0.0

    def is_due(self, key: str) -> bool:
        """Whether it is time for another event. key: changes with the status."""
        if key == self._key and self._clock() < self._next_s:
            return False
        self._key, self._next_s = key, self._clock() + EVERY_S
        return True


@contextmanager
def status_line() -> Iterator[StatusLine]:
    """A status line on standard error; logs and all that is written there appear above it. At the end it is gone."""
    line = StatusLine(sys.stderr)
    handlers = [
        h for h in logging.getLogger().handlers if isinstance(h, logging.StreamHandler) and h.stream is sys.stderr
    ]
    for handler in handlers:
        handler.setStream(line)
    try:
        with redirect_stderr(line):
            yield line
    finally:
        line.close()
        for handler in handlers:
            handler.setStream(sys.stderr)
