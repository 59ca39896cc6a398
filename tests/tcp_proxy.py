"""A TCP proxy on loopback with weather: cuts, black holes, slowness, delayed replies; it counts bytes.

TCP neither repeats nor reorders, so late replies are the remaining hazard: a delay beyond the sender's timeout makes it
resend.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections import Counter
from dataclasses import dataclass
from typing import Literal

Direction = Literal["there", "back"]  # to the port, and from it
CHUNK = 16384


@dataclass(frozen=True)
class Weather:
    """State of links. cut: no connections; hold_there, hold_back: no bytes to or from the router.

    bytes_per_s: in each direction, 0: unlimited.
    """

    cut: bool = False
    hold_there: bool = False
    hold_back: bool = False
    bytes_per_s: float = 0.0


FAIR = Weather()


class Proxy:
    """Forwards connections to a loopback port, for the length of the block.

    buffer_bytes: kernel buffers, small so that senders feel a slow link; 0: default.
    """

    def __init__(self, port: int, weather: Weather = FAIR, buffer_bytes: int = 0) -> None:
        self.weather = weather
        self._port = port
        self._listener = socket.create_server(("127.0.0.1", 0))
        if buffer_bytes:  # inherited by accepted connections
            self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer_bytes)
        self._links: list[socket.socket] = []
        self._threads: list[threading.Thread] = []
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._bytes: Counter[Direction] = Counter()
        self._start(self._accept)

    @property
    def endpoint(self) -> str:
        return f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"

    def carried(self, direction: Direction) -> int:
        """Bytes forwarded so far."""
        return self._bytes[direction]

    def set(self, weather: Weather) -> None:
        self.weather = weather
        if weather.cut:
            self._drop_links()

    def __enter__(self) -> Proxy:
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._drop_links()
        for thread in self._threads:
            thread.join(5.0)

    def _start(self, work: object, *args: object) -> None:
        thread = threading.Thread(target=work, args=args, daemon=True)  # type: ignore[arg-type]
        self._threads.append(thread)
        thread.start()

    def _drop_links(self) -> None:
        with self._lock:
            links, self._links = self._links, []
        for link in links:
            with contextlib.suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
            link.close()

    def _accept(self) -> None:
        while not self._closed.is_set():
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            try:
                if self.weather.cut:
                    raise ConnectionRefusedError
                far = socket.create_connection(("127.0.0.1", self._port), timeout=2.0)
            except OSError:
                near.close()
                continue
            far.settimeout(None)
            with self._lock:
                self._links += [near, far]
            self._start(self._pump, near, far, "there")
            self._start(self._pump, far, near, "back")

    def _pump(self, source: socket.socket, sink: socket.socket, direction: Direction) -> None:
        """Forward bytes until either end is gone; bytes read before a cut are lost."""
        try:
            while data := source.recv(CHUNK):
                while getattr(self.weather, f"hold_{direction}") and not self._closed.is_set():
                    time.sleep(0.02)
                if rate := self.weather.bytes_per_s:
                    time.sleep(len(data) / rate)
                sink.sendall(data)
                with self._lock:
                    self._bytes[direction] += len(data)
        except OSError:
            pass
        for end in (source, sink):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
