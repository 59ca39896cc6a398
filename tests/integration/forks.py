"""Site processes forked from a server with loaded libraries.

A tenth of the CPU time per start; kills, signals, exit codes and files are real. Tests of loading start real commands.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from pathlib import Path
from typing import IO, Any

from sitegrid.process.children import Child, Children

LOADED = (
    "agents.agent",
    "agents.drivers.zenoh",
    "mapserver.follower.follower",
    "mapserver.monitoring.metrics",
    "mapserver.server",
    "sim.simulator",
    "sitegrid.command_line",
    "sitegrid.web.process",
)
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload([__name__, *LOADED])


class Fork:
    """`sitegrid <words>`, with the part of subprocess.Popen that Child uses."""

    def __init__(self, words: list[str], errors: IO[bytes] | None) -> None:
        read, output = CONTEXT.Pipe(duplex=False)
        log = Path(errors.name if errors else os.devnull).absolute()
        self._process = CONTEXT.Process(target=run, args=(words, output, log, Path.cwd(), dict(os.environ)))
        self._process.start()
        output.close()
        self.stdout, self.pid = os.fdopen(os.dup(read.fileno()), "rb"), self._process.pid
        read.close()

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        if (code := self.poll()) is None:
            raise subprocess.TimeoutExpired("sitegrid", timeout or 0.0)
        return code

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def kill(self) -> None:
        self._process.kill()


def run(words: list[str], output: Connection, log: Path, folder: Path, environment: dict[str, str]) -> None:
    """In the fork: run the command as from a shell."""
    os.setsid()
    for source, number in ((os.open(os.devnull, os.O_RDONLY), 0), (output.fileno(), 1)):
        os.dup2(source, number)
    os.dup2(os.open(log, os.O_WRONLY | os.O_APPEND), 2)
    output.close()
    sys.stdout, sys.stderr = (os.fdopen(number, "w", buffering=1, closefd=False) for number in (1, 2))
    sys.argv = ["sitegrid", *words]
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    from sitegrid.cli import main

    sys.exit(main(words))


def cpu_s() -> float:
    """CPU time of the fork server and its ended forks."""
    if not (pid := forkserver._forkserver._forkserver_pid):
        return 0.0
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


class ForkedChild(Child):
    def _started(self, words: list[str]) -> Any:
        return Fork(words, self._errors)


class Forks(Children):
    child = ForkedChild
