"""Visitors' sockets: limits, and which ones make room.

A socket counts from acceptance, before TLS, until closed, whatever it becomes: a missing handshake, half a request, a
WebSocket. Sockets that wait for their peer make room, longest waiting first. Answers in progress and WebSockets stay;
the latter have a share of the places.
"""

from __future__ import annotations

import errno
import logging
import resource
import socket
from collections import Counter
from collections.abc import Iterable
from ipaddress import ip_address, ip_network
from typing import Any

from protocol.errors import ConfigError

CONNECTIONS = 500
# 28 browsers behind one NAT loading the page at once (six sockets each, and the live one), or 100 open pages behind a
# proxy; two such addresses leave places to others.
OF_ADDRESS = 200
LIVE = 0.5  # share for WebSockets; the rest is for short requests
SPARE = 50  # extra sockets, per address and in all, that get a refusal; beyond, they are closed at once
QUEUE = 256  # connections held by the system before acceptance
AT_ONCE = 32  # accepted between reads: none makes room before its request could be read
FILES = 4096  # requested from the system
OTHER_FILES = 100  # besides visitors: libraries, log, router links
STALLED_S = 30.0  # timeout of a socket that takes nothing
OUT_OF_FILES = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)
log = logging.getLogger("sitegrid.web.process")


class Connection(socket.socket):
    """A visitor's socket. waits: for its peer. is_live: a WebSocket. has_place: within the limits."""

    def __init__(self, accepted: socket.socket, origin: str, listening: Listening) -> None:
        super().__init__(fileno=accepted.detach())
        self.origin, self._listening = origin, listening
        self.waits, self.is_live, self.has_place = True, False, True

    def close(self) -> None:
        """Close and free its place."""
        if self.fileno() >= 0:
            self._listening.forget(self)
        super().close()


class Listening(socket.socket):
    """A listening socket with limits. most: connections in all. counts: refusals, evictions."""

    def __init__(self, family: socket.AddressFamily, most: int = CONNECTIONS) -> None:
        super().__init__(family)
        self.counts: Counter[str] = Counter()
        self._most = most
        self._files: dict[int, Connection] = {}
        self._origins: dict[str, dict[Connection, None]] = {}  # longest waiting first

    def listen(self, backlog: int = QUEUE) -> None:
        """Listen; asyncio's backlog is its number of accepts in a row."""
        super().listen(max(backlog, QUEUE))

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept; without room ConnectionAbortedError, which the event loop ignores.

        The event loop closes evicted sockets in its next turns; new ones wait for that.
        """
        if len(self._files) >= self._most + SPARE and len(self._files) > self._placed:
            raise BlockingIOError
        try:
            accepted, address = super().accept()
        except OSError as error:
            if error.errno not in OUT_OF_FILES:
                raise
            self._make_room(self._fullest())  # the loop would log every attempt with a traceback
            self.refuse("")
            raise ConnectionAbortedError from None
        connection = Connection(accepted, origin_of(address[0]), self)
        own = self._origins.setdefault(connection.origin, {})
        self._files[connection.fileno()] = connection
        if len(own) >= OF_ADDRESS:
            connection.has_place = self._make_room(own)
        elif self._placed >= self._most:
            connection.has_place = self._make_room(self._fullest())
        own[connection] = None
        if len(own) > OF_ADDRESS + SPARE or len(self._files) > self._most + SPARE:
            self.refuse(connection.origin)
            connection.close()
            raise ConnectionAbortedError
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux only: nothing else ends a peer that responds but takes nothing
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(STALLED_S * 1e3))
        return connection, address

    @property
    def _placed(self) -> int:
        """Connections except evicted ones."""
        return sum(map(len, self._origins.values()))

    def connection(self, file: int) -> Connection:
        """Visitor's socket by file number."""
        return self._files[file]

    def waits(self, connection: Connection, *, now: bool) -> None:
        """Note that a connection waits for its peer, or is being answered."""
        connection.waits = now
        if now and connection in (own := self._origins.get(connection.origin, {})):
            own[connection] = own.pop(connection)

    def has_room_for_live(self, connection: Connection) -> bool:
        """Whether another WebSocket fits, for its origin and in all."""
        own = sum(one.is_live for one in self._origins[connection.origin])
        every = sum(one.is_live for one in self._files.values())
        return connection.has_place and own < LIVE * OF_ADDRESS and every < LIVE * self._most

    def forget(self, connection: Connection) -> None:
        """Drop a closed connection."""
        self._files.pop(connection.fileno(), None)
        self._leave(connection)

    def refuse(self, origin: str) -> None:
        """Count a refused socket and log its origin."""
        self.counts["refused_connections"] += 1
        if self.counts["refused_connections"].bit_count() == 1:  # 1st, 2nd, 4th...
            own, every = len(self._origins.get(origin, ())), len(self._files)
            log.warning("too many connections address=%s open=%d of_all=%d", origin, own, every)

    def _fullest(self) -> Iterable[Connection]:
        return max(self._origins.values(), key=len, default={})

    def _make_room(self, among: Iterable[Connection]) -> bool:
        """Evict the longest waiting, if any. Its transport closes it, as if the peer had left."""
        longest = next((one for one in among if one.waits), None)
        if longest is None:
            return False
        self.counts["ended_waiting"] += 1
        self._leave(longest)
        try:
            longest.shutdown(socket.SHUT_RDWR)
        except OSError:  # the peer has left
            return True
        return True

    def _leave(self, connection: Connection) -> None:
        own = self._origins.get(connection.origin, {})
        own.pop(connection, None)
        if not own:
            self._origins.pop(connection.origin, None)


def listen(address: tuple[str, int]) -> Listening:
    """Listen on an address; ConfigError if impossible, or if the limit of open files is too low."""
    host, port = address[0].strip("[]"), address[1]
    most = min(CONNECTIONS, _files() - OTHER_FILES - SPARE)
    if most < SPARE:
        raise ConfigError("ulimit -n", f"raise it: a web server needs {OTHER_FILES + 2 * SPARE} open files or more")
    listening = Listening(socket.AF_INET6 if ":" in host else socket.AF_INET, most)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind((host, port))
        listening.listen()
    except OSError as error:
        listening.close()
        raise ConfigError("--listen", f"cannot listen on {host}:{port}: {error.strerror}") from None
    return listening


def _files() -> int:
    """Limit of open files, raised as far as allowed."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = FILES if hard == resource.RLIM_INFINITY else min(FILES, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        return wanted
    return FILES if soft == resource.RLIM_INFINITY else soft


def origin_of(host: str) -> str:
    """Origin of an address: an IPv6 /64 counts as one host."""
    address = ip_address(host.partition("%")[0])
    is_alone = address.version == 4 or address.ipv4_mapped
    return host if is_alone else str(ip_network((int(address), 64), strict=False))
