"""Numba's compilation of kernels, said when it happens: at the first start in a new folder, or of another version."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from sitegrid.process.lifetime import say
from sitegrid.process.progress import EVERY_S

COMPILING = "first start: compiling kernels, about a minute"


@contextmanager
def compilation_reported() -> Iterator[None]:
    """Print `{"compiling": n}`, the number of kernels so far, for the first and then every EVERY_S."""
    from numba.core.event import Event, Listener, install_listener

    class Counter(Listener):
        count, next_s = 0, 0.0

        def on_start(self, _: Event) -> None:
            self.count += 1
            if time.monotonic() >= self.next_s:
                self.next_s = time.monotonic() + EVERY_S
                say({"compiling": self.count, **({"note": COMPILING} if self.count == 1 else {})})

        def on_end(self, _: Event) -> None: ...

    with install_listener("numba:compile", Counter()):
        yield
