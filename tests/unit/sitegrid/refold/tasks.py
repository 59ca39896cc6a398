"""Tasks for engines, found by this module's name in other processes."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from protocol.errors import StoreError


def square(number: int) -> tuple[int, int]:
    return number * number, os.getpid()


def die_once(marker: Path) -> int:
    """Die the first time."""
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()


def die(_: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def hang(_: int) -> None:
    time.sleep(1000)


def fail(number: int) -> int:
    raise StoreError("/a/file", f"is damaged {number}")
