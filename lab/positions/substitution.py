"""Recordings with other readings: what an agent would have read on the same drive, had its sensors been others.

The truth that makes them stays in this package; agents get readings and nothing else.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from lab.campaign.recordings import RecordedDrive, track_file
from protocol.arrays import Floats, Ints
from protocol.machine.machine_config import BASE, MachineConfig, SensorConfig
from protocol.machine.readings import Encoder, Gps, Imu, Reading
from protocol.site.site_config import Projection
from sim.sensors.frames import map_from_base
from sim.sensors.gps import ReceiverErrors
from sim.sensors.noise import generator
from sim.sensors.presets import BASE_RATE_HZ, GpsNoise
from sim.simulator import START_NS
from sitegrid.proof.tracks import Truth, interpolate

STEP_NS = 1_000_000_000 // BASE_RATE_HZ  # of the simulated world


@dataclass(frozen=True)
class TrueMotion:
    """True motion of `base_link` at n instants.

    stamp_ns: (n,). position_m: (n, 3) in `map`. attitude_rad: roll, pitch, yaw (n, 3), without jumps.
    """

    stamp_ns: Ints
    position_m: Floats
    attitude_rad: Floats

    def antenna_m(self, sensor: SensorConfig, stamp_ns: Ints) -> Floats:
        """Where an antenna truly is at other instants (m,): (m, 3) in `map`; NaN outside of the known ones."""
        roll, pitch, yaw = interpolate(stamp_ns, self.stamp_ns, self.attitude_rad).T
        lever = np.broadcast_to(np.array(sensor.mount.xyz_m)[:, None], (3, len(stamp_ns)))
        antenna: Floats = (
            interpolate(stamp_ns, self.stamp_ns, self.position_m) + map_from_base(lever, yaw, pitch, roll).T
        )
        return antenna

    def distance_m(self, stamp_ns: Ints) -> Floats:
        """How far it has moved ahead and to the left, in its own axes, at other instants (m,): (m, 2)."""
        return self._integral(self.velocity_mps()[:, :2], stamp_ns)

    def sideways_m(self, stamp_ns: Ints) -> Floats:
        """What sliding sideways has added to its place at other instants (m,), east and north: (m, 2)."""
        yaw, pitch, roll = self.attitude_rad.T[::-1]
        sliding = np.stack([np.zeros_like(yaw), self.velocity_mps()[:, 1], np.zeros_like(yaw)])
        return self._integral(map_from_base(sliding, yaw, pitch, roll).T[:, :2], stamp_ns)

    def velocity_mps(self) -> Floats:
        """Velocity at its own instants, ahead, left and up in its axes: (n, 3)."""
        in_map = CubicSpline(self._time_s(self.stamp_ns), self.position_m)(self._time_s(self.stamp_ns), 1)
        roll, pitch, yaw = self.attitude_rad.T
        axes = [map_from_base(axis[:, None] * np.ones_like(yaw), yaw, pitch, roll).T for axis in np.eye(3)]
        return np.stack([(axis * in_map).sum(axis=1) for axis in axes], axis=1)

    def turn_rate_radps(self, stamp_ns: Ints) -> Floats:
        """Angular rate about its own upright axis at other instants (m,), within the known ones."""
        angles, time_s = CubicSpline(self._time_s(self.stamp_ns), self.attitude_rad), self._time_s(stamp_ns)
        roll, pitch, _ = angles(time_s).T
        _, pitching, turning = angles(time_s, 1).T
        rate: Floats = turning * np.cos(pitch) * np.cos(roll) - pitching * np.sin(roll)
        return rate

    def _integral(self, rates: Floats, stamp_ns: Ints) -> Floats:
        """Integral of rates (n, k) at its own instants, from the first of them on: at other instants (m,), (m, k)."""
        integral: Floats = CubicSpline(self._time_s(self.stamp_ns), rates).antiderivative()(self._time_s(stamp_ns))
        return integral

    def _time_s(self, stamp_ns: Ints) -> Floats:
        return np.asarray(stamp_ns - self.stamp_ns[0], float) * 1e-9


@dataclass(frozen=True)
class GpsErrors:
    """Errors of one receiver at r instants, east, north and up (r, 3) each [m].

    stamp_ns: (r,), all instants at which it reads, silent or not. stated_m2: the variances (3,) that it states.
    """

    stamp_ns: Ints
    slow_m: Floats
    white_m: Floats
    stated_m2: Floats

    @property
    def total_m(self) -> Floats:
        """What a fix is off (r, 3)."""
        return self.slow_m + self.white_m

    def rows(self, stamp_ns: Ints) -> Ints:
        """Which instants these stamps (m,) are (m,); ValueError where one is none of them."""
        rows = np.searchsorted(self.stamp_ns, stamp_ns).clip(max=len(self.stamp_ns) - 1)
        if (self.stamp_ns[rows] != stamp_ns).any():
            raise ValueError("a receiver was read between its instants: another rate, or a faulty clock")
        return rows


def true_motion(folder: Path) -> TrueMotion:
    """The true motion of a recording's machine; folder: of the recording."""
    table = np.genfromtxt(track_file(folder), delimiter=",", names=True, dtype=None)
    angles = [np.unwrap(table[name]) for name in ("roll", "pitch", "yaw")]
    position_m = np.stack([table[name] for name in "xyz"], axis=1)
    return TrueMotion(table["stamp_ns"].astype(np.int64), position_m, np.stack(angles, axis=1))


def gps_errors(
    machine: MachineConfig, noise: GpsNoise, seed: int, until_ns: int, number: int = 0
) -> dict[str, GpsErrors]:
    """Fresh errors of a machine's receivers, by their names, from the start of a simulation until a stamp.

    noise: of each receiver, as a preset has it; `machine_share` and `site_share` are in it. number: the machine's place
    in the fleet. Machines, and base stations, of one seed and different numbers have `site_share` of the slow variance
    in common. The model is the simulator's: with its seed and number come its errors.
    """
    receivers = [s for s in machine.sensors if s.kind == "gps"]
    if not receivers:
        return {}
    every = BASE_RATE_HZ // noise.rate_hz
    steps = np.arange(every, (until_ns - START_NS) // STEP_NS + 1, every)
    rngs = [generator(seed, number, s.name) for s in receivers]
    errors = ReceiverErrors([noise] * len(receivers), [number] * len(receivers), rngs, seed)
    slow, white = errors.run(steps)
    columns = zip(receivers, slow.transpose(2, 1, 0), white.transpose(2, 1, 0), errors.stated_m2.T, strict=True)
    return {s.name: GpsErrors(START_NS + steps * STEP_NS, *values) for s, *values in columns}


def with_gps_errors(recording: RecordedDrive, motion: TrueMotion, errors: Mapping[str, GpsErrors]) -> RecordedDrive:
    """The recording with fixes of the true antennas and these errors; receivers are silent where they were.

    errors: by receiver; fixes of others stay.
    """
    projection = Projection(recording.site)
    fixes: dict[tuple[str, int], Gps] = {}
    for name, error in errors.items():
        sensor = recording.machine.sensor(name)
        stamps = np.array([r.stamp_ns for r in recording.readings if r.sensor == name], np.int64)
        if sensor is None or not len(stamps):
            continue
        off_m = error.total_m[error.rows(stamps)]
        places = projection.to_geodetic_many(*(motion.antenna_m(sensor, stamps) + off_m).T)
        rows = zip(stamps.tolist(), places.T.tolist(), strict=True)
        stated = error.stated_m2.tolist()
        fixes |= {(name, stamp): Gps(name, stamp, *place, *stated) for stamp, place in rows}
    readings: tuple[Reading, ...] = tuple(fixes.get((r.sensor, r.stamp_ns), r) for r in recording.readings)
    return replace(recording, readings=readings)


def without_slow_errors(errors: Mapping[str, GpsErrors]) -> dict[str, GpsErrors]:
    """Errors of which the white noise alone is left, and stated."""
    return {
        name: replace(own, slow_m=np.zeros_like(own.slow_m), stated_m2=np.maximum(own.white_m.var(axis=0), 1e-6))
        for name, own in errors.items()
    }


def with_true_wheels(recording: RecordedDrive, motion: TrueMotion) -> RecordedDrive:
    """The recording with encoders on wheels of the nominal radius that never slip, with ticks as fine as can be."""
    ticks = {s.name: s.ticks_per_rev for s in recording.machine.sensors if s.kind == "encoder"}
    old = [r for r in recording.readings if isinstance(r, Encoder)]
    ahead_m = motion.distance_m(np.array([r.stamp_ns for r in old], np.int64))[:, 0].tolist()
    per_m = 1 / (2 * math.pi * recording.machine.wheel_radius_m)
    new: dict[Reading, Reading] = {}
    for r, metres in zip(old, ahead_m, strict=True):
        mean, half = metres * per_m * ticks[r.sensor], (r.left_ticks - r.right_ticks) / 2
        new[r] = replace(r, left_ticks=mean + half, right_ticks=mean - half)
    return replace(recording, readings=tuple(new.get(r, r) for r in recording.readings))


def with_true_turn(recording: RecordedDrive, motion: TrueMotion) -> RecordedDrive:
    """The recording with the true turn rate in the gyros on the rear frame; what else they measure stays."""
    axes = {
        s.name: s.mount.frame_from_sensor() for s in recording.machine.sensors if s.kind == "imu" and s.frame == BASE
    }
    old = [r for r in recording.readings if isinstance(r, Imu) and r.sensor in axes]
    rates = motion.turn_rate_radps(np.array([r.stamp_ns for r in old], np.int64)).tolist()
    new: dict[Reading, Reading] = {}
    for r, rate in zip(old, rates, strict=True):
        frame_from_sensor = axes[r.sensor]
        in_frame = frame_from_sensor @ (r.gyro_x_radps, r.gyro_y_radps, r.gyro_z_radps)
        in_frame[2] = rate
        x, y, z = (frame_from_sensor.T @ in_frame).tolist()
        new[r] = replace(r, gyro_x_radps=x, gyro_y_radps=y, gyro_z_radps=z)
    return replace(recording, readings=tuple(new.get(r, r) for r in recording.readings))


def without_side_slip(recording: RecordedDrive, motion: TrueMotion) -> RecordedDrive:
    """The drive of a machine that never slid sideways: its true track, and its fixes, less what sliding added.

    No sensor reads a velocity to the side, and the filter takes it for none: here it is none.
    """
    projection = Projection(recording.site)
    old = [r for r in recording.readings if isinstance(r, Gps)]
    places = np.array([projection.to_map(r.lat_deg, r.lon_deg, r.height_m) for r in old])
    places[:, :2] -= motion.sideways_m(np.array([r.stamp_ns for r in old], np.int64))
    moved = projection.to_geodetic_many(*places.T).T.tolist()
    new: dict[Reading, Reading] = {
        r: replace(r, lat_deg=lat, lon_deg=lon, height_m=height)
        for r, (lat, lon, height) in zip(old, moved, strict=True)
    }
    truth = recording.truth
    track = Truth(truth.stamp_ns, truth.position_m - motion.sideways_m(truth.stamp_ns))
    return replace(recording, readings=tuple(new.get(r, r) for r in recording.readings), truth=track)
