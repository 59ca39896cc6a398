"""Where the ground under a machine changed: of all histories of borders, the likeliest by all steps so far.

A history is begun with every step that may be the first one on a new ground, and the likeliest are kept: what lies
before a border says nothing of the ground behind it, so that of all histories that end with the same border the
likeliest is the only one that can win (Fearnhead and Liu 2007, On-line inference for multiple changepoint problems,
with maxima in place of sums). Each has a Kalman filter of its own. With l, t the c_rr under the leading and the
trailing axle and w the leading one's share of the load, a step measures regressor (w l + (1 - w) t) + noise; a border
makes l unknown, and t becomes l once the trailing axle has come up. The score of a history is the logarithm of how
likely its measurements and its borders are.

So a border is where all that came behind it says it was, and is taken back when more steps speak against it.
"""

from __future__ import annotations

import math

import numpy as np

from agents.estimation.balance import BalanceStep

FIRST_C_RR, FIRST_STD = 0.03, 0.1
JUMP_STD = 0.1  # of c_rr behind a border, from what it was before: as unknown as at first
BORDERS_PER_M = 0.02  # a border every 50 m; maps with five times as many hardly differ
# Noise is no sooner gone than a torque's error of a second, and a bump of the ground looks like a change of it: so many
# times the variance of white noise, or small borders are seen where there are none.
COLOURED = 2.0
UNEVEN = 5e-4  # random walk of c_rr [1/sqrt(m)] on one ground
LIKELY = 9.0  # squares beyond so many times the variance count as so many: a single jolt is no border
MOST, KEPT = 80, 60  # histories at most; of more, so many of the likeliest
# What a row of the histories has: l, t, their variances and covariance, the score, and how far the trailing axle is
# from the last border [m], 0 or less once it has come up.
LEAD, TRAIL, LEAD_VAR, COVARIANCE, TRAIL_VAR, SCORE, BEHIND_M = range(7)


class BorderSearch:
    """Searches for borders step by step. remembered: of how many steps the borders are of interest."""

    def __init__(self, remembered: int) -> None:
        self._remembered = remembered
        variance = FIRST_STD**2
        self._rows = np.array([[FIRST_C_RR], [FIRST_C_RR], [variance], [variance], [variance], [0.0], [0.0]])
        self._borders: list[tuple[int, ...]] = [()]
        self._direction = 0.0

    def update(self, number: int, step: BalanceStep, raw: float, r: float) -> tuple[int, ...]:
        """Take in a step; returns the numbers of the steps that begin a new ground, ascending.

        number: of the step, counted up. raw: of the step, without the scale error; r: variance of its white noise.
        """
        self._turn(step.regressor)
        self._branch(number, step)
        rows = self._rows
        rows[BEHIND_M] -= step.distance_m
        rows[LEAD_VAR] += UNEVEN**2 * step.distance_m
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
        """Note that all steps are to show so much more."""
        self._rows[[LEAD, TRAIL]] += c_rr

    def _turn(self, regressor: float) -> None:
        """Back across a border that only one axle had crossed, nobody knows on which ground the axles stand."""
        direction = math.copysign(1.0, regressor)
        if direction == -self._direction:
            rows = self._rows
            half_way = rows[BEHIND_M] > 0
            rows[LEAD_VAR, half_way] += JUMP_STD**2
            rows[BEHIND_M, half_way] = 0.0
        self._direction = direction

    def _branch(self, number: int, step: BalanceStep) -> None:
        """One history more, with a border before this step: that of the likeliest whose axles stand on one ground."""
        rows = self._rows
        scores = np.where(rows[BEHIND_M] <= 0, rows[SCORE], -np.inf)
        parent = int(scores.argmax())
        if step.distance_m <= 0 or scores[parent] == -np.inf:
            return
        level, variance = rows[LEAD, parent], rows[LEAD_VAR, parent]
        expected = BORDERS_PER_M * step.distance_m
        odds = expected + math.log(-math.expm1(-expected))  # logarithm: one or more of a Poisson process, against none
        behind_m = step.wheelbase_m + step.distance_m / 2  # a step shows the ground at its middle
        new = [level, level, JUMP_STD**2, 0.0, variance, scores[parent] + odds, behind_m]
        self._rows = np.column_stack([rows, new])
        recent = (border for border in self._borders[parent] if border > number - self._remembered)
        self._borders.append((*recent, number))

    def _measure(self, step: BalanceStep, raw: float, r: float) -> None:
        """Condition all histories on the step, and score them."""
        rows, lead = self._rows, step.regressor * step.lead_share
        trail = step.regressor - lead
        with_lead = lead * rows[LEAD_VAR] + trail * rows[COVARIANCE]  # covariances with what is measured
        with_trail = lead * rows[COVARIANCE] + trail * rows[TRAIL_VAR]
        variance = lead * with_lead + trail * with_trail + COLOURED * r
        innovation = raw - lead * rows[LEAD] - trail * rows[TRAIL]
        square = innovation**2 / variance
        rows[SCORE] -= 0.5 * (np.minimum(square, LIKELY) + np.log(variance))
        innovation *= np.sqrt(LIKELY / np.maximum(square, LIKELY))
        rows[LEAD] += with_lead / variance * innovation
        rows[TRAIL] += with_trail / variance * innovation
        rows[LEAD_VAR] -= with_lead**2 / variance
        rows[COVARIANCE] -= with_lead * with_trail / variance
        rows[TRAIL_VAR] -= with_trail**2 / variance
