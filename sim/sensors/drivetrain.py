"""Sensors of the machine itself: wheel encoders, drive torque, angle of the joint, weight of what it carries."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from protocol.arrays import Floats, Ints
from sim.sensors.noise import Draws, GaussMarkov
from sim.sensors.sensor_group import SensorGroup, SensorUnit
from sim.state import FleetState


class EncoderGroup(SensorGroup):
    """Counts the rear wheels' turns; slip and the wheels' true radius are in what it counts."""

    def __init__(self, units: Sequence[SensorUnit]) -> None:
        super().__init__(units)
        self._ticks_per_rad = self.per_unit(lambda unit: unit.sensor.ticks_per_rev) / (2 * np.pi)

    def read(self, steps: Ints, rows: Ints, states: FleetState) -> Floats:  # noqa: ARG002 - has no noise of its own
        """Ticks of the left and the right wheel."""
        ticks: Floats = np.floor(self.pick(states.wheel_rad, rows) * self._ticks_per_rad)
        return ticks


class TorqueGroup(SensorGroup):
    """Drive torque at the wheels, as the drive train reports it."""

    def __init__(self, units: Sequence[SensorUnit]) -> None:
        super().__init__(units)
        noises = [unit.rig.preset.torque for unit in units]
        self._white_nm, scale = np.array([(noise.white_nm, noise.scale) for noise in noises]).T
        start = self.per_unit(lambda unit: unit.rng.standard_normal(2))
        self._scale = 1 + scale * start[0]
        self._fault = self.per_unit(lambda unit: unit.rig.faults.torque_scale)
        slow_nm, time_s = np.array([(noise.correlated_nm, noise.correlation_s) for noise in noises]).T
        self._slow = GaussMarkov(slow_nm[None], time_s, 1 / noises[0].rate_hz, start[1:])
        self._draws = Draws([unit.rng for unit in units], 2)

    def read(self, steps: Ints, rows: Ints, states: FleetState) -> Floats:
        """Torque of all wheels together."""
        draws = self._draws.next_rows(len(steps))
        scale = self._scale * np.where(self.faulty(steps), self._fault, 1.0)
        values: Floats = (
            scale * self.pick(states.torque_nm, rows) + self._slow.run(draws[:1]) + self._white_nm * draws[1]
        )
        return values


class ArticulationGroup(SensorGroup):
    """Angle of the joint."""

    def __init__(self, units: Sequence[SensorUnit]) -> None:
        super().__init__(units)
        noises = [unit.rig.preset.articulation for unit in units]
        self._white_rad, zero_rad = np.radians([(noise.white_deg, noise.zero_deg) for noise in noises]).T
        self._zero_rad = zero_rad * self.per_unit(lambda unit: unit.rng.standard_normal())
        self._draws = Draws([unit.rng for unit in units], 1)

    def read(self, steps: Ints, rows: Ints, states: FleetState) -> Floats:
        """Angle of the front frame."""
        noise = self._zero_rad + self._white_rad * self._draws.next_rows(len(steps))
        values: Floats = self.pick(states.articulation_rad, rows) + noise
        return values


class PayloadGroup(SensorGroup):
    """What the machine carries, as its weighing system states it: never less than nothing."""

    def __init__(self, units: Sequence[SensorUnit]) -> None:
        super().__init__(units)
        self._white_kg, scale = np.array([(u.rig.preset.payload.white_kg, u.rig.preset.payload.scale) for u in units]).T
        self._scale = 1 + scale * self.per_unit(lambda unit: unit.rng.standard_normal())
        self._draws = Draws([unit.rng for unit in units], 1)

    def read(self, steps: Ints, rows: Ints, states: FleetState) -> Floats:
        """Weight of the payload."""
        noise = self._white_kg * self._draws.next_rows(len(steps))
        weighed: Floats = np.maximum(self._scale * self.pick(states.payload_kg, rows) + noise, 0.0)
        return weighed
