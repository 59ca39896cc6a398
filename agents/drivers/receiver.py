"""A receiver on a port: opens and reopens it, finds its baud, and states its problem in a sentence."""

import errno
import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from agents.drivers import Observed
from agents.drivers.formats import Message
from agents.drivers.formats.framing import GPSD
from agents.drivers.formats.gpsd import GREETING
from agents.drivers.line import Line
from agents.drivers.transports import Transport, open_transport, why_closed

log = logging.getLogger("agents.drivers")

BAUDS = (115_200, 9600, 38_400, 57_600, 230_400, 460_800, 921_600, 4800)  # most usual first
RETRY_S = 1.0  # between attempts to open: a returning one is read within 2 s
TRY_S = 2.5  # of bytes without frames before another baud; receivers send each second
SILENT_S = 5.0
NO_FIX_S = 30.0  # of messages without a fix; a warm start takes less
FOREIGN_FRAMES = 10  # of another format, none of its own


class ReceiverSource:
    """Source of one port. baud: 0 to find it. clock_ns, wait: monotonic clock and pause of the host."""

    def __init__(
        self,
        address: str,
        baud: int,
        format_: str,
        line: Line,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        wait: Callable[[float], object] = time.sleep,
    ) -> None:
        self._address, self._stated_baud, self._format, self._line = address, baud, format_, line
        self._clock_ns, self._wait = clock_ns, wait
        self._counters: Counter[str] = Counter()
        self._transport: Transport | None = None
        self._problem = ""
        self._bauds = list(dict.fromkeys((baud or BAUDS[0], *BAUDS)))  # the current one first
        self._retry_s, self._was_fixed = 0.0, False
        self._heard_s = self._framed_s = self._fixed_s = self._now_s()

    def read(self, timeout_s: float) -> Sequence[Observed] | None:
        """New values; a broken link is reopened."""
        try:
            transport = self._transport or self._open(timeout_s)
            data = transport.read(timeout_s) if transport else b""
        except OSError as error:
            self._break(f"the link broke ({error.strerror or error}): plug it in again")
            return ()
        if data is None:
            self._tell("" if self._line.frames[self._format] else f"no frame of {self._format.upper()} is in this file")
            return None
        if not data or not transport:
            self._watch_silence()
            return ()
        before = self._line.frames.total()
        observed = self._line.feed(data, self._clock_ns() if transport.is_live else None, transport.byte_ns)
        self._judge(has_frames=self._line.frames.total() > before, is_live=transport.is_live)
        return observed

    def write(self, data: bytes) -> None:
        """Send bytes, such as corrections, from any thread; OSError without a link."""
        if not (transport := self._transport):
            raise OSError(errno.ENOTCONN, "its driver has no link")
        transport.write(data)

    def counters(self) -> Mapping[str, int]:
        """Frames, broken bytes, link failures."""
        return {**self._line.counters, **dict(self._counters)}

    def problems(self) -> Sequence[str]:
        """Its problem: of the link, else of its messages."""
        problem = self._problem or self._why_unfixed()
        return [f"{self._address}: {problem}"] if problem else []

    def close(self) -> None:
        """Release the port."""
        if self._transport:
            self._transport.close()
        self._transport = None

    def _open(self, timeout_s: float) -> Transport | None:
        if (early_s := self._retry_s - self._now_s()) > 0:
            self._wait(min(early_s, timeout_s))
            return None
        self._retry_s = self._now_s() + RETRY_S
        try:
            self._transport = open_transport(self._address, self._bauds[0])
            if self._format == GPSD:
                self._transport.write(GREETING)
        except OSError as error:
            self._break(why_closed(error))
        self._heard_s = self._framed_s = self._now_s()
        return self._transport

    def _break(self, why: str) -> None:
        self._counters["link_broke"] += self._transport is not None
        self.close()
        self._tell(why)

    def _judge(self, *, has_frames: bool, is_live: bool) -> None:
        self._heard_s = now_s = self._now_s()
        if has_frames:
            self._framed_s = now_s
            self._tell(self._why_foreign() or self._why_baud())
        elif is_live and now_s - self._framed_s > TRY_S:
            self._try_another()
        if not self._line.has_fixes or (self._line.seen and self._line.seen.utc_ns):
            self._fixed_s, self._was_fixed = now_s, True

    def _watch_silence(self) -> None:
        if not self._transport or self._now_s() - self._heard_s <= SILENT_S:
            return
        silent = "nothing comes: is it powered, wired, and set to send here?"
        if self._address.startswith("tcp:"):  # a peer without power never hangs up
            self._break(silent)
        self._tell(silent)

    def _try_another(self) -> None:
        """Bytes without frames: switch to the next baud, if any."""
        self._framed_s = self._now_s()
        if "://" in self._address:
            self._tell("bytes come, but neither NMEA, UBX nor gpsd's: is it the right port?")
            return
        self._bauds.append(self._bauds.pop(0))
        self._counters["bauds_tried"] += 1
        self._tell(f"no frame of NMEA or UBX at {self._bauds[-1]} baud: trying {self._bauds[0]}")
        self.close()
        self._retry_s = 0.0

    def _why_baud(self) -> str:
        baud = self._bauds[0]
        return f"it sends at {baud} baud: say `baud = {baud}`" if self._stated_baud not in (0, baud) else ""

    def _why_foreign(self) -> str:
        frames = self._line.frames
        foreign, n = max(frames.items(), key=lambda item: item[1])
        if frames[self._format] or n < FOREIGN_FRAMES:
            return ""
        own = self._format.upper()
        return f'it sends {foreign.upper()}, and nothing of {own}: say `kind = "{foreign}"`, or set it to send {own}'

    def _why_unfixed(self) -> str:
        seen = self._line.seen
        if self._now_s() - self._fixed_s > NO_FIX_S:
            return why_unplaced(seen)
        if not seen or self._was_fixed:
            return ""
        return "waiting for its date" if seen.values else f"no fix yet: {seen.satellites} satellites"

    def _tell(self, problem: str) -> None:
        if problem != self._problem:
            log.warning("receiver port=%s problem=%r", self._address, problem or "none: it is read")
        self._problem = problem

    def _now_s(self) -> float:
        return self._clock_ns() * 1e-9


def why_unplaced(seen: Message | None) -> str:
    """Why a receiver's newest fix is no position, or ""."""
    if not seen:
        return "it sends no positions: switch on GGA and RMC, or NAV-PVT"
    if not seen.values:
        return f"no fix, {seen.satellites} satellites: its antenna needs open sky"
    return "" if seen.utc_ns else "it sends positions without a date: switch on RMC, or ZDA"
