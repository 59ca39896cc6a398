"""A connection pooler in transaction mode, as small as one can be: each transaction goes to another session."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading

SSL_REQUEST = 80877103


class SwappingPooler:
    """Forwards each client to two sessions of a server in turns. honest: hands on the first one's own process id."""

    def __init__(self, port: int, *, honest: bool = False) -> None:
        self._port, self._honest = port, honest
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self.swaps = True
        self._links: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        for link in (self._listener, *self._links):
            with contextlib.suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
            link.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                self._links.append(client)
                threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        with contextlib.suppress(OSError, EOFError):
            startup = _startup(client)
            sessions = [socket.create_connection(("127.0.0.1", self._port)) for _ in range(2)]
            self._links += sessions
            greetings = []
            for session in sessions:
                session.sendall(startup)
                greetings.append(_until_ready(session))
            for kind, body in greetings[0]:
                other = struct.pack("!I", 1) + body[4:]
                client.sendall(_message(kind, other if kind == b"K" and not self._honest else body))
            turn = 0
            while True:
                while True:
                    kind, body = _read(client)
                    sessions[turn].sendall(_message(kind, body))
                    if kind in (b"Q", b"S"):
                        break
                for answer in _until_ready(sessions[turn]):
                    client.sendall(_message(*answer))
                turn = 1 - turn if self.swaps else turn


def _startup(client: socket.socket) -> bytes:
    while True:
        (length,) = struct.unpack("!I", _exactly(client, 4))
        body = _exactly(client, length - 4)
        if struct.unpack("!I", body[:4])[0] != SSL_REQUEST:
            return struct.pack("!I", length) + body
        client.sendall(b"N")


def _until_ready(session: socket.socket) -> list[tuple[bytes, bytes]]:
    messages = [_read(session)]
    while messages[-1][0] != b"Z":
        messages.append(_read(session))
    return messages


def _read(link: socket.socket) -> tuple[bytes, bytes]:
    kind = _exactly(link, 1)
    (length,) = struct.unpack("!I", _exactly(link, 4))
    return kind, _exactly(link, length - 4)


def _exactly(link: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        more = link.recv(count - len(data))
        if not more:
            raise EOFError
        data += more
    return data


def _message(kind: bytes, body: bytes) -> bytes:
    return kind + struct.pack("!I", len(body) + 4) + body
