"""GPS receivers: from fixes to measurements, each in its mode.

Relative: each receiver is shifted so that its first fix lies at the believed antenna. In a map that all machines share
this is the transform of a receiver's fixes into the vehicle's own world, by its first fix and the start's roll, pitch
and yaw (navsat_transform): on the way back into the map the rotations cancel, and this shift is left.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from agents.dead_reckoning import DeadReckonedPose
from agents.localisation import measurements
from agents.localisation.consistency import Consistency, InnovationMonitor
from agents.localisation.filters.belief import Belief, Conditioned, Measurement, anchor_states, reset_states
from agents.localisation.filters.motion import GpsError
from agents.localisation.filters.state import Layout
from agents.localisation.sensor_modes import ModalSensors, StampedValue
from protocol.arrays import Floats
from protocol.machine.machine_config import ABSOLUTE, DIFFERENTIAL, RELATIVE, SensorConfig
from protocol.machine.readings import Gps
from protocol.site.site_config import Projection

MIN_FIX_STD_M = 0.3  # receivers state less than their error; one whose std is configured may be better
GATE_SIGMA = 4.0  # fixes further off are refused: outliers of GPS are common
MIN_DRIFT_M2 = 1e-6  # a receiver without slow error must not make the covariance singular


@dataclass(frozen=True)
class Fix:
    """A fix in `map`, (2,) each [m, m2], and the dead-reckoned pose at that time."""

    stamp_ns: int
    sensor: SensorConfig
    position_m: Floats
    variance_m2: Floats
    reckoned: DeadReckonedPose

    @property
    def is_absolute(self) -> bool:
        """Whether it is a place in `map` without an anchor."""
        return self.sensor.mode == ABSOLUTE

    @property
    def lever_m(self) -> Floats:
        """Where the antenna sits (3,)."""
        return np.array(self.sensor.mount.xyz_m)


def drifting(sensors: Sequence[SensorConfig]) -> list[SensorConfig]:
    """Receivers whose slow error matters: it cancels in differences."""
    return [s for s in sensors if s.kind == "gps" and s.use and s.mode != DIFFERENTIAL]


class Receivers(ModalSensors[Fix]):
    """The receivers of one machine; `errors` are those of the layout's slow errors, as they are now.

    slow: whether a share of each error is slow, else all of it is white.
    """

    def __init__(self, sensors: Sequence[SensorConfig], projection: Projection, layout: Layout, *, slow: bool) -> None:
        super().__init__()
        self._sensors = {s.name: s for s in sensors if s.kind == "gps" and s.use}
        self._projection, self._layout, self._slow = projection, layout, slow
        self._states = {s.name: i for i, s in enumerate(drifting(sensors))} if slow else {}
        self._errors = [GpsError(MIN_DRIFT_M2, self._sensors[name].drift_time_s) for name in self._states]
        self._monitors = {name: InnovationMonitor() for name in self._sensors}
        self._shifts: dict[str, Floats] = {}  # of relative ones, and how unsure the believed antenna was then [m2]
        self._anchor_m2: dict[str, float] = {}

    @property
    def errors(self) -> tuple[GpsError, ...]:
        """The slow error of each receiver that has states for it."""
        return tuple(self._errors)

    @property
    def consistency(self) -> dict[str, Consistency]:
        """How consistent the filter is with each receiver, of those with enough fixes."""
        consistency = {name: monitor.consistency() for name, monitor in self._monitors.items()}
        return {name: value for name, value in consistency.items() if value}

    def fix(self, gps: Gps, reckoned: DeadReckonedPose) -> Fix:
        """A reading in `map`, with the variances that are configured, else with its own."""
        sensor = self._sensors[gps.sensor]
        x, y, _ = self._projection.to_map(gps.lat_deg, gps.lon_deg, gps.height_m)
        stated = (gps.var_e_m2, gps.var_n_m2)
        variance = [sensor.std["position"] ** 2] * 2 if "position" in sensor.std else stated
        return Fix(gps.stamp_ns, sensor, np.array([x, y]), np.array(variance), reckoned)

    def expected(self, fix: Fix) -> tuple[float, GpsError]:
        """What a fix is off: variance of its white noise, per axis [m2], and the slow error of its receiver."""
        return float(self._white(fix).mean()), GpsError(_drift_m2(fix), fix.sensor.drift_time_s)

    def anchor(self, fix: Fix, belief: Belief) -> None:
        """Shift the receiver so that this fix lies at the believed antenna."""
        believed, H = _antenna(belief, fix.lever_m)
        self._shifts[fix.sensor.name] = believed - fix.position_m
        self._anchor_m2[fix.sensor.name] = float(np.trace(H @ belief.P @ H.T)) / 2

    def measurement(self, fix: Fix) -> Measurement | None:
        """A place, or of a differential receiver a velocity; None where no fix before makes a pair with this one."""
        return self._velocity(fix) if fix.sensor.mode == DIFFERENTIAL else self._position(fix)

    def confirm(self, fix: Fix, result: Conditioned) -> None:
        """Note what the filter made of a fix: the receiver's error has its first value now."""
        super().confirm(fix, result)
        self._monitors[fix.sensor.name].note(result)

    def _position(self, fix: Fix) -> Measurement:
        sensor = fix.sensor
        place = fix.position_m + self._shifts[sensor.name] if sensor.mode == RELATIVE else fix.position_m
        error, change = None, None
        if self._slow:
            index, drift_m2 = self._states[sensor.name], _drift_m2(fix)
            error = self._layout.gps_error(index)
            if fix.is_absolute:
                change = partial(reset_states, states=error, variance=drift_m2)
            else:  # both the error now and that of the first fix count, and where the filter was wrong then
                change = partial(_anchor_antenna, states=error, lever_m=fix.lever_m, variance=2 * drift_m2)
                drift_m2 = 2 * drift_m2 + self._anchor_m2[sensor.name]
            self._errors[index] = GpsError(drift_m2, sensor.drift_time_s)
        R = np.diag(self._white(fix))
        first = None if sensor.name in self._confirmed else change  # a receiver brings its own unknown error
        return measurements.fix(fix.stamp_ns, sensor.name, place, R, fix.lever_m, error, sensor.gate(GATE_SIGMA), first)

    def _velocity(self, fix: Fix) -> Measurement | None:
        """Of the antenna, between the last fix and this one: slow errors cancel but for what they change meanwhile."""
        sensor, now = fix.sensor, StampedValue(fix.stamp_ns, fix.position_m, self._white(fix))
        before, mean = self._last.get(sensor.name, now), self._rate(sensor.name, now)
        if mean is None:
            return None
        R, dt_s = np.diag(mean.variances), (now.stamp_ns - before.stamp_ns) * 1e-9
        if self._slow:
            R += np.eye(2) * (2 * _drift_m2(fix) * -math.expm1(-dt_s / sensor.drift_time_s) / dt_s**2)
        return measurements.velocity(mean.stamp_ns, sensor.name, mean.values, R, fix.lever_m, sensor.gate(GATE_SIGMA))

    def _white(self, fix: Fix) -> Floats:
        """Variance (2,) of a fix without its slow part."""
        variance = fix.variance_m2 * (1 - fix.sensor.drift_share) if self._slow else fix.variance_m2
        least = MIN_DRIFT_M2 if "position" in fix.sensor.std else MIN_FIX_STD_M**2
        return np.maximum(variance, least)


def _drift_m2(fix: Fix) -> float:
    """Variance of the slow error."""
    return max(fix.sensor.drift_share * float(fix.variance_m2.mean()), MIN_DRIFT_M2)


def _antenna(belief: Belief, lever_m: Floats) -> tuple[Floats, Floats]:
    """Where the antenna is believed (2,) in `map`, and the Jacobian (2, n) of that."""
    model = measurements.fix(belief.stamp_ns, "", np.zeros(2), np.eye(2), lever_m, None, 0.0)
    return model.h(belief.x[None])[0], model.jacobian(belief.x)


def _anchor_antenna(belief: Belief, states: slice, lever_m: Floats, variance: float) -> Belief:
    return anchor_states(belief, states, _antenna(belief, lever_m)[1], variance)
