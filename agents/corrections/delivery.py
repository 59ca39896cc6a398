"""Corrections to a machine's receivers: messages on its base's key are checked and written to the ports."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import zenoh

from agents.corrections.rtcm import whole_frames
from agents.drivers.transports import Transport, open_transport, why_closed
from protocol.errors import MessageError
from protocol.site.site_config import NAME
from protocol.wire import keys
from protocol.wire.codec import decode_corrections
from protocol.wire.messages import Corrections

WAITING = 50  # capacity in messages while a port blocks: some seconds; the oldest is dropped
STALE_NS = 60 * 10**9  # receivers lose their fixed solution after 30 to 60 s
FOLLOWS = 100  # inverse of the clock drift that makes no correction old
DRAINED = 64  # pieces read at a time from a port that nobody reads


@dataclass(frozen=True)
class CorrectionsConfig:
    """Corrections for a machine's receivers.

    base: its name; empty for none. ports: addresses of [[driver]] tables, other serial ports, or `tcp://HOST:PORT`.
    baud: of serial ports.
    """

    base: str = ""
    ports: tuple[str, ...] = ()
    baud: int = 115_200

    def __post_init__(self) -> None:
        if self.base and not NAME.fullmatch(self.base):
            raise ValueError(f"base: {self.base!r} is not a name (lower-case letters, digits, - and _)")
        if bool(self.base) != bool(self.ports):
            raise ValueError("base, ports: one is of no use without the other")


class CorrectionPort(Protocol):
    """Where a receiver takes corrections."""

    def write(self, data: bytes) -> object:
        """Send bytes; OSError."""

    def close(self) -> None:
        """Release it."""


class OwnPort:
    """A port for corrections alone, opened, or reopened, when some arrive."""

    def __init__(self, address: str, baud: int) -> None:
        self._address, self._baud = address, baud
        self._transport: Transport | None = None

    def write(self, data: bytes) -> None:
        """Send bytes; the receiver's output is discarded."""
        try:
            self._transport = self._transport or open_transport(self._address, self._baud)
            for _ in range(DRAINED):
                if not self._transport.read(0.0):
                    break
            self._transport.write(data)
        except OSError:
            self.close()
            raise

    def close(self) -> None:
        """Release the port."""
        if self._transport:
            self._transport.close()
        self._transport = None


@dataclass(frozen=True)
class CorrectionsState:
    """State of a base, pure; times but stamps by the machine's monotonic clock.

    heard_ns: last message. true_ns: when the newest frame reached the relay, or None. fastest_ns: least lag of arrivals
    behind stamps, with the clock offset; so late messages show, and wrong clocks do not.
    """

    base: str
    since_ns: int
    heard_ns: int | None = None
    true_ns: int | None = None
    fastest_ns: int = 0
    said: str = ""

    def after(self, message: Corrections, came_ns: int) -> "CorrectionsState":
        """The state after a message."""
        behind_ns = fastest_ns = came_ns - message.stamp_ns
        if self.heard_ns is not None:
            followed_ns = self.fastest_ns + (came_ns - self.heard_ns) // FOLLOWS
            if behind_ns <= followed_ns + STALE_NS:  # else a clock was set
                fastest_ns = min(behind_ns, followed_ns)
        true_ns = message.stamp_ns + fastest_ns if message.frames else self.true_ns
        return replace(self, heard_ns=came_ns, true_ns=true_ns, fastest_ns=fastest_ns, said=message.problem)

    def problem(self, now_ns: int) -> str:
        """Why receivers lack corrections, or ""."""
        age_ns = now_ns - (self.since_ns if self.true_ns is None else self.true_ns)
        if self.said:
            return f"{self.base}: {self.said}"
        if age_ns <= STALE_NS:
            return ""
        if self.heard_ns is None or now_ns - self.heard_ns > STALE_NS:
            return f"{self.base}: silent for {age_ns / 1e9:.0f} s: start `sitegrid corrections`, or mend its link"
        return f"{self.base}: the last correction is {age_ns / 1e9:.0f} s old: is the base on?"


class CorrectionsDelivery:
    """Writes one base's corrections to all ports, on a thread that a port may block."""

    def __init__(
        self,
        session: zenoh.Session,
        site: str,
        base: str,
        ports: Mapping[str, CorrectionPort],
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._ports, self._clock_ns = dict(ports), clock_ns
        self._counters: Counter[str] = Counter()
        self._state = CorrectionsState(base, clock_ns())
        self._failed: dict[str, str] = {}
        self._subscriber = session.declare_subscriber(keys.corrections(site, base), zenoh.handlers.RingChannel(WAITING))
        self._thread = threading.Thread(target=self._run, name="corrections", daemon=True)
        self._thread.start()

    def report(self) -> dict[str, Any]:
        """Age of the newest frame, refusals and problems, in plain values."""
        now_ns, state = self._clock_ns(), self._state
        problems = [why for why in (state.problem(now_ns), *dict(self._failed).values()) if why]
        age_s = None if state.true_ns is None else round((now_ns - state.true_ns) * 1e-9, 1)
        return {"base": state.base, "age_s": age_s, "problem": "; ".join(problems), "counters": dict(self._counters)}

    def close(self) -> None:
        """Stop listening, release the ports."""
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]
        self._thread.join()
        for port in self._ports.values():
            port.close()

    def _run(self) -> None:
        for sample in self._subscriber:
            try:
                message = decode_corrections(sample.payload.to_bytes(), self._state.base)
                self._counters["frames"] += len(whole_frames(message.frames))
            except MessageError as error:
                self._counters[f"refused_{error.reason}"] += 1
            except ValueError:
                self._counters["refused_crc"] += 1
            else:
                self._state = self._state.after(message, self._clock_ns())
                self._write(message.frames)

    def _write(self, frames: bytes) -> None:
        for address, port in self._ports.items() if frames else ():
            try:
                port.write(frames)
                self._failed.pop(address, None)
            except OSError as error:
                self._failed[address] = f"corrections do not reach {address}: {why_closed(error)}"
                self._counters["not_written"] += 1


def open_delivery(
    session: zenoh.Session, site: str, config: CorrectionsConfig, open_ports: Mapping[str, CorrectionPort]
) -> CorrectionsDelivery | None:
    """Start delivery, if configured. open_ports: those of drivers, by address."""
    ports = {address: open_ports.get(address) or OwnPort(address, config.baud) for address in config.ports}
    return CorrectionsDelivery(session, site, config.base, ports) if ports else None
