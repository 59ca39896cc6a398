"""Recordings with replaced fixes: the same drive with other receiver errors.

The truth stays in this package; agents get readings only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lab.campaign.recordings import RecordedDrive, track_file
from protocol.arrays import Floats, Ints
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import Gps, Reading
from protocol.site.site_config import Projection
from sim.sensors.frames import map_from_base
from sim.sensors.gps import ReceiverErrors
from sim.sensors.noise import generator
from sim.sensors.presets import BASE_RATE_HZ, GpsNoise
from sim.simulator import START_NS
from sitegrid.proof.tracks import interpolate

STEP_NS = 1_000_000_000 // BASE_RATE_HZ  # of the simulated world


@dataclass(frozen=True)
class TrueMotion:
    """True motion of `base_link` at n instants.

    stamp_ns: (n,). position_m: (n, 3) in `map`. attitude_rad: roll, pitch, yaw (n, 3), unwrapped.
    """

    stamp_ns: Ints
    position_m: Floats
    attitude_rad: Floats

    def antenna_m(self, sensor: SensorConfig, stamp_ns: Ints) -> Floats:
        """True antenna position at other instants (m,): (m, 3) in `map`; NaN outside."""
        roll, pitch, yaw = interpolate(stamp_ns, self.stamp_ns, self.attitude_rad).T
        lever = np.broadcast_to(np.array(sensor.mount.xyz_m)[:, None], (3, len(stamp_ns)))
        antenna: Floats = (
            interpolate(stamp_ns, self.stamp_ns, self.position_m) + map_from_base(lever, yaw, pitch, roll).T
        )
        return antenna


@dataclass(frozen=True)
class GpsErrors:
    """Errors of one receiver at r instants, east, north, up (r, 3) each [m].

    stamp_ns: (r,), all reading instants, silent or not. stated_m2: stated variances (3,).
    """

    stamp_ns: Ints
    slow_m: Floats
    white_m: Floats
    stated_m2: Floats

    @property
    def total_m(self) -> Floats:
        """Error of a fix (r, 3)."""
        return self.slow_m + self.white_m

    def rows(self, stamp_ns: Ints) -> Ints:
        """Indices (m,) of these stamps (m,); ValueError for an unknown one."""
        rows = np.searchsorted(self.stamp_ns, stamp_ns).clip(max=len(self.stamp_ns) - 1)
        if (self.stamp_ns[rows] != stamp_ns).any():
            raise ValueError("a receiver was read between its instants: another rate, or a faulty clock")
        return rows


def true_motion(folder: Path) -> TrueMotion:
    """True motion of a recording's machine; folder: of the recording."""
    table = np.genfromtxt(track_file(folder), delimiter=",", names=True, dtype=None)
    angles = [np.unwrap(table[name]) for name in ("roll", "pitch", "yaw")]
    position_m = np.stack([table[name] for name in "xyz"], axis=1)
    return TrueMotion(table["stamp_ns"].astype(np.int64), position_m, np.stack(angles, axis=1))


def gps_errors(
    machine: MachineConfig, noise: GpsNoise, seed: int, until_ns: int, number: int = 0
) -> dict[str, GpsErrors]:
    """New errors of a machine's receivers by name, from a simulation's start to a stamp.

    noise: of each receiver, with `machine_share` and `site_share`. number: index in the fleet; machines of one seed
    share `site_share` of the slow variance. The model is the simulator's: same seed and number, same errors.
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
    """The recording with fixes at true antennas plus these errors; silences are kept.

    errors: by receiver; other fixes stay.
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
