"""Faults of readers: what one of them does must not reach machines, nor fill the server's memory."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, closing, suppress
from itertools import cycle

from protocol.errors import SitegridError
from sitegrid.client import connect
from tests.chaos.chaos_site import ROUTER, SERVER, ChaosSite
from tests.chaos.leashed import Process
from tests.chaos.outcome import FaultOutcome
from tests.chaos.scenario import FaultRun

LONGEST_ACK_MS = 1000
MOST_MEMORY = 1.5  # of the server: its peak, as a multiple of what it has with one reader that behaves
LONGEST_ANSWER_S = 5.0  # of a reader that behaves, while others wait
SETTLE_S, LASTS_S, PAUSE_S = 4.0, 6.0, 1.0
EVERY_S = 0.2
SLEEPING = (("sleeping", 10), ("looping", 2), ("leaving", 10))
WAITING = (("waiting", 3),)


def sleeping_reader(scenario: FaultRun) -> FaultOutcome:
    """Readers that ask for much and are stopped, are gone in mid-answer, or ask without end."""
    return _strike(scenario, SLEEPING)


def waiting_reader(scenario: FaultRun) -> FaultOutcome:
    """Readers that wait for a journal row that never comes, hundreds of times, and ask for the past meanwhile."""
    outcome = _strike(scenario, WAITING)
    if (outcome.answer_s_max or 0.0) > LONGEST_ANSWER_S:
        outcome.problems.append(f"a reader that behaves waited {outcome.answer_s_max} s for an answer")
    return outcome


def _strike(scenario: FaultRun, kinds: Sequence[tuple[str, int]]) -> FaultOutcome:
    """Let each kind of reader come once, and again while there is time; beside them one that behaves."""
    with scenario.site() as site:
        site.start_all()
        with closing(_Reader(site)) as reader:
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
    if (outcome.ack_ms_max or 0) > LONGEST_ACK_MS:
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


class _Reader:
    """A reader that behaves, on a thread of its own: asks for a point now and then, and notes how long that takes."""

    def __init__(self, site: ChaosSite) -> None:
        self._longest_s = 0.0
        self._asked_s: float | None = None  # since when it waits
        self._client = connect(site.endpoints[ROUTER], site.name, timeout_s=60.0)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def longest_s(self) -> float:
        """How long it waited at most, for an answer that has not come yet too."""
        asked_s = self._asked_s
        return max(self._longest_s, time.monotonic() - asked_s if asked_s else 0.0)

    def forget(self) -> None:
        self._longest_s = 0.0

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._client.close()

    def _run(self) -> None:
        while not self._stop.wait(EVERY_S):
            self._asked_s = time.monotonic()
            with suppress(SitegridError):  # refused, or not answered: as long as that took
                self._client.point(0.0, 0.0)
            self._longest_s, self._asked_s = self.longest_s(), None
