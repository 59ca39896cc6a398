"""compose.yaml without an engine: its commands as local processes, in its order, with its health checks.

A service's host name becomes a free port on loopback, a volume a folder, the image's working directory the project.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from protocol.wire.session import free_endpoint
from sitegrid.process.children import Child, Children, ProcessError

_ENV = re.compile(r"^ENV (?P<pairs>(?:.*\\\n)*.*)$", re.MULTILINE)
CHECK_S = 0.5  # between two health checks, in place of the file's own


def load(path: Path) -> dict[str, Any]:
    """The services of a compose file."""
    services: dict[str, Any] = YAML(typ="safe").load(path.read_text())["services"]
    return services


def image_environment(dockerfile: Path) -> dict[str, str]:
    """What the image sets, but the path."""
    pairs = [p for match in _ENV.finditer(dockerfile.read_text()) for p in shlex.split(match["pairs"])]
    return {name: value for name, _, value in (pair.partition("=") for pair in pairs) if name and name != "PATH"}


@dataclass
class ComposeRun:
    """The services of one file, started one after the other as it says.

    ports: of this host, by those inside; health: codes of each service's checks, newest last.
    """

    services: Mapping[str, Any]
    folder: Path
    children: Children
    started: dict[str, Child] = field(default_factory=dict)
    health: dict[str, list[int]] = field(default_factory=dict)
    ports: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.ports |= {port: free_port() for port in listened_on(self.services)}

    def up(self) -> None:
        """Start every service once what it depends on is as it has to be."""
        for name in self.services:
            self._start(name)

    def words(self, name: str, line: Sequence[str]) -> list[str]:
        """A command of a service, for this host."""
        return [self._here(name, word) for word in line]

    def check(self, name: str) -> bool:
        """Run the health check of a service once."""
        health = self.services[name]["healthcheck"]
        kind, program, *rest = health["test"]
        assert kind == "CMD", "no shell is in the way"
        first = {"python": [sys.executable], "sitegrid": [sys.executable, "-m", "sitegrid.cli"]}[program]
        command = [*first, *self.words(name, rest)]
        try:
            done = subprocess.run(command, capture_output=True, timeout=_seconds(health["timeout"]), check=False)
            code = done.returncode
        except subprocess.TimeoutExpired:
            code = -1
        self.health.setdefault(name, []).append(code)
        return code == 0

    def down(self) -> dict[str, int]:
        """End all, those first that depend on others; their exit codes."""
        return {name: child.stop() for name, child in reversed(self.started.items())}

    def _start(self, name: str) -> None:
        if name in self.started:
            return
        service = self.services[name]
        for other, rule in service.get("depends_on", {}).items():
            self._start(other)
            if rule["condition"] == "service_healthy":
                self._wait_healthy(other)
            else:
                assert rule["condition"] == "service_started"
        assert "environment" not in service, "it would have to be set here"
        self.started[name] = self.children.start(name, *self.words(name, service["command"]))

    def _wait_healthy(self, name: str) -> None:
        """Fails as an engine would: after so many retries once the time to start is over."""
        health = self.services[name]["healthcheck"]
        patience_s = _seconds(health["start_period"]) + health["retries"] * _seconds(health["interval"])
        end_s = time.monotonic() + patience_s
        while self.health.get(name, [1])[-1] != 0 and not self.check(name):
            if time.monotonic() >= end_s or self.started[name].code is not None:
                raise ProcessError(name, f"is not healthy, checks gave {self.health[name]}")
            time.sleep(CHECK_S)

    def _here(self, name: str, word: str) -> str:
        for volume in self.services[name].get("volumes", []):
            source, target = volume.split(":")
            place = self.folder / "volumes" / source
            place.mkdir(parents=True, exist_ok=True)
            if word == target or word.startswith(f"{target}/"):
                return str(place) + word[len(target) :]
        word = re.sub(rf"\b({'|'.join(self.services)}|0\.0\.0\.0)(?=:\d)", "127.0.0.1", word)
        return re.sub(r"\d+", lambda match: str(self.ports.get(match[0], match[0])), word)


def listened_on(services: Mapping[str, Any]) -> set[str]:
    """Ports that services listen on."""
    words = [word for service in services.values() for word in service["command"]]
    return {match[1] for word in words if (match := re.fullmatch(r"(?:tcp/)?0\.0\.0\.0:(\d+)", word))}


def free_port() -> int:
    """A port of loopback that is free now."""
    return int(free_endpoint().rsplit(":", 1)[1])


def _seconds(text: str) -> float:
    assert text.endswith("s"), text
    return float(text[:-1])
