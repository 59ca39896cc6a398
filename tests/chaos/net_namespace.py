"""Two network namespaces, office and machines, connected by a cable."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

OFFICE_IP, MACHINES_IP = "10.197.61.1", "10.197.61.2"


class NotPermittedError(Exception):
    """The system forbids it; the message says what."""


class Cable:
    """The namespaces, for the length of the block."""

    def __init__(self) -> None:
        self.office, self.machines = (f"chaos-{os.getpid()}-{side}" for side in ("office", "machines"))

    def __enter__(self) -> Cable:
        if not shutil.which("ip") or not shutil.which("tc"):
            raise NotPermittedError("no `ip` and `tc` (iproute2) here")
        with ExitStack() as made:
            for name in (self.office, self.machines):
                _run("ip", "netns", "add", name)
                made.callback(_run, "ip", "netns", "del", name)
            ends = ("ip", "-n", self.office, "link", "add", "veth0", "type", "veth")
            _run(*ends, "peer", "name", "veth0", "netns", self.machines)
            for name, address in ((self.office, OFFICE_IP), (self.machines, MACHINES_IP)):
                _run("ip", "-n", name, "address", "add", f"{address}/24", "dev", "veth0")
                for device in ("lo", "veth0"):
                    _run("ip", "-n", name, "link", "set", device, "up")
            self._made = made.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._made.close()

    @staticmethod
    def inside(name: str) -> tuple[str, ...]:
        """Command prefix to run in a namespace."""
        return ("ip", "netns", "exec", name)

    @contextmanager
    def down(self) -> Iterator[None]:
        """Unplug the machines' end for the block."""
        link = ("ip", "-n", self.machines, "link", "set", "veth0")
        _run(*link, "down")
        yield
        _run(*link, "up")

    @contextmanager
    def slow(self, kbit_s: int) -> Iterator[None]:
        """Slow both directions for the block."""
        where, rate = ("dev", "veth0", "root"), ("rate", f"{kbit_s}kbit", "burst", "4kb", "latency", "400ms")
        for name in (self.office, self.machines):
            _run("tc", "-n", name, "qdisc", "replace", *where, "tbf", *rate)
        yield
        for name in (self.office, self.machines):
            _run("tc", "-n", name, "qdisc", "del", *where)


def _run(*words: str) -> None:
    done = subprocess.run(words, capture_output=True, text=True, timeout=10, check=False)
    if done.returncode:
        raise NotPermittedError(f"`{' '.join(words[:4])}`: {done.stderr.strip() or done.returncode}")
