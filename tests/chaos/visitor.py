"""A misbehaving visitor: `python -m tests.chaos.visitor KIND NETWORK PORT SITE`.

Opens connections to the web server endlessly and holds the newest HELD, from addresses 127.0.NETWORK.x. Runs until
killed.
"""

from __future__ import annotations

import itertools
import socket
import ssl
import sys
import time
from collections import deque
from contextlib import suppress

HELD = 500  # connections: all visitors' capacity
ADDRESSES = 3  # of one visitor: a single address could only fill its own share
EVERY_S = 0.05  # between connections, once all are open
PATIENCE_S = 3.0
HELLO = b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03"  # start of a TLS handshake
ASK = b"GET /%s HTTP/1.1\r\nHost: 127.0.0.1\r\n%s"
UPGRADE = b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
UPGRADE += b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
MUCH = (  # the largest possible answers
    b"region?bounds=-1000,-1000,999,999&layers=resistance,grade,visits,age_s&format=npz",
    b"region?bounds=-250,-250,249,249&layers=resistance,grade,visits,age_s",
    b"features/zones",
    b"tiles",
)


def trusting() -> ssl.SSLContext:
    """TLS without verification."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context


class Visitor:
    """Connections by kind, ready to be held."""

    def __init__(self, network: int, port: int, site: str) -> None:
        self._network, self._port, self._path = network, port, f"api/v1/sites/{site}/".encode()
        self._numbers, self._tls = itertools.count(), trusting()

    def idle(self) -> socket.socket:
        """A silent connection, without handshake."""
        source = f"127.0.{self._network}.{1 + next(self._numbers) % ADDRESSES}"
        return socket.create_connection(("127.0.0.1", self._port), PATIENCE_S, source_address=(source, 0))

    def shaking(self) -> socket.socket:
        """An endless handshake."""
        opened = self.idle()
        opened.sendall(HELLO)
        return opened

    def half(self) -> socket.socket:
        """A whole request and a half."""
        return self._asked(ASK % (b"healthz", b"\r\n") + ASK % (b"", b"X-Slow: "))

    def sleeping(self) -> socket.socket:
        """A live page that reads nothing."""
        return self._asked(ASK % (self._path + b"live", UPGRADE))

    def asking(self) -> socket.socket:
        """A large query, answered in every other case."""
        number = next(self._numbers)
        asked = self._asked(ASK % (self._path + MUCH[number // 2 % len(MUCH)], b"Connection: close\r\n\r\n"))
        asked.settimeout(20 * PATIENCE_S)
        while number % 2 and asked.recv(2**20):
            pass
        return asked

    def _asked(self, request: bytes) -> socket.socket:
        opened = self._tls.wrap_socket(self.idle())
        opened.sendall(request)
        return opened


KINDS = ("idle", "shaking", "half", "sleeping", "asking")


def main(kind: str, network: str, port: str, site: str) -> None:
    connect, held = getattr(Visitor(int(network), int(port), site), kind), deque[socket.socket](maxlen=HELD)
    while True:
        with suppress(OSError):  # closed or refused: next one
            held.append(connect())
        time.sleep(EVERY_S if len(held) == HELD else 0)


if __name__ == "__main__":
    main(*sys.argv[1:])
