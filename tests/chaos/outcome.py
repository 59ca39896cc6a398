"""Outcome of a fault: counts, longest pause, verdict."""

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
    """The suite must end now."""


@dataclass
class FaultOutcome:
    """Result of one fault.

    count: strikes. recorded: samples in audit files. declared: not journalled, but declared lost. lost: neither; named:
    lost ones that the server reports missing, by machine and number; silent: the other lost ones. ack_ms_max: longest
    time to acknowledgement, from agents that ended in order; longest_pause_s: between commits of one machine, without
    fault times; both None without agents. memory_ratio: server's peak over that with one reader; answer_s_max: this
    reader's longest wait; both for reader faults only. skipped: why it did not run.
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
        """Nothing lost or double, and no other problem."""
        return self.lost == self.double == self.silent == 0 and not self.problems


@dataclass(frozen=True)
class Console:
    """Output of scenarios, and their stop signal."""

    line: Any = print
    stop: threading.Event = field(default_factory=threading.Event)

    def say(self, text: str) -> None:
        self.line(text, flush=True)

    def wait(self, seconds: float) -> None:
        """Sleep; InterruptError if the suite must end."""
        if self.stop.wait(max(0.0, seconds)):
            raise InterruptError

    def stop_on_signals(self) -> None:
        """Ctrl-C and SIGTERM end the suite with cleanup."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: self.stop.set())


def longest_pause(commits: Sequence[float], faults: Iterable[TimeSpan], end_s: float) -> float:
    """Longest time without a commit, from the first to end_s, fault times excluded."""
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
