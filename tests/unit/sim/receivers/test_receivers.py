"""Simulated receivers' bytes, read by foreign libraries and by an agent."""

from __future__ import annotations

import io
import math
from contextlib import closing
from dataclasses import astuple, replace
from itertools import accumulate, pairwise

import pynmeagps
import pytest
import pyubx2

from agents.drivers.line import Line
from protocol.machine.readings import Encoder, Gps, GpsVelocity, Reading
from sim.config import SimConfig
from sim.receivers.epoch import GEOID_M
from sim.receivers.receiver import SimulatedReceiver, Wiring, wire
from sim.simulator import Simulator

pytestmark = pytest.mark.slow
SECONDS = 12.0  # contains an outage of 1 s within 10 s


class Driven:
    """A short drive of one machine: readings, wirings, bytes."""

    def __init__(self, format_: str, preset: str, seed: int = 11) -> None:
        config = SimConfig("loading", world="fast", machines=1, seed=seed, seconds=SECONDS, receivers=format_)
        with closing(Simulator(replace(config, preset=preset))) as simulator:
            self.wirings = wire(simulator.scenario.rigs()[0], format_)
            receivers = [SimulatedReceiver(wiring) for wiring in self.wirings]
            self.readings, self.sent = list[Reading](), [b""] * len(receivers)
            for _ in range(simulator.bundles or 0):
                (span,) = simulator.advance().values()
                self.readings += span
                self.sent = [data + each.speak(span) for data, each in zip(self.sent, receivers, strict=True)]

    def readings_of(self, wiring: Wiring, stream: str) -> list[Reading]:
        return [reading for reading in self.readings if reading.sensor == wiring.feeds[stream].name]


@pytest.fixture(scope="module", params=["dgps", "rtk"])
def ubx(request: pytest.FixtureRequest) -> Driven:
    return Driven("ubx", request.param)


@pytest.fixture(scope="module", params=["dgps", "rtk"])
def nmea(request: pytest.FixtureRequest) -> Driven:
    return Driven("nmea", request.param)


def by_pyubx2(data: bytes, identity: str) -> list[pyubx2.UBXMessage]:
    read = pyubx2.UBXReader(io.BytesIO(data), protfilter=2, quitonerror=2)
    return [message for _, message in read if message.identity == identity]


def by_pynmeagps(data: bytes, identity: str) -> list[pynmeagps.NMEAMessage]:
    read = pynmeagps.NMEAReader(io.BytesIO(data), nmeaonly=True, quitonerror=2)
    return [message for _, message in read if message.msgID == identity]


def test_the_oracle_reads_fixes_of_ubx_as_they_were_measured_to_their_last_digit(ubx: Driven) -> None:
    for wiring, data in zip(ubx.wirings, ubx.sent, strict=True):
        read = by_pyubx2(data, "NAV-PVT")
        located = [message for message in read if message.fixType]
        assert 0 < len(read) - len(located) < 10, "an outage is said"
        fixes, motions = ubx.readings_of(wiring, "fix"), ubx.readings_of(wiring, "velocity")
        for message, fix, motion in zip(located, fixes, motions, strict=True):
            assert isinstance(fix, Gps)
            assert isinstance(motion, GpsVelocity)
            assert (message.lat, message.lon) == pytest.approx((fix.lat_deg, fix.lon_deg), abs=0.51e-7)
            assert (message.height, message.hMSL + GEOID_M * 1e3) == pytest.approx((fix.height_m * 1e3,) * 2, abs=0.51)
            assert (message.velE, message.velN) == pytest.approx([v * 1e3 for v in astuple(motion)[2:4]], abs=0.51)
            assert message.hAcc == pytest.approx(fix.var_e_m2**0.5 * 1e3, abs=0.51)
            assert message.sAcc == pytest.approx(motion.var_e_m2ps2**0.5 * 1e3, abs=0.51)
            seconds = (message.hour * 60 + message.min) * 60 + message.second
            assert seconds * 10**9 + message.nano == fix.stamp_ns % (86_400 * 10**9)
            assert (message.iTOW - 18_000 - fix.stamp_ns // 10**6) % 86_400_000 == 0


def test_the_oracle_reads_imu_and_wheels_in_their_units(ubx: Driven) -> None:
    read, wiring = by_pyubx2(ubx.sent[0], "ESF-MEAS"), ubx.wirings[0]
    inertial = [message for message in read if message.numMeas == 6]
    for message, imu in zip(inertial, ubx.readings_of(wiring, "imu"), strict=True):
        fields = [(getattr(message, f"dataField_{i:02}") ^ 1 << 23) - (1 << 23) for i in range(1, 7)]
        assert [getattr(message, f"dataType_{i:02}") for i in range(1, 7)] == [14, 13, 5, 16, 17, 18]
        measured = [math.degrees(rate) * 2**12 for rate in astuple(imu)[2:5]] + [f * 2**10 for f in astuple(imu)[5:]]
        assert fields == pytest.approx(measured, abs=0.51)
        assert message.timeTag == imu.stamp_ns // 10**6 % 2**32
    wheels = [(m.dataType_01, m.dataType_02, m.dataField_01, m.dataField_02) for m in read if m.numMeas == 2]
    signed = [[w & 0x7FFFFF for w in words[2:]] for words in wheels]
    ticks = [reading.left_ticks for reading in ubx.readings_of(wiring, "wheels") if isinstance(reading, Encoder)]
    steps = [0.0, *(abs(b - a) for a, b in pairwise(ticks))]
    assert [left for left, _ in signed] == list(accumulate(map(int, steps)))
    assert {words[:2] for words in wheels} == {(8, 9)}


def test_two_antennas_fixed_by_carrier_phase_have_a_heading(ubx: Driven) -> None:
    """Its variance is right: few of 50 headings err by more than two standard deviations."""
    base, rover = ubx.wirings
    read = by_pyubx2(ubx.sent[1], "NAV-RELPOSNED")
    assert by_pyubx2(ubx.sent[0], "NAV-RELPOSNED") == []
    if rover.base:
        assert 30 < len(read) < 60
        feeds = {"heading": rover.feeds["heading"]}
        headings = [v.values for v in Line("ubx", feeds).feed(ubx.sent[1], None) if v.sensor]
        for message, values in zip(read, headings, strict=True):
            east_m, north_m = (getattr(message, f"relPos{axis}") / 100 for axis in "EN")
            assert message.relPosHeading == pytest.approx(math.degrees(math.atan2(east_m, north_m)) % 360, abs=1.0)
            assert values[-1] == pytest.approx(math.radians(message.accHeading) ** 2)
            assert 0.5 < message.accHeading < 3, "two fixes of 1 cm, 0.78 m apart"
    else:
        assert read == []
    assert base.base == ""


def test_the_oracle_reads_sentences_as_they_were_measured_to_their_last_digit(nmea: Driven) -> None:
    for wiring, data in zip(nmea.wirings, nmea.sent, strict=True):
        read = {name: by_pynmeagps(data, name) for name in ("GGA", "RMC", "VTG", "GST", "THS")}
        assert len({len(read[name]) for name in ("GGA", "RMC", "VTG", "GST")}) == 1
        is_fine = bool(nmea.wirings[1].base)
        least_deg, least_m = (0.51e-7 / 60, 0.00051) if is_fine else (0.51e-5 / 60, 0.051)
        located = [
            each for each in zip(*(read[n] for n in ("GGA", "RMC", "GST", "VTG")), strict=True) if each[0].quality
        ]
        fixes, motions = nmea.readings_of(wiring, "fix"), nmea.readings_of(wiring, "velocity")
        for (gga, rmc, gst, vtg), fix, motion in zip(located, fixes, motions, strict=True):
            assert isinstance(fix, Gps)
            assert isinstance(motion, GpsVelocity)
            for message in (gga, rmc):
                place = message.lat, message.lon
                assert place == pytest.approx((fix.lat_deg, fix.lon_deg), abs=least_deg + 0.5e-10)
            assert gga.alt + gga.sep == pytest.approx(fix.height_m, abs=least_m)
            assert (gst.stdLat, gst.stdAlt) == pytest.approx((fix.var_n_m2**0.5, fix.var_u_m2**0.5), abs=least_m)
            speed_mps = math.hypot(motion.velocity_e_mps, motion.velocity_n_mps)
            assert rmc.spd == vtg.sogn == pytest.approx(speed_mps * 3600 / 1852, abs=0.00051)
            if rmc.cog != "":
                course = math.degrees(math.atan2(motion.velocity_e_mps, motion.velocity_n_mps))
                assert math.remainder(rmc.cog - course, 360) == pytest.approx(0, abs=0.0051)
        assert bool(read["THS"]) == bool(wiring.base)


@pytest.mark.parametrize("format_", ["ubx", "nmea"])
def test_an_agent_reads_every_reading_that_a_receiver_carries(format_: str) -> None:
    driven = Driven(format_, "dgps", seed=12)
    for wiring, data in zip(driven.wirings, driven.sent, strict=True):
        line = Line(format_, wiring.feeds)
        counted = [value.sensor for value in line.feed(data, 10**15) if value.sensor]
        for stream, sensor in wiring.feeds.items():
            assert counted.count(sensor.name) == len(driven.readings_of(wiring, stream)), stream
        assert line.counters["bytes_broken"] == 0
        assert 0 < line.counters["no_fix"] < 10
        assert "malformed" not in line.counters
