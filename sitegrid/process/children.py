"""Child processes: started, their JSON lines read, and always ended."""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from protocol.errors import SitegridError

END_S = 8.0  # after SIGTERM; then it is killed
END_BYTES = 4096  # of a log, where its last line is
Meanwhile = Callable[[dict[str, Any]], None]


class ProcessError(SitegridError):
    """A child process did not do what it should."""

    def __init__(self, name: str, problem: str) -> None:
        super().__init__(f"{name}: {problem}")


class Child:
    """One `sitegrid` process and the JSON lines that it prints."""

    def __init__(
        self, name: str, words: list[str], errors: Path | None = None, meanwhile: Meanwhile = lambda _: None
    ) -> None:
        self.name, self._meanwhile = name, meanwhile
        self._errors = errors.open("ab") if errors else None
        self._process = self._started(words)
        self.pid = self._process.pid
        self._lines: queue.Queue[dict[str, Any]] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _started(self, words: list[str]) -> subprocess.Popen[bytes]:
        return subprocess.Popen(  # noqa: S603 - our own command, no shell
            [sys.executable, "-m", "sitegrid.cli", *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            start_new_session=True,  # Ctrl-C reaches the parent alone, which ends its children in order
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
        )

    @property
    def code(self) -> int | None:
        """Exit code, None while it runs."""
        return self._process.poll()

    def lines(self) -> list[dict[str, Any]]:
        """JSON lines that have come in since the last call."""
        return [self._lines.get_nowait() for _ in range(self._lines.qsize())]  # this thread alone takes them

    def expect(self, key: str, silent_s: float) -> dict[str, Any]:
        """Wait for a line that has `key`, as long as others come; ProcessError if the process ends, or says nothing."""
        end_s = time.monotonic() + silent_s
        while (left_s := end_s - time.monotonic()) > 0:
            line = self._line(min(left_s, 0.1))
            if key in line:
                return line
            if line:
                end_s = time.monotonic() + silent_s
            elif self.code is not None and self._lines.empty() and not self._reader.is_alive():
                see = f"; see {self._errors.name}" if self._errors else ""
                raise ProcessError(self.name, f"ended with {self.code} instead of printing `{key}`{see}")
            self._meanwhile(line)
        raise ProcessError(self.name, f"did not print `{key}` within {silent_s:g} s")

    def last_words(self) -> str:
        """What it logged last, as its error; empty where it logged nothing."""
        lines = Path(self._errors.name).read_bytes()[-END_BYTES:].splitlines() if self._errors else []
        last = lines[-1].decode(errors="replace") if lines else ""
        try:
            table = json.loads(last)
        except ValueError:
            return last
        return str(table.get("error") or table.get("event") or last) if isinstance(table, dict) else last

    def send(self, number: signal.Signals) -> None:
        """Send a signal, if it still runs."""
        if self.code is None:
            self._process.send_signal(number)

    def wait(self, timeout_s: float) -> int:
        """Wait for the end; returns the exit code."""
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise ProcessError(self.name, f"has not ended within {timeout_s:g} s") from None

    def stop(self) -> int:
        """End it: SIGTERM, then SIGKILL; returns the exit code."""
        self.send(signal.SIGTERM)
        try:
            code = self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            code = self._process.wait()
        self._reader.join()
        if self._process.stdout:
            self._process.stdout.close()
        if self._errors:
            self._errors.close()
        return code

    def _line(self, wait_s: float) -> dict[str, Any]:
        """The next line, empty if none comes in time."""
        try:
            return self._lines.get(timeout=wait_s)
        except queue.Empty:
            return {}

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            try:
                table = json.loads(line)
            except ValueError:
                continue
            if isinstance(table, dict):
                self._lines.put(table)


class Children(ExitStack):
    """All children of a run; leaving the block ends them, the youngest first.

    meanwhile: is called ten times a second while a line is waited for, with another one that came in or with nothing.
    """

    child: type[Child] = Child

    def __init__(self, log_folder: Path | None = None, meanwhile: Meanwhile = lambda _: None) -> None:
        super().__init__()
        self._log_folder, self._meanwhile = log_folder, meanwhile

    def start(self, name: str, *words: str | Path | float) -> Child:
        """Start `sitegrid <words>`."""
        errors = self._log_folder / f"{name}.log" if self._log_folder else None
        child = self.child(name, [str(word) for word in words], errors, self._meanwhile)
        self.callback(child.stop)
        return child


def wait_until(is_so: Callable[[], bool], timeout_s: float, what: str) -> None:
    """Poll a condition until it holds; ProcessError with `what` if it does not in time."""
    end_s = time.monotonic() + timeout_s
    while not is_so():
        if time.monotonic() >= end_s:
            raise ProcessError(what, f"has not come true within {timeout_s:g} s")
        time.sleep(0.02)
