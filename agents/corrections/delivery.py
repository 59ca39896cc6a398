"""Corrections to the ports of a machine's receivers: what comes in on the key of its base is checked and written on."""

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

WAITING = 50  # messages while a port holds the thread up: some seconds; then the oldest gives way
STALE_NS = 60 * 10**9  # receivers give their fixed solution up after 30 to 60 s
FOLLOWS = 100  # clocks that run apart by up to a hundredth make no correction old
DRAINED = 64  # pieces at a time of what a receiver sends on a port that nobody reads


@dataclass(frozen=True)
class CorrectionsConfig:
    """Corrections for the receivers of a machine.

    base: whose; empty for none. ports: where they are written: addresses of [[driver]] tables, other serial ports, or
    `tcp://HOST:PORT`. baud: of those serial ports.
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
        """Send bytes to the receiver; OSError where that fails."""

    def close(self) -> None:
        """Let go of it."""


class OwnPort:
    """A port for corrections alone. It is opened when some come in, and again with the next ones where it broke."""

    def __init__(self, address: str, baud: int) -> None:
        self._address, self._baud = address, baud
        self._transport: Transport | None = None

    def write(self, data: bytes) -> None:
        """Send bytes; what the receiver has sent is let go."""
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
        """Give the port back."""
        if self._transport:
            self._transport.close()
        self._transport = None


@dataclass(frozen=True)
class CorrectionsState:
    """What is known of a base: pure. since_ns: of the machine's monotonic clock, as all times but stamps.

    heard_ns: when the relay last said anything. true_ns: when the newest frame reached the relay, None without one.
    fastest_ns: the least that arrivals are ahead of stamps. Two clocks are apart by that, and by the fastest way; so a
    message that was held up shows, and a wrong clock does not.
    """

    base: str
    since_ns: int
    heard_ns: int | None = None
    true_ns: int | None = None
    fastest_ns: int = 0
    said: str = ""

    def after(self, message: Corrections, came_ns: int) -> "CorrectionsState":
        """The state after a message that came in."""
        behind_ns = fastest_ns = came_ns - message.stamp_ns
        if self.heard_ns is not None:
            followed_ns = self.fastest_ns + (came_ns - self.heard_ns) // FOLLOWS
            if behind_ns <= followed_ns + STALE_NS:  # else a clock was set
                fastest_ns = min(behind_ns, followed_ns)
        true_ns = message.stamp_ns + fastest_ns if message.frames else self.true_ns
        return replace(self, heard_ns=came_ns, true_ns=true_ns, fastest_ns=fastest_ns, said=message.problem)

    def problem(self, now_ns: int) -> str:
        """Why receivers have no corrections, in a sentence; empty while they have."""
        age_ns = now_ns - (self.since_ns if self.true_ns is None else self.true_ns)
        if self.said:
            return f"{self.base}: {self.said}"
        if age_ns <= STALE_NS:
            return ""
        if self.heard_ns is None or now_ns - self.heard_ns > STALE_NS:
            return f"{self.base}: silent for {age_ns / 1e9:.0f} s: start `sitegrid corrections`, or mend its link"
        return f"{self.base}: the last correction is {age_ns / 1e9:.0f} s old: is the base on?"


class CorrectionsDelivery:
    """Writes the corrections of one base to all ports, by address, from a thread that a port may hold up."""

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
        self._failed: dict[str, str] = {}  # ports
        self._subscriber = session.declare_subscriber(keys.corrections(site, base), zenoh.handlers.RingChannel(WAITING))
        self._thread = threading.Thread(target=self._run, name="corrections", daemon=True)
        self._thread.start()

    def report(self) -> dict[str, Any]:
        """How old the newest frame is, what was refused, and what hinders it, in plain values."""
        now_ns, state = self._clock_ns(), self._state
        problems = [why for why in (state.problem(now_ns), *dict(self._failed).values()) if why]
        age_s = None if state.true_ns is None else round((now_ns - state.true_ns) * 1e-9, 1)
        return {"base": state.base, "age_s": age_s, "problem": "; ".join(problems), "counters": dict(self._counters)}

    def close(self) -> None:
        """Stop listening, and give the ports back."""
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
    """Begin to write corrections, where a machine takes some. open_ports: those that drivers read, by address."""
    ports = {address: open_ports.get(address) or OwnPort(address, config.baud) for address in config.ports}
    return CorrectionsDelivery(session, site, config.base, ports) if ports else None
