"""The life of a command's process: a stop flag that signals set, an end in time, and lines for people and programs."""

from __future__ import annotations

import ctypes
import json
import logging
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, is_dataclass
from typing import Any

from sitegrid.process import streams

END_S = 2.5  # from the signal to the end of the process
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
LARGE_BYTES = 2**20  # a block of memory that is worth a system call
_MMAP_THRESHOLD = -3  # M_MMAP_THRESHOLD of malloc.h
log = logging.getLogger("sitegrid.process.lifetime")


def stop_flag(end_s: float | None = END_S) -> threading.Event:
    """Return an event that SIGNALS set. Wait on it with a time-out only: Python may lose SIGTERM otherwise.

    The process ends end_s after the signal, whatever it is doing then; None lets it take its time. No sample is lost at
    any moment: samples are acknowledged after their commit, and deleted after their acknowledgement. SIGHUP, a terminal
    that was closed, stays ignored where `nohup` has it ignored.
    """
    stop = threading.Event()

    def on_signal(*_: object) -> None:
        """Nothing: the thread that watches receives the signal, too."""

    _handle(on_signal)
    _watch_signals(stop, on_signal, end_s)
    return stop


def raise_interrupts() -> None:
    """Have the first of SIGNALS raise KeyboardInterrupt, for a command that tidies up then; the second ends it."""

    def on_signal(*_: object) -> None:
        _handle(signal.SIG_DFL)
        raise KeyboardInterrupt

    _handle(on_signal)


def _handle(handler: Callable[..., None] | signal.Handlers) -> None:
    for number in SIGNALS:
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


def _watch_signals(stop: threading.Event, handler: Callable[..., None], end_s: float | None) -> None:
    """Log a signal, set the event and end the process in time, from a thread that receives signals by itself.

    Python runs signal handlers on the main thread, and not while that waits inside Zenoh: for a router, for a reply or
    for a slow subscriber, up to 30 s. The wake-up descriptor is written to at once (signal.set_wakeup_fd).
    """
    signals, woken = socket.socketpair()
    woken.setblocking(False)
    signal.set_wakeup_fd(woken.fileno(), warn_on_full_buffer=False)

    def watch(_: socket.socket) -> None:  # holds the other end open for as long as the process runs
        while True:
            if (number := signals.recv(1)[0]) not in SIGNALS:
                continue
            if number == signal.SIGHUP:  # what nobody asked for: a supervisor sends SIGTERM
                _log_or_not(log.warning, "ending: the terminal was closed (nohup keeps it) signal=%s", "SIGHUP")
            else:
                _log_or_not(log.info, "ending signal=%s", signal.Signals(number).name)
            stop.set()
            if end_s is None:
                continue
            time.sleep(end_s)
            if signal.getsignal(signal.SIGTERM) is handler:  # not where a test goes on
                _log_or_not(log.warning, "ended in mid-work seconds=%g", end_s)
                os._exit(0)

    threading.Thread(target=watch, args=(woken,), name="signals", daemon=True).start()


def end_in_time(code: int, end_s: float = END_S) -> None:
    """End the process with this exit code within end_s, whatever it is doing then."""

    def end() -> None:
        time.sleep(end_s)
        _log_or_not(log.warning, "ended in mid-work seconds=%g", end_s)
        os._exit(code)

    threading.Thread(target=end, name="end", daemon=True).start()


def _log_or_not(write: Callable[..., None], *event: object) -> None:
    """Log from a thread that is not waited for: standard error may be a pipe that nobody empties."""
    thread = threading.Thread(target=write, args=event, daemon=True)
    thread.start()
    thread.join(0.2)


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
    streams.write_out(json.dumps(table, allow_nan=False))


def tell(*lines: object) -> None:
    """Print lines for people on standard output, at once."""
    streams.write_out("\n".join(map(str, lines)))


def note(line: str) -> None:
    """Print a line for people on standard error, so that standard output stays for results."""
    streams.write_error(line)


def plain(value: Any) -> Any:
    """Records as tables, and NaN, which JSON does not know, as None."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, Mapping):
        return {key: plain(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return None if isinstance(value, float) and value != value else value
