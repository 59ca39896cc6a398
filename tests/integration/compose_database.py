"""PostgreSQL's image by local programs: create data, run scripts, serve."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

from tests.postgres_server import USER, as_user, binaries

DATABASE = "postgres:"  # name of its image
SCRIPTS = "/docker-entrypoint-initdb.d/"
END_S = 30.0


class DatabaseServer:
    """One service. folder: accessible to another user. files: on this host, by their place inside."""

    def __init__(self, folder: Path, environment: Mapping[str, str], files: Mapping[str, Path]) -> None:
        self.folder, self._files, self._options = folder, files, as_user()
        folder.mkdir(exist_ok=True)
        if os.geteuid() == 0:
            shutil.chown(folder, USER)
        path = f"{binaries()}:{os.environ['PATH']}"
        self._environment = {"TZ": "UTC", **environment, "PATH": path, "PGHOST": str(folder)}
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def data(self) -> str:
        return self._environment["PGDATA"]

    @property
    def pid(self) -> int:
        assert self._process
        return self._process.pid

    @property
    def code(self) -> int | None:
        return self._process.poll() if self._process else None

    def initialise(self) -> None:
        """Like the image's first start: data, a database, scripts without other connections."""
        e, port = self._environment, ["-o", "-c listen_addresses= -c unix_socket_directories=" + str(self.folder)]
        user, data = e["POSTGRES_USER"], e["PGDATA"]
        method = e["POSTGRES_HOST_AUTH_METHOD"]
        self.do("initdb", "-D", data, "-U", user, "-A", method, "-E", "UTF8", "--no-locale", "-N")
        self.do("pg_ctl", "start", "-w", "-D", data, "-l", str(self.folder / "first.log"), *port)
        self.do("createdb", "-U", user, e["POSTGRES_DB"])
        for target, source in self._files.items():
            if target.startswith(SCRIPTS):
                self.do("sh", str(self._copied(source)))
        self.do("pg_ctl", "stop", "-w", "-m", "fast", "-D", data)

    def enter(self, words: Sequence[str]) -> None:
        """Start by the compose file's entry point."""
        program, script, *rest = words
        self.run([program, str(self._copied(self._files[script])), *rest])

    def run(self, words: Sequence[str]) -> None:
        sockets = ("-c", f"unix_socket_directories={self.folder}")
        with (self.folder / "log").open("ab") as log:
            self._process = subprocess.Popen(
                [*words, *sockets], stdout=log, stderr=log, cwd=self.folder, **self._with_environment()
            )

    def do(self, *words: str) -> None:
        """Run a program beside it, like `docker compose exec`."""
        done = subprocess.run(
            words, capture_output=True, text=True, cwd=self.folder, check=False, **self._with_environment()
        )
        assert done.returncode == 0, f"{words}: {done.stdout}{done.stderr}"

    def send(self, number: signal.Signals) -> None:
        if self._process and self.code is None:
            self._process.send_signal(number)

    def wait(self, timeout_s: float) -> int:
        assert self._process
        return self._process.wait(timeout_s)

    def stop(self) -> int:
        """Stop as the image specifies: SIGINT ends all sessions."""
        self.send(signal.SIGINT)
        try:
            return self.wait(END_S)
        except subprocess.TimeoutExpired:
            self.send(signal.SIGQUIT)
            return self.wait(END_S)

    def _with_environment(self) -> dict[str, object]:
        return {**self._options, "env": self._environment}

    def _copied(self, source: Path) -> Path:
        """Where the other user can read it."""
        return Path(shutil.copy(source, self.folder))
