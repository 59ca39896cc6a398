"""Timeout of waits in tests: stops hangs on busy hosts, judges nothing; passing tests never reach it."""

from __future__ import annotations

from collections.abc import Callable

from sitegrid.process.children import wait_until

PATIENCE_S = 300.0


def until(is_so: Callable[[], object], what: str) -> None:
    """Wait for a condition; ProcessError with `what` on timeout."""
    wait_until(lambda: bool(is_so()), PATIENCE_S, what)
