"""The lock of a store's folder: one server on this host has it open."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from protocol.errors import StoreError

LOCK_FILE = "lock"


@contextmanager
def hold(folder: Path) -> Iterator[None]:
    """Keep a second server off the folder: each would take the samples that the other has. A crash releases it."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK_FILE).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            problem = "another server is using this store; stop it, or choose another --store"
            raise StoreError(folder, problem) from None
        yield
