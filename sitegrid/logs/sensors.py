"""Selection of a machine's sensors."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from protocol.errors import ConfigError, SitegridError
from protocol.machine.log_folder import LogFolder
from protocol.machine.machine_config import MachineConfig


class UnsupportedError(SitegridError):
    """A configuration that the pipeline cannot run; the message says why."""


def select(machine: MachineConfig, gps: int | None = None, imu: int | None = None) -> MachineConfig:
    """Use the first `gps` receivers, and the first `imu` IMUs and attitude sensors; None: unchanged.

    Raises UnsupportedError.
    """
    limits = {"gps": gps, "imu": imu, "attitude": imu}
    counts = dict.fromkeys(limits, 0)
    sensors = []
    for sensor in machine.sensors:
        limit = limits.get(sensor.kind)
        if limit is not None:
            counts[sensor.kind] += 1
            sensor = replace(sensor, use=counts[sensor.kind] <= limit)
        sensors.append(sensor)
    if gps is not None and counts["gps"] < gps:
        raise UnsupportedError(f"{machine.name} has {counts['gps']} GPS receivers, not {gps}")
    return replace(machine, sensors=tuple(sensors))


def chosen(machine: MachineConfig, sensors: Collection[str] = (), gps: int | Collection[str] = ()) -> MachineConfig:
    """The machine with only these sensors, and this number or these of its receivers; empty: unchanged."""
    if sensors:
        machine = _using(machine, sensors, [s.name for s in machine.sensors])
    if isinstance(gps, int):
        return select(machine, gps=gps)
    return _using(machine, gps, [s.name for s in machine.sensors if s.kind == "gps"]) if gps else machine


def refitted(log: LogFolder, machine: MachineConfig) -> LogFolder:
    """The log with this machine's choice of sensors in use."""
    sensors = {sensor.name: sensor for sensor in machine.sensors}
    sources = tuple(replace(source, sensor=sensors[source.sensor.name]) for source in log.sources)
    return replace(log, machine=machine, sources=sources)


def _using(machine: MachineConfig, names: Collection[str], among: Sequence[str]) -> MachineConfig:
    """The machine with only `names` of `among` in use; other sensors are unchanged."""
    if unknown := [name for name in names if name not in among]:
        raise ConfigError(machine.name, f"has no {unknown[0]!r}, but {', '.join(among) or 'no receiver'}")
    sensors = (replace(s, use=s.name in names) if s.name in among else s for s in machine.sensors)
    return replace(machine, sensors=tuple(sensors))
