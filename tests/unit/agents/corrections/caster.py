"""A caster or TCP base on loopback; each test chooses its behaviour."""

from __future__ import annotations

import socket
import ssl
import threading
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType

Serve = Callable[[socket.socket], None]


class Caster:
    """Keeps each request, then runs `serve` on the connection."""

    def __init__(self, serve: Serve, *, port: int = 0, asks: bool = True, tls: ssl.SSLContext | None = None) -> None:
        self.requests: list[str] = []
        self._serve, self._asks, self._tls = serve, asks, tls
        self._open: list[socket.socket] = []
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port: int = self._listener.getsockname()[1]
        self._threads = [threading.Thread(target=self._accept)]
        self._threads[0].start()

    def __enter__(self) -> Caster:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.kill()

    def kill(self) -> None:
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._threads[0].join()
        for link in self._open:
            with suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
        for thread in self._threads[1:]:
            thread.join()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                link, _ = self._listener.accept()
                self._open.append(link)
                self._threads.append(threading.Thread(target=self._talk, args=(link,)))
                self._threads[-1].start()

    def _talk(self, plain: socket.socket) -> None:
        with suppress(OSError):
            link = self._tls.wrap_socket(plain, server_side=True) if self._tls else plain
            with plain, link:
                request = b""
                while self._asks and b"\r\n\r\n" not in request and (data := link.recv(4096)):
                    request += data
                self.requests.append(request.decode("latin-1"))
                self._serve(link)


def sends(*pieces: bytes, stays: bool = True) -> Serve:
    """Send, then wait for the other side's end, or hang up."""

    def serve(link: socket.socket) -> None:
        for piece in pieces:
            link.sendall(piece)
        while stays and link.recv(4096):
            pass

    return serve


def floods(piece: bytes, first: bytes = b"") -> Serve:
    """Send one piece forever."""

    def serve(link: socket.socket) -> None:
        link.sendall(first)
        while True:
            link.sendall(piece)

    return serve
