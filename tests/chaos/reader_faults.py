"""Reader faults must neither reach machines nor fill the server's memory."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, suppress
from http.client import HTTPException
from itertools import cycle

import numpy as np

from protocol.errors import SitegridError
from sitegrid.client import connect
from tests.chaos.chaos_site import ROUTER, SERVER, ChaosSite
from tests.chaos.guests import Guest, made_up
from tests.chaos.leashed import Process
from tests.chaos.outcome import FaultOutcome
from tests.chaos.scenario import FaultRun

LONGEST_ACK_MS = 1000
MOST_MEMORY = 1.5  # server's peak over that with one normal reader
LONGEST_ANSWER_S = 5.0  # of a normal reader beside others
SETTLE_S, LASTS_S, PAUSE_S = 4.0, 6.0, 1.0
EVERY_S = 0.2
KNOWN_M, LANE_M, STEP_M, SURVEY_MPS = 1800.0, 14.0, 2.5, 25.0  # 3.2 km2 of known ground, below a query's limit
SLEEPING = (("sleeping", 10), ("looping", 2), ("leaving", 10))
WAITING = (("waiting", 3),)


def sleeping_reader(scenario: FaultRun) -> FaultOutcome:
    """Readers that stop reading, leave in mid-answer, or query endlessly."""
    return _strike(scenario, SLEEPING)


def waiting_reader(scenario: FaultRun) -> FaultOutcome:
    """Hundreds of waits for an impossible row, and queries of the past."""
    outcome = _strike(scenario, WAITING)
    if (outcome.answer_s_max or 0.0) > LONGEST_ANSWER_S:
        outcome.problems.append(f"a reader that behaves waited {outcome.answer_s_max} s for an answer")
    return outcome


def questions(scenario: FaultRun) -> FaultOutcome:
    """One reader sends the largest allowed queries over square kilometres."""
    return _strike(scenario, (("greedy", 1),), _know_much)


def _know_much(site: ChaosSite) -> None:
    """A fast machine drives all over KNOWN_M x KNOWN_M."""
    along_m = np.arange(0.0, KNOWN_M, STEP_M)
    with closing(Guest(site, "surveyor")) as surveyor:
        for number, x_m in enumerate(np.arange(0.0, KNOWN_M, LANE_M)):
            y_m, first_s = along_m if number % 2 else along_m[::-1], number * (KNOWN_M + LANE_M) / SURVEY_MPS
            lane = made_up(np.full(len(y_m), x_m), y_m, first_s, STEP_M / SURVEY_MPS, 1.0, STEP_M)
            if problem := surveyor.send(lane):
                site.problem(f"samples of an honest machine are refused: {problem}")
            site.tend()


def _strike(
    scenario: FaultRun, kinds: Sequence[tuple[str, int]], prepare: Callable[[ChaosSite], None] | None = None
) -> FaultOutcome:
    """Run each kind of reader once, then repeatedly, beside a normal one."""
    with scenario.site() as site:
        site.start_all()
        if prepare:
            prepare(site)
        client = connect(site.endpoints[ROUTER], site.name, timeout_s=60.0)
        with closing(client), closing(Asker(lambda: client.point(0.0, 0.0))) as reader:
            site.linger(SETTLE_S)
            idle_mb = site.forget_peak_mb(SERVER)
            reader.forget()
            count = _come_and_go(scenario, site, kinds)
            peak_mb, longest_s = site.peak_mb(SERVER), reader.longest_s()
        outcome = site.finish(scenario.fault, count)
    outcome.notes |= {"server idle [MB]": round(idle_mb), "server peak [MB]": round(peak_mb)}
    outcome.memory_ratio, outcome.answer_s_max = round(peak_mb / idle_mb, 2), round(longest_s, 2)
    if outcome.memory_ratio > MOST_MEMORY:
        outcome.problems.append(f"the server took {outcome.memory_ratio} times the memory that one reader needs")
    if not prepare and (outcome.ack_ms_max or 0) > LONGEST_ACK_MS:  # else prepared batches may wait
        outcome.problems.append(f"an acknowledgement took {outcome.ack_ms_max} ms")
    return outcome


def _come_and_go(scenario: FaultRun, site: ChaosSite, kinds: Sequence[tuple[str, int]]) -> int:
    end_s, count = time.monotonic() + scenario.seconds, 0
    for spell, (kind, readers) in enumerate(cycle(kinds)):
        if spell >= len(kinds) and time.monotonic() >= end_s:
            break
        scenario.say(f"{readers} x {kind} for {LASTS_S:g} s")
        with site.fault(), ExitStack() as ended:
            command = (sys.executable, "-m", "tests.chaos.reader", kind, site.endpoints[ROUTER], site.name)
            logs = [site.folder / "log" / f"reader-{count + n}" for n in range(readers)]
            running = [Process(log, command, {}) for log in logs]
            for reader in running:
                ended.callback(reader.end)
            site.linger(LASTS_S)
            for reader in running:
                if reader.code not in (None, -signal.SIGKILL):
                    site.problem(f"{kind} reader ended with {reader.code}: {reader.last_words()}")
        count += readers
        site.linger(PAUSE_S)
    return count


class Asker:
    """A normal reader on its own thread that measures its waiting times.

    ask: raises if refused or unanswered. answers: count.
    """

    def __init__(self, ask: Callable[[], object]) -> None:
        self.answers, self._longest_s = 0, 0.0
        self._asked_s: float | None = None  # waiting since
        self._ask, self._stop = ask, threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def longest_s(self) -> float:
        """Longest wait, including a pending one."""
        asked_s = self._asked_s
        return max(self._longest_s, time.monotonic() - asked_s if asked_s else 0.0)

    def forget(self) -> None:
        self._longest_s = 0.0

    def close(self) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(EVERY_S):
            self._asked_s = time.monotonic()
            with suppress(SitegridError, OSError, HTTPException):  # refused or unanswered: counted by duration
                self._ask()
                self.answers += 1
            self._longest_s, self._asked_s = self.longest_s(), None
