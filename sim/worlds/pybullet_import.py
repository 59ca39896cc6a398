"""PyBullet, imported without the line about its build that it writes to standard error."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Send what libraries write to standard error, past Python, nowhere."""
    try:
        saved = os.dup(2)
    except OSError:  # standard error is closed: nothing to hide
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(nowhere)


with _quiet():
    import pybullet

__all__ = ["pybullet"]
