"""Attitude references: from orientations to measurements, each in its mode.

Absolute: orientations are measurements of the filter step that they came in. Differential: successive orientations make
an angular rate. Relative: the heading is turned so that the first one agrees with the believed heading; roll and pitch
stay, since gravity gives them. Differential and relative ones are measurements of their own stamps.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from agents.localisation import measurements
from agents.localisation.filters.belief import Belief, Change, Measurement, anchor_states
from agents.localisation.filters.state import YAW, Layout
from agents.localisation.imu_steps import FilterStep
from agents.localisation.measurements import GATE_SIGMA
from agents.localisation.sensor_modes import ModalSensors, StampedValue
from protocol.arrays import Floats
from protocol.machine.machine_config import ABSOLUTE, RELATIVE, SensorConfig

UNKNOWN_STD = 1e4  # of a quantity that a sensor does not measure


@dataclass(frozen=True)
class Orientation:
    """Roll, pitch and yaw [rad] of `base_link` by a reference."""

    sensor: SensorConfig
    value: StampedValue

    @property
    def stamp_ns(self) -> int:
        """When it was measured."""
        return self.value.stamp_ns


def anchored_headings(sensors: Sequence[SensorConfig]) -> list[SensorConfig]:
    """References whose heading counts from a believed one."""
    return [s for s in sensors if s.kind == "attitude" and s.use and s.mode == RELATIVE and s.provides("heading")]


class References(ModalSensors[Orientation]):
    """The attitude references of one machine."""

    def __init__(self, sensors: Sequence[SensorConfig], layout: Layout) -> None:
        super().__init__()
        self._sensors = {s.name: s for s in sensors if s.kind == "attitude" and s.use}
        states = range(layout.heading_errors.start, layout.heading_errors.stop)
        self._states = dict(zip((s.name for s in anchored_headings(sensors)), states, strict=False))
        self._turns: dict[str, float] = {}  # of relative ones

    def measurements(self, step: FilterStep) -> list[Measurement]:
        """Measurements of absolute references, at the stamp of the step."""
        absolute = [o for o in self._orientations(step) if o.sensor.mode == ABSOLUTE]
        return [self._attitude(o, step.stamp_ns, o.value.values) for o in absolute]

    def own_stamped(self, step: FilterStep) -> list[Orientation]:
        """Orientations of the other references, which become measurements of their own stamps."""
        return [o for o in self._orientations(step) if o.sensor.mode != ABSOLUTE]

    def anchor(self, orientation: Orientation, belief: Belief) -> None:
        """Turn the reference so that this heading agrees with the believed one."""
        self._turns[orientation.sensor.name] = float(belief.x[YAW] - orientation.value.values[2])

    def measurement(self, orientation: Orientation) -> Measurement | None:
        """A turned attitude, or of a differential reference an angular rate; None where there is no pair."""
        sensor, value = orientation.sensor, orientation.value
        if sensor.mode != RELATIVE:
            return self._rotation(sensor, value)
        turned = value.values + np.array([0.0, 0.0, self._turns[sensor.name]])
        return self._attitude(orientation, value.stamp_ns, turned, self._first_change(orientation))

    def _orientations(self, step: FilterStep) -> list[Orientation]:
        """With the variances that are configured, else their own; wide open where the sensor does not measure."""
        orientations = []
        for name, value in step.orientations.items():
            sensor, names = self._sensors[name], ("tilt", "tilt", "heading")
            stated = [sensor.std[n] ** 2 if n in sensor.std else v for n, v in zip(names, value.variances, strict=True)]
            variances = np.where([sensor.provides(n) for n in names], stated, UNKNOWN_STD**2)
            orientations.append(Orientation(sensor, StampedValue(value.stamp_ns, value.values, variances)))
        return orientations

    def _attitude(
        self, orientation: Orientation, stamp_ns: int, rpy_rad: Floats, change: Change | None = None
    ) -> Measurement:
        sensor, R = orientation.sensor, np.diag(orientation.value.variances)
        error = self._states.get(sensor.name)
        return measurements.orientation(stamp_ns, sensor.name, rpy_rad, R, sensor.gate(GATE_SIGMA), error, change)

    def _first_change(self, orientation: Orientation) -> Change | None:
        """Gives the state of the anchor's error its first value."""
        name = orientation.sensor.name
        if name in self._confirmed or name not in self._states:
            return None
        states = slice(self._states[name], self._states[name] + 1)
        return partial(_anchor_heading, states=states, variance=float(orientation.value.variances[2]))

    def _rotation(self, sensor: SensorConfig, now: StampedValue) -> Measurement | None:
        """Angular rate between the last orientation and this one: E^-1 makes it from rates of roll, pitch and yaw."""
        mean = self._rate(sensor.name, now, angles=True)
        if mean is None:
            return None
        (sr, cr), (sp, cp) = ((math.sin(a), math.cos(a)) for a in now.values[:2].tolist())
        body_from_rates = np.array([[1.0, 0.0, -sp], [0.0, cr, cp * sr], [0.0, -sr, cp * cr]])
        R = body_from_rates * mean.variances @ body_from_rates.T
        rates = body_from_rates @ mean.values
        return measurements.rotation(mean.stamp_ns, sensor.name, rates, R, sensor.gate(GATE_SIGMA))


def _anchor_heading(belief: Belief, states: slice, variance: float) -> Belief:
    H: Floats = np.zeros((1, len(belief.x)))
    H[0, YAW] = 1.0
    return anchor_states(belief, states, H, variance)
