"""Replay of a log folder: real time, faster, or as fast as the agent."""

from collections.abc import Callable, Mapping, Sequence

from protocol.machine.log_folder import LogFolder
from protocol.machine.readings import Reading

SPAN_NS = 50_000_000  # readings of 50 ms together, like a live bundle


class Replay:
    """Reads a log folder. speed: times real time; 0 for unlimited. clock, wait: time [s] and pause."""

    def __init__(
        self, log: LogFolder, speed: float, clock: Callable[[], float], wait: Callable[[float], object]
    ) -> None:
        self._log = log
        self._readings = log.timed()
        self._speed = speed
        self._clock = clock
        self._wait = wait
        self._next = next(self._readings, None)
        self._first_ns = self._next[0] if self._next else 0
        self._began_s = clock()

    def read(self, timeout_s: float) -> Sequence[Reading] | None:
        """The next 50 ms of the log, once due."""
        if self._next is None:
            return None
        if self._speed > 0:
            due_s = self._began_s + (self._next[0] - self._first_ns) * 1e-9 / self._speed
            if (early_s := due_s - self._clock()) > 0:
                self._wait(min(early_s, timeout_s))
                if early_s > timeout_s:
                    return ()
        return self._next_span(self._next[0] + SPAN_NS)

    def counters(self) -> Mapping[str, int]:
        """Refused rows of the log, by reason."""
        return {f"log_{reason}": n for reason, n in self._log.refused.items()}

    def problems(self) -> Sequence[str]:
        """None."""
        return ()

    def close(self) -> None:
        """Do nothing: nothing stays open between reads."""

    def _next_span(self, end_ns: int) -> list[Reading]:
        span: list[Reading] = []
        while self._next is not None and self._next[0] < end_ns:
            span.append(self._next[1])
            self._next = next(self._readings, None)
        return span
