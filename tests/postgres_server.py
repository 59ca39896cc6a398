"""Real PostgreSQL servers in temporary folders: Debian's binaries, run as a non-root user."""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psycopg

USER = "postgres"  # PostgreSQL refuses root
SETTINGS = {
    "unix_socket_directories": "",
    "listen_addresses": "127.0.0.1",
    "max_connections": "60",
    "shared_buffers": "64MB",
    "max_wal_size": "256MB",
    "wal_level": "replica",
    "max_wal_senders": "6",
    "hot_standby": "on",
    "autovacuum": "on",
    "logging_collector": "off",
}
START_S = 60.0


def binaries() -> Path:
    """Folder of `initdb` and `postgres`; RuntimeError says what to install."""
    folders = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: float(path.parent.name), reverse=True)
    on_path = shutil.which("postgres")
    for folder in (*folders, *([Path(on_path).parent] if on_path else [])):
        if (folder / "initdb").exists():
            return folder
    raise RuntimeError("these tests need PostgreSQL's server: apt-get install postgresql (14 or newer)")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@dataclass(frozen=True)
class Database:
    cluster: Cluster
    name: str

    @property
    def url(self) -> str:
        """Over TCP."""
        return self.cluster.url(self.name)

    def sql(self, statement: str) -> list[tuple[Any, ...]]:
        """Run a statement as the superuser."""
        return self.cluster.sql(statement, self.name)

    def end_all(self) -> None:
        """End all other sessions."""
        others = "datname = current_database() AND pid <> pg_backend_pid()"
        self.sql(f"SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE {others}")  # a constant

    def end_writer(self) -> None:
        """End the session that holds a journal's lock, if any."""
        held = "SELECT pid FROM pg_locks WHERE locktype = 'advisory' AND granted"
        here = "database = (SELECT oid FROM pg_database WHERE datname = current_database())"
        self.sql(f"SELECT pg_terminate_backend(pid) FROM ({held} AND {here}) AS holder")  # constants


class Cluster:
    """One PostgreSQL server with data. port: on 127.0.0.1; folder: of its Unix socket too."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.data, self.port = folder, folder / "data", free_port()
        self._process: subprocess.Popen[bytes] | None = None
        self._databases = 0
        self._bin = binaries()

    def initialise(self) -> None:
        self._run("initdb", "-D", self.data, "-U", USER, "-A", "trust", "-E", "UTF8", "--no-locale", "-N")

    def copy_of(self, primary: Cluster, name: str) -> None:
        """Make a replica's data; `name` identifies it."""
        source = f"host=127.0.0.1 port={primary.port} user={USER} application_name={name}"
        self._run("pg_basebackup", "-D", self.data, "-d", source, "-R", "-X", "stream", "-c", "fast")

    def start(self, **more: str) -> None:
        """Start and wait for an answer. more: settings."""
        settings = {**SETTINGS, "unix_socket_directories": str(self.folder), "port": str(self.port), **more}
        words = [str(self._bin / "postgres"), "-D", str(self.data)]
        words += [f"--{name.replace('_', '-')}={value}" for name, value in settings.items()]
        log = (self.folder / "log").open("ab")
        self._process = subprocess.Popen(words, stdout=log, stderr=log, cwd=self.folder, **as_user())
        log.close()
        end_s = time.monotonic() + START_S
        while True:
            try:
                psycopg.connect(self.url(), connect_timeout=5).close()
                return
            except psycopg.OperationalError:
                if self._process.poll() is not None or time.monotonic() > end_s:
                    raise RuntimeError((self.folder / "log").read_text(errors="replace")[-2000:]) from None
                time.sleep(0.05)

    def stop(self, number: int = signal.SIGINT) -> None:
        """Stop: SIGINT ends sessions, SIGKILL crashes the main process."""
        if self._process:
            with suppress(ProcessLookupError):
                self._process.send_signal(number)
            self._process.wait(30)
            self._process = None

    def promote(self) -> None:
        """Make a replica the primary."""
        self._run("pg_ctl", "promote", "-D", self.data, "-w")

    def shows_all_of(self, primary: Cluster) -> bool:
        """Whether a replica's sessions see everything written, which comes after it is on disk."""
        written = primary.sql("SELECT pg_current_wal_lsn()")[0][0]
        return bool(self.sql(f"SELECT pg_last_wal_replay_lsn() >= '{written}'::pg_lsn")[0][0])

    def url(self, database: str = "postgres") -> str:
        """Of a database, over TCP."""
        return f"postgresql://{USER}@127.0.0.1:{self.port}/{database}"

    def socket_url(self, database: str = "postgres") -> str:
        """Of a database, over the Unix socket."""
        return f"postgresql://{USER}@/{database}?host={self.folder}&port={self.port}"

    def new_database(self) -> Database:
        self._databases += 1
        name = f"test_{self._databases}"
        self.sql(f"CREATE DATABASE {name}")
        return Database(self, name)

    def sql(self, statement: str, database: str = "postgres") -> list[tuple[Any, ...]]:
        """Run a statement as the superuser."""
        with psycopg.connect(self.url(database), autocommit=True) as db:
            cursor = db.execute(statement)
            return cursor.fetchall() if cursor.description else []

    def _run(self, name: str, *words: object) -> None:
        command = [str(self._bin / name), *map(str, words)]
        options = as_user()
        done = subprocess.run(command, capture_output=True, cwd=self.folder, check=False, text=True, **options)
        if done.returncode:
            raise RuntimeError(f"{name}: {done.stderr[-2000:]}")


@contextmanager
def cluster(**settings: str) -> Iterator[Cluster]:
    """A new running server, removed with its data."""
    with cluster_folder() as folder:
        made = Cluster(folder)
        made.initialise()
        made.start(**settings)
        try:
            yield made
        finally:
            made.stop(signal.SIGQUIT)


@contextmanager
def replica(primary: Cluster, name: str) -> Iterator[Cluster]:
    """A new streaming replica, removed with its data."""
    with cluster_folder() as folder:
        made = Cluster(folder)
        made.copy_of(primary, name)
        made.start()
        try:
            yield made
        finally:
            made.stop(signal.SIGQUIT)


@contextmanager
def cluster_folder() -> Iterator[Path]:
    """A folder for the other user."""
    with tempfile.TemporaryDirectory(prefix="pg-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        if os.geteuid() == 0:
            shutil.chown(folder, USER)
        yield folder


def as_user() -> dict[str, Any]:
    """Child process options for a non-root user."""
    if os.geteuid():
        return {}
    user = pwd.getpwnam(USER)
    return {
        "user": user.pw_uid,
        "group": user.pw_gid,
        "extra_groups": [],
        "env": {"PATH": os.environ["PATH"], "TZ": "UTC"},
    }
