"""GPS receivers: slow and white errors, Doppler velocities, outages, antennas on lever arms."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from protocol.arrays import Bools, Floats, Ints
from protocol.site.site_config import Projection
from sim.sensors.frames import cross, map_from_base
from sim.sensors.noise import Draws, GaussMarkov, generator, site_generator
from sim.sensors.presets import BASE_RATE_HZ, GpsNoise
from sim.sensors.sensor_group import SensorGroup, SensorUnit
from sim.state import STEP_S, FleetState

AXES = np.array([1.0, 1.0, 5 / 3])  # heights are 5/3 worse
LEAST_M2 = 1e-4  # smallest variance that a receiver states
LEAST_M2PS2 = 1e-6  # same, of a velocity


class AntennaGroup(SensorGroup):
    """Receivers of antennas; silent for outage_s of every outage_period_s."""

    def __init__(self, units: Sequence[SensorUnit], seed: int) -> None:
        super().__init__(units)
        noises = [unit.rig.preset.gps for unit in units]
        self._lever_m = self.per_unit(lambda unit: unit.sensor.mount.xyz_m)[:, None]
        self._outage_s, self._period_s = np.array([(noise.outage_s, noise.outage_period_s) for noise in noises]).T
        self._phase_s = self._period_s * self.per_unit(lambda unit: _phase(unit, seed))

    def valid(self, steps: Ints) -> Bools:
        """False during an outage."""
        time_s = steps[:, None] * STEP_S + self._phase_s
        valid: Bools = time_s % self._period_s >= self._outage_s - 1e-9
        return valid

    def attitude(self, rows: Ints, states: FleetState) -> list[Floats]:
        """Yaw, pitch and roll."""
        return [self.pick(angle, rows) for angle in (states.yaw_rad, states.pitch_rad, states.roll_rad)]


class VelocityGroup(AntennaGroup):
    """Doppler velocities of antennas with white errors; no side slip."""

    def __init__(self, units: Sequence[SensorUnit], seed: int) -> None:
        super().__init__(units, seed)
        self._std_mps = np.array([unit.rig.preset.gps.velocity_std_mps for unit in units])
        self._draws = Draws([unit.rng for unit in units], 2)

    def read(self, steps: Ints, rows: Ints, states: FleetState) -> Floats:
        """East and north, and their variances."""
        speed = self.pick(states.speed_mps, rows)
        ahead = np.stack([speed, np.zeros_like(speed), np.zeros_like(speed)])
        of_antenna = ahead + cross(self.pick(states.rates_radps, rows), self._lever_m)
        velocity = map_from_base(of_antenna, *self.attitude(rows, states))[:2]
        velocity += self._std_mps * self._draws.next_rows(len(steps))
        return np.concatenate([velocity, np.broadcast_to(np.maximum(self._std_mps**2, LEAST_M2PS2), velocity.shape)])


class GpsGroup(AntennaGroup):
    """Fixes with stated total variances; errors continue during outages."""

    def __init__(self, units: Sequence[SensorUnit], seed: int, projection: Projection) -> None:
        super().__init__(units, seed)
        self._projection = projection
        noises = [unit.rig.preset.gps for unit in units]
        self._errors = ReceiverErrors(noises, [unit.machine for unit in units], [unit.rng for unit in units], seed)
        self._off_m = self.per_unit(lambda unit: unit.rig.faults.antenna_off_m)[:, None]

    def read(self, steps: Ints, rows: Ints, states: FleetState) -> Floats:
        """Latitude, longitude, height, stated variances."""
        lever = self._lever_m + self._off_m * self.faulty(steps)
        base = np.stack([self.pick(place, rows) for place in (states.x_m, states.y_m, states.z_m)])
        slow, white = self._errors.run(steps)
        antenna = base + map_from_base(lever, *self.attitude(rows, states))
        fixes = self._projection.to_geodetic_many(*(antenna + (slow + white)))
        return np.concatenate([fixes, np.broadcast_to(self._errors.stated_m2[:, None], base.shape)])


class ReceiverErrors:
    """Errors east, north and up: slow ones of site, machine and receiver, and white noise.

    noises, rngs: per receiver, of one rate. machines: their carriers. stated_m2: stated variances (3, units).
    """

    def __init__(
        self, noises: Sequence[GpsNoise], machines: Sequence[int], rngs: Sequence[np.random.Generator], seed: int
    ) -> None:
        drift_m = AXES[:, None] * [noise.scale * noise.drift_std_m for noise in noises]
        self._white_m = AXES[:, None] * [noise.scale * noise.white_std_m for noise in noises]
        self.stated_m2: Floats = np.maximum(drift_m**2 + self._white_m**2, LEAST_M2)
        time_s = np.array([noise.drift_time_s for noise in noises])
        machine, site = np.array([(noise.machine_share, noise.site_share) for noise in noises]).T
        start = np.stack([rng.standard_normal(3) for rng in rngs], axis=-1)
        self._own = GaussMarkov(drift_m * np.sqrt(1 - machine), time_s, 1 / noises[0].rate_hz, start)
        self._draws = Draws(rngs, 6)
        carriers, carrier = np.unique(machines, return_inverse=True)
        sources = (
            (site, np.zeros_like(carrier), [site_generator(seed)]),
            (machine - site, carrier, [generator(seed, m, "receivers") for m in carriers.tolist()]),
        )
        self._common = [
            (drift_m * np.sqrt(share), CommonDrift(shared, source, time_s))
            for share, source, shared in sources
            if share.any()
        ]

    def run(self, steps: Ints) -> tuple[Floats, Floats]:
        """Slow and white errors, (3, r, units) each [m], at the next reading steps (r,)."""
        draws = self._draws.next_rows(len(steps))
        slow = self._own.run(draws[:3])
        for std_m, drift in self._common:
            slow += std_m[:, None] * drift.run(steps)
        return slow, self._white_m[:, None] * draws[3:]


class CommonDrift:
    """Drift shared by several receivers, (3, r, units), variance 1; equal for equal correlation times.

    rngs: per source, the site or a machine. source: of each receiver (units,). It advances every world step, whatever
    the receivers' rates. All correlation times of a source use the same white noise.
    """

    def __init__(self, rngs: Sequence[np.random.Generator], source: Ints, time_s: Floats) -> None:
        processes, self._process_of = np.unique(np.stack([source, time_s]), axis=1, return_inverse=True)
        self._source_of = processes[0].astype(int)
        start = np.stack([rng.standard_normal(3) for rng in rngs], axis=-1)[:, self._source_of]
        self._drift = GaussMarkov(np.ones_like(start), processes[1], 1 / BASE_RATE_HZ, start)
        self._draws = Draws(rngs, 3)
        self._step = 0

    def run(self, steps: Ints) -> Floats:
        """Advance to the last step; returns the drift after each."""
        drift = self._drift.run(self._draws.next_rows(int(steps[-1]) - self._step)[:, :, self._source_of])
        rows = steps - self._step - 1
        self._step = int(steps[-1])
        picked: Floats = drift[:, rows[:, None], self._process_of]
        return picked


def _phase(unit: SensorUnit, seed: int) -> float:
    """Phase in the outage period, 0..1: staggered on one machine, independent between machines."""
    receivers = [sensor for sensor in unit.rig.machine.sensors if sensor.kind == unit.sensor.kind]
    turn = receivers.index(unit.sensor) / len(receivers)
    return float(generator(seed, unit.machine, "outage").uniform()) + turn
