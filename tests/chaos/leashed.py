"""A child process that ends with the suite, however that ends."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

END_S = 10.0  # after SIGTERM, before SIGKILL
# The kernel kills the children of a killed suite.
LEASH = ("setpriv", "--pdeathsig", "KILL") if shutil.which("setpriv") else ()


class Process:
    """One child with output files."""

    def __init__(self, log: Path, command: Sequence[str], env: Mapping[str, str]) -> None:
        self.log = log
        with log.with_suffix(".out").open("wb") as out, log.with_suffix(".err").open("wb") as errors:
            self._process = subprocess.Popen(
                [*LEASH, *command],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=errors,
                start_new_session=True,
                env={**os.environ, "OMP_NUM_THREADS": "1", **env},
            )
        self.pid = self._process.pid

    @property
    def code(self) -> int | None:
        """Exit code, None while running."""
        return self._process.poll()

    def send(self, number: signal.Signals) -> None:
        if self.code is None:
            self._process.send_signal(number)

    def said(self, key: str) -> bool:
        return f'"{key}":' in self.log.with_suffix(".out").read_text(encoding="utf-8")

    def line(self, key: str) -> Any:
        """Value of the line printed with this key, or None."""
        lines = self.log.with_suffix(".out").read_text(encoding="utf-8").splitlines()
        return next((json.loads(line)[key] for line in lines if line.startswith(f'{{"{key}":')), None)

    def last_words(self) -> str:
        """Last line on standard error."""
        lines = self.log.with_suffix(".err").read_text(encoding="utf-8", errors="replace").splitlines()
        return lines[-1][:300] if lines else ""

    def end(self, *numbers: signal.Signals) -> int:
        """End it by signals, finally SIGKILL; returns the exit code."""
        for number in numbers:
            self.send(number)
        try:
            return self._process.wait(END_S if numbers else 0.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()
