"""Locks of folders: one server on this host has a store open, and one process makes a folder at a place."""

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
    """Keep a second server off the folder: each would take the samples that the other has. A crash releases it."""
    folder.mkdir(parents=True, exist_ok=True)
    make_private(folder / LOCK_FILE)
    with (folder / LOCK_FILE).open("w") as file:
        if not _taken(file):
            raise StoreError(folder, "another server is using this store; stop it, or choose another --store")
        yield


@contextmanager
def hold_place(folder: Path) -> Iterator[None]:
    """Keep a second process from making a folder at the same place: its lock lies beside that, and goes away after it.

    ConfigError where another one does; StoreError where none can be made there.
    """
    path = folder.with_name(f".{folder.name}.lock")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        make_private(path)
        file = path.open("w")
    except OSError as error:
        raise StoreError(folder, f"cannot be written: {error.strerror or error}") from None
    with file:
        # One that has just ended has removed its file: a lock of that keeps nobody off.
        if not _taken(file) or not _is_still(file, path):
            raise ConfigError(folder, "another process is at work there; wait for it, or choose another --out")
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def _taken(file: TextIO) -> bool:
    """Whether this process has the lock of a file now."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _is_still(file: TextIO, path: Path) -> bool:
    """Whether this is the file of that name."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False
