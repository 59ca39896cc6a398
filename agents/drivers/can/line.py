"""Frames of one bus into values of sensors, and what hinders that, in sentences. Pure.

Frames are matched by PGN, whoever sends them. Where several send one, the first counts until it falls silent, and the
rest is named.
"""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from agents.drivers import Observed
from agents.drivers.can.pgns import group_name
from agents.drivers.can.signals import Signal, group_of
from agents.drivers.can.streams import STREAMS, CanStream
from agents.drivers.line import split_stream, stated
from protocol.machine.machine_config import SensorConfig

HELD_NS = 10**9  # a signal of another frame is as new as this; the slowest that counts, EEC3, comes each 250 ms
SILENT_NS = 5 * 10**9  # without a frame, or without a value
ANY = -1  # sender of a stream that is taken from whoever sends it


class _Feed(NamedTuple):
    """Which sensor a stream of a sender feeds."""

    name: str
    sender: int
    stream: CanStream
    sensor: SensorConfig


class Axles:
    """Sums the loads of a machine's axles, which come one by one, each with its location. mass_kg: as of `CanLine`."""

    def __init__(self, mass_kg: float) -> None:
        self._mass_kg = mass_kg
        self._loads: dict[float, float] = {}  # by location, of the round that is under way
        self._before: set[float] = set()  # locations of the round before
        self._known: set[float] = set()  # those of two rounds in a row

    def payload_kg(self, location: float, load_kg: float) -> float | None:
        """What the axles of the round that this load ends carry above the empty machine; None where one is missing."""
        total_kg = None
        if location in self._loads:
            self._known |= self._loads.keys() & self._before
            if self._loads.keys() == self._known:
                total_kg = max(sum(self._loads.values()) - self._mass_kg, 0.0)
            self._before, self._loads = set(self._loads), {}
        self._loads[location] = load_kg
        return total_kg


class CanLine:
    """Values of one bus. feeds: sensor by stream, `engine`, or `0x0f:retarder` of one sender among several.

    signals: by name, those of streams and others that the configuration adds. mass_kg: of the empty machine, above
    which its axles carry a payload.
    """

    def __init__(self, feeds: Mapping[str, SensorConfig], signals: Mapping[str, Signal], mass_kg: float = 0.0) -> None:
        self.counters: Counter[str] = Counter()
        self._feeds = [_feed(key, sensor) for key, sensor in feeds.items()]
        self._by_group: dict[int, list[Signal]] = defaultdict(list)
        for signal in signals.values():
            self._by_group[signal.group].append(signal)
        self._begun_by: dict[str, list[int]] = defaultdict(list)  # numbers of feeds
        for number, feed in enumerate(self._feeds):
            for name in feed.stream.begins:
                self._begun_by[name].append(number)
        self._groups = [{signals[name].group for name in feed.stream.begins} for feed in self._feeds]
        self._held: dict[str, tuple[float, int]] = {}
        self._senders: dict[int, dict[int, int]] = defaultdict(dict)  # when each was heard, by group; the first counts
        self._valued_ns: dict[int, int] = {}  # by number of the feed
        self._begun_ns = 0
        self._axles = Axles(mass_kg)

    def take(self, identifier: int, data: bytes, host_ns: int, *, is_extended: bool = True) -> list[Observed]:
        """Values of a frame that came at `host_ns`."""
        self._begun_ns = self._begun_ns or host_ns
        self.counters["frames_can"] += 1
        group = group_of(identifier, is_extended=is_extended)
        if (signals := self._by_group.get(group)) is None:
            return []
        values = {signal.name: value for signal in signals if (value := signal.value(data)) is not None}
        if not values:
            self.counters["frames_without_value"] += 1
            return []
        if "axle_load" in values:
            payload_kg = self._axles.payload_kg(values.get("axle_location", 0.0), values.pop("axle_load"))
            values |= {"axle_load": payload_kg} if payload_kg is not None else {}
        sender = identifier & 0xFF if is_extended else 0
        counts = self._counts(group, sender, host_ns)
        if counts:
            self._held |= {name: (value, host_ns) for name, value in values.items()}
        taken_from = (ANY, sender) if counts else (sender,)
        begun = {feed for name in values for feed in self._begun_by.get(name, ())}
        begun = {number for number in begun if self._feeds[number].sender in taken_from}
        if not begun:
            return []
        held = {name: value for name, (value, ns) in self._held.items() if host_ns - ns <= HELD_NS} | values
        made = [self._observed(number, held, host_ns) for number in sorted(begun)]
        return [observed for observed in made if observed]

    def problems(self, host_ns: int) -> Sequence[str]:
        """What is fed by nothing, or by several senders, as of `host_ns`."""
        begun = self._begun_ns
        idle = [i for i in range(len(self._feeds)) if host_ns - self._valued_ns.get(i, begun) > SILENT_NS]
        shared = {group for i, feed in enumerate(self._feeds) if feed.sender == ANY for group in self._groups[i]}
        rivals = {group: heard for group in sorted(shared) if len(heard := self._heard(group, host_ns)) > 1}
        return [
            *(self._why_idle(number, host_ns) for number in idle),
            *(_which_counts(group, heard) for group, heard in rivals.items()),
        ]

    def _counts(self, group: int, sender: int, host_ns: int) -> bool:
        """Whether a sender is the first of those that are heard."""
        senders = self._senders[group]
        senders[sender] = host_ns
        if len(senders) > 1:
            for silent in [known for known, ns in senders.items() if host_ns - ns > SILENT_NS]:
                del senders[silent]
        return next(iter(senders)) == sender

    def _heard(self, group: int, host_ns: int) -> list[int]:
        return [sender for sender, ns in self._senders[group].items() if host_ns - ns <= SILENT_NS]

    def _observed(self, number: int, held: Mapping[str, float], host_ns: int) -> Observed | None:
        feed = self._feeds[number]
        try:
            values = feed.stream.make(held)
        except KeyError:
            values = None
        if values is None:
            self.counters["without_value"] += 1
            return None
        self._valued_ns[number] = host_ns
        return Observed(feed.sensor.name, feed.sensor.kind, stated(values, feed.sensor), host_ns)

    def _why_idle(self, number: int, host_ns: int) -> str:
        feed, groups = self._feeds[number], self._groups[number]
        names = " nor ".join(map(group_name, sorted(groups)))
        if any(self._heard(group, host_ns) for group in groups):
            return f"{names} comes, but what {feed.sensor.name} needs is marked as not available"
        return f"no {names} with a value comes: {feed.sensor.name} is not fed; is it the right bus?"


def _feed(key: str, sensor: SensorConfig) -> _Feed:
    sender, name = split_stream(key)
    own = CanStream(sensor.kind, (name,), lambda held: (held[name],))
    return _Feed(name, int(sender, 16) if sender else ANY, STREAMS.get(name, own), sensor)


def _which_counts(group: int, senders: Sequence[int]) -> str:
    first, second, *_ = named = [f"0x{sender:02x}" for sender in senders]
    other = f'`feeds` can name another, as "{second}:STREAM"'
    return f"{group_name(group)} comes from {' and '.join(named)}: {first} counts; {other}"
