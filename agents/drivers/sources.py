"""All [[driver]] tables as one driver: a thread each, and one time base that turns values into readings.

Values wait until a receiver states UTC; before that there is no position either.
"""

import logging
import queue
import threading
import time
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from contextlib import suppress

from agents.drivers import Observed, Source
from agents.drivers.receiver import ReceiverSource
from agents.drivers.time_base import TimeBase
from protocol.errors import MessageError
from protocol.machine.readings import Reading, parse_reading

log = logging.getLogger("agents.drivers")

QUEUE = 2000  # capacity in pieces: 10 s or more
UNTIED = 60_000  # capacity of values waiting for UTC: ten minutes at 100 Hz; older ones are dropped and counted
POLL_S = 0.2
GATHER_S = 0.05  # values of this time travel together: each piece costs a thread switch


class Sources:
    """Driver of several named sources."""

    def __init__(self, sources: Mapping[str, Source], time_base: TimeBase) -> None:
        self._sources, self._time_base = dict(sources), time_base
        self._queue: queue.Queue[tuple[str, Sequence[Observed] | None]] = queue.Queue(QUEUE)
        self._counters: Counter[str] = Counter()
        self._untied: deque[Observed] = deque()
        self._failed: list[str] = []
        self._stop = threading.Event()
        self._threads = [threading.Thread(target=self._run, args=item, daemon=True) for item in self._sources.items()]
        self._running = len(self._threads)
        for thread in self._threads:
            thread.start()

    def receivers(self) -> dict[str, ReceiverSource]:
        """Receiver ports, by address."""
        return {name: source for name, source in self._sources.items() if isinstance(source, ReceiverSource)}

    def read(self, timeout_s: float) -> Sequence[Reading] | None:
        """Readings of the next piece, and of earlier values that waited for UTC."""
        try:
            name, observed = self._queue.get(timeout=timeout_s if self._running else 0.0)
        except queue.Empty:
            return () if self._running else None
        if observed is None:
            self._running -= 1
            return ()
        return [reading for value in observed for reading in self._readings(name, value)]

    def counters(self) -> Mapping[str, int]:
        """Counters of each source by its name, and refusals here."""
        of_sources = {f"{name} {n}": v for name, source in self._sources.items() for n, v in source.counters().items()}
        return {**of_sources, **self._time_base.counters, **self._counters}

    def problems(self) -> Sequence[str]:
        """Problems of the sources, and readings waiting for UTC."""
        problems = [*self._failed, *(problem for source in self._sources.values() for problem in source.problems())]
        for name, ahead_s in self._time_base.apart_s.items():
            where = "ahead of" if ahead_s > 0 else "behind"
            problems.append(f"{name}: its time is {abs(ahead_s):.0f} s {where} the others', so it is left out")
        if self._untied and not problems:
            problems.append("readings wait for UTC: no receiver has stated date and time (a fix; NMEA: RMC or ZDA)")
        return problems

    def close(self) -> None:
        """End the threads and sources."""
        self._stop.set()
        for thread in self._threads:
            thread.join()

    def _run(self, name: str, source: Source) -> None:
        try:
            self._gather(name, source)
        except Exception as error:  # of a plug-in
            log.exception("a driver ended")
            self._failed.append(f"{name}: its driver ended ({error!r}): mend it, and start the agent again")
        source.close()
        self._put(name, None)

    def _gather(self, name: str, source: Source) -> None:
        gathered: list[Observed] = []
        due_s = 0.0
        while not self._stop.is_set() and (observed := source.read(GATHER_S if gathered else POLL_S)) is not None:
            now_s = time.monotonic()
            due_s = due_s if gathered else now_s + GATHER_S
            gathered += observed
            if gathered and now_s >= due_s:
                self._put(name, gathered)
                gathered = []
        self._put(name, gathered)

    def _put(self, name: str, observed: Sequence[Observed] | None) -> None:
        """Queue; while the agent is busy, bytes wait in port or file."""
        while not self._stop.is_set():
            with suppress(queue.Full):
                self._queue.put((name, observed), timeout=POLL_S)
                return

    def _readings(self, clock: str, value: Observed) -> list[Reading]:
        if not value.sensor:
            self._time_base.take(clock, value.utc_ns, value.host_ns)
        if self._time_base.utc_ns(value.host_ns) is None:
            self._untied.append(value)
            if len(self._untied) > UNTIED:
                self._untied.popleft()
                self._counters["untied_dropped"] += 1
            return []
        values = [*self._untied, value]
        self._untied.clear()
        return [reading for v in values if v.sensor and (reading := self._reading(v))]

    def _reading(self, value: Observed) -> Reading | None:
        if value.utc_ns and not self._time_base.believes(value.utc_ns, value.host_ns):
            return None
        stamp_ns = value.utc_ns or self._time_base.utc_ns(value.host_ns) or 0
        try:
            return parse_reading(value.kind, value.sensor, stamp_ns, value.values)
        except MessageError as error:
            self._counters[f"refused_reading_{error.reason}"] += 1
            return None
