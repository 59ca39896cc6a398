"""GPS receivers: slow and white errors, outages, antennas on their lever arms."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from protocol.arrays import Bools, Floats, Ints
from protocol.site.site_config import Projection
from sim.sensors.frames import map_from_base
from sim.sensors.noise import Draws, GaussMarkov, generator, site_generator
from sim.sensors.presets import BASE_RATE_HZ
from sim.sensors.sensor_group import SensorGroup, SensorUnit
from sim.state import STEP_S, FleetState

AXES = np.array([1.0, 1.0, 5 / 3])  # heights are this much worse
LEAST_M2 = 1e-4  # no receiver states a smaller variance


class GpsGroup(SensorGroup):
    """Receivers. They state their total variances; errors run on while they are silent."""

    def __init__(self, units: Sequence[SensorUnit], seed: int, projection: Projection) -> None:
        super().__init__(units)
        self._projection = projection
        noises = [unit.rig.preset.gps for unit in units]
        drift_m = AXES[:, None] * [noise.scale * noise.drift_std_m for noise in noises]
        self._white_m = AXES[:, None] * [noise.scale * noise.white_std_m for noise in noises]
        self._variances = np.maximum(drift_m**2 + self._white_m**2, LEAST_M2)[:, None]
        time_s, shared = np.array([(noise.drift_time_s, noise.shared) for noise in noises]).T
        self._shared_m = drift_m * np.sqrt(shared)
        own_m, dt = drift_m * np.sqrt(1 - shared), 1 / noises[0].rate_hz
        self._drift = GaussMarkov(own_m, time_s, dt, self.per_unit(lambda unit: unit.rng.standard_normal(3)))
        self._draws = Draws([unit.rng for unit in units], 6)
        self._common = SiteDrift(seed, time_s) if shared.any() else None
        self._lever_m = self.per_unit(lambda unit: unit.sensor.mount.xyz_m)[:, None]
        self._off_m = self.per_unit(lambda unit: unit.rig.faults.antenna_off_m)[:, None]
        self._outage_s, self._period_s = np.array([(noise.outage_s, noise.outage_period_s) for noise in noises]).T
        self._phase_s = self._period_s * self.per_unit(lambda unit: _phase(unit, seed))

    def read(self, steps: Ints, rows: Ints, states: FleetState) -> Floats:
        """Latitude, longitude, height and the stated variances."""
        lever = self._lever_m + self._off_m * self.faulty(steps)
        attitude = [self.pick(angle, rows) for angle in (states.yaw_rad, states.pitch_rad, states.roll_rad)]
        base = np.stack([self.pick(place, rows) for place in (states.x_m, states.y_m, states.z_m)])
        draws = self._draws.next_rows(len(steps))
        errors = self._drift.run(draws[:3]) + self._white_m[:, None] * draws[3:]
        if self._common:
            errors += self._shared_m[:, None] * self._common.at(steps)
        fixes = self._projection.to_geodetic_many(*(base + map_from_base(lever, *attitude) + errors))
        return np.concatenate([fixes, np.broadcast_to(self._variances, base.shape)])

    def valid(self, steps: Ints) -> Bools:
        """False for outage_s of every outage_period_s."""
        time_s = steps[:, None] * STEP_S + self._phase_s
        valid: Bools = time_s % self._period_s >= self._outage_s - 1e-9
        return valid


class SiteDrift:
    """The drift that receivers of a site share, (3, r, units) of variance 1; the same for equal correlation times.

    It runs at every step of the world, whatever the receivers' rates; the weather is one, so all correlation times
    answer to the same white noise.
    """

    def __init__(self, seed: int, time_s: Floats) -> None:
        rng = site_generator(seed)
        times_s, self._process_of = np.unique(time_s, return_inverse=True)
        sigma = np.ones((3, len(times_s)))
        self._drift = GaussMarkov(sigma, times_s, 1 / BASE_RATE_HZ, sigma * rng.standard_normal((3, 1)))
        self._draws = Draws([rng], 3)
        self._step = 0

    def at(self, steps: Ints) -> Floats:
        """Run on to the last of these steps; returns the drift after each."""
        drift = self._drift.run(self._draws.next_rows(int(steps[-1]) - self._step))
        rows = steps - self._step - 1
        self._step = int(steps[-1])
        picked: Floats = drift[:, rows[:, None], self._process_of]
        return picked


def _phase(unit: SensorUnit, seed: int) -> float:
    """Where in its outage period a receiver starts, 0..1: in turn on one machine, machines independently."""
    receivers = [sensor for sensor in unit.rig.machine.sensors if sensor.kind == "gps"]
    turn = receivers.index(unit.sensor) / len(receivers)
    return float(generator(seed, unit.machine, "outage").uniform()) + turn
