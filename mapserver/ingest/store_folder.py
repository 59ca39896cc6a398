"""The lock of a store's folder: one server on this host has it open."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from protocol.errors import StoreError
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
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            problem = "another server is using this store; stop it, or choose another --store"
            raise StoreError(folder, problem) from None
        yield
