"""What a fault did: counts, the longest pause, and whether that is what was promised."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

TimeSpan = tuple[float, float]  # [s] of one clock

COLUMNS = (
    *("fault", "count", "recorded", "merged", "declared", "lost", "named", "double", "silent"),
    *("longest ack", "longest pause", "memory", "answer", ""),
)
LINE = "{:<17}{:>6}{:>10}{:>9}{:>10}{:>6}{:>7}{:>8}{:>8}{:>13}{:>15}{:>8}{:>8}  {}"


class InterruptError(Exception):
    """The suite is to end now."""


@dataclass
class FaultOutcome:
    """Result of one fault.

    count: how often it struck; recorded: samples in the audit files; declared: those that are in no journal and were
    declared lost to the server; lost: those that are in no journal and were not; named: those of the lost that the
    server names as missing, by machine and number; silent: the others. ack_ms_max: the longest time from the first
    sending of a batch until it was acknowledged, as agents that ended in order report it; longest_pause_s: between two
    commits of one machine, without the time that faults lasted; both None where no agents run. memory_ratio: the
    server's peak, as a multiple of what it has with one reader; answer_s_max: the longest time that this reader waited;
    both None but for faults of readers. skipped: why it did not run.
    """

    fault: str
    count: int = 0
    recorded: int = 0
    merged: int = 0
    declared: int = 0
    lost: int = 0
    named: int = 0
    double: int = 0
    silent: int = 0
    ack_ms_max: int | None = None
    longest_pause_s: float | None = None
    memory_ratio: float | None = None
    answer_s_max: float | None = None
    skipped: str = ""
    problems: list[str] = field(default_factory=list)
    pids: list[int] = field(default_factory=list)
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def is_good(self) -> bool:
        """Nothing lost, nothing double, and nothing else that should not be."""
        return self.lost == self.double == self.silent == 0 and not self.problems


@dataclass(frozen=True)
class Console:
    """Where scenarios print, and the signal that ends them."""

    line: Any = print
    stop: threading.Event = field(default_factory=threading.Event)

    def say(self, text: str) -> None:
        self.line(text, flush=True)

    def wait(self, seconds: float) -> None:
        """Let time pass; InterruptError if the suite is to end."""
        if self.stop.wait(max(0.0, seconds)):
            raise InterruptError

    def stop_on_signals(self) -> None:
        """Ctrl-C and SIGTERM end the suite in order: what it started is ended, what it made is removed."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: self.stop.set())


def longest_pause(commits: Sequence[float], faults: Iterable[TimeSpan], end_s: float) -> float:
    """The longest time without a commit, from the first one to end_s, without what faults lasted meanwhile."""
    times = [*sorted(commits), end_s]
    spans = _united(faults)
    return max((b - a - _covered((a, b), spans) for a, b in pairwise(times)), default=0.0)


def _united(spans: Iterable[TimeSpan]) -> list[TimeSpan]:
    united: list[TimeSpan] = []
    for begin, end in sorted(spans):
        if united and begin <= united[-1][1]:
            united[-1] = (united[-1][0], max(end, united[-1][1]))
        else:
            united.append((begin, end))
    return united


def _covered(gap: TimeSpan, spans: Iterable[TimeSpan]) -> float:
    return sum(max(0.0, min(gap[1], end) - max(gap[0], begin)) for begin, end in spans)


def table(outcomes: Iterable[FaultOutcome]) -> str:
    return "\n".join(LINE.format(*row).rstrip() for row in (COLUMNS, *map(_row, outcomes)))


def _row(outcome: FaultOutcome) -> tuple[str, ...]:
    if outcome.skipped:
        return (outcome.fault, *("-",) * (len(COLUMNS) - 2), f"skipped: {outcome.skipped}")
    pause = "-" if outcome.longest_pause_s is None else f"{outcome.longest_pause_s:.1f} s"
    ack = "-" if outcome.ack_ms_max is None else f"{outcome.ack_ms_max} ms"
    names = ("count", "recorded", "merged", "declared", "lost", "named", "double", "silent")
    counts = (getattr(outcome, name) for name in names)
    verdict = "ok" if outcome.is_good else "FAILED: " + "; ".join(outcome.problems or ["lost or double"])
    ratio = "-" if outcome.memory_ratio is None else f"{outcome.memory_ratio} x"
    answer = "-" if outcome.answer_s_max is None else f"{outcome.answer_s_max:.1f} s"
    return (outcome.fault, *map(str, counts), ack, pause, ratio, answer, verdict)
