"""Stamps that do not continue earlier ones: stray, or by a clock that was set. For files and streams.

If others continue a distant stamp, and few the earlier ones, the clock was set, and it counts.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from protocol.units import HOUR_NS

GAP_NS = 5_000_000_000  # a larger lead is a pause, a clock change, or stray
STEADY_NS = 1_000_000_000  # uninterrupted distant stamps for longer are no single error
LATE_LIMIT = 200  # surplus of late stamps that means a clock set back, not a late sensor
LONG_NS = 12 * HOUR_NS  # no recording pauses longer: one side of such a break is stray
MOST_RUNS = 8  # weighed at a time; a file without order has endless runs

Item = TypeVar("Item")


@dataclass(eq=False)
class _Run(Generic[Item]):
    """Stamps that continue only each other. steady_ns: since the last earlier one. excess: over those."""

    is_ahead: bool
    newest_ns: int
    steady_ns: int = 0
    excess: int = 0
    items: list[Item] = field(default_factory=list)


class ClockWatch(Generic[Item]):
    """Separates valid from stray stamps.

    late_ns: allowed lateness. newest_ns, counted: of valid ones, since the clock was set.
    """

    def __init__(self, late_ns: int = 0) -> None:
        self.newest_ns = 0
        self.counted = 0
        self._late_ns = late_ns
        self._runs: list[_Run[Item]] = []

    def goes_on(self, stamp_ns: int) -> bool:
        """Whether a stamp continues the valid ones."""
        return not self.newest_ns or self.newest_ns - self._late_ns <= stamp_ns <= self.newest_ns + GAP_NS

    def count(self, stamp_ns: int) -> Sequence[Item]:
        """Note a continuing stamp; returns items now known as stray."""
        self.newest_ns = max(self.newest_ns, stamp_ns)
        self.counted += 1
        return self._weigh() if self._runs else ()

    def doubt(self, stamp_ns: int, item: Item) -> tuple[Sequence[Item], Sequence[Item]]:
        """Note another stamp; returns items that count if the clock was set, and those then stray."""
        is_ahead = stamp_ns > self.newest_ns
        fitting = [r for r in self._runs if r.is_ahead == is_ahead and r.newest_ns - self._late_ns <= stamp_ns]
        run = max(fitting, key=lambda r: r.newest_ns, default=None)
        if run is None:
            run = _Run(is_ahead, stamp_ns)
            self._runs.append(run)
        run.newest_ns, run.steady_ns = max(run.newest_ns, stamp_ns), run.steady_ns or stamp_ns
        run.excess += 1
        run.items.append(item)
        if not self._is_set(run):
            return (), self._give_up(self._runs[:-MOST_RUNS])
        self._runs.remove(run)
        self.newest_ns, self.counted = run.newest_ns, len(run.items)
        return run.items, self._give_up(self._runs)

    def end(self) -> tuple[Sequence[Item], Sequence[Item]]:
        """The same at the end; items after a pause count."""
        paused = [r for r in self._runs if r.is_ahead and r.newest_ns < self.newest_ns + LONG_NS][:1]
        counting = [item for run in paused for item in run.items]
        return counting, self._give_up([r for r in self._runs if r not in paused])

    def _is_set(self, run: _Run[Item]) -> bool:
        """Whether the clock was set to a run's time. As many distant stamps outvote few earlier ones."""
        if run.is_ahead and run.newest_ns - run.steady_ns > STEADY_NS:
            return True
        return run.excess > (LATE_LIMIT if self._is_near(run) else min(LATE_LIMIT, self.counted))

    def _is_near(self, run: _Run[Item]) -> bool:
        return abs(run.newest_ns - self.newest_ns) <= GAP_NS + self._late_ns

    def _weigh(self) -> Sequence[Item]:
        """Weigh a valid stamp against runs; it clears nearby ones, of a late sensor."""
        for run in self._runs:
            run.steady_ns = 0
            run.excess = 0 if self._is_near(run) else run.excess - 1
        return self._give_up([run for run in self._runs if run.excess <= 0])

    def _give_up(self, runs: Sequence[_Run[Item]]) -> Sequence[Item]:
        self._runs = [run for run in self._runs if run not in runs]
        return [item for run in runs for item in run.items]
