"""[[driver]] tables of agent.toml: what talks on which port, and which sensors its streams feed."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import entry_points

from agents.drivers import Driver, Source
from agents.drivers.can.buses import is_recording, split_bus
from agents.drivers.can.config import SignalConfig, all_signals, misfit
from agents.drivers.can.line import CanLine
from agents.drivers.can.source import CanSource, RecordingSource
from agents.drivers.formats import STREAMS
from agents.drivers.formats.framing import GPSD
from agents.drivers.line import DECODERS, Line, split_stream
from agents.drivers.receiver import ReceiverSource
from agents.drivers.sources import Sources
from agents.drivers.time_base import TimeBase
from agents.drivers.transports import split_address
from agents.drivers.zenoh import ZENOH, BundleSource
from protocol.errors import ConfigError
from protocol.machine.machine_config import QUANTITIES, MachineConfig, SensorConfig

CAN = "can"  # a machine's own bus
PLUG_INS = "sitegrid.drivers"  # group of entry points


@dataclass(frozen=True)
class DriverConfig:
    """One [[driver]]: a port to listen to.

    kind: `nmea`, `ubx`, `gpsd`, `can`, `zenoh`, or a plug-in. address: a serial port (`/dev/ttyACM0`),
    `tcp://HOST:PORT`, `udp://[HOST]:PORT`, or a recorded file; none for `zenoh`; for `can` see `split_bus`. baud: 0
    finds it. feeds: sensor by stream, of STREAMS; `gp:fix` names an NMEA talker, gpsd device, or bus address
    (`0x0f:retarder`); for `zenoh` a sensor in the bundles. dbc, signals: of `can`: a file of signals, and others beside
    the built-in ones. options: of a plug-in.
    """

    kind: str
    address: str = ""
    baud: int = 0
    feeds: Mapping[str, str] = field(default_factory=dict, hash=False)
    options: Mapping[str, str] = field(default_factory=dict, hash=False)
    dbc: str = ""
    signals: Mapping[str, SignalConfig] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        if self.kind not in (known := known_kinds()):
            raise ValueError(f"kind: {self.kind!r} is none of {', '.join(known)}")
        if self.kind == ZENOH and (self.address or self.baud or self.options):
            raise ValueError("address, baud, options: zenoh has none, its bundles come on the machine's own key")
        if self.kind != ZENOH:
            self._check_address()
        if self.kind in DECODERS:
            self._check_feeds()
        if self.kind == CAN:
            self._check_bus()
        elif self.dbc or self.signals:
            raise ValueError(f"dbc, signals: of can alone, {self.kind} has none")

    def _check_address(self) -> None:
        if not self.address or not self.address.isprintable():
            raise ValueError(f"address: {self.address!r} is neither a port, tcp://HOST:PORT, udp://:PORT nor a file")
        if not 0 <= self.baud <= 10_000_000:
            raise ValueError(f"baud: {self.baud} is no baud; 0 finds it")

    def _check_feeds(self) -> None:
        if self.options:
            raise ValueError(f"options: of plug-ins alone, {self.kind} has none")
        if "://" in self.address:
            split_address(self.address)
        for key in self.feeds:
            if split_stream(key)[1] not in STREAMS:
                raise ValueError(f"feeds: {key!r} is no stream; there are {', '.join(STREAMS)}")

    def _check_bus(self) -> None:
        if self.baud or self.options:
            raise ValueError("baud, options: can has none; a bus has its bit rate from the host (`ip link set`)")
        if not is_recording(self.address):
            split_bus(self.address)
        for key in self.feeds:
            sender, _ = split_stream(key)
            try:
                is_address = not sender or 0 <= int(sender, 16) <= 0xFF
            except ValueError:
                is_address = False
            if not is_address:
                raise ValueError(f'feeds: {key!r}: {sender!r} is no address on a bus, as "0x0f:retarder"')

    @property
    def states_utc(self) -> bool:
        """Whether it states UTC, as receivers and bus recordings do."""
        return self.kind in DECODERS or (self.kind == CAN and is_recording(self.address))

    @property
    def name(self) -> str:
        """Address, else kind."""
        return self.address or self.kind


# Of a plug-in: makes a table's source; ValueError for a wrong table.
Factory = Callable[[DriverConfig, MachineConfig], Source]


def known_kinds() -> list[str]:
    """Built-in kinds, then installed plug-ins."""
    return [*DECODERS, CAN, ZENOH, *(plug_in.name for plug_in in entry_points(group=PLUG_INS))]


def check_drivers(drivers: Sequence[DriverConfig], machine: MachineConfig, where: str) -> None:
    """Refuse tables that contradict each other or the machine; ConfigError."""
    addresses = [driver.name for driver in drivers]
    fed = [name for driver in drivers for name in driver.feeds.values()]
    for names, what in ((addresses, "two listen at"), (fed, "two streams feed")):
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise ConfigError(where, f"[[driver]]: {what} {twice}")
    for i, driver in enumerate(drivers):
        for key, name in driver.feeds.items():
            sensor = machine.sensor(name)
            problem = _misfit(driver, split_stream(key)[1], sensor) if sensor else f"no [[sensor]] is named {name!r}"
            if problem:
                raise ConfigError(f"{where} [[driver]] {i + 1} feeds.{key}", problem)


def _misfit(driver: DriverConfig, stream: str, sensor: SensorConfig) -> str:
    if driver.kind == CAN:
        return misfit(stream, sensor, driver.signals)
    if driver.kind not in DECODERS:
        return ""
    if sensor.kind != (kind := STREAMS[stream]):
        return f"{sensor.name} is of kind {sensor.kind}, and a {stream} feeds one of kind {kind}"
    quantity = QUANTITIES[kind][0]
    if driver.kind == GPSD and quantity not in sensor.std:
        return f"gpsd's accuracies are no standard deviations: give {sensor.name} its `std = {{ {quantity} = ... }}`"
    if stream == "heading" and sensor.provides("tilt"):
        return f'two antennas show no tilt: give {sensor.name} `measures = ["heading"]`'
    return ""


def open_sources(
    drivers: Sequence[DriverConfig],
    machine: MachineConfig,
    host_utc: Callable[[], tuple[int, int]],
    bundles: Callable[[], Driver],
) -> Sources:
    """Start to listen.

    host_utc: the host's UTC and monotonic clock [ns], without receivers. bundles: driver of the key `sensors`.
    """
    time_base = TimeBase()
    if not any(driver.states_utc for driver in drivers):
        time_base.take("host", *host_utc())
    return Sources({driver.name: _open(driver, machine, bundles) for driver in drivers}, time_base)


def _open(driver: DriverConfig, machine: MachineConfig, bundles: Callable[[], Driver]) -> Source:
    feeds = {key: sensor for key, name in driver.feeds.items() if (sensor := machine.sensor(name))}
    if driver.kind == ZENOH:
        return BundleSource(bundles(), feeds)
    if driver.kind in DECODERS:
        return ReceiverSource(driver.address, driver.baud, driver.kind, Line(driver.kind, feeds))
    if driver.kind == CAN:
        return _open_bus(driver, feeds, machine.mass_kg)
    plug_in = next(iter(entry_points(group=PLUG_INS, name=driver.kind)))
    try:
        factory: Factory = plug_in.load()
        return factory(driver, machine)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"[[driver]] {driver.kind}", str(error)) from None


def _open_bus(driver: DriverConfig, feeds: Mapping[str, SensorConfig], mass_kg: float) -> Source:
    try:
        line = CanLine(feeds, all_signals(driver.signals, driver.dbc), mass_kg)
    except ValueError as error:
        raise ConfigError(f"[[driver]] {driver.address}", str(error)) from None
    return RecordingSource(driver.address, line) if is_recording(driver.address) else CanSource(driver.address, line)
