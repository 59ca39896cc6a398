"""`python -m tests.chaos.stepped_clock FILE ...`: `sitegrid ...` with a clock off by FILE's nanoseconds.

Only the wall clock is stepped; monotonic clocks and waits continue (`faketime` breaks both). Replayed readings are
stamped by the machine's stepped clock.
"""

from __future__ import annotations

import struct
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from mmap import ACCESS_READ, mmap
from pathlib import Path

from agents.drivers.replay import Replay
from protocol.machine.readings import Reading

OFF = struct.Struct("<q")


def write(path: Path, off_ns: int) -> None:
    """Step the clock of all processes under a file."""
    with path.open("r+b" if path.exists() else "wb") as file:
        file.write(OFF.pack(off_ns))


def _step_clocks(path: Path) -> None:
    with path.open("rb") as file:
        off = mmap(file.fileno(), OFF.size, access=ACCESS_READ)
    true_ns, true_read = time.time_ns, Replay.read

    def off_ns() -> int:
        return int(OFF.unpack_from(off)[0])

    def read(self: Replay, timeout_s: float) -> Sequence[Reading] | None:
        readings = true_read(self, timeout_s)
        return readings and [replace(reading, stamp_ns=reading.stamp_ns + off_ns()) for reading in readings]

    time.time_ns = lambda: true_ns() + off_ns()
    time.time = lambda: time.time_ns() * 1e-9
    Replay.read = read  # type: ignore[method-assign]


if __name__ == "__main__":
    _step_clocks(Path(sys.argv[1]))
    from sitegrid.cli import main  # after stepping the clocks

    sys.exit(main(sys.argv[2:]))
