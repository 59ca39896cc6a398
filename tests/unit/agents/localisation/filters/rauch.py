"""The Rauch-Tung-Striebel smoother over a whole run, from what a filter did step by step: a reference for the tests."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from agents.localisation.filters.belief import Belief, Change, Conditioned, Filter, Measurement, Motion
from agents.localisation.filters.ekf import Ekf
from agents.localisation.filters.square_root import wrapped
from agents.localisation.filters.state import ANGLES
from protocol.arrays import Floats

Smoothed = dict[int, tuple[Floats, Floats]]  # mean and covariance of the whole state, by stamp


class Recorder:
    """A filter that remembers of each belief which one it came from, and the covariance (n, n) of that one with it."""

    def __init__(self, engine: Filter) -> None:
        self.engine = engine
        self._came: dict[int, tuple[Belief, Belief, Floats | None]] = {}  # beliefs stay, so that no id is used again

    def predict(self, belief: Belief, motion: Motion, stamp_ns: int) -> Belief:
        after = self.engine.predict(belief, motion, stamp_ns)
        cross = belief.P @ motion.jacobian(belief.x).T if isinstance(self.engine, Ekf) else _unscented(belief, motion)
        self._came[id(after)] = belief, after, cross
        return after

    def condition(self, belief: Belief, measurement: Measurement) -> Conditioned:
        result = self.engine.condition(belief, measurement)
        if result.accepted:
            self._came[id(result.belief)] = belief, result.belief, None
        return result

    def changing(self, change: Callable[..., Belief], M: Floats | None = None) -> Change:
        """The change of a belief, with its linear map of the error; none leaves the error as it is."""

        def changed(belief: Belief, *more: Any) -> Belief:
            after = change(belief, *more)
            self._came[id(after)] = belief, after, belief.P if M is None else belief.P @ M.T
            return after

        return changed

    def smoothed(self, last: Belief) -> Smoothed:
        """All that led to the last belief, each stamp as known after all measurements."""
        x, P, belief = last.x, last.P, last
        smoothed = {last.stamp_ns: (x, P)}
        while id(belief) in self._came:
            before, after, cross = self._came[id(belief)]
            if cross is not None:
                scale = 1 / np.sqrt(np.diag(after.P))
                G = np.linalg.solve(after.P * np.outer(scale, scale), cross.T * scale[:, None]).T * scale
                x = before.x + G @ wrapped(x - after.x, ANGLES)
                P = before.P + G @ (P - after.P) @ G.T
                smoothed.setdefault(before.stamp_ns, (x, P))
            belief = before
        return smoothed


def _unscented(belief: Belief, motion: Motion) -> Floats:
    """Covariance of the state before and after a motion, by sigma points sqrt(3) deviations off: 2 n weights of 1/6."""
    offsets = math.sqrt(3) * np.linalg.cholesky(belief.P).T
    offsets = np.concatenate([offsets, -offsets])
    moved = motion.f(belief.x + offsets) - motion.f(belief.x[None])
    return offsets.T @ moved / 6
