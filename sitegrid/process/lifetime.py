"""The life of a command's process: a stop flag that signals set, an end in time, and lines for people and programs."""

from __future__ import annotations

import ctypes
import json
import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, is_dataclass
from typing import Any

END_S = 2.5  # from the signal to the end of the process
LARGE_BYTES = 2**20  # a block of memory that is worth a system call
_MMAP_THRESHOLD = -3  # M_MMAP_THRESHOLD of malloc.h
log = logging.getLogger("sitegrid.process.lifetime")


def stop_flag(end_s: float | None = END_S) -> threading.Event:
    """Return an event that SIGINT and SIGTERM set. Wait on it with a time-out only: Python may lose SIGTERM otherwise.

    The process ends end_s after the signal, whatever it is doing then; None lets it take its time. No sample is lost at
    any moment: samples are acknowledged after their commit, and deleted after their acknowledgement.
    """
    stop = threading.Event()

    def on_signal(*_: object) -> None:
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    if end_s is not None:
        _end_in_time(stop, on_signal, end_s)
    return stop


def _end_in_time(stop: threading.Event, handler: Callable[..., None], end_s: float) -> None:
    """End the process in time, from a thread that receives signals by itself.

    Python runs signal handlers on the main thread, and not while that waits inside Zenoh: for a router, for a reply or
    for a slow subscriber, up to 30 s. The wake-up descriptor is written to at once (signal.set_wakeup_fd).
    """
    signals, woken = socket.socketpair()
    woken.setblocking(False)
    signal.set_wakeup_fd(woken.fileno(), warn_on_full_buffer=False)

    def watch(_: socket.socket) -> None:  # holds the other end open for as long as the process runs
        while True:
            if signals.recv(1)[0] not in (signal.SIGINT, signal.SIGTERM):
                continue
            stop.set()
            time.sleep(end_s)
            if signal.getsignal(signal.SIGTERM) is handler:  # not where a test goes on
                _end_now(end_s)

    threading.Thread(target=watch, args=(woken,), name="signals", daemon=True).start()


def _end_now(after_s: float) -> None:
    """End the process; a thread logs it, since standard error may be a pipe that nobody empties."""
    warning = threading.Thread(target=log.warning, args=("ended in mid-work seconds=%g", after_s), daemon=True)
    warning.start()
    warning.join(0.2)
    os._exit(0)


def return_large_blocks() -> bool:
    """Make the C library return large blocks to the system when they are freed; False where it cannot.

    glibc raises its threshold for that up to 32 MB when large blocks are freed, and keeps smaller ones: the arrays of
    each query would stay in resident memory, a few more of them every hour.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    return bool(mallopt and mallopt(_MMAP_THRESHOLD, LARGE_BYTES))


def wait(stop: threading.Event) -> None:
    """Wait until the process is asked to end."""
    while not stop.wait(0.5):
        pass


def say(table: Mapping[str, Any]) -> None:
    """Print one JSON object as a line, at once: other processes read it."""
    print(json.dumps(table, allow_nan=False), flush=True)


def note(line: str) -> None:
    """Print a line for people on standard error, so that standard output stays for results."""
    print(line, file=sys.stderr, flush=True)


def plain(value: Any) -> Any:
    """Records as tables, and NaN, which JSON does not know, as None."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, Mapping):
        return {key: plain(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return None if isinstance(value, float) and value != value else value
