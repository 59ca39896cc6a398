"""A TCP forwarder on loopback that counts bytes, so that a link can be measured with all that its protocols add."""

from __future__ import annotations

import socket
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress

CHUNK = 65536


@contextmanager
def counted(endpoint: str) -> Iterator[tuple[str, Counter[str]]]:
    """An endpoint that leads to another one, and the bytes that went `up` to it and `down` from it so far."""
    port = int(endpoint.rsplit(":", 1)[1])
    passed: Counter[str] = Counter()
    links: list[socket.socket] = []
    listener = socket.create_server(("127.0.0.1", 0))

    def accept() -> None:
        with suppress(OSError):
            while True:
                near, _ = listener.accept()
                far = socket.create_connection(("127.0.0.1", port))
                links.extend((near, far))
                for name, source, sink in (("up", near, far), ("down", far, near)):
                    threading.Thread(target=_pass_on, args=(passed, name, source, sink), daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    try:
        yield f"tcp/127.0.0.1:{listener.getsockname()[1]}", passed
    finally:
        for one in (listener, *links):
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()


def _pass_on(passed: Counter[str], name: str, source: socket.socket, sink: socket.socket) -> None:
    with suppress(OSError):
        while data := source.recv(CHUNK):
            passed[name] += len(data)  # the only thread that counts this direction, but for a link opened again
            sink.sendall(data)
    for one in (source, sink):
        with suppress(OSError):
            one.shutdown(socket.SHUT_RDWR)
