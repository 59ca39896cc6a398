"""Locks of folders: one server per store and host, one process per new folder."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from protocol.errors import ConfigError, StoreError
from protocol.files import make_private

LOCK_FILE = "lock"


def is_in_use(folder: Path) -> bool:
    """Whether a server has a store open."""
    try:
        with (folder / LOCK_FILE).open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except BlockingIOError:
        return True
    return False


@contextmanager
def hold(folder: Path) -> Iterator[None]:
    """Keep a second server out: each would lack the other's samples. A crash releases the lock."""
    folder.mkdir(parents=True, exist_ok=True)
    make_private(folder / LOCK_FILE)
    with (folder / LOCK_FILE).open("w") as file:
        if not _taken(file):
            raise StoreError(folder, "another server is using this store; stop it, or choose another --store")
        yield


@contextmanager
def hold_place(folder: Path) -> Iterator[None]:
    """Keep others from creating the same folder, by a lock beside it.

    ConfigError if one does; StoreError if it cannot be written.
    """
    path = folder.with_name(f".{folder.name}.lock")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        make_private(path)
        file = path.open("w")
    except OSError as error:
        raise StoreError(folder, f"cannot be written: {error.strerror or error}") from None
    with file:
        # a process that just ended has unlinked its file, whose lock excludes nobody
        if not _taken(file) or not _is_still(file, path):
            raise ConfigError(folder, "another process is at work there; wait for it, or choose another --out")
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def _taken(file: TextIO) -> bool:
    """Try to lock a file."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _is_still(file: TextIO, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False
