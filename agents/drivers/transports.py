"""Where bytes come from: serial ports, TCP, UDP, files. A link that breaks raises OSError; its owner opens it again."""

import errno
import os
import re
import select
import socket
from pathlib import Path
from typing import BinaryIO, Protocol
from urllib.parse import urlsplit

PIECE_BYTES = 4096
CONNECT_S = 1.0  # a machine's own network answers in milliseconds
BITS = 10  # of a byte on a serial line: start, eight, stop
WIRED = re.compile(r"/tty(?!ACM)[A-Z]")  # ports whose bytes go over a wire at their baud; ttyACM is USB alone


class Transport(Protocol):
    """An open link."""

    is_live: bool  # bytes come when they are sent; a file has them all
    byte_ns: float  # how long a byte takes

    def read(self, timeout_s: float) -> bytes | None:
        """Bytes that have come in, empty if none came, None at the end; OSError where the link broke."""

    def write(self, data: bytes) -> None:
        """Send bytes to the receiver; OSError where the link broke."""

    def close(self) -> None:
        """Let go of it."""


class SerialPort:
    """A serial port."""

    is_live = True

    def __init__(self, path: str, baud: int) -> None:
        try:
            import serial  # of the extra `receivers`
        except ImportError:
            raise OSError(errno.ENOPKG, "pyserial is not installed: pip install 'sitegrid[receivers]'") from None
        self._port = serial.Serial(path, baud, timeout=0, write_timeout=1.0, exclusive=True)
        self.byte_ns = BITS * 1e9 / baud if WIRED.search(str(Path(path).resolve())) else 0.0

    def read(self, timeout_s: float) -> bytes:
        """Bytes as soon as there are some."""
        if not select.select([self._port.fileno()], [], [], timeout_s)[0]:
            return b""
        if data := os.read(self._port.fileno(), PIECE_BYTES):  # pyserial would select once more
            return data
        raise OSError(errno.EIO, "no device")

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._port.write(data)

    def close(self) -> None:
        """Give the port back."""
        self._port.close()


class Socket:
    """A TCP connection, or datagrams of whoever sends them here."""

    is_live = True
    byte_ns = 0.0

    def __init__(self, scheme: str, host: str, port: int) -> None:
        self._is_tcp = scheme == "tcp"
        if self._is_tcp:
            self._socket = socket.create_connection((host, port), CONNECT_S)
        else:
            family, *_, place = socket.getaddrinfo(host or None, port, type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE)[
                0
            ]
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
            self._socket.bind(place)

    def read(self, timeout_s: float) -> bytes:
        """Bytes as soon as there are some."""
        if not select.select([self._socket], [], [], timeout_s)[0]:
            return b""
        data = self._socket.recv(1 << 16)
        if self._is_tcp and not data:
            raise ConnectionResetError(errno.ECONNRESET, "closed by the other side")
        return data

    def write(self, data: bytes) -> None:
        """Send bytes; nobody listens to datagrams."""
        if self._is_tcp:
            self._socket.sendall(data)

    def close(self) -> None:
        """Hang up."""
        self._socket.close()


class RecordedBytes:
    """A file with what a receiver sent."""

    is_live = False
    byte_ns = 0.0

    def __init__(self, path: Path) -> None:
        self._file: BinaryIO = path.open("rb")

    def read(self, _: float) -> bytes | None:
        """The next bytes, at once."""
        return self._file.read(PIECE_BYTES) or None

    def write(self, data: bytes) -> None:
        """A file hears nothing."""

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def open_transport(address: str, baud: int) -> Transport:
    """Open `tcp://HOST:PORT`, `udp://[HOST]:PORT`, a file, or a serial port; OSError where that fails."""
    if "://" in address:
        scheme, host, port = split_address(address)
        return Socket(scheme, host, port)
    path = Path(address)
    return RecordedBytes(path) if path.is_file() else SerialPort(address, baud)


def split_address(address: str) -> tuple[str, str, int]:
    """Scheme, host and port; ValueError where it is no address."""
    parts = urlsplit(address)
    if parts.scheme not in ("tcp", "udp") or not parts.port or (parts.scheme == "tcp" and not parts.hostname):
        raise ValueError(f"address: {address!r} is neither tcp://HOST:PORT nor udp://[HOST]:PORT, nor a port or a file")
    return parts.scheme, parts.hostname or "", parts.port


def why_closed(error: OSError) -> str:
    """Why a link cannot be opened and what to do, in one sentence."""
    match error.errno:
        case errno.EACCES | errno.EPERM:
            return "no permission: add this user to the group of the port (dialout), and log in again"
        case errno.ENOENT | errno.ENODEV | errno.ENXIO | errno.EIO:
            there = sorted(str(p) for name in ("ttyACM*", "ttyUSB*", "ttyAMA*") for p in Path("/dev").glob(name))
            return f"no such port; there {'are ' + ', '.join(there) if there else 'is none: plug it in'}"
        case errno.EAGAIN | errno.EBUSY | errno.EADDRINUSE:
            return "another program has this port: end it (gpsd, ModemManager?)"
        case errno.ECONNREFUSED:
            return "nobody listens there: start the sender, or correct host and port"
    return error.strerror or str(error)
