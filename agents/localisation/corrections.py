"""Corrections of a base station: which count, and what the filter makes of them.

A base stands at a known place, so that what its fixes are off is its GPS error alone. Part of that error is the
machine's too. The filter has states for the base's slow error b and for the lasting part d, as of a wrong survey:

    correction = b + d + white noise

and the noise of b is correlated with that of the machine's error, by the share that `site_share` finds. So nothing has
to be switched: where the two have nothing in common, b is of no use and does no harm; a base that falls silent is
forgotten as its error fades; and when it jumps, its corrections are refused until d has been opened.
"""

import math
from collections import Counter
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from agents.localisation import measurements
from agents.localisation.filters.belief import Belief, Conditioned, Measurement
from agents.localisation.filters.motion import BaseError, GpsError
from agents.localisation.filters.state import YAW, Layout
from agents.localisation.gps import Fix
from agents.localisation.imu_steps import FilterStep
from agents.localisation.site_share import ShareEstimator
from protocol.arrays import Floats
from protocol.machine.machine_config import SensorConfig
from protocol.machine.readings import Correction

MAX_AGE_S = 30.0  # older ones are refused: a slow GPS error lasts about so long
MAX_AHEAD_S = 10.0  # those of later stamps wait for the machine to come so far; beyond that, a clock is wrong
REPEATS = 5  # the same error so often in a row is a receiver, or a base, that stands still
GATE_SIGMA = 4.0  # as of fixes


def base_of(sensors: Sequence[SensorConfig]) -> SensorConfig | None:
    """The base station whose corrections a machine uses."""
    return next((s for s in sensors if s.kind == Correction.kind and s.use), None)


class Corrections:
    """The corrections of one base, on their way into one machine's filter."""

    def __init__(self, base: SensorConfig, layout: Layout) -> None:
        self.counters: Counter[str] = Counter()
        self._base, self._layout = base, layout
        self._share = ShareEstimator()
        self._waiting: list[Correction] = []
        self._newest: Correction | None = None
        self._repeats = 0
        self._begun = False
        self._used_ns = 0
        self._track_m, self._turn, self._step = np.zeros(2), np.eye(2), None

    def take(self, correction: Correction, now_ns: int) -> None:
        """Keep a correction that is plausible, until it is due."""
        if why := self._why_not(correction, now_ns):
            self.counters[f"{self._base.name}_{why}"] += 1
            return
        self._newest = correction
        self._waiting.append(correction)
        self._share.add_correction(
            correction.stamp_ns, _error_m(correction), correction.white_m2, correction.slow_m2, correction.time_s
        )

    def _why_not(self, correction: Correction, now_ns: int) -> str:
        last = self._newest
        if last and correction.stamp_ns <= last.stamp_ns:
            return "not_newer"
        age_s = (now_ns - correction.stamp_ns) * 1e-9
        if age_s > MAX_AGE_S:
            return "too_old"
        if age_s < -MAX_AHEAD_S:
            return "in_future"
        same = last is not None and (last.east_m, last.north_m) == (correction.east_m, correction.north_m)
        self._repeats = self._repeats + 1 if same else 0
        if self._repeats >= REPEATS:
            self._newest = correction
            return "repeated"
        return ""

    @property
    def error(self) -> BaseError | None:
        newest = self._newest
        if newest is None:
            return None
        return BaseError(newest.slow_m2, newest.time_s, self._share.share)

    def due(self, belief: Belief, machine: GpsError) -> Measurement | None:
        """The newest correction that is not ahead of the belief, as a measurement at its stamp."""
        ready = [c for c in self._waiting if c.stamp_ns <= belief.stamp_ns]
        if not ready:
            return None
        self._waiting = [c for c in self._waiting if c.stamp_ns > belief.stamp_ns]
        c = ready[-1]
        age_s = (belief.stamp_ns - c.stamp_ns) * 1e-9
        fade = math.exp(-age_s / c.time_s)
        changed_m2 = c.slow_m2 * (1 - fade**2) * max(1.0, age_s * 5)
        R = np.eye(2) * (c.white_m2 + changed_m2)
        change = None
        if not self._begun:
            offset = np.array([c.offset_e_m, c.offset_n_m])
            change = partial(_begin, layout=self._layout, share=self._share.share, machine=machine, c=c, offset=offset)
        return measurements.correction(
            belief.stamp_ns, self._base.name, _error_m(c), R, fade, self._layout, self._base.gate(GATE_SIGMA), change
        )

    def confirm(self, result: Conditioned, stamp_ns: int) -> None:
        self._begun = True
        if result.accepted:
            self._used_ns = stamp_ns

    def follow(self, step: FilterStep, belief: Belief) -> None:
        """Follow dead reckoning in `map`, by the heading and wheel scale that are believed."""
        if self._step is not None:
            self._track_m = self._track_m + self._moved(step.reckoned)
            self._share.drive(abs(step.reckoned.travel_m - self._step.reckoned.travel_m))
        angle = float(belief.x[YAW]) - step.reckoned.angle_rad
        scale = 1.0
        if self._layout.wheel_scale:
            scale = 1 / (1 + float(belief.x[self._layout.wheel_scales.start]))
        c, s = math.cos(angle) * scale, math.sin(angle) * scale
        self._turn, self._step = np.array([[c, -s], [s, c]]), step

    def _moved(self, reckoned) -> Floats:
        before = self._step.reckoned
        return self._turn @ np.array([reckoned.x_m - before.x_m, reckoned.y_m - before.y_m])

    def note(self, fix: Fix, belief: Belief, white_m2: float, slow: GpsError) -> None:
        if self._step is None:
            return
        lever = fix.lever_m
        yaw = float(belief.x[YAW])
        c, s = math.cos(yaw), math.sin(yaw)
        antenna = np.array([c * lever[0] - s * lever[1], s * lever[0] + c * lever[1]])
        off = fix.position_m - antenna - self._track_m - self._moved(fix.reckoned)
        self._share.add_fix(fix.stamp_ns, off, white_m2, slow.variance_m2, slow.time_s)

    def report(self, now_ns: int) -> dict[str, Any]:
        return {"share": self._share.share}


def _error_m(correction: Correction) -> Floats:
    return np.array([correction.east_m, correction.north_m])


def _begin(belief: Belief, layout: Layout, share: float, machine: GpsError, c: Correction, offset: Floats) -> Belief:
    e, b, d = layout.gps_error(0), layout.base_error, layout.base_offset
    k = share * math.sqrt(c.slow_m2 / machine.variance_m2)
    M = np.eye(len(belief.x))
    M[b], M[d] = 0.0, 0.0
    M[b, e] = np.eye(2) * k
    x, P = M @ belief.x, M @ belief.P @ M.T
    x[d] = offset
    P[b, b] += np.eye(2) * c.slow_m2 * (1 - share**2)
    P[d, d] += np.eye(2) * c.offset_m2
    return Belief(belief.stamp_ns, x, P)
