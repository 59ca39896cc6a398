"""Files that are whole or not there: written beside their place, synced, then given their name."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def whole_file(path: Path, permissions: int = 0o666) -> Iterator[BinaryIO]:
    """Open a binary file for reading and writing that replaces `path` when the block ends without an error.

    A reader sees the old file or the new one, never half of it, also after a power cut. The file beside it has a name
    of its own for every writer (`.NAME.*.part`); what a killed writer left is removed by the next one.

    permissions: of the new file, before the umask. Raises OSError.
    """
    for left in path.parent.glob(f".{path.name}.*.part"):
        if not _is_running(left):
            left.unlink(missing_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}.part")
    try:
        with open(part, "x+b", opener=lambda name, flags: os.open(name, flags, permissions)) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    sync_folder(path.parent)


def write_whole(path: Path, data: bytes, permissions: int = 0o666) -> None:
    """Write a file whole or not at all; raises OSError."""
    with whole_file(path, permissions) as file:
        file.write(data)


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable; raises OSError."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _is_running(part: Path) -> bool:
    """Whether the process that writes this file is alive; its number is the last but two of the name's parts."""
    try:
        os.kill(int(part.name.split(".")[-3]), 0)
    except ProcessLookupError:
        return False
    except (PermissionError, ValueError):
        return True
    return True
