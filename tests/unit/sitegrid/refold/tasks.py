"""Tasks for engines: who does them is another process, which finds them by the name of this module."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from protocol.errors import StoreError


def square(number: int) -> tuple[int, int]:
    return number * number, os.getpid()


def die_once(marker: Path) -> int:
    """Be killed, but for the second time."""
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
