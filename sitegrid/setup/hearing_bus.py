"""What is on a CAN bus: parameter groups with values, and groups that an agent misses."""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import replace

from agents.drivers.can.buses import Bus, CanFrame, buses, is_recording, read_recording, split_bus, why_shut
from agents.drivers.can.line import CanLine
from agents.drivers.can.pgns import SIGNALS, group_name
from agents.drivers.can.signals import Signal, group_of
from agents.drivers.can.source import OFF, SILENT, take
from agents.drivers.can.streams import STREAMS
from agents.drivers.tables import CAN
from protocol.machine.machine_config import SensorConfig
from sitegrid.setup.hearing import HeardLine

NEEDED = {"engine": "engine torque (EEC1)", "speed": "wheel speed (CCVS1)", "gearbox": "clutch and shifts (ETC1)"}
PLACES = {"fix", "velocity"}  # NMEA 2000 buses have no engine
POLL_S = 0.1
USUAL = re.compile(r"v?can\d+")  # bus names that a host may lack


def is_bus(address: str) -> bool:
    """Whether an address is a bus, or a recording of one."""
    if is_recording(address) or address in buses() or USUAL.fullmatch(address):
        return True
    try:
        return "://" in address and bool(split_bus(address))
    except ValueError:
        return False


def listen_to_bus(address: str, seconds: float, signals: Mapping[str, Signal] = SIGNALS) -> HeardLine:
    """Listen to a bus for some seconds, or read a recording. signals: by name, more than the built-in ones."""
    try:
        if is_recording(address):
            return heard_bus(address, read_recording(address), signals)
        with closing(Bus(address)) as bus:
            heard = heard_bus(address, _live(bus, time.monotonic() + seconds), signals)
            return replace(heard, kind="", problem=OFF) if bus.is_off else heard
    except OSError as error:
        return HeardLine(address, problem=why_shut(address, error))


def heard_bus(address: str, frames: Iterable[CanFrame], signals: Mapping[str, Signal] = SIGNALS) -> HeardLine:
    """Groups with values in these frames, usable streams, missing ones."""
    known = {name: stream.kind for name, stream in STREAMS.items()}
    known |= {name: "payload" for name in signals if name not in SIGNALS}  # any kind of one column
    line = CanLine({name: SensorConfig(name, kind) for name, kind in known.items()}, signals)
    stamps: dict[str, list[float]] = {}
    streams: set[str] = set()
    for frame in frames:
        group = group_of(frame.identifier, is_extended=frame.is_extended)
        streams.update(value.sensor for value in take(line, frame, round(frame.utc_s * 1e9)))
        if any(signal.group == group and signal.value(frame.data) is not None for signal in signals.values()):
            stamps.setdefault(group_name(group), []).append(frame.utc_s)
    rates = {name: _hz(every) for name, every in sorted(stamps.items())}
    if not streams:
        n = line.counters["frames_can"]
        foreign = f"{n} frames, and none that the built-in table knows: say its `signals`, or a DBC"
        return HeardLine(address, messages=rates, problem=foreign if n else SILENT)
    lacks = [what for name, what in NEEDED.items() if name not in streams]
    problem = f"no value of {', '.join(lacks)}" if lacks and not streams & PLACES else ""
    return HeardLine(address, CAN, 0, rates, tuple(name for name in known if name in streams), problem=problem)


def _live(bus: Bus, end_s: float) -> Iterator[CanFrame]:
    while (left_s := end_s - time.monotonic()) > 0:
        yield from bus.read(min(left_s, POLL_S))


def _hz(stamps: list[float]) -> float:
    """0 for a single frame."""
    return round((len(stamps) - 1) / (stamps[-1] - stamps[0]), 2) if stamps[-1] > stamps[0] else 0.0
