"""GPS receivers: from fixes to measurements, each in its mode.

Relative: each receiver is shifted so that its first fix lies at the believed antenna. In a map that all machines share
this is the transform of a receiver's fixes into the vehicle's own world, by its first fix and the start's roll, pitch
and yaw (navsat_transform): on the way back into the map the rotations cancel, and this shift is left.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from agents.dead_reckoning import Dead
from agents.localisation import measurements
from agents.localisation.consistency import Consistency, Watch
from agents.localisation.filters.belief import Belief, Measurement
from agents.localisation.filters.history import Change, Fusion
from agents.localisation.filters.motion import GpsError
from agents.localisation.filters.state import Layout
from agents.localisation.measurements import SensingConfig
from agents.localisation.modes import Told, rate, referred, renewed
from protocol.arrays import Floats
from protocol.machine.machine_config import ABSOLUTE, DIFFERENTIAL, RELATIVE, SensorConfig
from protocol.machine.readings import Gps
from protocol.site.site_config import Projection

MIN_DRIFT_M2 = 1e-6  # a receiver without slow error must not make the covariance singular


@dataclass(frozen=True)
class Fix:
    """A fix in `map`, (2,) each [m, m2], and where dead reckoning was."""

    stamp_ns: int
    sensor: SensorConfig
    position_m: Floats
    variance_m2: Floats
    dead: Dead

    @property
    def is_absolute(self) -> bool:
        """Whether it tells a place before anything is believed."""
        return self.sensor.mode == ABSOLUTE

    @property
    def lever_m(self) -> Floats:
        """Where the antenna sits (3,)."""
        return np.array(self.sensor.mount.xyz_m)


def drifting(sensors: Sequence[SensorConfig]) -> list[SensorConfig]:
    """Receivers whose slow error matters: it cancels in differences."""
    return [s for s in sensors if s.kind == "gps" and s.use and s.mode != DIFFERENTIAL]


class Receivers:
    """The receivers of one machine; `errors` are those of the layout's slow errors, as they are now.

    slow: whether a share of each error is slow, else all of it is white.
    """

    def __init__(
        self,
        sensors: Sequence[SensorConfig],
        projection: Projection,
        layout: Layout,
        config: SensingConfig,
        *,
        slow: bool,
    ) -> None:
        self._sensors = {s.name: s for s in sensors if s.kind == "gps" and s.use}
        self._projection, self._layout, self._config, self._slow = projection, layout, config, slow
        self._states = {s.name: i for i, s in enumerate(drifting(sensors))} if slow else {}
        self.errors = [GpsError(MIN_DRIFT_M2, self._sensors[name].drift_time_s) for name in self._states]
        self._watches = {name: Watch() for name in self._sensors}
        self._heard: set[str] = set()
        self._shifts: dict[str, Floats] = {}  # of relative ones, and how unsure the believed antenna was then [m2]
        self._referred_m2: dict[str, float] = {}
        self._last: dict[str, Told] = {}  # of differential ones

    @property
    def consistency(self) -> dict[str, Consistency]:
        """How consistent the filter is with each receiver, of those that were heard enough."""
        found = {name: watch.consistency() for name, watch in self._watches.items()}
        return {name: value for name, value in found.items() if value}

    def fix(self, gps: Gps, dead: Dead) -> Fix:
        """A reading in `map`, with the variances that are configured, else with its own."""
        sensor = self._sensors[gps.sensor]
        x, y, _ = self._projection.to_map(gps.lat_deg, gps.lon_deg, gps.height_m)
        stated = (gps.var_e_m2, gps.var_n_m2)
        variance = [sensor.std["position"] ** 2] * 2 if "position" in sensor.std else stated
        return Fix(gps.stamp_ns, sensor, np.array([x, y]), np.array(variance), dead)

    def add(self, fusion: Fusion, fix: Fix) -> list[Belief]:
        """Give a fix to the filter; returns the beliefs that it changed."""
        if fix.sensor.mode == DIFFERENTIAL:
            velocity = self._velocity(fix)
            return self._noted(fusion, fix, fusion.add([velocity])) if velocity else []
        if fix.sensor.mode == RELATIVE:
            fix = self._shifted(fusion, fix)
        return self._noted(fusion, fix, fusion.add(*self._position(fix)))

    def _noted(self, fusion: Fusion, fix: Fix, beliefs: list[Belief]) -> list[Belief]:
        name = fix.sensor.name
        if beliefs:
            self._heard.add(name)
            self._watches[name].note(fusion.last[name])
        return beliefs

    def _position(self, fix: Fix) -> tuple[list[Measurement], Change | None]:
        sensor = fix.sensor
        error, change = None, None
        if self._slow:
            index, drift_m2 = self._states[sensor.name], _drift_m2(fix)
            error = self._layout.gps_error(index)
            if fix.is_absolute:
                change = partial(renewed, states=error, variance=drift_m2)
            else:  # both the error now and that of the first fix count, and where the filter was wrong then
                change = partial(_referred, states=error, lever_m=fix.lever_m, variance=2 * drift_m2)
                drift_m2 = 2 * drift_m2 + self._referred_m2[sensor.name]
            self.errors[index] = GpsError(drift_m2, sensor.drift_time_s)
        measurement = measurements.fix(
            fix.stamp_ns, sensor.name, fix.position_m, np.diag(self._white(fix)), fix.lever_m, error, self._gate(sensor)
        )
        # a receiver that comes late brings its own unknown error
        return [measurement], None if sensor.name in self._heard else change

    def _shifted(self, fusion: Fusion, fix: Fix) -> Fix:
        """The fix, counted from the first: that one lies where the antenna was believed at its stamp."""
        name = fix.sensor.name
        if name not in self._heard:  # also where the first was refused, as too late
            belief = fusion.at(fix.stamp_ns)
            believed, H = _antenna(belief, fix.lever_m)
            self._shifts[name] = believed - fix.position_m
            self._referred_m2[name] = float(np.trace(H @ belief.P @ H.T)) / 2
        return replace(fix, position_m=fix.position_m + self._shifts[name])

    def _velocity(self, fix: Fix) -> Measurement | None:
        """Of the antenna, between the last fix and this one: slow errors cancel but for what they change meanwhile."""
        sensor, now = fix.sensor, Told(fix.stamp_ns, fix.position_m, self._white(fix))
        before = self._last.get(sensor.name, now)
        if now.stamp_ns < before.stamp_ns:
            return None
        self._last[sensor.name] = now
        mean = rate(before, now)
        if mean is None:
            return None
        R, dt_s = np.diag(mean.variances), (now.stamp_ns - before.stamp_ns) * 1e-9
        if self._slow:
            R += np.eye(2) * (2 * _drift_m2(fix) * -math.expm1(-dt_s / sensor.drift_time_s) / dt_s**2)
        return measurements.velocity(mean.stamp_ns, sensor.name, mean.values, R, fix.lever_m, self._gate(sensor))

    def _white(self, fix: Fix) -> Floats:
        """Variance (2,) of a fix without its slow part; what is configured may be as small as it likes."""
        variance = fix.variance_m2 * (1 - fix.sensor.drift_share) if self._slow else fix.variance_m2
        least = MIN_DRIFT_M2 if "position" in fix.sensor.std else self._config.min_fix_std_m**2
        return np.maximum(variance, least)

    def _gate(self, sensor: SensorConfig) -> float:
        return sensor.gate_sigma or self._config.gps_gate_sigma


def _drift_m2(fix: Fix) -> float:
    """Variance of the slow error."""
    return max(fix.sensor.drift_share * float(fix.variance_m2.mean()), MIN_DRIFT_M2)


def _antenna(belief: Belief, lever_m: Floats) -> tuple[Floats, Floats]:
    """Where the antenna is believed (2,) in `map`, and the Jacobian (2, n) of that."""
    model = measurements.fix(belief.stamp_ns, "", np.zeros(2), np.eye(2), lever_m, None, 0.0)
    return model.h(belief.x[None])[0], model.jacobian(belief.x)


def _referred(belief: Belief, states: slice, lever_m: Floats, variance: float) -> Belief:
    return referred(belief, states, _antenna(belief, lever_m)[1], variance)
