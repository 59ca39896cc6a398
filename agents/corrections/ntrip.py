"""Stream of an NTRIP caster's mountpoint, versions 1 and 2 (RTCM 10410), with or without TLS.

OSError or LinkError if it breaks or the caster refuses; the reader opens another. Buffers are bounded: the caster's
answer, and the line before a chunk.
"""

import re
import socket
import ssl
import time
from base64 import b64encode
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from urllib.parse import urlsplit

from protocol.errors import ConfigError, LinkError, one_line
from protocol.version import package_version

PORTS = {"ntrip": 2101, "ntrips": 443}
PIECE_BYTES = 4096
CONNECT_S = 10.0  # timeout, also of the answer, for mobile networks
SILENT_S = 60.0  # bases send every second; a link silent for so long is dead
POSITION_S = 10.0  # interval of GGA, for networks of bases
MAX_ANSWER_BYTES = 16_384  # of an answer's head, or of a list of mountpoints
MAX_NAMED = 5  # mountpoints named in a sentence
_CHUNK = re.compile(rb"[ \t]*([0-9a-fA-F]{1,7})[ \t]*(;[^\n]*)?\r?")


@dataclass(frozen=True)
class Caster:
    """A mountpoint and its user. is_encrypted: with TLS."""

    host: str
    port: int
    mountpoint: str
    user: str = ""
    password: str = ""
    is_encrypted: bool = False

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


def parse_caster(address: str, user: str = "", password: str = "") -> Caster:
    """Parse `ntrip://HOST[:PORT]/MOUNTPOINT`, or `ntrips://` with TLS; ConfigError."""
    parts = urlsplit(address)
    try:
        port = parts.port or PORTS.get(parts.scheme)
    except ValueError:
        port = None
    mountpoint = parts.path.removeprefix("/")
    if not port or not parts.hostname or not re.fullmatch(r"[!-~]{1,100}", mountpoint):
        raise ConfigError(address, "is not like ntrip://HOST[:PORT]/MOUNTPOINT (ntrips: with TLS)")
    if parts.username is not None:
        raise ConfigError(parts.hostname, "say who asks in `user` and `password`, not the address: everybody sees it")
    return Caster(parts.hostname, port, mountpoint, user, password, parts.scheme == "ntrips")


def gga(latitude_deg: float, longitude_deg: float, height_m: float, now: datetime) -> str:
    """A position as an NMEA GGA sentence with a fix."""
    parts = [f"GPGGA,{now:%H%M%S}.00"]
    for angle_deg, signs, digits in ((latitude_deg, "NS", 2), (longitude_deg, "EW", 3)):
        degrees, millionths = divmod(round(abs(angle_deg) * 60e6), 60_000_000)
        minutes = f"{millionths // 10**6:02}.{millionths % 10**6:06}"
        parts.append(f"{degrees:0{digits}}{minutes},{signs[angle_deg < 0]}")
    body = ",".join([*parts, f"1,12,1.0,{height_m:.1f},M,0.0,M,,"])
    checksum = 0
    for byte in body.encode():
        checksum ^= byte
    return f"${body}*{checksum:02X}"


class NtripStream:
    """An open stream. place: latitude, longitude [deg], height [m] sent to the caster, or None."""

    def __init__(
        self,
        caster: Caster,
        place: tuple[float, float, float] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._caster, self._place, self._clock = caster, place, clock
        self._socket = _connect(caster)
        try:
            self._socket.sendall(_request(caster))
            self._stated_s = self._heard_s = -1e9
            self._state_place()
            rest, is_chunked = self._answer()
        except BaseException:
            self._socket.close()
            raise
        self._heard_s = clock()
        self._chunks = Chunks() if is_chunked else None
        self._waiting = rest

    def read(self, timeout_s: float) -> bytes:
        """New bytes, maybe none; OSError or LinkError if the link broke."""
        self._state_place()
        data, self._waiting = self._waiting or self._receive(timeout_s), b""
        if data:
            self._heard_s = self._clock()
        elif self._clock() - self._heard_s > SILENT_S:
            raise LinkError(self._caster, f"{self._caster.mountpoint} sends nothing: is its base on?")
        return self._chunks.feed(data) if self._chunks else data

    def close(self) -> None:
        """Hang up."""
        self._socket.close()

    def _receive(self, timeout_s: float) -> bytes:
        self._socket.settimeout(max(timeout_s, 0.001))  # 0 would not wait for the rest of a TLS record
        try:
            data = self._socket.recv(PIECE_BYTES)
        except TimeoutError:
            return b""
        if not data:
            raise LinkError(self._caster, "the caster hung up")
        return data

    def _state_place(self) -> None:
        if self._place and self._clock() - self._stated_s > POSITION_S:
            self._stated_s = self._clock()
            self._socket.settimeout(CONNECT_S)
            self._socket.sendall(f"{gga(*self._place, datetime.now(UTC))}\r\n".encode())

    def _answer(self) -> tuple[bytes, bool]:
        answer, end_s = b"", self._clock() + CONNECT_S
        while (judged := judge(answer, self._caster, is_all=len(answer) > MAX_ANSWER_BYTES)) is None:
            if (left_s := end_s - self._clock()) <= 0:
                raise LinkError(self._caster, "no answer in time: is it an NTRIP caster?")
            try:
                answer += self._receive(left_s)
            except LinkError:
                if not answer:
                    raise
                return judge(answer, self._caster, is_all=True) or (b"", False)
        return judged


def judge(answer: bytes, caster: Caster, *, is_all: bool = False) -> tuple[bytes, bool] | None:
    """Judge a caster's answer; returns the bytes behind it, and whether they are chunked; None if incomplete.

    is_all: no more will come. LinkError: why the caster refuses.
    """
    status, has_head, body = answer.partition(b"\n")  # version 1: data may follow the first line
    head = b""
    if is_http := status.startswith(b"HTTP/"):
        end = re.search(rb"\r?\n\r?\n", answer)
        head, has_head, body = (answer[: end.start()], end[0], answer[end.end() :]) if end else (answer, b"", b"")
    if not has_head and not is_all:
        return None
    code = (*status.split(), b"", b"")[1]
    fields = dict(re.findall(rb"^([\w-]+):[ \t]*([^\n]*?)[ \t\r]*$", head.lower(), re.MULTILINE))
    content = fields.get(b"content-type", b"gnss/data")
    if status.startswith(b"SOURCETABLE") or (code == b"200" and content.startswith(b"gnss/sourcetable")):
        if not is_all and b"ENDSOURCETABLE" not in body:
            return None
        names = [name.decode("ascii", "replace") for name in re.findall(rb"^STR;([^;\r\n]*)", body, re.MULTILINE)]
        some = f"; it has {', '.join(names[:MAX_NAMED])}{' and others' * (len(names) > MAX_NAMED)}" if names else ""
        raise LinkError(caster, f"there is no mountpoint {caster.mountpoint}{some}")
    if code in (b"401", b"403") or b"bad password" in status.lower():
        raise LinkError(
            caster, f"the caster refuses {caster.mountpoint} to user {caster.user!r}: wrong user or password"
        )
    if code == b"404":
        raise LinkError(caster, f"there is no mountpoint {caster.mountpoint}")
    is_data = content.startswith((b"gnss/", b"application/octet-stream"))
    if not ((status.startswith(b"ICY 200") or (is_http and code == b"200" and is_data)) and has_head):
        said = one_line(status[:80].decode("ascii", "replace").strip())
        raise LinkError(caster, f"answers {said!r}: no NTRIP caster, or it cannot serve {caster.mountpoint} now")
    return body, b"chunked" in fields.get(b"transfer-encoding", b"")


class Chunks:
    """A chunked body's bytes (RFC 9112, section 7.1)."""

    def __init__(self) -> None:
        self._left = 0  # bytes of a chunk and its line end
        self._line = b""

    def feed(self, data: bytes) -> bytes:
        """Body bytes in these; OSError at the end, or if malformed."""
        body = bytearray()
        while data:
            if self._left:
                body += data[: max(self._left - 2, 0)]
                taken = min(self._left, len(data))
                self._left, data = self._left - taken, data[taken:]
                continue
            line, end, data = data.partition(b"\n")
            self._line += line
            size = _CHUNK.fullmatch(self._line) if end else None
            if (end and not size) or len(self._line) > PIECE_BYTES:
                raise OSError("the caster's chunks are malformed")
            if size:
                if not int(size[1], 16):
                    raise ConnectionResetError("the caster ended the stream")
                self._left, self._line = int(size[1], 16) + 2, b""
        return bytes(body)


def _connect(caster: Caster) -> socket.socket:
    link = socket.create_connection((caster.host, caster.port), CONNECT_S)
    if not caster.is_encrypted:
        return link
    try:
        return ssl.create_default_context().wrap_socket(link, server_hostname=caster.host)
    except (ssl.SSLError, TimeoutError) as error:
        link.close()
        if isinstance(error, ssl.SSLCertVerificationError):
            raise LinkError(caster, f"its certificate is not trusted: {error.verify_message}") from None
        raise LinkError(caster, "does not speak TLS: is it ntrip:// in place of ntrips://?") from None


def _request(caster: Caster) -> bytes:
    lines = [
        f"GET /{caster.mountpoint} HTTP/1.1",
        f"Host: {caster}",
        "Ntrip-Version: Ntrip/2.0",
        f"User-Agent: NTRIP sitegrid/{package_version()}",
        "Connection: close",
    ]
    if caster.user:
        secret = b64encode(f"{caster.user}:{caster.password}".encode()).decode()
        lines.append(f"Authorization: Basic {secret}")
    return "\r\n".join([*lines, "", ""]).encode()
