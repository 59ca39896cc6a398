"""Which states the sensors of a machine need."""

from agents.dead_reckoning import turn_source
from agents.localisation.filters.state import Layout
from agents.localisation.gps import drifting
from agents.localisation.headings import anchored_headings
from protocol.machine.machine_config import ABSOLUTE, MachineConfig


def layout_of(machine: MachineConfig) -> Layout:
    """States for the slow errors of a machine's sensors."""
    source = turn_source(machine)
    imus = sum(s.kind == "imu" and s.use for s in machine.sensors)
    turns = imus + (source is not None and source.kind != "imu")
    return Layout(turns, True, len(drifting(machine.sensors)), len(anchored_headings(machine.sensors)))


def shows_tilt(machine: MachineConfig, profile: str) -> bool:
    """Whether a sensor shows roll and pitch, or how they change; a machine without any is taken to be on a plane."""
    return any(
        s.kind == "imu" or (s.kind == "attitude" and s.provides("tilt") and (profile == "paper" or s.mode != ABSOLUTE))
        for s in machine.sensors
        if s.use
    )
