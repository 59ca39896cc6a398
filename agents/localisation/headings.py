"""Attitude references: orientations to measurements, each in its mode.

Absolute: measured at the filter step. Magnetic heading errors are slow: the machine's steel, nearby iron and currents,
and calibration last from tens of metres to for ever. So each has a Gauss-Markov state, learnt while GPS shows the
heading; without GPS the heading holds to within its change. Profile `paper` takes orientations with white errors, tilt
included.

Differential: successive orientations give an angular rate. Relative: the heading is turned so that its first value
agrees with the believed one; roll and pitch stay, as gravity gives them. Both keep their own stamps.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from agents.localisation import measurements
from agents.localisation.filters.belief import Belief, Change, Measurement, anchor_states, reset_states
from agents.localisation.filters.motion import HeadingError
from agents.localisation.filters.state import YAW, Layout
from agents.localisation.imu_steps import FilterStep
from agents.localisation.sensor_modes import ModalSensors, StampedValue
from agents.localisation.tuning import TUNING, LocalisationTuning
from protocol.arrays import Floats
from protocol.machine.machine_config import ABSOLUTE, BASE, RELATIVE, SensorConfig
from protocol.machine.readings import Attitude
from protocol.rotations import matrix_from_quaternion, rpy_from_matrix

UNKNOWN_STD = 1e4  # of unmeasured quantities


@dataclass(frozen=True)
class Orientation:
    """Roll, pitch, yaw [rad] of `base_link` by a reference."""

    sensor: SensorConfig
    value: StampedValue

    @property
    def stamp_ns(self) -> int:
        """Stamp of the measurement."""
        return self.value.stamp_ns


def heading_references(sensors: Sequence[SensorConfig]) -> list[SensorConfig]:
    """References with a heading error state: absolute ones, then anchored ones."""
    able = [s for s in sensors if s.kind == "attitude" and s.use and s.frame == BASE and s.provides("heading")]
    return [s for mode in (ABSOLUTE, RELATIVE) for s in able if s.mode == mode]


class References(ModalSensors[Orientation]):
    """One machine's attitude references; `errors`: of absolute headings; slow: whether these are slow, else white."""

    def __init__(
        self, sensors: Sequence[SensorConfig], layout: Layout, tuning: LocalisationTuning = TUNING, *, slow: bool
    ) -> None:
        super().__init__()
        self._sensors = {s.name: s for s in sensors if s.kind == "attitude" and s.use}
        self._base_from_sensor = {name: s.mount.frame_from_sensor() for name, s in self._sensors.items()}
        references, states = heading_references(sensors), range(layout.heading_errors.start, layout.heading_errors.stop)
        self._states = dict(zip((s.name for s in references), states, strict=False))
        self._turns: dict[str, float] = {}  # of relative ones
        self._tuning, self._slow = tuning, slow
        absolute = [s.name for s in references if s.mode == ABSOLUTE] if slow else []
        self._errors = dict.fromkeys(absolute, HeadingError(tuning.least_heading_rad, tuning.heading_s))
        self._used_ns: dict[str, int] = {}

    @property
    def errors(self) -> tuple[HeadingError, ...]:
        """Errors of absolute headings that have states."""
        return tuple(self._errors.values())

    def measurements(self, step: FilterStep, belief: Belief) -> list[Measurement]:
        """Measurements of absolute references at the step's stamp; belief: the newest."""
        absolute = [a for a in step.attitudes.values() if self._sensors[a.sensor].mode == ABSOLUTE]
        if not self._slow:
            return [self._attitude(o, step.stamp_ns, o.value.values) for o in map(self._orientation, absolute)]
        due = [
            a for a in absolute if step.stamp_ns - self._used_ns.get(a.sensor, 0) >= self._tuning.heading_due_s * 1e9
        ]
        self._used_ns.update((a.sensor, step.stamp_ns) for a in due)
        return [m for a in due for m in self._heading(self._orientation(a), step.stamp_ns, belief)]

    def own_stamped(self, step: FilterStep) -> list[Orientation]:
        """Orientations of other references, measured at their own stamps."""
        return [self._orientation(a) for a in step.attitudes.values() if self._sensors[a.sensor].mode != ABSOLUTE]

    def anchor(self, orientation: Orientation, belief: Belief) -> None:
        """Turn the reference so that this heading agrees with the believed one."""
        self._turns[orientation.sensor.name] = float(belief.x[YAW] - orientation.value.values[2])

    def measurement(self, orientation: Orientation) -> Measurement | None:
        """A turned attitude, or an angular rate of a differential reference; None without a pair."""
        sensor, value = orientation.sensor, orientation.value
        if sensor.mode != RELATIVE:
            return self._rotation(sensor, value)
        turned = value.values + np.array([0.0, 0.0, self._turns[sensor.name]])
        return self._attitude(orientation, value.stamp_ns, turned, self._first_change(orientation))

    def _orientation(self, attitude: Attitude) -> Orientation:
        """With configured variances, else its own; unmeasured angles are wide open."""
        sensor, names = self._sensors[attitude.sensor], ("tilt", "tilt", "heading")
        own = attitude.var_roll_rad2, attitude.var_pitch_rad2, attitude.var_yaw_rad2
        stated = [sensor.std[n] ** 2 if n in sensor.std else v for n, v in zip(names, own, strict=True)]
        variances = np.where([sensor.provides(n) for n in names], stated, UNKNOWN_STD**2)
        angles = rpy_of_base(attitude, self._base_from_sensor[attitude.sensor])
        return Orientation(sensor, StampedValue(attitude.stamp_ns, angles, variances))

    def _heading(self, orientation: Orientation, stamp_ns: int, belief: Belief) -> list[Measurement]:
        """A reference's heading, with its error state.

        An error larger than stated gets that size and keeps its rate of change (2 std^2 / time); else it would be
        expected to fade, and pull the heading along. References of one machine share one magnetic field, so several
        count as one.
        """
        sensor = orientation.sensor
        if sensor.name not in self._errors:
            return []
        state, variance = self._states[sensor.name], float(orientation.value.variances[2])
        stated = (
            math.sqrt(variance) if "heading" in sensor.std else max(math.sqrt(variance), self._tuning.least_heading_rad)
        )
        times = max(1.0, abs(float(belief.x[state])) / stated)
        std = math.sqrt(len(self._errors)) * times * stated
        self._errors[sensor.name] = HeadingError(std, self._tuning.heading_s * times**2)
        first = partial(reset_states, states=slice(state, state + 1), variance=std**2)
        change = None if sensor.name in self._confirmed else first
        self._confirmed.add(sensor.name)
        yaw, white, gate = (
            float(orientation.value.values[2]),
            self._tuning.heading_white * stated**2,
            sensor.gate(self._tuning.gate_sigma),
        )
        return [measurements.heading(stamp_ns, sensor.name, yaw, white, state, gate, change)]

    def _attitude(
        self, orientation: Orientation, stamp_ns: int, rpy_rad: Floats, change: Change | None = None
    ) -> Measurement:
        sensor, R = orientation.sensor, np.diag(orientation.value.variances)
        error = self._states.get(sensor.name)
        return measurements.orientation(
            stamp_ns, sensor.name, rpy_rad, R, sensor.gate(self._tuning.gate_sigma), error, change
        )

    def _first_change(self, orientation: Orientation) -> Change | None:
        """First value of the anchor's error state."""
        name = orientation.sensor.name
        if name in self._confirmed or name not in self._states:
            return None
        states = slice(self._states[name], self._states[name] + 1)
        return partial(_anchor_heading, states=states, variance=float(orientation.value.variances[2]))

    def _rotation(self, sensor: SensorConfig, now: StampedValue) -> Measurement | None:
        """Angular rate between two orientations: E^-1 converts rates of roll, pitch and yaw."""
        mean = self._rate(sensor.name, now, angles=True)
        if mean is None:
            return None
        (sr, cr), (sp, cp) = ((math.sin(a), math.cos(a)) for a in now.values[:2].tolist())
        body_from_rates = np.array([[1.0, 0.0, -sp], [0.0, cr, cp * sr], [0.0, -sr, cp * cr]])
        R = body_from_rates * mean.variances @ body_from_rates.T
        rates = body_from_rates @ mean.values
        return measurements.rotation(mean.stamp_ns, sensor.name, rates, R, sensor.gate(self._tuning.gate_sigma))


def rpy_of_base(attitude: Attitude, base_from_sensor: Floats) -> Floats:
    """Roll, pitch, yaw (3,) [rad] of `base_link`: map_from_base = map_from_sensor sensor_from_base."""
    map_from_sensor = matrix_from_quaternion((attitude.qx, attitude.qy, attitude.qz, attitude.qw))
    return rpy_from_matrix(map_from_sensor.dot(base_from_sensor.T))


def _anchor_heading(belief: Belief, states: slice, variance: float) -> Belief:
    H: Floats = np.zeros((1, len(belief.x)))
    H[0, YAW] = 1.0
    return anchor_states(belief, states, H, variance)
