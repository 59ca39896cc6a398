"""Listening on real pseudo terminals, sockets, files: named, or explained in a sentence."""

from __future__ import annotations

import errno
import itertools
import os
import pty
import random
import socket
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from agents.drivers.transports import serial_ports, why_closed
from protocol.errors import ConfigError
from sim.receivers.nmea import sentence as nmea
from sitegrid.setup.hearing import Ear, HeardLine, block, missing
from sitegrid.setup.listening import address_of, listen, listen_to
from tests.unit.agents.drivers.frames import GGA, RMC, TPV, esf, pvt, report, ubx

IMU = esf(5, *((kind, 4) for kind in (14, 13, 5, 16, 17, 18)))
INDOORS = pvt(fix_type=0, flags=0, satellites=3)
BASE = b"\xd3\x00\x00\x47\xea\x4b"  # RTCM3, the shortest frame
NOISE = random.Random(4).randbytes(200)


@contextmanager
def repeated(send: Callable[[], object]) -> Iterator[None]:
    """Send repeatedly, like a receiver."""
    ended = threading.Event()

    def run() -> None:
        while not ended.wait(0.05):
            send()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@contextmanager
def on_a_port(folder: Path, sent: Callable[[], bytes], baud: int = 0) -> Iterator[str]:
    """A sending serial device; noise at any other than its own baud rate."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    port = folder / "ttyACM0"
    port.symlink_to(os.ttyname(slave))

    def send() -> None:
        is_set = baud in (0, termios.tcgetattr(slave)[5])
        try:
            os.write(master, sent() if is_set else NOISE)
        except BlockingIOError:  # no reader yet
            return

    try:
        with repeated(send):
            yield str(port)
    finally:
        os.close(slave)
        os.close(master)


SENTENCES = {
    "a position and an IMU": (pvt() + IMU, "ubx", ("fix", "velocity", "imu"), ""),
    "sentences": (nmea(RMC) + nmea(GGA), "nmea", ("fix", "velocity"), ""),
    "no date": (nmea(GGA), "nmea", ("fix",), "positions without a date: switch on RMC"),
    "indoors": (INDOORS, "ubx", ("fix", "velocity"), "no fix, 3 satellites: its antenna needs open sky"),
    "two on a line": (
        nmea(GGA) + nmea(GGA.replace("GN", "GP")) + nmea(RMC),
        "nmea",
        ("fix", "velocity"),
        "gn, gp send",
    ),
    "a base": (BASE, "", (), "corrections (RTCM3), and no position"),
    "other messages": (ubx("NAV-DOP"), "", (), "no positions: switch on GGA and RMC, or NAV-PVT"),
    "another protocol": (b"$@\x00\x01abc\x00", "", (), "SBF (Septentrio), which no driver reads: set it to send NMEA"),
    "garbage": (NOISE, "", (), "bytes come, but neither NMEA, UBX"),
    "silence": (b"", "", (), "nothing comes: is it powered"),
}


@pytest.mark.parametrize("case", SENTENCES)
def test_what_talks_on_a_serial_port_is_named(tmp_path: Path, case: str) -> None:
    data, kind, streams, problem = SENTENCES[case]
    with on_a_port(tmp_path, lambda: data) as port:
        heard = listen(port, 0.4, (115_200, 9600))
    assert (heard.kind, heard.streams, bool(heard.problem)) == (kind, streams, bool(problem))
    assert problem in heard.problem
    (first, *lines) = block(heard)
    assert first == port
    assert all(line.startswith("  ") for line in lines)


def test_the_baud_is_found(tmp_path: Path) -> None:
    with on_a_port(tmp_path, pvt, baud=termios.B38400) as port:
        assert listen(port, 0.2, (9600, 38_400)).baud == 38_400


def test_a_fix_is_told_with_place_time_accuracy_and_rate() -> None:
    ear = Ear()
    for i in range(11):
        ear.feed(pvt() + IMU + IMU, 10**12 + i * 10**8)
    heard = ear.heard("/dev/ttyACM0", 38_400)
    text = "\n".join(block(heard))
    for part in ("38400 baud", "NAV-PVT 10 Hz", "ESF-MEAS 21 Hz", "fixed, 24 satellites", "0.014 m", "10:15:27 UTC"):
        assert part in text
    assert heard.place[0] == pytest.approx(49.0101234)


@pytest.mark.parametrize("pieces", [1, 7, 10_000])
def test_any_bytes_in_any_pieces_are_heard_without_an_error(pieces: int) -> None:
    whole = [pvt(), nmea(GGA), nmea(RMC), report(TPV), report({"class": 3}), BASE, ubx("NAV-DOP"), b"$GNGGA,,*00"]
    draw, ear = random.Random(7), Ear()
    stream = b"".join(
        draw.choice(whole)[draw.choice((0, 0, 1)) :] + draw.randbytes(draw.choice((0, 9))) for _ in range(400)
    )
    for at in range(0, len(stream), pieces):
        ear.feed(stream[at : at + pieces], 10**12 + at)
    assert ear.heard("x").messages["ubx NAV-PVT"] >= 0
    noise = Ear()
    noise.feed(draw.randbytes(400_000) + b"$@" * 9, 10**12)
    assert "neither NMEA" in noise.heard("x").problem, "no format is read into noise"


def test_addresses_and_files_are_heard_at_once_and_gpsd_is_asked(tmp_path: Path) -> None:
    recording = tmp_path / "drive.ubx"
    recording.write_bytes(b"".join(pvt(second=20 + i) for i in range(5)))
    with socket.create_server(("127.0.0.1", 0)) as server, ExitStack() as stack:

        def serve() -> None:
            link, _ = server.accept()
            with link:
                link.sendall(report({"class": "VERSION"}))
                assert link.recv(99).startswith(b"?WATCH=")
                link.sendall(report(TPV) * 3)
                link.recv(1)

        thread = threading.Thread(target=serve)
        thread.start()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            place = free.getsockname()
        sender = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        stack.enter_context(repeated(lambda: sender.sendto(nmea(GGA) + nmea(RMC), place)))
        gpsd, datagrams = f"tcp://127.0.0.1:{server.getsockname()[1]}", f"udp://127.0.0.1:{place[1]}"
        every = listen_to([gpsd, datagrams, str(recording)], 0.5)
        thread.join()
    assert [heard.kind for heard in every] == ["gpsd", "nmea", "ubx"]
    assert every[2].messages == {"ubx NAV-PVT": 1.0}, "a recording's rate is by its own time"
    assert every[0].accuracy_m is None


def refused(number: int) -> Any:
    def opens(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    return opens


@pytest.mark.parametrize(
    ("number", "sentence"),
    [
        (errno.EACCES, "no permission: add this user to the group of the port (dialout)"),
        (errno.EBUSY, "another program has this port"),
        (errno.EAGAIN, "another program has this port"),
        (errno.ENOENT, "no such port; there "),
    ],
)
def test_a_port_that_cannot_be_opened_is_one_sentence(monkeypatch: Any, number: int, sentence: str) -> None:
    monkeypatch.setattr("sitegrid.setup.listening.open_transport", refused(number))
    assert sentence in listen("/dev/ttyACM0", 0.1).problem


def test_what_is_no_port_is_one_sentence(tmp_path: Path) -> None:
    for address in (str(tmp_path), "/dev/null"):
        assert listen(address, 0.1).problem == "it is no serial port, nor a file"
    with socket.create_server(("127.0.0.1", 0)) as closed:
        address = f"tcp://127.0.0.1:{closed.getsockname()[1]}"
    assert "nobody listens there" in listen(address, 0.1).problem
    assert address_of("gpsd") == "tcp://127.0.0.1:2947"
    with pytest.raises(ConfigError, match="neither tcp://HOST:PORT"):
        address_of("ntrip://a:1")


def test_ports_go_by_the_names_that_survive_replugging(tmp_path: Path) -> None:
    named = tmp_path / "serial" / "by-id"
    named.mkdir(parents=True)
    for name in ("ttyACM0", "ttyUSB0", "ttyS0"):
        (tmp_path / name).touch()
    (named / "usb-u-blox").symlink_to(tmp_path / "ttyACM0")
    assert serial_ports(tmp_path) == [str(named / "usb-u-blox"), str(tmp_path / "ttyUSB0")]
    assert "no such port" in why_closed(OSError(errno.ENOENT, "x"))


@pytest.mark.parametrize(
    ("streams", "sentences"),
    [
        ((), ("no position, so no sample", "no IMU: no slope", "no torque: no rolling resistance")),
        (("fix", "velocity"), ("no IMU: no slope", "no torque: no rolling resistance")),
        (("fix", "imu"), ("no torque: slope only",)),
    ],
)
def test_what_is_missing_is_said_for_position_slope_and_resistance(
    streams: tuple[str, ...], sentences: tuple[str, ...]
) -> None:
    said = missing([HeardLine("a", "ubx", streams=streams)]).values()
    assert all(want in one for want, one in itertools.zip_longest(sentences, said, fillvalue="-"))
