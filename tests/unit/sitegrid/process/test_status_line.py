"""A status line on a terminal, and when a status is an event elsewhere."""

from __future__ import annotations

import fcntl
import logging
import os
import struct
import sys
import termios
from collections.abc import Iterator
from typing import TextIO

import pytest

from sitegrid.process.status_line import CLEAR, EVERY_S, Due, status_line

COLUMNS = 40


@pytest.fixture
def terminal() -> Iterator[tuple[int, TextIO]]:
    """What is on standard error, a terminal of COLUMNS, can be read from the descriptor."""
    ours, theirs = os.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, COLUMNS, 0, 0))
    with os.fdopen(theirs, "w", encoding="utf-8") as stream:
        handler = logging.StreamHandler(stream)
        logging.getLogger().addHandler(handler)
        yield ours, stream
        logging.getLogger().removeHandler(handler)
    os.close(ours)


def screen(descriptor: int, end: str) -> list[str]:
    """Lines as a person sees them, up to this end: a terminal may hand over what was written in pieces."""
    written = b""
    while not written.endswith(end.encode()):
        written += os.read(descriptor, 65_536)
    return [line.rpartition(CLEAR)[2] for line in written.decode().replace("\r\n", "\n").split("\n")]


def test_logs_stand_above_the_line_which_is_cut_and_gone_at_the_end(terminal, monkeypatch):
    ours, stream = terminal
    monkeypatch.setattr(sys, "stderr", stream)
    with status_line() as line:
        line.show("loader-1  +-0.80 m")
        logging.getLogger("x").warning("a wheel slips")
        sys.stderr.write("half")
        print(" a line", file=sys.stderr)
        line.show("loader-1\x1b[31m " + 40 * "long ")
        (*logged, last) = screen(ours, "…")
        assert logged == ["a wheel slips", "half a line"]
        assert len(last) == COLUMNS - 1
        assert last.startswith("loader-1 [31m long")
        assert last.endswith("…")
    assert screen(ours, CLEAR) == [""]
    assert sys.stderr is stream
    logging.getLogger("x").warning("afterwards")
    assert screen(ours, "\n") == ["afterwards", ""]


def test_a_terminal_that_was_closed_ends_nothing(monkeypatch):
    ours, theirs = os.openpty()
    with os.fdopen(theirs, "w", encoding="utf-8") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        with status_line() as line:
            os.close(ours)
            line.show("loader-1")


def test_a_status_is_an_event_when_it_changes_and_now_and_then():
    now_s = 0.0
    due = Due(lambda: now_s)
    assert [due.is_due("a"), due.is_due("a"), due.is_due("b"), due.is_due("b")] == [True, False, True, False]
    now_s = EVERY_S
    assert [due.is_due("b"), due.is_due("b")] == [True, False]
