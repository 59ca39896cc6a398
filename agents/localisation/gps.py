"""GPS receivers: fixes to measurements, each in its mode.

Relative: a shift puts the first fix at the believed antenna. In a shared map this equals navsat_transform, which moves
fixes into the vehicle's own world: on the way back the rotations cancel.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from agents.dead_reckoning import DeadReckonedPose
from agents.ground_speed import MIN_FIX_STD_M
from agents.localisation import measurements
from agents.localisation.consistency import MAX_SHARE, Consistency, InnovationMonitor
from agents.localisation.filters.belief import Belief, Change, Conditioned, Measurement, anchor_states, restate_states
from agents.localisation.filters.motion import GpsError, gps_covariance
from agents.localisation.filters.state import YAW, Layout
from agents.localisation.fix import Fix
from agents.localisation.sensor_modes import ModalSensors, StampedValue
from agents.localisation.shared_errors import MOST_SHARED, SharedFix, ShareEstimator
from agents.localisation.tuning import TUNING, LocalisationTuning
from protocol.arrays import Floats
from protocol.machine.machine_config import ABSOLUTE, DIFFERENTIAL, RELATIVE, SensorConfig
from protocol.machine.readings import Gps
from protocol.site.site_config import Projection

AGREED_NS = 3_000_000_000  # age at which a fix no longer shows whether its receiver agrees
MIN_DRIFT_M2 = 1e-6  # keeps the covariance regular without slow errors


def drifting(sensors: Sequence[SensorConfig]) -> list[SensorConfig]:
    """Receivers with a slow error; in differences it cancels."""
    return [s for s in sensors if s.kind == "gps" and s.use and s.mode != DIFFERENTIAL]


class Receivers(ModalSensors[Fix]):
    """One machine's receivers; `errors`: current slow errors of the layout.

    slow: whether a share of each error is slow, else all white. machine_share: slow variance in common, None to
    estimate it.
    """

    def __init__(
        self,
        sensors: Sequence[SensorConfig],
        projection: Projection,
        layout: Layout,
        tuning: LocalisationTuning = TUNING,
        *,
        slow: bool,
        machine_share: float | None = None,
    ) -> None:
        super().__init__()
        self._sensors = {s.name: s for s in sensors if s.kind == "gps" and s.use}
        self._projection, self._layout, self._tuning, self._slow = projection, layout, tuning, slow
        self._states = {s.name: i for i, s in enumerate(drifting(sensors))} if slow else {}
        self._drift_m2 = dict.fromkeys(self._states, MIN_DRIFT_M2)  # of the slow error, without an anchor's
        self._stated_m2: dict[str, float] = {}  # its value at the last significant change
        absolute = [s.name for s in self._sensors.values() if s.mode == ABSOLUTE]
        self._compared = {name: i for i, name in enumerate(absolute)} if slow and machine_share is None else {}
        self._estimator = ShareEstimator(len(absolute), tuning)
        self._configured = machine_share
        self._monitors = {name: InnovationMonitor(tuning if slow else None) for name in self._sensors}
        self._judged: dict[str, tuple[int, bool]] = {}  # stamp of each one's last fix, and whether accepted
        self._refused: Counter[str] = Counter()  # in a row
        self._off_m: dict[str, list[Floats]] = {}  # innovations of refused fixes since the last relock
        self._jumps: dict[str, tuple[int, float]] = {}  # stamp, and the receiver's squared error [m2]
        self._shifts: dict[str, Floats] = {}  # of relative ones, and the antenna's variance then [m2]
        self._anchor_m2: dict[str, float] = {}

    @property
    def errors(self) -> tuple[GpsError, ...]:
        """Slow errors of receivers with states."""
        return tuple(self._error(name) for name in self._states)

    def forgotten(self) -> tuple[GpsError, ...]:
        """The same, after discarding jumps that were none."""
        self._jumps.clear()
        return self.errors

    def error_states(self, receiver: str) -> slice | None:
        """States of a receiver's slow error; None without."""
        return self._layout.gps_error(self._states[receiver]) if receiver in self._states else None

    def variance_factor(self, receiver: str) -> float:
        """Factor applied to a receiver's stated variance [-]."""
        return self._monitors[receiver].variance_factor if receiver in self._monitors else 1.0

    @property
    def machine_share(self) -> float | None:
        """Share of slow variance common to all receivers; None with fewer than two."""
        if not self._slow or len(self._sensors) < 2:
            return None
        return self._estimator.share if self._configured is None else self._configured

    @property
    def consistency(self) -> dict[str, Consistency]:
        """Filter consistency with each receiver that has enough fixes."""
        speaking = [name for name, monitor in self._monitors.items() if monitor.consistency()]
        share = self.machine_share
        checks = share is not None and share <= MAX_SHARE and sum(n in self._states for n in speaking) > 1
        judged = {n: self._monitors[n].consistency(is_checked=checks and n in self._states) for n in speaking}
        return {name: value for name, value in judged.items() if value}

    def fix(self, gps: Gps, reckoned: DeadReckonedPose) -> Fix:
        """A reading in `map`, with configured variances, else its own, times its factor."""
        sensor, factor = self._sensors[gps.sensor], self.variance_factor(gps.sensor)
        x, y, _ = self._projection.to_map(gps.lat_deg, gps.lon_deg, gps.height_m)
        stated = (gps.var_e_m2, gps.var_n_m2)
        variance = np.array([sensor.std["position"] ** 2] * 2 if "position" in sensor.std else stated)
        return Fix(gps.stamp_ns, sensor, np.array([x, y]), factor * variance, reckoned)

    def anchor(self, fix: Fix, belief: Belief) -> None:
        """Shift the receiver so that this fix lies at the believed antenna."""
        believed, H = _antenna(belief, fix.lever_m)
        self._shifts[fix.sensor.name] = believed - fix.position_m
        self._anchor_m2[fix.sensor.name] = float(np.trace(H @ belief.P @ H.T)) / 2

    def measurement(self, fix: Fix) -> Measurement | None:
        """A position, or a velocity of a differential receiver; None without an earlier fix."""
        return self._velocity(fix) if fix.sensor.mode == DIFFERENTIAL else self._position(fix)

    def confirm(self, fix: Fix, result: Conditioned) -> None:
        """Note the filter's result; the receiver's error is no longer new."""
        super().confirm(fix, result)
        name = fix.sensor.name
        if name in self._states and (name not in self._stated_m2 or self._is_restated(name)):
            self._stated_m2[name] = self._drift_m2[name]
        self._monitors[name].note(result, self._believed_error(name, result.belief))
        if fix.sensor.mode == DIFFERENTIAL or not math.isfinite(result.nis):
            return
        self._judged[name] = (fix.stamp_ns, result.accepted)
        if not result.accepted:
            self._refused[name] += 1
            self._off_m.setdefault(name, []).append(result.innovation)
            if self._refused[name] % self._tuning.relock:
                return
            del self._off_m[name]
            if self.is_outvoted(fix):
                self._jumps[name] = (fix.stamp_ns, float((result.innovation**2).mean()))
            return
        self._refused[name] = 0
        self._off_m.pop(name, None)
        faded_ns = self._tuning.faded * fix.sensor.drift_time_s * 1e9
        if name in self._jumps and fix.stamp_ns - self._jumps[name][0] > faded_ns:
            del self._jumps[name]
        if len(self._compared) > 1 and name in self._compared:
            white_m2, slow_m2, time_s = _mean(self._white(fix)), self._drift_m2[name], fix.sensor.drift_time_s
            i, antenna = self._compared[name], fix.reckoned_antenna_m
            shared = SharedFix(i, fix.stamp_ns, fix.position_m, antenna, white_m2, slow_m2, time_s)
            self._estimator.add(shared, float(result.belief.x[YAW]) - fix.reckoned.angle_rad)

    def _believed_error(self, name: str, belief: Belief) -> float | None:
        if (states := self.error_states(name)) is None:
            return None
        error = belief.x[states]
        return float(error.dot(error)) / 2 / self._error(name).variance_m2

    def _error(self, name: str) -> GpsError:
        drift_m2, time_s, anchor_m2 = self._drift_m2[name], self._sensors[name].drift_time_s, self._anchor_m2.get(name)
        common_m2 = min(self.machine_share or 0.0, MOST_SHARED) * drift_m2
        # a relative one has errors now, at its first fix, and the filter's then
        variance_m2 = drift_m2 if anchor_m2 is None else 2 * drift_m2 + anchor_m2
        if name in self._jumps:  # it errs by its jump, for the lifetime of its errors
            jumped_ns, jump_m2 = self._jumps[name]
            variance_m2 += jump_m2 * math.exp((jumped_ns - self._judged[name][0]) * 1e-9 / time_s)
        return GpsError(variance_m2, time_s, common_m2)

    def _position(self, fix: Fix) -> Measurement:
        sensor = fix.sensor
        place = fix.position_m + self._shifts[sensor.name] if sensor.mode == RELATIVE else fix.position_m
        error, change = None, None
        opens: tuple[slice, ...] = (measurements.PLACE,)
        if self._slow:
            error = self._layout.gps_error(self._states[sensor.name])
            self._drift_m2[sensor.name] = drift_m2 = _drift_m2(fix)
            if sensor.name not in self._confirmed:  # its error is unknown
                change = self._joining(fix, error)
            elif self._is_restated(sensor.name):
                before_m2 = self._stated_m2[sensor.name]
                change = partial(restate_states, states=error, before=before_m2, after=drift_m2)
            if self.is_outvoted(fix):
                opens = (error,)
            elif not self._votes(fix) and self._has_jumped(fix.sensor.name, _mean(self._white(fix))):
                # whether receiver or filter is wrong, motion will show
                opens = (measurements.PLACE, error)
        R = np.diag(self._white(fix))
        gate = sensor.gate(self._tuning.gps_gate_sigma)
        return measurements.fix(fix.stamp_ns, sensor.name, place, R, fix.lever_m, error, gate, opens, change)

    def _is_restated(self, name: str) -> bool:
        """Whether a stated variance changed so much that the error is another one."""
        times = self._tuning.restated
        return not 1 / times < self._drift_m2[name] / self._stated_m2[name] < times

    def is_outvoted(self, fix: Fix) -> bool:
        """Whether most other receivers agree with the filter; then a refused one is wrong."""
        votes = self._votes(fix)
        return sum(votes) > votes.count(False)

    def _has_jumped(self, name: str, white_m2: float) -> bool:
        """Whether refused fixes drift no further, so that receiver or position jumped.

        Else the motion is wrong, as with a stuck wheel, and shows nothing.
        """
        off_m, half = self._off_m.get(name), self._tuning.relock // 2
        if not off_m:
            return True
        first_m, last_m = (math.hypot(*np.mean(part, axis=0)) for part in (off_m[:half], off_m[-half:]))
        return last_m - first_m < self._tuning.gps_gate_sigma * math.sqrt(2 * white_m2 / half)

    def _votes(self, fix: Fix) -> list[bool]:
        since_ns = fix.stamp_ns - AGREED_NS
        return [accepted for name, (ns, accepted) in self._judged.items() if ns > since_ns and name != fix.sensor.name]

    def _joining(self, fix: Fix, states: slice) -> Change:
        """First value of a receiver's error, given earlier receivers."""
        if not fix.is_absolute:
            return partial(_anchor_antenna, states=states, lever_m=fix.lever_m, variance=2 * _drift_m2(fix))
        names = [n for n in self._states if n in self._confirmed and self._sensors[n].mode == ABSOLUTE]
        covariance = gps_covariance(tuple(self._error(n) for n in [*names, fix.sensor.name]))
        weights = np.linalg.solve(covariance[:-1, :-1], covariance[:-1, -1])
        H = np.zeros((2, self._layout.n))
        for name, weight in zip(names, weights, strict=True):
            H[:, self._layout.gps_error(self._states[name])] = -weight * np.eye(2)
        variance = float(covariance[-1, -1] - weights.dot(covariance[:-1, -1]))
        return partial(_join, states=states, H=H, variance=variance)

    def _velocity(self, fix: Fix) -> Measurement | None:
        """Antenna velocity between two fixes: slow errors cancel but for their change."""
        sensor, now = fix.sensor, StampedValue(fix.stamp_ns, fix.position_m, self._white(fix))
        before, mean = self._last.get(sensor.name, now), self._rate(sensor.name, now)
        if mean is None:
            return None
        R, dt_s = np.diag(mean.variances), (now.stamp_ns - before.stamp_ns) * 1e-9
        if self._slow:
            R += np.eye(2) * (2 * self._differential_m2(fix) * -math.expm1(-dt_s / sensor.drift_time_s) / dt_s**2)
        return measurements.velocity(
            mean.stamp_ns, sensor.name, mean.values, R, fix.lever_m, sensor.gate(self._tuning.gps_gate_sigma)
        )

    def _differential_m2(self, fix: Fix) -> float:
        """Slow variance, inflated so that receivers sharing it count as one."""
        others = sum(s.mode == DIFFERENTIAL for s in self._sensors.values()) - 1
        return _drift_m2(fix) * (1 + others * (self.machine_share or 0.0))

    def _white(self, fix: Fix) -> Floats:
        """Variance (2,) of a fix without its slow part."""
        variance = fix.variance_m2 * (1 - fix.sensor.drift_share) if self._slow else fix.variance_m2
        least = MIN_DRIFT_M2 if "position" in fix.sensor.std else MIN_FIX_STD_M**2
        return np.maximum(variance, least)


def _mean(variance_m2: Floats) -> float:
    """Over both axes; ten times as fast as `mean`."""
    east_m2, north_m2 = variance_m2.tolist()
    return float(east_m2 + north_m2) / 2


def _drift_m2(fix: Fix) -> float:
    return max(fix.sensor.drift_share * _mean(fix.variance_m2), MIN_DRIFT_M2)


def _antenna(belief: Belief, lever_m: Floats) -> tuple[Floats, Floats]:
    """Believed antenna (2,) in `map`, and its Jacobian (2, n)."""
    model = measurements.fix(belief.stamp_ns, "", np.zeros(2), np.eye(2), lever_m, None, 0.0)
    return model.h(belief.x[None])[0], model.jacobian(belief.x)


def _join(belief: Belief, states: slice, H: Floats, variance: float) -> Belief:
    """Set states e (k,) to an error partly known from others: e = -H x + v."""
    joined = anchor_states(belief, states, H, variance)
    x = joined.x.copy()
    x[states] = -H @ belief.x
    return replace(joined, x=x)


def _anchor_antenna(belief: Belief, states: slice, lever_m: Floats, variance: float) -> Belief:
    return anchor_states(belief, states, _antenna(belief, lever_m)[1], variance)
