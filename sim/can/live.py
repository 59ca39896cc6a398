"""Buses that others can listen to: frames of simulated machines by python-can, one bus per machine."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from agents.drivers.can.buses import CanFrame, split_bus, why_shut
from agents.drivers.can.config import SignalConfig
from protocol.config import toml_lines
from protocol.errors import ConfigError
from protocol.machine.machine_config import SensorConfig


def address_of(first: str, index: int) -> str:
    """The bus of a machine by its place in the fleet: the number that ends the first one's address counts on."""
    return re.sub(r"\d*\Z", lambda number: str(int(number[0] or 0) + index), first, count=1)


class Buses:
    """The open buses of machines, by name. A frame that nobody takes is lost, as on a wire."""

    def __init__(self, first: str, machines: Iterable[str]) -> None:
        """first: address of the first machine's bus; ConfigError where one cannot be opened."""
        self._buses: dict[str, Any] = {}
        try:
            import can  # of the extra `can`
        except ImportError:
            raise ConfigError(first, "python-can is not installed: pip install '.[can]'") from None
        self._can: Any = can
        for index, machine in enumerate(machines):
            address = address_of(first, index)
            interface, channel, port = split_bus(address)
            more: dict[str, Any] = {"port": port} if port else {}
            try:
                self._buses[machine] = self._can.Bus(interface=interface, channel=channel, **more)
            except (can.CanError, OSError, ValueError) as error:
                self.close()
                raise ConfigError(address, why_shut(address, OSError(*error.args))) from None

    def send(self, machine: str, frames: Sequence[CanFrame]) -> None:
        """Send what a machine's bus carries."""
        for frame in frames:
            self._buses[machine].send(self._can.Message(0.0, frame.identifier, frame.is_extended, data=frame.data))

    def close(self) -> None:
        """Let go of all."""
        for bus in self._buses.values():
            bus.shutdown()


def bus_toml(address: str, feeds: Mapping[str, SensorConfig], signals: Mapping[str, SignalConfig]) -> str:
    """The [[driver]] table of an agent that listens to a bus."""
    named = ", ".join(f"{stream} = {json.dumps(sensor.name)}" for stream, sensor in feeds.items())
    tables = (f"\n[driver.signals.{name}]\n" + "\n".join(toml_lines(asdict(one))) for name, one in signals.items())
    return f'\n[[driver]]\nkind = "can"\naddress = {json.dumps(address)}\nfeeds = {{ {named} }}\n' + "\n".join(tables)
