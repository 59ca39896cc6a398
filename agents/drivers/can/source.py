"""A bus, or a recording of one, as a source: opened again where it breaks; what hinders it stands in a sentence."""

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import islice

from agents.drivers import Observed
from agents.drivers.can.buses import Bus, CanFrame, read_recording, why_shut
from agents.drivers.can.line import SILENT_NS, CanLine

log = logging.getLogger("agents.drivers")

RETRY_NS = 10**9  # between two tries to open
SILENT = "the bus is silent: is the ignition on, the cable in, the bit rate right?"
OFF = "bus off, the adapter left it after errors: check bit rate and wiring, and set `restart-ms 100`"
TOGETHER = 500  # frames of a recording that are handed on at once


class CanSource:
    """Source of one bus. open_bus: opens an address. clock_ns, wait: the host's monotonic clock, and how to wait."""

    def __init__(
        self,
        address: str,
        line: CanLine,
        open_bus: Callable[[str], Bus] = Bus,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        wait: Callable[[float], object] = time.sleep,
    ) -> None:
        self._address, self._line, self._open_bus = address, line, open_bus
        self._clock_ns, self._wait = clock_ns, wait
        self._counters: Counter[str] = Counter()
        self._bus: Bus | None = None
        self._problem = ""  # of the link
        self._retry_ns, self._heard_ns = 0, clock_ns()

    def read(self, timeout_s: float) -> Sequence[Observed] | None:
        """Values that have come in; a bus that breaks is opened again."""
        try:
            bus = self._bus or self._open(timeout_s)
            frames = bus.read(timeout_s) if bus else []
        except OSError as error:
            self._break(f"the link broke ({error.strerror}): plug it in again")
            return ()
        if bus:
            self._watch(bus, has_frames=bool(frames))
        now_ns = self._clock_ns()
        return [value for frame in frames for value in take(self._line, frame, now_ns - frame.late_ns)]

    def counters(self) -> Mapping[str, int]:
        """Frames, those without a value, error frames, and how often the link broke."""
        return {**self._line.counters, **self._counters}

    def problems(self) -> Sequence[str]:
        """What hinders it: the link first, then what comes over it."""
        sentences = [self._problem] if self._problem else self._line.problems(self._clock_ns())
        return [f"{self._address}: {problem}" for problem in sentences]

    def close(self) -> None:
        """Let go of the bus."""
        bus, self._bus = self._bus, None
        if bus:
            with suppress(OSError):
                bus.close()

    def _open(self, timeout_s: float) -> Bus | None:
        """Open the bus if it is time to."""
        if (early_ns := self._retry_ns - self._clock_ns()) > 0:
            self._wait(min(early_ns * 1e-9, timeout_s))
            return None
        self._retry_ns = self._clock_ns() + RETRY_NS
        try:
            self._bus = self._open_bus(self._address)
        except OSError as error:
            self._break(why_shut(self._address, error))
        self._heard_ns = self._clock_ns()
        return self._bus

    def _watch(self, bus: Bus, *, has_frames: bool) -> None:
        self._counters["error_frames"] = bus.errors
        if has_frames:
            self._heard_ns = self._clock_ns()
        if bus.is_off:
            self._tell(OFF)
        elif has_frames:
            self._tell("")
        elif self._clock_ns() - self._heard_ns > SILENT_NS:
            self._tell(SILENT)

    def _break(self, why: str) -> None:
        self._counters["link_broke"] += self._bus is not None
        self.close()
        self._tell(why)

    def _tell(self, problem: str) -> None:
        """Log what is wrong, as it begins and as it ends."""
        if problem != self._problem:
            log.warning("bus address=%s problem=%r", self._address, problem or "none: it is read")
        self._problem = problem


class RecordingSource:
    """Source of a recording of a bus, whose stamps are UTC."""

    def __init__(self, address: str, line: CanLine) -> None:
        self._address, self._line = address, line
        self._frames: Iterator[CanFrame] = read_recording(address)
        self._newest_ns, self._problem = 0, ""

    def read(self, _: float) -> Sequence[Observed] | None:
        """Values of the next frames, after the time of the last one."""
        observed: list[Observed] = []
        n_frames = 0
        try:
            for frame in islice(self._frames, TOGETHER):
                self._newest_ns, n_frames = round(frame.utc_s * 1e9), n_frames + 1
                observed += take(self._line, frame, self._newest_ns)
        except OSError as error:
            self._problem = f"it cannot be read further ({error.strerror})"
        return [Observed("", "", (), self._newest_ns, self._newest_ns), *observed] if n_frames else None

    def counters(self) -> Mapping[str, int]:
        """Frames, and those without a value."""
        return self._line.counters

    def problems(self) -> Sequence[str]:
        """What hinders it: the file first, then what is in it."""
        sentences = [self._problem] if self._problem else self._line.problems(self._newest_ns)
        return [f"{self._address}: {problem}" for problem in sentences]

    def close(self) -> None:
        """Nothing is held open once it was read."""


def take(line: CanLine, frame: CanFrame, host_ns: int) -> list[Observed]:
    """Values of a frame."""
    return line.take(frame.identifier, frame.data, host_ns, is_extended=frame.is_extended)
