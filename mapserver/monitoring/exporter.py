"""The edge of the metrics: HTTP for Prometheus, an ear for the agents' health, and a look at this process."""

from __future__ import annotations

import logging
import os
import resource
import shutil
import threading
import time
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from socketserver import TCPServer
from typing import Any

import zenoh

from mapserver.monitoring.metrics import CONTENT_TYPE, Heard, Host, metrics_of, render
from protocol.errors import ConfigError, LinkError, MessageError
from protocol.wire import keys
from protocol.wire.codec import MAX_SMALL_BYTES, decode_health

PATH = "/metrics"
MOST_AGENTS = 1000  # names are free to choose where there are no keys
REQUEST_S = 5.0
_STARTED_S = time.time()
log = logging.getLogger("mapserver.monitoring.exporter")


class HealthEar:
    """The newest health of every agent of a site, kept as bytes until somebody asks: callbacks only move bytes."""

    def __init__(self, session: zenoh.Session, site: str, clock: Callable[[], float] = time.time) -> None:
        self._clock = clock
        self._newest: dict[str, tuple[bytes, float]] = {}
        self._subscriber = session.declare_subscriber(keys.health_all(site), self._on_health)

    def heard(self) -> dict[str, Heard]:
        """By machine; what cannot be read, or comes under another's key, is left out."""
        found = {}
        for name, (data, heard_s) in sorted(self._newest.copy().items()):
            try:
                health = decode_health(data)
            except MessageError:
                continue
            if health.machine == name:
                found[name] = Heard(health.values, heard_s)
        return found

    def close(self) -> None:
        """Stop listening."""
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]

    def _on_health(self, sample: zenoh.Sample) -> None:
        try:
            machine = keys.machine_of(str(sample.key_expr))
        except ConfigError:  # a wildcard names no machine
            return
        data = sample.payload.to_bytes()
        if len(data) <= MAX_SMALL_BYTES and (machine in self._newest or len(self._newest) < MOST_AGENTS):
            self._newest[machine] = (data, self._clock())


class Exporter:
    """Answers GET /metrics until closed, on threads of its own."""

    def __init__(self, listen: tuple[str, int], text: Callable[[], str]) -> None:
        """Listen. text: what to answer. LinkError where the address cannot be had."""
        try:
            self._server = _Server(listen, _handler(text))
        except OSError as error:
            problem = f"cannot listen here for metrics ({error.strerror}); choose another address with --metrics"
            raise LinkError(f"{listen[0]}:{listen[1]}", problem) from None
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), name="metrics", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Where Prometheus finds it."""
        host, port = self._server.server_address[:2]
        return f"http://{host!s}:{port}{PATH}"

    def close(self) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


def text_of(
    info: Callable[[], Mapping[str, Any]], heard: Callable[[], Mapping[str, Heard]], store: Path, version: str
) -> str:
    """The exposition as of now. info: as `map/info` answers, asked of the store's owner."""
    start_s = time.perf_counter()
    now = info()
    return render(metrics_of(now, heard(), look(store, time.perf_counter() - start_s), version))


def look(store: Path, turn_s: float) -> Host:
    """What this process takes of its host (Linux)."""
    page = os.sysconf("SC_PAGE_SIZE")
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return Host(
        resident_bytes=int(Path("/proc/self/statm").read_text().split()[1]) * page,
        cpu_s=usage.ru_utime + usage.ru_stime,
        started_s=_STARTED_S,
        store_bytes=sum(_size(path) for path in store.rglob("*")),
        free_bytes=shutil.disk_usage(store).free,
        turn_s=turn_s,
    )


def _size(path: Path) -> int:
    try:
        return path.stat().st_size if path.is_file() else 0
    except OSError:  # gone meanwhile
        return 0


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False  # who reads slowly must not hold up the end

    def server_bind(self) -> None:
        """Bind without asking for the host's full name, as HTTPServer does: that may take long."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])


def _handler(text: Callable[[], str]) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        timeout = REQUEST_S

        def do_GET(self) -> None:
            """Answer with the metrics; nothing else is here."""
            if self.path.split("?")[0] != PATH:
                self.send_error(404)
                return
            try:
                body = text().encode()
            except Exception:  # whatever it is, the map goes on
                log.exception("metrics failed")
                self.send_error(503)
                return
            self.send_response(200)
            self.send_header("Content-Type", CONTENT_TYPE)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - the library's names
            """Standard error is for the log's lines."""

    return Handler
