"""How long a test waits for what has to come: it stops a hang, and judges nothing.

Long enough for a machine that does much else. Nobody waits so long in a test that passes.
"""

from __future__ import annotations

from collections.abc import Callable

from sitegrid.process.children import wait_until

PATIENCE_S = 300.0


def until(is_so: Callable[[], object], what: str) -> None:
    """Wait until something holds; a ProcessError with `what` if it never does."""
    wait_until(lambda: bool(is_so()), PATIENCE_S, what)
