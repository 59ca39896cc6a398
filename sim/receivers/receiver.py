"""Simulated receivers: readings in, bytes out, quantised by their formats. Pure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from math import atan2, degrees, hypot

from agents.drivers.formats import FIX, HEADING, IMU, STREAMS, VELOCITY, WHEELS
from agents.drivers.formats.framing import NMEA, UBX
from protocol.machine.machine_config import SensorConfig
from protocol.machine.readings import Encoder, Gps, GpsVelocity, Imu, Reading
from sim.receivers.epoch import QUALITIES, Epoch, baseline
from sim.receivers.nmea import NmeaWriter
from sim.receivers.ubx import UbxWriter
from sim.sensors.presets import GpsNoise
from sim.sensors.rigs import Rig

WRITERS: dict[str, Callable[[], UbxWriter | NmeaWriter]] = {UBX: UbxWriter, NMEA: NmeaWriter}


@dataclass(frozen=True)
class Wiring:
    """A receiver of a machine.

    period_ns: between epochs. feeds: sensor per stream. base: antenna from which its heading is measured.
    """

    name: str
    format: str
    period_ns: int
    feeds: Mapping[str, SensorConfig]
    base: str = ""

    @property
    def added(self) -> tuple[SensorConfig, ...]:
        """Sensors that the receiver derives from others."""
        return tuple(sensor for stream, sensor in self.feeds.items() if stream == HEADING)


def carried(wirings: Sequence[Wiring]) -> frozenset[str]:
    """Names of all sensors sent by receivers."""
    return frozenset(sensor.name for wiring in wirings for sensor in wiring.feeds.values())


def wire(rig: Rig, format_: str) -> list[Wiring]:
    """One receiver per antenna; a first one with UBX also has an IMU and wheel ticks.

    If fixed by carrier phase, the second antenna has a heading, from the first. Other sensors, like torque, stay out.
    """
    machine, period_ns = rig.machine, 10**9 // rig.preset.gps.rate_hz
    by_kind = {kind: [s for s in machine.sensors if s.kind == kind] for kind in STREAMS.values()}
    wirings = list[Wiring]()
    for i, antenna in enumerate(by_kind[STREAMS[FIX]]):
        feeds = {FIX: antenna, VELOCITY: by_kind[STREAMS[VELOCITY]][i]}
        if i == 0 and format_ == UBX:
            feeds |= {stream: by_kind[STREAMS[stream]][0] for stream in (IMU, WHEELS) if by_kind[STREAMS[stream]]}
        base = wirings[0].feeds[FIX] if i == 1 and _is_fixed(rig.preset.gps) else None
        if base:
            feeds[HEADING] = _compass(base, antenna)
        name = f"{machine.name}-{antenna.name}"
        wirings.append(Wiring(name, format_, period_ns, feeds, base.name if base else ""))
    return wirings


def _is_fixed(noise: GpsNoise) -> bool:
    return noise.scale * hypot(noise.drift_std_m, noise.white_std_m) <= QUALITIES["fixed"]


def _compass(base: SensorConfig, rover: SensorConfig) -> SensorConfig:
    """Two antennas as a heading sensor, x from the first to the second."""
    ahead_m, left_m = (b - a for a, b in zip(base.mount.xyz_m[:2], rover.mount.xyz_m[:2], strict=True))
    mount = replace(rover.mount, rpy_deg=(0.0, 0.0, round(degrees(atan2(left_m, ahead_m)), 2)))
    return SensorConfig("antennas", STREAMS[HEADING], mount, measures=("heading",))


class SimulatedReceiver:
    """One receiver; without a fix every epoch says so."""

    def __init__(self, wiring: Wiring) -> None:
        self._wiring = wiring
        self._writer = WRITERS[wiring.format]()
        self._due_ns = 0

    def speak(self, readings: Sequence[Reading]) -> bytes:
        """Bytes for a machine's readings, ordered by stamp."""
        spoken = bytearray()
        for stamp_ns, group in groupby(readings, lambda reading: reading.stamp_ns):
            spoken += self._speak_of(stamp_ns, {reading.sensor: reading for reading in group})
        return bytes(spoken)

    def _speak_of(self, stamp_ns: int, at_once: Mapping[str, Reading]) -> bytes:
        own = {stream: at_once.get(sensor.name) for stream, sensor in self._wiring.feeds.items()}
        spoken = b""
        if isinstance(self._writer, UbxWriter):
            if isinstance(imu := own.get(IMU), Imu):
                spoken += self._writer.imu(imu)
            if isinstance(wheels := own.get(WHEELS), Encoder):
                spoken += self._writer.wheels(wheels)
        fix, motion, base = own.get(FIX), own.get(VELOCITY), at_once.get(self._wiring.base)
        if isinstance(fix, Gps):
            line = baseline(base, fix) if isinstance(base, Gps) else None
            spoken += self._epoch(Epoch(stamp_ns, fix, motion if isinstance(motion, GpsVelocity) else None, line))
        elif self._due_ns and stamp_ns >= self._due_ns:
            spoken += self._epoch(Epoch(stamp_ns))
        return spoken

    def _epoch(self, epoch: Epoch) -> bytes:
        self._due_ns = epoch.utc_ns + self._wiring.period_ns
        return self._writer.epoch(epoch)
