"""The LD_PRELOAD shim (disk_shim.c): building and control."""

from __future__ import annotations

import errno
import os
import shutil
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum
from pathlib import Path

_CONTROL = struct.Struct("<iii")
_ALL = 2**31 - 1


class DiskError(IntEnum):
    """Failure modes."""

    FULL = errno.ENOSPC
    BROKEN = errno.EIO


def build(folder: Path) -> Path | None:
    """Compile the shim; None without a C compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if not compiler:
        return None
    library = folder / "disk_shim.so"
    source = Path(__file__).with_name("disk_shim.c")
    words = [compiler, "-O1", "-shared", "-fPIC", "-o", str(library), str(source), "-ldl", "-lpthread"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    return None if done.returncode else library


class FailingDisk:
    """Files below one folder, for processes started with `env`."""

    def __init__(self, library: Path, folder: Path, control: Path) -> None:
        self._control = control
        self.set(0)
        self.env = {"LD_PRELOAD": str(library), "CHAOS_DISK": str(folder), "CHAOS_FAULT": str(control)}

    def set(self, error: int, *, after: int = 0, times: int = _ALL) -> None:
        """Make writes fail; after: successes first, times: number of failures."""
        with self._control.open("r+b" if self._control.exists() else "wb") as file:
            os.pwrite(file.fileno(), _CONTROL.pack(error, after, times), 0)

    @property
    def left(self) -> int:
        """Requested failures still to come."""
        return int(_CONTROL.unpack(self._control.read_bytes())[2])

    @property
    def failed(self) -> int:
        """Failures since the last unbounded `set`."""
        return _ALL - self.left

    @contextmanager
    def failing(self, error: DiskError) -> Iterator[None]:
        """All writes fail inside the block."""
        self.set(error)
        try:
            yield
        finally:
            self.set(0)
