"""The relay at a caster over real sockets: both protocol versions, refusals, a dying caster."""

from __future__ import annotations

import datetime as dt
import random
import ssl
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from agents.corrections.ntrip import CONNECT_S, NtripStream, gga, parse_caster
from agents.corrections.relay import Relay, RelayConfig
from agents.corrections.rtcm import whole_frames
from protocol.errors import ConfigError, LinkError
from protocol.wire.codec import decode_corrections
from protocol.wire.messages import Corrections
from tests.patience import PATIENCE_S
from tests.unit.agents.corrections.caster import Caster, Serve, floods, sends
from tests.unit.agents.corrections.test_rtcm import frame
from tests.unit.agents.drives import SITE

FRAMES = [frame(random.Random(seed), 200) for seed in range(20)]
DATA = b"".join(FRAMES)
LONG = [frame(random.Random(seed), 1023) for seed in range(60)]  # of many messages
OK = b"ICY 200 OK\r\n"
V2 = b"HTTP/1.1 200 OK\r\nNtrip-Version: Ntrip/2.0\r\nContent-Type: gnss/data\r\n"
TABLE = b"STR;EAST;x;RTCM 3.2;\r\nSTR;SOUTH;x;RTCM 3.2;\r\nENDSOURCETABLE\r\n"


def chunked(data: bytes, size: int) -> bytes:
    pieces = (data[at : at + size] for at in range(0, len(data), size))
    return b"".join(b"%X;x=1\r\n%b\r\n" % (len(piece), piece) for piece in pieces)


class Running:
    """A relay, step by step; `waits`: pauses before reconnecting."""

    def __init__(self, port: int, scheme: str = "ntrip", host: str = "127.0.0.1") -> None:
        self.said: list[Corrections] = []
        self.waits: list[float] = []
        config = RelayConfig("base-1", f"{scheme}://{host}:{port}/NORTH", user="rover", password="s:cret")
        self.relay = Relay(self._publish, config, SITE, self.waits.append)

    def _publish(self, payload: bytes) -> None:
        self.said.append(decode_corrections(payload, "base-1"))

    @property
    def frames(self) -> list[bytes]:
        return whole_frames(b"".join(message.frames for message in self.said))

    def until(self, is_so: Callable[[], object]) -> None:
        end_s = time.monotonic() + PATIENCE_S
        while not is_so():
            assert self.relay.step()
            assert len(self.relay._framer._buffer) < 10_000
            assert time.monotonic() < end_s, self.said[-3:]


@pytest.mark.parametrize(
    "pieces",
    [
        (OK, DATA),
        (OK + b"\r\n" + DATA,),
        (OK + b"Server: caster\r\nDate: today\r\n\r\n" + DATA,),
        (V2 + b"\r\n" + DATA,),
        (b"HTTP/1.0 200 OK\r\n\r\n" + DATA,),
        (V2 + b"Transfer-Encoding: chunked\r\n\r\n", chunked(DATA, 7), b"1F4\r\n"),
        (OK + b"".join(LONG),),
        tuple(bytes([byte]) for byte in OK + DATA[:600]),
    ],
)
def test_frames_come_by_either_version_however_they_are_cut(pieces: tuple[bytes, ...]) -> None:
    expected = LONG if LONG[0] in pieces[0] else FRAMES[:2] if len(pieces) > 100 else FRAMES
    with Caster(sends(*pieces)) as caster:
        running = Running(caster.port)
        running.until(lambda: running.frames == expected)
        running.relay.close()
    (request,) = caster.requests
    assert request.startswith("GET /NORTH HTTP/1.1\r\n")
    assert "Authorization: Basic cm92ZXI6czpjcmV0\r\n" in request
    assert not any(message.problem or len(message.frames) > 8192 for message in running.said)


def test_a_caster_that_dies_is_asked_again_ever_later_until_it_is_back() -> None:
    caster = Caster(sends(OK, FRAMES[0], stays=False))
    running = Running(caster.port)
    running.until(lambda: "hung up" in running.relay.problem)
    caster.kill()
    running.until(lambda: len(running.waits) > 9)
    assert running.waits[-3:] == [60.0] * 3
    assert "nobody listens there" in running.said[-1].problem
    with Caster(sends(OK, FRAMES[1]), port=caster.port):
        running.until(lambda: FRAMES[1] in running.frames)
        assert not running.relay.problem
        running.relay.close()


@pytest.mark.parametrize(
    ("serve", "sentence"),
    [
        (sends(b"HTTP/1.1 401 Unauthorized\r\n\r\n"), "refuses NORTH to user 'rover': wrong user or password"),
        (sends(b"ERROR - Bad Password\r\n"), "refuses NORTH to user 'rover': wrong user or password"),
        (sends(b"HTTP/1.1 404 Not Found\r\n\r\n", stays=False), "there is no mountpoint NORTH"),
        (sends(b"SOURCETABLE 200 OK\r\n\r\n" + TABLE), "there is no mountpoint NORTH; it has EAST, SOUTH"),
        (
            sends(b"HTTP/1.1 200 OK\r\nContent-Type: gnss/sourcetable\r\n\r\n" + TABLE[:9], stays=False),
            "no mountpoint NORTH; it has",
        ),
        (sends(b"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\n\r\n<html>"), "no NTRIP caster"),
        (sends(b"HTTP/1.1 503 Busy\r\n\r\n"), "answers 'HTTP/1.1 503 Busy'"),
        (sends(DATA), "no NTRIP caster"),
        (sends(stays=False), "hung up"),
        (floods(b"x" * 4096), "no NTRIP caster"),
        (floods(b"A: b\r\n" * 500, b"HTTP/1.1 200 OK\r\n"), "no NTRIP caster"),
        (floods(b"STR;x\r\n" * 500, b"SOURCETABLE 200 OK\r\n"), "no mountpoint NORTH; it has x, x, x, x, x and others"),
        (floods(b"1" * 4096, V2 + b"Transfer-Encoding: chunked\r\n\r\n"), "chunks are malformed"),
        (sends(V2 + b"Transfer-Encoding: chunked\r\n\r\n-5\r\n"), "chunks are malformed"),
        (sends(V2 + b"Transfer-Encoding: chunked\r\n\r\n0\r\n\r\n"), "ended the stream"),
    ],
)
def test_a_caster_that_refuses_is_one_sentence_to_the_machines(serve: Serve, sentence: str) -> None:
    with Caster(serve) as caster:
        running = Running(caster.port)
        running.until(lambda: running.relay.problem)
    assert sentence in running.said[-1].problem
    assert f"127.0.0.1:{caster.port}" in running.said[-1].problem
    assert "\n" not in running.said[-1].problem


def test_garbage_without_end_is_held_in_a_bounded_buffer_and_named() -> None:
    with Caster(floods(b"\xd3\x03\xffgarbage" * 100, OK)) as caster:
        running = Running(caster.port)
        running.relay._framed_s = float("-inf")
        running.until(lambda: running.relay._stream)
        running.relay._framed_s = float("-inf")
        running.until(lambda: "no RTCM3" in running.relay.problem)
        running.relay.close()


def test_a_caster_that_says_nothing_is_given_up() -> None:
    times = iter(range(0, 10**6, round(CONNECT_S)))
    with Caster(sends()) as caster, pytest.raises(LinkError, match="no answer in time"):
        NtripStream(parse_caster(f"ntrip://127.0.0.1:{caster.port}/X"), clock=lambda: float(next(times)))
    with Caster(sends(OK)) as caster:
        now_s = [0.0]
        stream = NtripStream(parse_caster(f"ntrip://127.0.0.1:{caster.port}/X"), clock=lambda: now_s[0])
        assert stream.read(0.0) == b""
        now_s[0] = 61.0
        with pytest.raises(LinkError, match="sends nothing: is its base on"):
            stream.read(0.0)
        stream.close()


def test_a_caster_is_told_the_place_every_ten_seconds() -> None:
    heard: list[bytes] = []

    def serve(link: object) -> None:
        link.sendall(OK)  # type: ignore[attr-defined]
        while data := link.recv(4096):  # type: ignore[attr-defined]
            heard.append(data)

    now_s = [0.0]
    with Caster(serve) as caster:
        address = parse_caster(f"ntrip://127.0.0.1:{caster.port}/X")
        stream = NtripStream(address, (48.1173, -11.5, 545.4), lambda: now_s[0])
        for now_s[0] in (5.0, 10.5, 12.0, 21.0):
            stream.read(0.0)
        stream.close()
    stated = caster.requests[0].partition("\r\n\r\n")[2].encode() + b"".join(heard)
    assert stated.count(b"$GPGGA,") == 3
    assert stated.count(b",4807.038000,N,01130.000000,W,1,12,1.0,545.4,M,0.0,M,,*") == 3


@pytest.mark.parametrize(
    ("place", "sentence"),
    [
        (
            (48 + 7.038 / 60, 11 + 31 / 60, 545.4),
            "4807.038000,N,01131.000000,E,1,12,1.0,545.4,M,0.0,M,,",
        ),
        (
            (-0.99999999999, 179.99999999999, -3.0),
            "0100.000000,S,18000.000000,E,1,12,1.0,-3.0,M,0.0,M,,",
        ),
    ],
)
def test_a_place_is_a_sentence_with_its_checksum(place: tuple[float, float, float], sentence: str) -> None:
    made = gga(*place, dt.datetime(2026, 1, 1, 12, 35, 19, tzinfo=dt.UTC))
    checksum = 0
    for byte in made[1:-3].encode():
        checksum ^= byte
    assert made == f"$GPGGA,123519.00,{sentence}*{checksum:02X}"


def test_tls_needs_a_certificate_that_is_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = _certificate(tmp_path)
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    server.load_cert_chain(file)
    with Caster(sends(OK, DATA), tls=server) as caster:
        running = Running(caster.port, "ntrips", "localhost")
        running.until(lambda: "certificate is not trusted" in running.relay.problem)
        monkeypatch.setenv("SSL_CERT_FILE", str(file))
        running.until(lambda: running.frames == FRAMES)
        running.relay.close()
    with Caster(sends(b"HTTP/1.1 400 Bad Request\r\n\r\n"), asks=False) as caster:
        running = Running(caster.port, "ntrips", "localhost")
        running.until(lambda: running.relay.problem)
        assert "does not speak TLS" in running.relay.problem


@pytest.mark.parametrize("address", ["ntrip://host", "ntrip:///X", "http://h/X", "ntrip://h:99999/X", "ntrip://h/a b"])
def test_what_is_no_address_of_a_caster_is_refused(address: str) -> None:
    with pytest.raises(ConfigError, match="is not like"):
        parse_caster(address)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"source": "ntrip://user:secret@host/X"}, "not the address"),
        ({"source": "ntrip://host"}, "is not like"),
        ({"source": "http://host:80"}, "neither tcp"),
        ({"source": "/dev/ttyACM0", "user": "me"}, "of a caster alone"),
        ({"name": "Base 1"}, "not a name"),
    ],
)
def test_a_relay_that_cannot_be_is_refused(options: dict[str, str], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        RelayConfig(**{"name": "base-1", "source": "tcp://host:1", **options})  # type: ignore[arg-type]


def _certificate(folder: Path) -> Path:
    """Key and certificate of `localhost`, one file."""
    pytest.importorskip("cryptography")
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    key, name = (
        ec.generate_private_key(ec.SECP256R1()),
        x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "localhost")]),
    )
    now = dt.datetime.now(dt.UTC)
    made = x509.CertificateBuilder(name, name, key.public_key(), 1, now - dt.timedelta(1), now + dt.timedelta(1))
    made = made.add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), critical=False)
    made = made.add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    file = folder / "caster.pem"
    file.write_bytes(private + made.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM))
    return file
