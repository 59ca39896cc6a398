"""Timeout of waits in tests: stops hangs on busy hosts, judges nothing; passing tests never reach it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from sitegrid.process.children import wait_until

PATIENCE_S = 300.0


def until(is_so: Callable[[], object], what: str, progress: Callable[[], object] = lambda: None) -> None:
    """Wait for a condition; ProcessError with `what` on timeout, which starts anew whenever `progress` changes."""
    holds = False

    def looks(before: object) -> bool:
        nonlocal holds
        holds = bool(is_so())
        return holds or progress() != before

    while not holds:
        wait_until(partial(looks, progress()), PATIENCE_S, what)
