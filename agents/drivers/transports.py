"""Byte links: serial ports, TCP, UDP, files. A broken link raises OSError; its owner reopens it."""

import errno
import os
import re
import select
import socket
import time
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

MOST_BYTES = 1 << 16  # per read; longer datagrams are cut
TOGETHER_S = 0.02  # bytes gathered per read: waking up costs more than a frame
CONNECT_S = 1.0  # timeout; own networks answer in milliseconds
WRITE_S = 1.0  # timeout of one write, at any baud
BITS = 10  # per byte on a serial line: start, eight, stop
WIRED = re.compile(r"/tty(?!ACM)[A-Z]")  # ports with real baud; ttyACM is USB only
# Why a link cannot be opened, and the remedy.
WHY = {
    errno.EACCES: "no permission: add this user to the group of the port (dialout), and log in again",
    errno.EAGAIN: "another program has this port: end it (gpsd, ModemManager?)",
    errno.EADDRNOTAVAIL: "this host has no such address: udp://:PORT listens at all it has",
    errno.ECONNREFUSED: "nobody listens there: start the sender, or correct host and port",
}
SAME = {errno.EPERM: errno.EACCES, errno.EBUSY: errno.EAGAIN, errno.EADDRINUSE: errno.EAGAIN}


class Transport:
    """An open link. is_live: bytes come as sent, unlike a file's. byte_ns: duration of a byte."""

    def __init__(self, link: Any, *, is_live: bool = True, byte_ns: float = 0.0) -> None:
        """Wrap a `link` with `fileno` and `close`."""
        self._link, self.is_live, self.byte_ns = link, is_live, byte_ns

    def read(self, timeout_s: float) -> bytes | None:
        """New bytes, maybe none; None at the end of a file. OSError if the link broke."""
        if self.is_live:
            if not select.select([self._link.fileno()], [], [], timeout_s)[0]:
                return b""
            time.sleep(TOGETHER_S)
        if data := os.read(self._link.fileno(), MOST_BYTES):
            return data
        if self.is_live:
            raise OSError(errno.ENODEV, "closed by the other side")
        return None

    def write(self, data: bytes) -> None:
        """Send all bytes; OSError if impossible or too slow."""
        left = memoryview(data)
        while left:
            if not select.select([], [self._link.fileno()], [], WRITE_S)[1]:
                raise OSError(errno.ETIMEDOUT, "takes no bytes")
            left = left[os.write(self._link.fileno(), left) :]

    def close(self) -> None:
        """Close it."""
        self._link.close()


def open_transport(address: str, baud: int) -> Transport:
    """Open `tcp://HOST:PORT`, `udp://[HOST]:PORT`, a file, or a serial port; OSError."""
    if "://" in address:
        scheme, host, port = split_address(address)
        return Transport(socket.create_connection((host, port), CONNECT_S) if scheme == "tcp" else _bound(host, port))
    path = Path(address)
    if path.is_file():
        return Transport(path.open("rb"), is_live=False)
    try:
        import serial  # of the extra `receivers`
    except ImportError:
        raise OSError(errno.ENOPKG, "pyserial is not installed: pip install '.[receivers]'") from None
    port = serial.Serial(address, baud, timeout=0, exclusive=True)
    return Transport(port, byte_ns=BITS * 1e9 / baud if WIRED.search(str(path.resolve())) else 0.0)


def split_address(address: str) -> tuple[str, str, int]:
    """Scheme, host, port; ValueError if it is no address."""
    parts = urlsplit(address)
    if parts.scheme not in ("tcp", "udp") or not parts.port or (parts.scheme == "tcp" and not parts.hostname):
        raise ValueError(f"address: {address!r} is neither tcp://HOST:PORT nor udp://[HOST]:PORT, nor a port or a file")
    return parts.scheme, parts.hostname or "", parts.port


def why_closed(error: OSError) -> str:
    """Why a link cannot be opened, and the remedy, in a sentence."""
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.EIO):
        there = serial_ports()
        return f"no such port; there {'are ' + ', '.join(there) if there else 'is none: plug it in'}"
    if error.errno == errno.EISDIR or "configure port" in str(error):
        return "it is no serial port, nor a file"
    number = error.errno or 0
    return WHY.get(SAME.get(number, number), error.strerror or str(error))


def serial_ports(devices: Path = Path("/dev")) -> list[str]:
    """Serial ports, by names that survive replugging where possible."""
    named = sorted((devices / "serial" / "by-id").glob("*"))
    plain = [port for name in ("ttyACM*", "ttyUSB*", "ttyAMA*") for port in sorted(devices.glob(name))]
    known = {port.resolve() for port in named}
    return [str(port) for port in (*named, *(port for port in plain if port.resolve() not in known))]


def _bound(host: str, port: int) -> socket.socket:
    family, *_, place = socket.getaddrinfo(host or None, port, type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE)[0]
    bound = socket.socket(family, socket.SOCK_DGRAM)
    bound.bind(place)
    return bound
