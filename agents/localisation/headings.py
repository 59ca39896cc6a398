"""Attitude references: from orientations to measurements, each in its mode.

Differential: successive orientations make an angular rate. Relative: the heading is turned so that the first one agrees
with the believed heading; the tilt stays as it is, since gravity gives it. Both are measurements of their own stamps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np

from agents.localisation import measurements
from agents.localisation.filters.belief import Belief, Measurement
from agents.localisation.filters.history import Change, Fusion
from agents.localisation.filters.state import YAW, Layout
from agents.localisation.imu_steps import Step
from agents.localisation.measurements import SensingConfig
from agents.localisation.modes import Told, rate, referred
from protocol.arrays import Floats
from protocol.machine.machine_config import ABSOLUTE, RELATIVE, SensorConfig

UNKNOWN_STD = 1e4  # of what a sensor does not give


def counted_from_start(sensors: Sequence[SensorConfig]) -> list[SensorConfig]:
    """References whose heading counts from a believed one."""
    return [s for s in sensors if s.kind == "attitude" and s.use and s.mode == RELATIVE and s.says("heading")]


class References:
    """The attitude references of one machine."""

    def __init__(self, sensors: Sequence[SensorConfig], layout: Layout, config: SensingConfig) -> None:
        self._sensors = {s.name: s for s in sensors if s.kind == "attitude" and s.use}
        self._config = config
        states = range(layout.heading_errors.start, layout.heading_errors.stop)
        self._states = dict(zip((s.name for s in counted_from_start(sensors)), states, strict=False))
        self._turns: dict[str, float] = {}  # of relative ones
        self._last: dict[str, Told] = {}  # of differential ones

    def measurements(self, step: Step) -> list[Measurement]:
        """What absolute ones say at the end of a step."""
        said = ((self._sensors[name], told) for name, told in step.orientations.items())
        return [self._orientation(s, step.stamp_ns, self._judged(s, told)) for s, told in said if s.mode == ABSOLUTE]

    def add(self, fusion: Fusion, step: Step) -> list[Belief]:
        """Give what the others say to the filter; returns the beliefs that it changed."""
        beliefs: list[Belief] = []
        for name, raw in step.orientations.items():
            sensor = self._sensors[name]
            if sensor.mode == ABSOLUTE:
                continue
            told = self._judged(sensor, raw)
            if sensor.mode == RELATIVE:
                beliefs += self._add_relative(fusion, sensor, told)
            elif rotation := self._rotation(sensor, told):
                beliefs += fusion.add([rotation])
        return beliefs

    def _judged(self, sensor: SensorConfig, told: Told) -> Told:
        """With the variances that are configured, else its own; wide open where it says nothing."""
        names = ("tilt", "tilt", "heading")
        stated = [sensor.std[n] ** 2 if n in sensor.std else v for n, v in zip(names, told.variances, strict=True)]
        variances = np.where([sensor.says(n) for n in names], stated, UNKNOWN_STD**2)
        return Told(told.stamp_ns, told.values, variances)

    def _orientation(self, sensor: SensorConfig, stamp_ns: int, told: Told) -> Measurement:
        error, R = self._states.get(sensor.name), np.diag(told.variances)
        return measurements.orientation(stamp_ns, sensor.name, told.values, R, self._gate(sensor), error)

    def _add_relative(self, fusion: Fusion, sensor: SensorConfig, told: Told) -> list[Belief]:
        """The first agrees with the belief at its stamp, unless that is too long ago to know."""
        name, change = sensor.name, None
        turn = self._turns.get(name)
        if turn is None:
            turn = float(fusion.at(told.stamp_ns).x[YAW] - told.values[2])
            change = self._change(name, float(told.variances[2]))
        turned = Told(told.stamp_ns, told.values + np.array([0.0, 0.0, turn]), told.variances)
        beliefs = fusion.add([self._orientation(sensor, told.stamp_ns, turned)], change)
        if beliefs:
            self._turns[name] = turn
        return beliefs

    def _change(self, name: str, variance_rad2: float) -> Change | None:
        if name not in self._states:
            return None
        state = self._states[name]
        return partial(_referred, states=slice(state, state + 1), variance=variance_rad2)

    def _rotation(self, sensor: SensorConfig, now: Told) -> Measurement | None:
        """Angular rate between the last orientation and this one: E^-1 makes it from rates of roll, pitch and yaw."""
        before = self._last.get(sensor.name, now)
        if now.stamp_ns < before.stamp_ns:
            return None
        self._last[sensor.name] = now
        mean = rate(before, now, angles=True)
        if mean is None:
            return None
        (sr, cr), (sp, cp) = ((math.sin(a), math.cos(a)) for a in now.values[:2].tolist())
        body_from_rates = np.array([[1.0, 0.0, -sp], [0.0, cr, cp * sr], [0.0, -sr, cp * cr]])
        R = body_from_rates * mean.variances @ body_from_rates.T
        return measurements.rotation(mean.stamp_ns, sensor.name, body_from_rates @ mean.values, R, self._gate(sensor))

    def _gate(self, sensor: SensorConfig) -> float:
        return sensor.gate_sigma or self._config.gate_sigma


def _referred(belief: Belief, states: slice, variance: float) -> Belief:
    H: Floats = np.zeros((1, len(belief.x)))
    H[0, YAW] = 1.0
    return referred(belief, states, H, variance)
