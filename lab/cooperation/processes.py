"""Our own commands as child processes: started, the JSON lines that they print read, and always ended."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from lab.campaign.workers import ONE_THREAD
from protocol.errors import SitegridError

END_S = 10.0  # after SIGTERM; then it is killed


class Process:
    """One `sitegrid` process. seen_s: when it printed its keys first, by the wall clock."""

    def __init__(self, name: str, words: list[str], log: Path) -> None:
        self.name = name
        self.seen_s: dict[str, float] = {}
        self._log = log
        self._lines: dict[str, Any] = {}
        self._new = threading.Condition()
        self._is_silent = False  # whether it will print no more
        with log.open("ab") as errors:
            self._process = subprocess.Popen(  # noqa: S603 - our own command, no shell
                [sys.executable, "-m", "sitegrid.cli", *words],
                cwd=Path(__file__).parents[2],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=errors,
                start_new_session=True,  # Ctrl-C reaches the parent alone, which ends its children in order
                env={**os.environ, **ONE_THREAD, "PYTHONUNBUFFERED": "1"},
            )
        self.pid = self._process.pid
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def expect(self, key: str, timeout_s: float) -> Any:
        """What it printed under a key; SitegridError where it ends, or the time is up, before."""
        with self._new:
            self._new.wait_for(lambda: key in self._lines or self._is_silent, timeout_s)
            if key in self._lines:
                return self._lines[key]
        if self._is_silent:  # it has closed its end of the pipe, and is about to be gone
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(END_S)
        ended = self._process.poll()
        last = self._log.read_text(errors="replace").strip().rpartition("\n")[2]
        what = f"ended with {ended}" if ended is not None else f"still runs after {timeout_s:g} s"
        raise SitegridError(f"{self.name}: {what} and has not printed `{key}`; its last word: {last[:200]!r}")

    def stop(self) -> None:
        """End it: SIGTERM, then SIGKILL."""
        self._process.terminate()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join()
        assert self._process.stdout is not None
        self._process.stdout.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            try:
                table = json.loads(line)
            except ValueError:
                continue
            if isinstance(table, Mapping):
                with self._new:
                    self.seen_s = dict.fromkeys(table, time.time()) | self.seen_s
                    self._lines.update(table)
                    self._new.notify_all()
        with self._new:
            self._is_silent = True
            self._new.notify_all()


class Processes(ExitStack):
    """All processes of a run, and their logs in a folder; leaving the block ends them, the youngest first."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder
        self.all: dict[str, Process] = {}

    def start(self, name: str, *words: object) -> Process:
        """Start `sitegrid <words>`."""
        process = Process(name, [str(word) for word in words], self._folder / f"{name}.log")
        self.callback(process.stop)
        self.all[name] = process
        return process
