"""compose.yaml without an engine: its commands as local processes, in order, with health checks.

Host names become free loopback ports, volumes folders, the working directory the project; local programs replace
PostgreSQL's image and its entry point.
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
from tests.integration.compose_database import DATABASE, DatabaseServer
from tests.postgres_server import binaries

# Of the build; and with an empty folder or another processor each service would compile kernels.
NOT_HERE = ("", "PATH", "INSTALL", "NUMBA_CACHE_DIR", "NUMBA_CPU_NAME")
_ENV = re.compile(r"^ENV (?P<pairs>(?:.*\\\n)*.*)$", re.MULTILINE)
CHECK_S = 0.5  # between health checks, in place of the file's value


def load(path: Path) -> dict[str, Any]:
    services: dict[str, Any] = YAML(typ="safe").load(path.read_text())["services"]
    return services


def needed(services: Mapping[str, Any], *names: str, profile: str = "demo") -> dict[str, Any]:
    """Services started by `docker compose --profile PROFILE up NAMES`, with dependencies; without names, all."""
    wanted = set(names or (name for name, service in services.items() if profile in service["profiles"]))
    while more := {other for name in wanted for other in services[name].get("depends_on", {})} - wanted:
        wanted |= more
    return {name: service for name, service in services.items() if name in wanted}


def image_environment(dockerfile: Path) -> dict[str, str]:
    """The image's environment without NOT_HERE."""
    pairs = [p for match in _ENV.finditer(dockerfile.read_text()) for p in shlex.split(match["pairs"])]
    return {name: value for name, _, value in (pair.partition("=") for pair in pairs) if name not in NOT_HERE}


@dataclass
class ComposeRun:
    """One file's services, started in its order.

    ports: on this host, by those inside. health: results by service, newest last. databases: folder accessible to
    another user, if needed.
    """

    services: Mapping[str, Any]
    folder: Path
    children: Children
    databases: Path | None = None
    started: dict[str, Child | DatabaseServer] = field(default_factory=dict)
    health: dict[str, list[int]] = field(default_factory=dict)
    ports: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.ports |= {port: free_port() for port in listened_on(self.services)}

    def up(self) -> None:
        """Start each service after its dependencies."""
        for name in self.services:
            self._start(name)

    def words(self, name: str, line: Sequence[str]) -> list[str]:
        """A service's command for this host."""
        return [self._here(name, word) for word in line]

    def check(self, name: str) -> bool:
        """Run a service's health check once."""
        health = self.services[name]["healthcheck"]
        kind, program, *rest = health["test"]
        assert kind == "CMD", "no shell is in the way"
        programs = {"python": [sys.executable], "sitegrid": [sys.executable, "-m", "sitegrid.cli"]}
        first = programs.get(program) or [str(binaries() / program)]
        command = [*first, *self.words(name, rest)]
        try:
            done = subprocess.run(command, capture_output=True, timeout=_seconds(health["timeout"]), check=False)
            code = done.returncode
        except subprocess.TimeoutExpired:
            code = -1
        self.health.setdefault(name, []).append(code)
        return code == 0

    def down(self) -> dict[str, int]:
        """Stop everything, dependents first; returns exit codes."""
        return {name: child.stop() for name, child in reversed(self.started.items())}

    def start_again(self, name: str) -> Child | DatabaseServer:
        """Restart an ended service, like an engine."""
        assert self.services[name]["restart"] == "unless-stopped"
        assert self.started[name].code is not None
        del self.started[name]
        self._start(name)
        return self.started[name]

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
        if service["image"].startswith(DATABASE):
            self.started[name] = self._database(name, service)
            return
        assert "environment" not in service, "it would have to be set here"
        self.started[name] = self.children.start(name, *self.words(name, service["command"]))

    def _database(self, name: str, service: Mapping[str, Any]) -> DatabaseServer:
        assert self.databases, "a folder for them is needed"
        environment = {key: self._here(name, value) for key, value in service["environment"].items()}
        files = {target: source for source, target in _volumes(service) if source.startswith("./")}
        made = DatabaseServer(self.databases / name, environment, {t: Path(s) for t, s in files.items()})
        self.children.callback(made.stop)
        if "entrypoint" in service:
            made.enter([*service["entrypoint"], *self.words(name, service["command"])])
        else:
            made.initialise()
            made.run(self.words(name, service["command"]))
        return made

    def _wait_healthy(self, name: str) -> None:
        """Fails like an engine: after the start period's retries."""
        health = self.services[name]["healthcheck"]
        patience_s = _seconds(health["start_period"]) + health["retries"] * _seconds(health["interval"])
        end_s = time.monotonic() + patience_s
        while self.health.get(name, [1])[-1] != 0 and not self.check(name):
            if time.monotonic() >= end_s or self.started[name].code is not None:
                raise ProcessError(name, f"is not healthy, checks gave {self.health[name]}")
            time.sleep(CHECK_S)

    def _here(self, name: str, word: str) -> str:
        of_database = self.services[name]["image"].startswith(DATABASE)
        for source, target in _volumes(self.services[name]):
            if source.startswith("./") or not (word == target or word.startswith(f"{target}/")):
                continue
            place = self.databases / name if of_database and self.databases else self.folder / "volumes" / source
            place.mkdir(parents=True, exist_ok=True)
            return str(place) + word[len(target) :]
        names = "|".join(self.services)
        word = re.sub(
            rf"\b({names}|0\.0\.0\.0)(?=:\d)|(?<=host=)({names})\b|(?<=listen_addresses=)\*", "127.0.0.1", word
        )
        return re.sub(r"\d+", lambda match: str(self.ports.get(match[0], match[0])), word)


def listened_on(services: Mapping[str, Any]) -> set[str]:
    words = [word for service in services.values() for word in service["command"]]
    published = [port.rsplit(":", 1)[1] for service in services.values() for port in service.get("ports", [])]
    return {match[1] for word in words if (match := re.fullmatch(r"(?:tcp/)?0\.0\.0\.0:(\d+)", word))} | set(published)


def _volumes(service: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [(volume.split(":")[0], volume.split(":")[1]) for volume in service.get("volumes", [])]


def free_port() -> int:
    return int(free_endpoint().rsplit(":", 1)[1])


def _seconds(text: str) -> float:
    assert text.endswith("s"), text
    return float(text[:-1])
