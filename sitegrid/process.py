"""What every long-running sub-command needs: a stop flag that signals set, a ready line, and an end that is clean."""

from __future__ import annotations

import json
import signal
import sys
import threading
from collections.abc import Mapping
from typing import Any


def stop_flag() -> threading.Event:
    """Return an event that SIGINT and SIGTERM set. Wait on it with a time-out only (EVIDENCE: else SIGTERM is lost)."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop


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
    """Replace NaN, which JSON does not know, by None."""
    if isinstance(value, Mapping):
        return {key: plain(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return None if isinstance(value, float) and value != value else value
