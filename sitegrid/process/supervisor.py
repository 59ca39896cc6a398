"""What systemd is told of a process (sd_notify(3), `Type=notify`): that it is ready, and that its main loop turns.

A unit with `WatchdogSec=` restarts a process whose loop has stopped. Elsewhere nothing is told.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from typing import Any

from sitegrid.process.lifetime import say

BEAT_S = 1.0  # between two signs of life; config/systemd/ allows 60 s
READY, ALIVE = "READY=1", "WATCHDOG=1"


def say_ready(table: Mapping[str, Any]) -> None:
    """Print that the process works, as a JSON line, and tell its supervisor."""
    say(table)
    notify(READY)


def turns(stop: threading.Event, pause_s: float = 0.5, lives: Callable[[], bool] = lambda: True) -> Iterator[None]:
    """Turns of a main loop until the process is asked to end.

    lives: whether the work of other threads goes on; where it does not, nothing is told, and the watchdog restarts it.
    """
    is_stopped = until(stop, lives)
    while not (stop.wait(pause_s) or is_stopped()):
        yield


def until(stop: threading.Event, lives: Callable[[], bool] = lambda: True) -> Callable[[], bool]:
    """Whether the process is to end, for a loop of its own that asks at each turn."""
    due_s = time.monotonic()

    def is_stopped() -> bool:
        nonlocal due_s
        if time.monotonic() >= due_s and lives():
            due_s = time.monotonic() + BEAT_S
            notify(ALIVE)
        return stop.is_set()

    return is_stopped


def notify(state: str) -> None:
    """Tell the supervisor, where there is one that listens."""
    if not (path := os.environ.get("NOTIFY_SOCKET")):
        return
    address = f"\0{path[1:]}" if path.startswith("@") else path
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.setblocking(False)
        sender.sendto(state.encode(), address)
