"""HTTP for Prometheus, on its own threads."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterable
from socketserver import TCPServer, ThreadingMixIn
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server
from wsgiref.types import StartResponse, WSGIApplication, WSGIEnvironment

from prometheus_client import CollectorRegistry, ProcessCollector, make_wsgi_app
from prometheus_client.registry import Collector

from protocol.errors import LinkError

PATH = "/metrics"
REQUEST_S = 5.0  # timeout of a silent visitor
log = logging.getLogger("mapserver.monitoring.exporter")


class Exporter:
    """Answers GET /metrics with metrics of a collector and of this process."""

    def __init__(self, listen: tuple[str, int], collector: Collector) -> None:
        """LinkError if the address is not available."""
        registry = CollectorRegistry()
        registry.register(collector)
        ProcessCollector(registry=registry)
        try:
            self._server = make_server(*listen, _application(registry), _Server, _Handler)
        except OSError as error:
            problem = f"cannot listen here for metrics ({error.strerror}); choose another address with --metrics"
            raise LinkError(f"{listen[0]}:{listen[1]}", problem) from None
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), name="metrics", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Address for Prometheus."""
        host, port = self._server.server_address[:2]
        return f"http://{host!s}:{port}{PATH}"

    def close(self) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


def _application(registry: CollectorRegistry) -> WSGIApplication:
    """The library's application at one path, failures in our log."""
    answer = make_wsgi_app(registry)

    def application(environ: WSGIEnvironment, start_response: StartResponse) -> Iterable[bytes]:
        status = "404 Not Found"
        if environ["PATH_INFO"] == PATH:
            try:
                return answer(environ, start_response)  # type: ignore[no-any-return]
            except Exception:  # the map must go on
                log.exception("metrics failed")
                status = "503 Service Unavailable"
        start_response(status, [("Content-Length", "0")])
        return []

    return application


class _Server(ThreadingMixIn, WSGIServer):
    daemon_threads = True  # a slow visitor must not delay the end

    def server_bind(self) -> None:
        """Bind without HTTPServer's slow lookup of the host's full name."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])
        self.setup_environ()


class _Handler(WSGIRequestHandler):
    timeout = REQUEST_S

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - the library's names
        """Standard error is for the log."""
