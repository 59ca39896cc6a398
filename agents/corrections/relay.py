"""The relay: one base's RTCM3, from its port or a caster, onto the site's key.

It reopens broken links, casters with backoff; machines show its problem in their health.
"""

import logging
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from threading import Event
from typing import Any

from agents.corrections.ntrip import PORTS, NtripStream, parse_caster
from agents.corrections.rtcm import rtcm_framer
from agents.drivers.transports import Transport, open_transport, split_address, why_closed
from protocol.errors import ConfigError, LinkError
from protocol.site.site_config import SiteConfig
from protocol.wire.codec import encode_corrections
from protocol.wire.keys import check_name
from protocol.wire.messages import Corrections

log = logging.getLogger("agents.corrections")

GATHER_S = 0.1  # gathers a second's frames; the router admits 50 messages a second
MESSAGE_BYTES = 8192  # of frames per message, half the admitted size
RETRY_S, MAX_RETRY_S = 1.0, 60.0  # casters lock out frequent callers
STATE_S = 5.0  # interval of the relay's state without frames
UNFRAMED_S = 10.0


@dataclass(frozen=True)
class RelayConfig:
    """Options of a base's relay (config/corrections.toml).

    name: of the base. source: a serial port, `tcp://HOST:PORT`, `ntrip://HOST[:PORT]/MOUNTPOINT` or, with TLS,
    `ntrips://`. baud: of a serial port. user, password: of the caster. sends_position: send it the site's origin, for
    networks of bases.
    """

    name: str
    source: str
    baud: int = 115_200
    user: str = ""
    password: str = ""
    sends_position: bool = False

    def __post_init__(self) -> None:
        try:
            check_name(self.name, "name")
            if self.is_caster:
                parse_caster(self.source)
            elif "://" in self.source:
                split_address(self.source)
        except ConfigError as error:
            raise ValueError(str(error)) from None
        if not self.is_caster and (self.user or self.password or self.sends_position):
            raise ValueError("user, password, sends_position: of a caster alone (ntrip://)")

    @property
    def is_caster(self) -> bool:
        """Whether the source is an NTRIP caster."""
        return self.source.partition("://")[0] in PORTS


class Relay:
    """Reads one base. problem: current one, or "". wait: pause [s], ended by a stop."""

    def __init__(
        self,
        publish: Callable[[bytes], None],
        config: RelayConfig,
        site: SiteConfig,
        wait: Callable[[float], object] = time.sleep,
    ) -> None:
        self.counters: Counter[str] = Counter()
        self.problem = ""
        self._publish, self._config, self._site, self._wait = publish, config, site, wait
        self._stream: Transport | NtripStream | None = None
        self._framer = rtcm_framer()
        self._frames: list[bytes] = []
        self._gathered_s = self._said_s = self._framed_s = time.monotonic()
        self._retry_s = RETRY_S

    def run(self, stop: Event) -> dict[str, Any]:
        """Relay until stopped or at the end of a file; returns a report in plain values."""
        while not stop.is_set() and self.step():
            pass
        self._say()
        self.close()
        return {"base": self._config.name, "problem": self.problem, **self.counters}

    def step(self) -> bool:
        """Read input, publish what is due; False at the end."""
        try:
            self._stream = self._stream or self._opened()
            data = self._stream.read(0.1)
        except LinkError as error:
            return self._break(str(error))
        except OSError as error:
            why = f"the link broke ({error.strerror or error})" if self._stream else why_closed(error)
            return self._break(f"{self._config.source}: {why}")
        self._take(data or b"")
        now_s = time.monotonic()
        if now_s - self._framed_s > UNFRAMED_S:
            self._tell(f"{self._config.source}: {self._why_unframed()}")
        if now_s - (self._gathered_s if self._frames else self._said_s) >= (GATHER_S if self._frames else STATE_S):
            self._say()
        return data is not None

    def close(self) -> None:
        """Close the source."""
        if self._stream:
            self._stream.close()
        self._stream = None

    def _opened(self) -> Transport | NtripStream:
        config, site = self._config, self._site
        if not config.is_caster:
            stream: Transport | NtripStream = open_transport(config.source, config.baud)
        else:
            place = (site.origin_lat_deg, site.origin_lon_deg, site.origin_height_m)
            caster = parse_caster(config.source, config.user, config.password)
            stream = NtripStream(caster, place if config.sends_position else None)
        self._framer, self._framed_s = rtcm_framer(), time.monotonic()
        return stream

    def _take(self, data: bytes) -> None:
        if not (frames := self._framer.feed(data)):
            return
        self._framed_s, self._retry_s = time.monotonic(), RETRY_S
        self._gathered_s = self._gathered_s if self._frames else self._framed_s
        self._frames += [frame.data for frame in frames]
        self.counters["frames"] += len(frames)
        self._framer.broken = 0
        self._tell("")

    def _why_unframed(self) -> str:
        if self._framer.broken:
            return "bytes come, but no RTCM3: set its output to RTCM3 (1005, MSM4 or MSM7), check its baud"
        return "nothing comes: is the base on, and set to send RTCM3?"

    def _say(self) -> None:
        """Publish waiting frames, or that there are none."""
        parts = [b""]
        for frame in self._frames:
            if len(parts[-1]) + len(frame) > MESSAGE_BYTES:
                parts.append(b"")
            parts[-1] += frame
        self._frames, self._said_s = [], time.monotonic()
        for part in parts:
            self._publish(encode_corrections(Corrections(self._config.name, time.time_ns(), part, self.problem)))

    def _break(self, why: str) -> bool:
        self.counters["link_broke"] += self._stream is not None
        self.close()
        self._tell(why)
        self._say()
        self._wait(self._retry_s)
        self._retry_s = min(2 * self._retry_s, MAX_RETRY_S) if self._config.is_caster else RETRY_S
        return True

    def _tell(self, problem: str) -> None:
        if problem and problem != self.problem:
            log.warning("no corrections why=%r", problem)
        elif self.problem and not problem:
            log.info("corrections come again base=%s", self._config.name)
        self.problem = problem
