"""Corrections of a base station: which of them count, and what the filter makes of them.

A base stands at a known place, so that what its fixes are off is its GPS error alone, and a part of that is the
machine's too. The filter has states for its slow error b and for a part that lasts, d, as of a wrong survey:

    correction = b + d + white noise

The noise of b is correlated with that of the machine's error, by the share that `site_share` finds. So nothing has to
be switched: a base that has nothing in common with the machine is of no use and does no harm, one that falls silent is
forgotten as its error fades, and corrections of one that jumps are refused until d has been opened for them. They are
averaged over a second: of single ones, whose white noise is half a metre, some would always pass the gate, and a jump
would come in by little steps as if it were b.
"""

import math
from collections import Counter
from functools import partial
from typing import Any

import numpy as np

from agents.localisation import measurements
from agents.localisation.filters.belief import Belief, Change, Conditioned, Measurement, open_states, reset_states
from agents.localisation.filters.motion import GpsError, map_from_base
from agents.localisation.filters.state import ATTITUDE, VELOCITY, Layout
from agents.localisation.fix import GPS_GATE_SIGMA, Fix
from agents.localisation.site_share import WAIT_S, SiteShareEstimator
from protocol.arrays import Floats
from protocol.machine.machine_config import SensorConfig
from protocol.machine.readings import Correction

MAX_AGE_S = float(WAIT_S)  # older ones are refused: nobody judges what they have in common with the machine any more
SILENT_S = 30.0  # without a correction for so long none is used: a slow GPS error has mostly become another one
MAX_AHEAD_S = 10.0  # so far ahead of the machine's own readings they wait for these; beyond that a clock is wrong
REPEATS = 5  # the same error so often in a row is no measurement any more
MEAN_NS, DUE_NS = 1_000_000_000, 900_000_000  # corrections of so long are one measurement, once these are together,
REFUSALS = 3  # and so many refused ones in a row are a base that has jumped
LEAST_SHARE = 0.05  # a smaller one is none
UNKNOWN = GpsError(1.0, 45.0)  # the slow error of a base that was not heard yet: any will do


class Corrections:
    """The corrections of one base, on their path into one machine's filter; `counters` says what was refused, and why.

    Until a correction is due it waits: the machine's own readings are the clock.
    """

    def __init__(self, base: SensorConfig, layout: Layout) -> None:
        self.counters: Counter[str] = Counter()
        self._base, self._layout = base, layout
        self._share = SiteShareEstimator()
        self._waiting: list[Correction] = []
        self._newest: Correction | None = None  # of those that count
        self._repeats = 0
        self._why = "no correction has come in"
        self._due: list[Correction] = []  # since the last measurement
        self._measured_ns = self._measured_to_ns = 0  # stamps of that: the mean, and the last one in it
        self._refused = 0  # measurements in a row
        self._jump_m2 = 0.0  # how far the base has jumped, until d has been opened by that
        self._offset_m: Floats | None = None  # what the base said of d at first: the state counts from there
        self._accepted = False
        self._followed_ns = 0
        self._track_m, self._velocity_mps = np.zeros(2), np.zeros(2)

    # --- readings ----------------------------------------------------------------------------------------------------

    def take(self, correction: Correction, now_ns: int) -> None:
        """Keep a correction until it is due, if it counts; now_ns: the newest stamp of the machine's own readings."""
        reason = self._reason_against(correction, now_ns)
        self._newest = correction if reason in ("", "repeated") else self._newest
        if reason:
            self.counters[f"correction_{reason}"] += 1
            self._why = f"the last one was {reason.replace('_', ' ')}"
            return
        self._why = ""
        recent = [c for c in self._waiting if now_ns - c.stamp_ns <= MAX_AGE_S * 1e9]  # a link brings many at once
        self._waiting = [*recent, correction]

    def follow(self, belief: Belief) -> None:
        """Follow the machine by its believed velocity, which wheels and gyros show: dead reckoning in `map`."""
        if self._followed_ns:
            before_m, self._track_m = self._track_m, self._reckoned_m(belief.stamp_ns)
            self._share.drive(belief.stamp_ns, self._track_m - before_m)
        self._followed_ns = belief.stamp_ns
        self._velocity_mps = map_from_base(belief.x[ATTITUDE])[:2] @ belief.x[VELOCITY]

    def compare(self, fix: Fix, belief: Belief, white_m2: float, error: GpsError) -> None:
        """Compare a fix with dead reckoning; white_m2, error: its white noise, and the receiver's slow error."""
        if not self._followed_ns or not fix.is_absolute:
            return
        antenna_m = map_from_base(belief.x[ATTITUDE])[:2] @ fix.lever_m
        off_m = fix.position_m - antenna_m - self._reckoned_m(fix.stamp_ns)
        self._share.add_fix(fix.sensor.name, fix.stamp_ns, off_m, white_m2, error)

    # --- the filter --------------------------------------------------------------------------------------------------

    @property
    def base_error(self) -> GpsError:
        """The slow error of the base; any one while nothing is known of it."""
        newest = self._newest
        return GpsError(newest.slow_m2, newest.time_s) if newest else UNKNOWN

    @property
    def site_share(self) -> float:
        """How much of the slow variance machine and base have in common; rounded, so that it does not always change."""
        return round(self._share.share, 2) if self._accepted else 0.0

    def measurement(self, belief: Belief) -> Measurement | None:
        """The mean of the corrections of a second that are due, as a measurement at the belief's stamp; else None.

        With the base's b of now, one of age t is exp(-t / tau) b + d, and what b did since is noise, which corrections
        of the same time have in common.
        """
        due = [c for c in self._waiting if c.stamp_ns <= belief.stamp_ns]
        if not due:
            return None
        self._waiting = [c for c in self._waiting if c.stamp_ns > belief.stamp_ns]
        for correction in due:
            self._share.add_correction(correction)
        self._due += due
        newest = max(self._due, key=lambda c: c.stamp_ns)
        if newest.stamp_ns - self._measured_to_ns < DUE_NS:
            return None
        recent = [c for c in self._due if c.stamp_ns > newest.stamp_ns - MEAN_NS]
        self._due, self._measured_to_ns = [], newest.stamp_ns
        stamp_ns = newest.stamp_ns - sum(newest.stamp_ns - c.stamp_ns for c in recent) // len(recent)
        between_ns, self._measured_ns = stamp_ns - self._measured_ns, stamp_ns
        age_s = (belief.stamp_ns - stamp_ns) * 1e-9
        fade = math.exp(-age_s / newest.time_s)
        alike = max(1.0, age_s / (between_ns * 1e-9))
        white_m2 = sum(c.white_m2 for c in recent) / len(recent) ** 2
        variance_m2 = white_m2 + newest.slow_m2 * (1 - fade**2) * alike
        off_m = np.mean([(c.east_m, c.north_m) for c in recent], axis=0)
        change = self._change(newest)
        z, R, gate = off_m - self._offset_m, np.eye(2) * variance_m2, self._base.gate(GPS_GATE_SIGMA)
        return measurements.correction(belief.stamp_ns, self._base.name, z, R, fade, self._layout, gate, change)

    def confirm(self, result: Conditioned) -> None:
        """Note what the filter made of a measurement."""
        if not math.isfinite(result.nis):
            return
        self._accepted |= result.accepted
        self._why = "" if result.accepted else "the filter refuses them: the base jumped, or was moved"
        self._refused = 0 if result.accepted else self._refused + 1
        if self._refused >= REFUSALS:
            self._refused = 0
            self._jump_m2 = float((result.innovation**2).sum())
            self.counters["correction_base_jumped"] += 1

    def report(self, now_ns: int) -> dict[str, Any]:
        """Whether corrections are used, how old the last one is, and why they are not, in plain values."""
        newest, share = self._newest, self._share.share
        age_s = (now_ns - newest.stamp_ns) * 1e-9 if newest else None
        why = self._why
        if age_s is not None and age_s > SILENT_S:
            why = f"the last one is {age_s:.0f} s old"
        elif not why and not self._accepted:
            why = "the machine does not know its heading yet"
        elif not why and share < LEAST_SHARE:
            why = "its errors are not those of this machine, or its clock is off"
        return {
            "name": self._base.name,
            "used": not why,
            "why_not": why,
            "age_s": None if age_s is None else round(age_s, 1),
            "share": round(share, 2),
        }

    def _reason_against(self, correction: Correction, now_ns: int) -> str:
        """Why a correction does not count; nothing if it does."""
        last, age_s = self._newest, (now_ns - correction.stamp_ns) * 1e-9
        if last and correction.stamp_ns <= last.stamp_ns:
            return "not_newer"
        if age_s > MAX_AGE_S:
            return "too_old"
        if age_s < -MAX_AHEAD_S:
            return "in_future"
        same = last is not None and (last.east_m, last.north_m) == (correction.east_m, correction.north_m)
        self._repeats = self._repeats + 1 if same else 0
        return "repeated" if self._repeats >= REPEATS else ""

    def _change(self, newest: Correction) -> Change | None:
        """What gives b and d their first values, or opens d for a base that jumped."""
        jump_m2, self._jump_m2 = self._jump_m2, 0.0
        if not self._accepted:
            self._offset_m = np.array([newest.offset_e_m, newest.offset_n_m])
            return partial(_begun, layout=self._layout, slow_m2=newest.slow_m2, offset_m2=newest.offset_m2 + jump_m2)
        opened_m2 = np.eye(2) * jump_m2
        return partial(open_states, states=self._layout.base_offset, covariance=opened_m2) if jump_m2 else None

    def _reckoned_m(self, stamp_ns: int) -> Floats:
        """Where the machine is by dead reckoning (2,), around the last step."""
        reckoned: Floats = self._track_m + self._velocity_mps * ((stamp_ns - self._followed_ns) * 1e-9)
        return reckoned


def not_used(base: SensorConfig, profile: str) -> dict[str, Any]:
    """The report of a machine that names a base and has no use for it."""
    why = "the profile `paper` uses none" if profile == "paper" else "no GPS receiver shows places"
    return {"name": base.name, "used": False, "why_not": why}


def _begun(belief: Belief, layout: Layout, slow_m2: float, offset_m2: float) -> Belief:
    return reset_states(reset_states(belief, layout.base_error, slow_m2), layout.base_offset, offset_m2)
