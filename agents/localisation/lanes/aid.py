"""Lanes as one machine uses them: each window of its way or slopes becomes a measurement of its place."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np

from agents.dead_reckoning import DeadReckonedPose
from agents.localisation.filters.belief import Belief, Measurement, freed, reset_states
from agents.localisation.filters.state import YAW, Layout, X, Y
from agents.localisation.lanes.guards import ALARMS, Guards, prior_m2, share_of, shown
from agents.localisation.lanes.lane_map import LaneMap
from agents.localisation.lanes.matching import Match, match
from agents.localisation.lanes.slopes import SlopeWindow, match_slopes
from agents.localisation.lanes.window import Window
from protocol.arrays import Floats, Table

LANES, SLOPES = "lanes", "slopes"  # the names that its measurements count under


class LaneAid:
    """The lanes that a machine has, and what it makes of them. lanes: the newest, None before there are any."""

    def __init__(self, load_centre_m: float) -> None:
        self.lanes: LaneMap | None = None
        self.counters: Counter[str] = Counter()
        self._load_centre_m = load_centre_m
        self._is_used, self._std_m = False, math.nan
        self.restart()

    def restart(self) -> None:
        """Begin anew, as localisation does."""
        self._window, self._guards, self._prior_m2 = Window(self._load_centre_m), Guards(), prior_m2(young=False)
        self._slopes, self._reckoned = SlopeWindow(self._load_centre_m), DeadReckonedPose(0, 0.0, 0.0, 0.0, 0.0)

    def is_due(self, reckoned: DeadReckonedPose) -> bool:
        """Note where dead reckoning is; returns whether a window has ended there."""
        self._reckoned = reckoned
        self._slopes.add(reckoned)
        return self._window.add(reckoned)

    def feel(self, rows: Table) -> None:
        """Note the slopes of new samples."""
        heading_rad = rows["heading_rad"].astype(float)
        slope = rows["grade_e"] * np.cos(heading_rad) + rows["grade_n"] * np.sin(heading_rad)
        for felt in zip(rows["stamp_ns"].tolist(), slope.tolist(), rows["distance_m"].tolist(), strict=True):
            self._slopes.feel(*felt)

    def variances_m2(self, stamp_ns: int) -> Floats:
        """Of the states that the layout has with lanes (3,), before anything is known of them."""
        self._prior_m2 = prior_m2(young=self.lanes is None or self.lanes.is_young(stamp_ns))
        return self._prior_m2

    def measurement(self, belief: Belief) -> Measurement | None:
        """What the window that ended shows, of a belief with lanes; None where that is nothing."""
        heading_rad = float(belief.x[YAW])
        back_m, headings_rad = self._window.end(heading_rad)
        self._is_used = False
        if self.lanes is None or not self._guards.is_open(belief.stamp_ns):
            return None
        H = shown(len(belief.x), heading_rad)
        lanes = self.lanes.of_others(belief.stamp_ns)
        matched = match(lanes, H.dot(belief.x), H.dot(belief.P).dot(H.T), back_m, headings_rad)
        if not isinstance(matched, Match):
            self.counters[f"{LANES}_{matched}"] += 1
            return None
        z, R = matched.place_m, matched.covariance_m2
        return Measurement(LANES, belief.stamp_ns, z, R, lambda x: x @ H.T, lambda _: H, relocks=False)

    def slope_measurement(self, belief: Belief) -> Measurement | None:
        """What the slopes felt since the last such measurement show along the heading; None where that is nothing."""
        heading_rad = float(belief.x[YAW])
        profile = self._slopes.end(self._reckoned, heading_rad)
        if profile is None or self.lanes is None or not self._guards.is_open(belief.stamp_ns):
            return None
        place = shown(len(belief.x), heading_rad)
        H = np.array([[math.cos(heading_rad), math.sin(heading_rad)]]).dot(place)
        lanes, along_m2 = self.lanes.of_others(belief.stamp_ns), H.dot(belief.P).dot(H.T)
        matched = match_slopes(lanes, place.dot(belief.x), float(along_m2[0, 0]), heading_rad, profile)
        if isinstance(matched, str):
            self.counters[f"{SLOPES}_{matched}"] += 1
            return None
        z, R = H.dot(belief.x) + matched[0], np.array([[matched[1]]])
        return Measurement(SLOPES, belief.stamp_ns, z, R, lambda x: x @ H.T, lambda _: H, relocks=False)

    def judge(self, belief: Belief, nis: float, layout: Layout) -> bool:
        """Look at the belief after a measurement; returns whether lanes fit. Where not they are off for a while.

        nis: normalised innovation squared per component.
        """
        self._std_m = math.sqrt(float(np.linalg.eigvalsh(belief.P[X : Y + 1, X : Y + 1])[-1]))
        alarm = self._guards.judge(belief.stamp_ns, belief.x[layout.lane_guards], self._prior_m2, nis)
        self.counters[f"{LANES}_{alarm}"] += bool(alarm)
        self._is_used = not alarm
        return not alarm

    def share(self, cross_m2: Floats) -> float:
        """How much of a place came from lanes, by its covariance with the map's offset (2, 2)."""
        return share_of(cross_m2, float(self._prior_m2[0]))

    def taken_back(self, belief: Belief, layout: Layout) -> Belief:
        """The belief without what lanes said of the place, and with nothing known of the states that guard it."""
        guards = layout.lane_guards
        return reset_states(freed(belief, guards, self._prior_m2), guards, self._prior_m2)

    def report(self) -> dict[str, Any]:
        """Whether lanes are used, in plain values and a sentence."""
        squares = len(self.lanes.tiles) if self.lanes else 0
        return {"squares": squares, "used": self._is_used, "sentence": self._sentence(), "problem": self._problem()}

    def _problem(self) -> str:
        alarm = self._guards.alarm
        return f"{ALARMS[alarm]}: they are not used for some minutes" if alarm else ""

    def _sentence(self) -> str:
        if self.lanes is None:
            return "no lanes yet"
        if problem := self._problem():
            return problem
        return f"on the fleet's lanes, {self._std_m:.1f} m" if self._is_used else "no lane of the fleet's here"
