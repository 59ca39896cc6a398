"""Sensor groups: all sensors of one kind, rate and frame, read together as arrays."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from protocol.arrays import Bools, Floats, Ints
from protocol.machine.machine_config import SensorConfig
from protocol.machine.readings import KINDS, Reading, columns
from sim.sensors.presets import BASE_RATE_HZ
from sim.sensors.rigs import Rig
from sim.state import STEP_S, FleetState


@dataclass(frozen=True)
class SensorUnit:
    """One sensor of one machine. machine: its index in the fleet."""

    machine: int
    rig: Rig
    sensor: SensorConfig
    rng: np.random.Generator


@dataclass(frozen=True)
class GroupReadings:
    """Readings of one group: r instants by u sensors.

    machines (u,), names: of the sensors. values: (r, u, c), in the order of `protocol.machine.readings.columns`. valid:
    (r, u), false while silent.
    """

    kind: str
    machines: Ints
    names: tuple[str, ...]
    stamps_ns: Ints
    values: Floats
    valid: Bools

    def readings(self, unit: int) -> list[Reading]:
        """Readings of one sensor as objects."""
        cls, name, valid = KINDS[self.kind], self.names[unit], self.valid[:, unit].tolist()
        rows = zip(valid, self.stamps_ns[:, unit].tolist(), self.values[:, unit].tolist(), strict=True)
        return [cls(name, stamp, *values) for is_valid, stamp, values in rows if is_valid]


class SensorGroup(ABC):
    """Sensors of one kind, rate and frame; inside, arrays are (axes, readings, sensors): (c, r, u)."""

    def __init__(self, units: Sequence[SensorUnit]) -> None:
        self.units = units
        kind = units[0].sensor.kind
        self.machines: Ints = np.array([unit.machine for unit in units])
        self._every = BASE_RATE_HZ // units[0].rig.preset.rate_hz(kind)
        faults = [unit.rig.faults for unit in units]
        self._faulty_from_s = np.array([fault.from_s for fault in faults])
        self._clock_off_ns: Ints = np.array([round(fault.clock_off_s * 1e9) for fault in faults])
        names, stamps = tuple(unit.sensor.name for unit in units), np.empty((0, len(units)), np.int64)
        values, valid = np.empty((*stamps.shape, len(columns(kind)))), np.ones(stamps.shape, bool)
        self._nothing = GroupReadings(kind, self.machines, names, stamps, values, valid)

    def sample(self, steps: Ints, stamps_ns: Ints, states: FleetState) -> GroupReadings:
        """Read states (k, n, ...) of steps (k,) where due."""
        rows: Ints = np.flatnonzero(steps % self._every == 0)
        if not rows.size:
            return self._nothing
        due = steps[rows]
        stamps = stamps_ns[rows, None] + self._clock_off_ns * self.faulty(due)
        values = self.read(due, rows, states).transpose(1, 2, 0)
        return GroupReadings(self._nothing.kind, self.machines, self._nothing.names, stamps, values, self.valid(due))

    @abstractmethod
    def read(self, steps: Ints, rows: Ints, states: FleetState) -> Floats:
        """Values (c, r, u) at these rows of the states. steps: of the rows."""

    def valid(self, steps: Ints) -> Bools:
        """Whether readings are valid, (r, u)."""
        return np.ones((len(steps), len(self.units)), bool)

    def faulty(self, steps: Ints) -> Bools:
        """Whether the faults have begun, (r, u)."""
        begun: Bools = steps[:, None] * STEP_S >= self._faulty_from_s - 1e-9
        return begun

    def pick(self, quantity: Floats, rows: Ints) -> Floats:
        """State quantity (k, n) or (k, n, c) for these sensors, (r, u) or (c, r, u)."""
        picked = quantity[rows].take(self.machines, axis=1)
        return picked if picked.ndim == 2 else np.ascontiguousarray(picked.transpose(2, 0, 1))

    def per_unit(self, value: Callable[[SensorUnit], object]) -> Floats:
        """One value or array per sensor, sensors last."""
        return np.ascontiguousarray(np.moveaxis(np.array([value(unit) for unit in self.units], float), 0, -1))
