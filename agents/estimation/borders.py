"""Where the ground changed: the likeliest history of borders, given all steps so far.

Every step may begin new ground, and thus a history. What lies before a border says nothing of the ground behind it, so
of histories with the same last border only the likeliest can win (Fearnhead and Liu 2007, On-line inference for
multiple changepoint problems, with maxima for sums). Each has a Kalman filter of l, t, the c_rr under leading and
trailing axle; with the leading load share w, a step measures regressor (w l + (1 - w) t) + noise. A border makes l
unknown; t becomes l once the trailing axle is across. The score is the log-likelihood of measurements and borders.
Later steps may move a border or remove it.
"""

from __future__ import annotations

import math

import numpy as np

from agents.estimation.balance import BalanceStep
from agents.estimation.tuning import TUNING, EstimationTuning

MOST, KEPT = 80, 60  # most histories, and survivors of pruning
# Rows: l, t, their variances and covariance, score, and the trailing axle's distance to the last border [m], 0 or less
# once across.
LEAD, TRAIL, LEAD_VAR, COVARIANCE, TRAIL_VAR, SCORE, BEHIND_M = range(7)


class BorderSearch:
    """Searches for borders. remembered: number of steps whose borders are reported."""

    def __init__(self, remembered: int, tuning: EstimationTuning = TUNING) -> None:
        self._remembered, self._tuning = remembered, tuning
        variance = tuning.unknown_std**2
        self._rows = np.array(
            [[tuning.first_c_rr], [tuning.first_c_rr], [variance], [variance], [variance], [0.0], [0.0]]
        )
        self._borders: list[tuple[int, ...]] = [()]
        self._direction = 0.0

    def update(self, number: int, step: BalanceStep, raw: float, r: float) -> tuple[int, ...]:
        """Add a step; returns the numbers of the steps that begin new ground, ascending.

        number: of the step, increasing. raw: without the scale error; r: variance of its white noise.
        """
        self._turn(step.regressor)
        self._branch(number, step)
        rows = self._rows
        rows[BEHIND_M] -= step.distance_m
        rows[LEAD_VAR] += self._tuning.uneven**2 * step.distance_m
        on_one_ground = rows[BEHIND_M] <= 0
        for of_trail, of_lead in ((TRAIL, LEAD), (COVARIANCE, LEAD_VAR), (TRAIL_VAR, LEAD_VAR)):
            np.copyto(rows[of_trail], rows[of_lead], where=on_one_ground)
        self._measure(step, raw, r)
        best = int(rows[SCORE].argmax())
        rows[SCORE] -= rows[SCORE, best]
        borders = self._borders[best]
        if rows.shape[1] > MOST:
            kept = np.sort(np.argsort(-rows[SCORE], kind="stable")[:KEPT])
            self._rows, self._borders = rows[:, kept], [self._borders[i] for i in kept.tolist()]
        return borders

    def shift(self, c_rr: float) -> None:
        """Shift the c_rr of all histories."""
        self._rows[[LEAD, TRAIL]] += c_rr

    def _turn(self, regressor: float) -> None:
        """After a reversal on a border, the axles' ground is unknown."""
        direction = math.copysign(1.0, regressor)
        if direction == -self._direction:
            rows = self._rows
            half_way = rows[BEHIND_M] > 0
            rows[LEAD_VAR, half_way] += self._tuning.unknown_std**2
            rows[BEHIND_M, half_way] = 0.0
        self._direction = direction

    def _branch(self, number: int, step: BalanceStep) -> None:
        """Add a history with a border before this step to the likeliest on one ground."""
        rows = self._rows
        scores = np.where(rows[BEHIND_M] <= 0, rows[SCORE], -np.inf)
        parent = int(scores.argmax())
        if step.distance_m <= 0 or scores[parent] == -np.inf:
            return
        level, variance = rows[LEAD, parent], rows[LEAD_VAR, parent]
        expected = self._tuning.borders_per_m * step.distance_m
        odds = expected + math.log(-math.expm1(-expected))  # log-odds of a Poisson process: one or more against none
        behind_m = step.wheelbase_m + step.distance_m / 2
        new = [level, level, self._tuning.unknown_std**2, 0.0, variance, scores[parent] + odds, behind_m]
        self._rows = np.column_stack([rows, new])
        recent = (border for border in self._borders[parent] if border > number - self._remembered)
        self._borders.append((*recent, number))

    def _measure(self, step: BalanceStep, raw: float, r: float) -> None:
        rows, lead = self._rows, step.regressor * step.lead_share
        trail = step.regressor - lead
        with_lead = lead * rows[LEAD_VAR] + trail * rows[COVARIANCE]  # covariances with the measurement
        with_trail = lead * rows[COVARIANCE] + trail * rows[TRAIL_VAR]
        variance = lead * with_lead + trail * with_trail + self._tuning.coloured * r
        innovation = raw - lead * rows[LEAD] - trail * rows[TRAIL]
        square = innovation**2 / variance
        rows[SCORE] -= 0.5 * (np.minimum(square, self._tuning.likely) + np.log(variance))
        innovation *= np.sqrt(self._tuning.likely / np.maximum(square, self._tuning.likely))
        rows[LEAD] += with_lead / variance * innovation
        rows[TRAIL] += with_trail / variance * innovation
        rows[LEAD_VAR] -= with_lead**2 / variance
        rows[COVARIANCE] -= with_lead * with_trail / variance
        rows[TRAIL_VAR] -= with_trail**2 / variance
