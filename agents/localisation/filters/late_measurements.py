"""Measurements in any order: a filter with a history, re-filtered from the stamp of a late measurement.

A node has a stamp, its measurements, and the belief after them.
"""

import math
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter

import numpy as np

from agents.localisation.filters.belief import Belief, Conditioned, Filter, Measurement, extended, open_states
from agents.localisation.filters.motion import MotionModel, motion
from agents.localisation.filters.smoother import SmoothedPose
from agents.localisation.tuning import TUNING
from protocol.arrays import Floats

WINDOW_S = 1.0  # greatest lateness; receivers and networks need less
NO_SENSOR: frozenset[str] = frozenset()
_stamp = attrgetter("stamp_ns")


@dataclass
class _Node:
    """One stamp. reopened: sensors relocked here."""

    stamp_ns: int
    measurements: list[Measurement] = field(default_factory=list)
    belief: Belief | None = None
    reopened: set[str] = field(default_factory=set)


class Fusion:
    """Filters measurements into beliefs.

    model: motion model; a new one holds from then on. counters: measurements used, gated and refused, by sensor. last:
    each sensor's newest result. window_s: as WINDOW_S. relock: as in LocalisationTuning.
    """

    def __init__(
        self, engine: Filter, model: MotionModel, start: Belief, window_s: float = WINDOW_S, relock: int = TUNING.relock
    ) -> None:
        self.counters: Counter[str] = Counter()
        self.last: dict[str, Conditioned] = {}
        self.model = model
        self._engine, self._relock = engine, relock
        self._window_ns = round(window_s * 1e9)
        self._nodes = [_Node(start.stamp_ns, [], start)]
        self._refused: Counter[str] = Counter()  # in a row
        self._smoothed: list[SmoothedPose] = []

    @property
    def belief(self) -> Belief:
        """The newest belief."""
        belief = self._nodes[-1].belief
        assert belief is not None
        return belief

    def at(self, stamp_ns: int) -> Belief:
        """The belief at a stamp, predicted from the last one before."""
        index = bisect_right(self._nodes, stamp_ns, key=_stamp) - 1
        belief = self._nodes[max(index, 0)].belief
        assert belief is not None
        return self._moved(belief, stamp_ns)

    def take_smoothed(self) -> list[SmoothedPose]:
        """Poses that left the smoother's lag since the last call, oldest first.

        No late measurement can change them, so the order of arrival does not matter.
        """
        taken, self._smoothed = self._smoothed, []
        return taken

    def remaining(self) -> list[SmoothedPose]:
        """Poses within the smoother's lag as known now, and the newest belief's; none without a lag."""
        beliefs = [node.belief for node in self._nodes if node.belief]  # a failed filter leaves the newest node without
        newest = beliefs[-1]
        if newest.past is None:
            return []
        left = [pose for belief in beliefs if belief.past for pose in belief.past.final]
        return left + newest.past.poses(newest.stamp_ns, newest.x, newest.P)

    def extend(self, model: MotionModel, variance: Floats) -> None:
        """Append the further states of a model, with variances (k,)."""
        self.model = model
        for node in self._nodes:
            node.belief = node.belief and extended(node.belief, variance)

    def add(self, measurements: Sequence[Measurement]) -> list[Belief]:
        """Filter measurements of one stamp; returns the changed beliefs, oldest first."""
        stamp_ns = measurements[0].stamp_ns
        if self._is_too_late(stamp_ns):
            self.counters["too_late"] += len(measurements)
            return []
        index = self._place(stamp_ns)
        node = self._nodes[index]
        present = {m.sensor for m in node.measurements}
        fresh = {m.sensor: m for m in measurements if m.sensor not in present}
        self.counters["duplicate"] += len(measurements) - len(fresh)
        if not fresh:
            return []
        node.measurements += fresh.values()
        if index == len(self._nodes) - 1 and node.belief is not None:  # same stamp as the newest: nothing to repeat
            node.belief = self._condition(_changed(node.belief, fresh.values()), node, fresh.values(), fresh.keys())
        else:
            self._filter_from(index, fresh.keys())
        changed = [n.belief for n in self._nodes[index:] if n.belief is not None]
        self._forget()
        return changed

    def _is_too_late(self, stamp_ns: int) -> bool:
        """Whether it precedes the window or would change the first node."""
        first, newest = self._nodes[0], self._nodes[-1]
        before = stamp_ns < max(first.stamp_ns, newest.stamp_ns - self._window_ns)
        return before or (stamp_ns == first.stamp_ns and first is not newest)

    def _place(self, stamp_ns: int) -> int:
        index = bisect_left(self._nodes, stamp_ns, key=_stamp)
        if index == len(self._nodes) or self._nodes[index].stamp_ns != stamp_ns:
            self._nodes.insert(index, _Node(stamp_ns))
        return index

    def _filter_from(self, index: int, fresh: Collection[str]) -> None:
        for i in range(index, len(self._nodes)):
            before, node = self._nodes[i - 1].belief, self._nodes[i]
            assert before is not None
            prior = _changed(self._moved(before, node.stamp_ns), node.measurements)
            node.belief = self._condition(prior, node, node.measurements, fresh if i == index else NO_SENSOR)

    def _moved(self, belief: Belief, stamp_ns: int) -> Belief:
        while belief.stamp_ns < stamp_ns:
            to_ns = min(stamp_ns, belief.stamp_ns + self.model.max_step_ns)
            dt_s = (to_ns - belief.stamp_ns) * 1e-9
            belief = self._engine.predict(belief, motion(self.model, belief, dt_s), to_ns)
        return belief

    def _condition(
        self, belief: Belief, node: _Node, measurements: Iterable[Measurement], fresh: Collection[str]
    ) -> Belief:
        """Condition in turn; only fresh measurements are counted."""
        for measurement in measurements:
            result = self._engine.condition(belief, measurement)
            if measurement.sensor in fresh:
                self._judge(node, measurement, result)
            if not result.accepted and measurement.sensor in node.reopened:
                for states in measurement.opens:
                    belief = _opened(belief, result.innovation, states)
                result = self._engine.condition(belief, replace(measurement, gate_sigma=0.0))
            belief = result.belief
        return belief

    def _judge(self, node: _Node, measurement: Measurement, result: Conditioned) -> None:
        sensor = measurement.sensor
        self.last[sensor] = result
        if result.accepted:
            self._refused[sensor] = 0
            self.counters[f"{sensor}_used"] += 1
            return
        if not math.isfinite(result.nis):
            self.counters[f"{sensor}_invalid"] += 1
            return
        self._refused[sensor] += 1
        self.counters[f"{sensor}_gated"] += 1
        if measurement.relocks and self._refused[sensor] >= self._relock:
            self._refused[sensor] = 0
            self.counters[f"{sensor}_relocked"] += 1
            node.reopened.add(sensor)

    def _forget(self) -> None:
        """Drop nodes before the window, except one to start from."""
        oldest_ns = self._nodes[-1].stamp_ns - self._window_ns
        recent = next((i for i, node in enumerate(self._nodes) if node.stamp_ns > oldest_ns), len(self._nodes))
        stands = max(recent - 1, 0)  # usually one or two, so no search
        for node in self._nodes[:stands]:
            if node.belief and node.belief.past:
                self._smoothed += node.belief.past.final
        del self._nodes[:stands]


def _changed(belief: Belief, measurements: Iterable[Measurement]) -> Belief:
    for measurement in measurements:
        if measurement.change:
            belief = measurement.change(belief)
    return belief


def _opened(belief: Belief, innovation: Floats, states: slice) -> Belief:
    return open_states(belief, states, np.outer(innovation, innovation) + np.eye(len(innovation)))
