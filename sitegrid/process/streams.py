"""Standard output and standard error: whole lines, written at once; and reports as text.

Neither a reader that has left (`sitegrid query info | head -1`) nor a full disk behind `>` stops the work: what cannot
be written is dropped, and the door says so at the end. A reader that left has what it wanted: that is no error.
"""

from __future__ import annotations

import errno
import os
import stat
import sys
from collections.abc import Mapping, Sequence
from typing import Any, TextIO

_problems: list[str] = []  # of standard output; empty ones where nobody reads any more
Report = dict[str, Any]
MOST_COLUMNS = 24  # of a table; one with more is turned, its rows side by side
SHOWN = (list, dict)  # values of a row that a table for people has no room for


def complete() -> None:
    """Open what the caller closed (`2>&-`), on nothing: else a database became file 1 or 2, where Zenoh may write."""
    _problems.clear()
    while (descriptor := os.open(os.devnull, os.O_RDWR)) < 3:
        pass
    os.close(descriptor)
    for name, number in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "w", encoding="utf-8", closefd=False))  # noqa: SIM115 - until the end


def write_out(text: str) -> None:
    """Write lines to standard output."""
    write(sys.stdout, f"{text}\n")


def write_error(text: str) -> None:
    """Write lines to standard error."""
    write(sys.stderr, f"{text}\n")


def flush() -> None:
    """Write what others, as argparse, have left in the buffers."""
    for stream in (sys.stdout, sys.stderr):
        write(stream, "")


def is_open() -> bool:
    """Whether standard output could be written so far."""
    return not _problems


def problem() -> str:
    """Why standard output could not be written; nothing if it could, or if its reader has left."""
    return next(filter(None, _problems), "")


def write(stream: TextIO, text: str) -> None:
    """Write at once, as it is."""
    try:
        stream.write(text)
        stream.flush()
    except OSError as error:
        if stream is sys.stdout:
            _problems.append("" if _is_left(stream, error) else error.strerror or str(error))
        _mute(stream)


def _is_left(stream: TextIO, error: OSError) -> bool:
    """Whether nobody reads any more: the other end of a pipe was closed, or the terminal."""
    if error.errno != errno.EIO:
        return isinstance(error, BrokenPipeError)
    return stat.S_ISCHR(os.fstat(stream.fileno()).st_mode)


def _mute(stream: TextIO) -> None:
    """Have the stream write to nothing from now on: Python itself flushes it once more, at the end."""
    try:
        descriptor = os.open(os.devnull, os.O_WRONLY)
        os.dup2(descriptor, stream.fileno())
        os.close(descriptor)
        stream.flush()
    except (OSError, ValueError):  # no file, as in a test
        pass


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows under their names, numbers to the right; what is not known is a dash."""
    lines = [list(rows[0]), *(["-" if value is None else str(value) for value in row.values()] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(w.rjust(width) for w, width in zip(line, widths, strict=True)) for line in lines)


def lines(report: Report) -> list[str]:
    """For people: values on a line of their own, rows as tables."""
    shown_lines = []
    for name, value in report.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            shown = [k for k in value[0] if not any(isinstance(row[k], SHOWN) for row in value)]
            rows = [{k: row[k] for k in shown} for row in value]
            shown_lines.append(table(_turned(rows) if len(rows[0]) > MOST_COLUMNS else rows))
        elif value not in ([], {}):
            shown_lines.append(f"{name}: {', '.join(map(str, value)) if isinstance(value, list) else value}")
    return shown_lines


def _turned(rows: Sequence[Report]) -> list[Report]:
    """Rows as columns, under their first values."""
    named = {f"{next(iter(row.values()))} {list(row.values())[1]}": row for row in rows}
    return [{"": name, **{title: row[name] for title, row in named.items()}} for name in list(rows[0])[2:]]
