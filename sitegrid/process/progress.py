"""Progress of a long run: a bar on a terminal, which moves without news too; elsewhere a plain line now and then.

Numba's compilation of kernels is said when it happens: at the first start in a new folder, or of another version.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sitegrid.process.lifetime import note, say

EVERY_S = 5.0  # between two plain lines
COMPILING = "first start: kernels compile for about a minute"


class Display:
    """Progress of a run; use it as a context. title: what goes on.

    kept: where what is done is kept, if the same command goes on with it; who interrupts is told.
    """

    def __init__(self, title: str, *, headless: bool, kept: Path | None = None) -> None:
        self._kept = kept
        self._bar: Any = None
        self._task: Any = None
        self._next_s = 0.0
        if not headless and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

            columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[what]}"))
            times = (TimeElapsedColumn(), TimeRemainingColumn())
            self._bar = Progress(*columns, *times, console=Console(stderr=True))
            self._task = self._bar.add_task(title, total=None, what="")

    def begin(self, title: str, what: str = "") -> None:
        """Go on with something else, of which nobody knows how long it takes."""
        if self._bar:
            self._bar.remove_task(self._task)
            self._task = self._bar.add_task(title, total=None, what=what)
        else:
            note(f"{title}, {what}" if what else title)

    def show(self, done_s: float, total_s: float, what: str) -> None:
        """Show how many simulated seconds are done, and what there is to say."""
        if self._bar:
            with suppress(OSError):  # a terminal that was closed ends no work
                self._bar.update(self._task, completed=done_s, total=total_s or None, what=what)
        elif time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + EVERY_S
            note(f"{done_s:5.0f} of {total_s:g} s, {what}")

    def __enter__(self) -> Display:
        if self._bar:
            self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._bar:
            with suppress(OSError):
                if not self._bar.tasks[0].total:  # else a bar without an end would stay on the screen
                    self._bar.update(self._task, visible=False)
                self._bar.stop()
        if self._kept and kind is KeyboardInterrupt:
            note(f"interrupted; what is done is kept in {self._kept}, and the same command goes on with it")


@contextmanager
def compilation_reported() -> Iterator[None]:
    """Print `{"compiling": n, "kernel": name}` at the first kernel, then every EVERY_S while any compiles.

    n: kernels so far. So one that takes minutes on a busy host does not look like a hung process.
    """
    from numba.core.event import Event, Listener, install_listener

    class Reporter(Listener):
        count, thread = 0, threading.Thread()
        open: tuple[str, ...] = ()  # kernels that compile, the innermost last

        def on_start(self, event: Event) -> None:
            self.count += 1
            self.open = (*self.open, event.data["dispatcher"].py_func.__qualname__)
            if not self.thread.is_alive():
                more = {"note": COMPILING} if self.count == 1 else {}
                say({"compiling": self.count, "kernel": self.open[-1], **more})
                self.thread = threading.Thread(target=self.repeat, name="kernels reported", daemon=True)
                self.thread.start()

        def on_end(self, _: Event) -> None:
            self.open = self.open[:-1]

        def repeat(self) -> None:
            time.sleep(EVERY_S)
            while kernels := self.open:
                say({"compiling": self.count, "kernel": kernels[-1]})
                time.sleep(EVERY_S)

    with install_listener("numba:compile", Reporter()):
        yield


@contextmanager
def done_beside(parts: Iterable[object]) -> Iterator[None]:
    """Have the parts of some work done on a thread of its own; the end waits for the part that is being done."""
    ending = threading.Event()

    def work() -> None:
        for _ in parts:
            if ending.is_set():
                return

    thread = threading.Thread(target=work, name="kernels", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ending.set()
        thread.join()
