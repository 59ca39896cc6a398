"""Ports of simulated receivers: named pseudo terminals in a folder, like /dev/serial."""

from __future__ import annotations

import json
import os
import select
import tty
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from protocol.errors import ConfigError
from protocol.machine.readings import Reading
from sim.receivers.receiver import SimulatedReceiver, Wiring, carried
from sim.sensors.rigs import Rig


class PseudoTerminal:
    """A pseudo terminal. Without a reader bytes are lost, as on a wire."""

    def __init__(self, path: Path) -> None:
        """ConfigError if a file has the name."""
        self._path = path
        self._end, listener = os.openpty()
        tty.setraw(listener)
        os.set_blocking(self._end, False)
        self._name = name = os.ttyname(listener)
        os.close(listener)  # from now on the system reports whether there is a reader
        try:
            if path.is_symlink():
                path.unlink()  # left by a killed simulator
            path.symlink_to(name)
        except OSError as error:
            os.close(self._end)
            raise ConfigError(path, f"no port can be there ({error.strerror}): choose another folder") from None

    def write(self, data: bytes) -> None:
        """Send to the reader; an overflow of the system's buffer is lost."""
        ready = select.poll()
        ready.register(self._end, select.POLLOUT)
        if any(event & select.POLLOUT and not event & select.POLLHUP for _, event in ready.poll(0)):
            with suppress(BlockingIOError):
                os.write(self._end, data)

    def close(self) -> None:
        """Remove the port."""
        if self._path.is_symlink() and str(self._path.readlink()) == self._name:
            self._path.unlink()
        os.close(self._end)


class Ports:
    """Ports of all simulated machines. folder: created if missing."""

    def __init__(self, folder: Path, machines: Mapping[str, Sequence[Wiring]]) -> None:
        self._receivers: dict[str, list[tuple[SimulatedReceiver, PseudoTerminal]]] = {}
        self._carried = {name: carried(wirings) for name, wirings in machines.items()}
        folder.mkdir(parents=True, exist_ok=True)
        try:
            for name, wirings in machines.items():
                opened = self._receivers.setdefault(name, [])
                for wiring in wirings:
                    opened.append((SimulatedReceiver(wiring), PseudoTerminal(folder / wiring.name)))
        except ConfigError:
            self.close()
            raise

    def send(self, machine: str, readings: Sequence[Reading]) -> tuple[Reading, ...]:
        """Send the readings of the machine's receivers over their ports; returns the others."""
        for receiver, port in self._receivers[machine]:
            port.write(receiver.speak(readings))
        return tuple(reading for reading in readings if reading.sensor not in self._carried[machine])

    def close(self) -> None:
        """Remove all ports."""
        for _, port in (each for opened in self._receivers.values() for each in opened):
            port.close()


def driver_toml(folder: Path, wirings: Sequence[Wiring], rig: Rig) -> str:
    """Agent's [[driver]] tables: these ports, and bundles for what neither ports nor a bus carry."""
    tables = [
        f"kind = {json.dumps(w.format)}\naddress = {json.dumps(str(folder.absolute() / w.name))}\n"
        + _feeds({stream: sensor.name for stream, sensor in w.feeds.items()})
        for w in wirings
    ]
    if rest := {s.name: s.name for s in rig.off_bus if s.name not in carried(wirings)}:
        tables.append('kind = "zenoh"\n' + _feeds(rest))
    return "".join(f"\n[[driver]]\n{table}" for table in tables)


def _feeds(feeds: Mapping[str, str]) -> str:
    return "feeds = { " + ", ".join(f"{key} = {json.dumps(name)}" for key, name in feeds.items()) + " }\n"
