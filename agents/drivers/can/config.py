"""Signals that a [[driver]] of a bus names itself: by position in the frame, or by a DBC."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.drivers.can.pgns import SIGNALS
from agents.drivers.can.signals import EXTENDED, Signal, group_of
from agents.drivers.can.streams import STREAMS
from protocol.machine.machine_config import SensorConfig
from protocol.machine.readings import columns

MOST_PGN = 0x3FFFF


@dataclass(frozen=True)
class SignalConfig:
    """One signal of [driver.signals]: value = scale * raw + offset, in the unit of the column that it feeds.

    pgn, or id: whose frames have it, id being an 11-bit identifier. start: its lowest bit, from that of the first byte.
    bits: 0 where `dbc` states place and unit, as "Message.Signal" of the driver's DBC; scale and offset apply then to
    the value that the DBC makes.
    """

    pgn: int = 0
    id: int = 0
    start: int = 0
    bits: int = 0
    scale: float = 1.0
    offset: float = 0.0
    signed: bool = False
    dbc: str = ""

    def __post_init__(self) -> None:
        if self.dbc:
            if self.pgn or self.id or self.bits or self.start or self.signed:
                raise ValueError("dbc: it states pgn, id, start, bits and signed: leave them out")
        elif not (1 <= self.bits <= 64 and 0 <= self.start <= 511):
            raise ValueError(f"bits, start: {self.bits} bits from bit {self.start} are not within a frame")
        elif (self.pgn > 0) == (self.id > 0) or not (0 <= self.pgn <= MOST_PGN and 0 <= self.id < 1 << 11):
            raise ValueError("pgn, id: give one of them, a PGN up to 0x3FFFF or an identifier of 11 bits")


@dataclass(frozen=True)
class DbcSignal(Signal):
    """A signal that cantools decodes. factor, shift: what the configuration adds to the DBC's scale and offset.

    error: what cantools raises on a frame that is too short, or has another value of the multiplexer.
    """

    message: Any = None
    error: type[Exception] = ValueError
    label: str = ""
    factor: float = 1.0
    shift: float = 0.0

    def value(self, data: bytes) -> float | None:
        """The value in a frame; None where it has none."""
        try:
            raw = self.message.decode(data, decode_choices=False, scaling=False)[self.label]
        except (KeyError, self.error):
            return None
        value = self.scaled(raw)
        return None if value is None else self.factor * value + self.shift


def all_signals(config: Mapping[str, SignalConfig], dbc: str) -> dict[str, Signal]:
    """The built-in signals, and those of the configuration, in place of one of that name; ValueError names a fault."""
    database, error = _load(dbc) if dbc else (None, ValueError)
    return SIGNALS | {name: _made(name, signal, database, error) for name, signal in config.items()}


def misfit(stream: str, sensor: SensorConfig, signals: Mapping[str, SignalConfig]) -> str:
    """Why a stream of a bus cannot feed a sensor; empty where it can."""
    if stream not in STREAMS:
        if stream not in signals:
            return f"{stream} is no stream, nor one of the driver's signals; there are {', '.join(STREAMS)}"
        several = len(columns(sensor.kind)) > 1
        return f"{sensor.name} is of kind {sensor.kind}, which a single signal does not make" if several else ""
    if sensor.kind != (kind := STREAMS[stream].kind):
        return f"{sensor.name} is of kind {sensor.kind}, and {stream} feeds one of kind {kind}"
    if kind == "odometry" and sensor.measures != (only := (("rate",) if stream == "turn_rate" else ("speed",))):
        return f'the bus shows one of speed and rate: give {sensor.name} `measures = ["{only[0]}"]`'
    quantity = {"fix": "position", "velocity": "velocity"}.get(stream)
    if quantity and quantity not in sensor.std:
        return f"the bus states no accuracy: give {sensor.name} its `std = {{ {quantity} = ... }}`"
    return ""


def _load(path: str) -> tuple[Any, type[Exception]]:
    try:
        import cantools  # of the extra `can`
    except ImportError:
        raise ValueError("dbc: cantools is not installed: pip install '.[can]'") from None
    try:
        return cantools.database.load_file(Path(path), strict=False), cantools.Error
    except (OSError, ValueError, cantools.Error) as error:
        raise ValueError(f"dbc: {path}: {str(error).splitlines()[0]}") from None


def _made(name: str, config: SignalConfig, database: Any, error: type[Exception]) -> Signal:
    if not config.dbc:
        group = EXTENDED | config.pgn if config.pgn else config.id
        return Signal(name, group, config.start, config.bits, config.scale, config.offset, config.signed)
    message_name, _, label = config.dbc.partition(".")
    if database is None:
        raise ValueError(f"signals.{name}: the driver names no `dbc`")
    message = next((m for m in database.messages if m.name == message_name), None)
    signal = next((s for s in message.signals if s.name == label), None) if message else None
    if message is None or signal is None:
        raise ValueError(f"signals.{name}: the DBC has no {config.dbc!r}")
    group = group_of(message.frame_id, is_extended=message.is_extended_frame)
    plain = Signal(name, group, 0, signal.length, signal.scale, signal.offset, signal.is_signed)
    return DbcSignal(**vars(plain), message=message, error=error, label=label, factor=config.scale, shift=config.offset)
