"""All sensors of all machines: true states in, raw readings out, as columns; reading objects only on demand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from protocol.arrays import Ints
from protocol.machine.readings import Reading
from protocol.site.site_config import Projection
from sim.sensors.drivetrain import ArticulationGroup, EncoderGroup, PayloadGroup, TorqueGroup
from sim.sensors.gps import GpsGroup
from sim.sensors.inertial import AttitudeGroup, ImuGroup
from sim.sensors.noise import generator
from sim.sensors.rigs import Rig
from sim.sensors.sensor_group import GroupReadings, SensorGroup, SensorUnit
from sim.state import FleetState

_GROUPS: dict[str, type[SensorGroup]] = {
    "imu": ImuGroup,
    "attitude": AttitudeGroup,
    "torque": TorqueGroup,
    "encoder": EncoderGroup,
    "articulation": ArticulationGroup,
    "payload": PayloadGroup,
}


@dataclass(frozen=True)
class FleetReadings:
    """Readings of all sensors over a span of time. places: group and column of each sensor of each machine."""

    groups: tuple[GroupReadings, ...]
    places: Sequence[Sequence[tuple[int, int]]]

    def readings(self, machine: int) -> list[Reading]:
        """Readings of one machine in the order of their stamps; of one stamp, in the order of its sensors."""
        own = [reading for group, unit in self.places[machine] for reading in self.groups[group].readings(unit)]
        own.sort(key=lambda reading: reading.stamp_ns)
        return own


class Sensors:
    """The sensors of a fleet.

    Readings of one sensor depend on the seed, its machine's place in the fleet and its name alone: not on other
    machines and sensors, nor on how many steps are sampled at a time.
    """

    def __init__(self, rigs: Sequence[Rig], seed: int, projection: Projection) -> None:
        groups: dict[tuple[str, int, str], list[SensorUnit]] = {}
        places: list[list[tuple[tuple[str, int, str], int]]] = []
        for i, rig in enumerate(rigs):
            places.append([])
            for sensor in rig.machine.sensors:
                key = (sensor.kind, rig.preset.rate_hz(sensor.kind), sensor.frame)
                group = groups.setdefault(key, [])
                places[i].append((key, len(group)))
                group.append(SensorUnit(i, rig, sensor, generator(seed, i, sensor.name)))
        number = {key: i for i, key in enumerate(groups)}
        self._places = [[(number[key], unit) for key, unit in sensors] for sensors in places]
        self._groups = [
            GpsGroup(units, seed, projection) if kind == "gps" else _GROUPS[kind](units)
            for (kind, _, _), units in groups.items()
        ]

    def sample(self, steps: Ints, stamps_ns: Ints, states: FleetState) -> FleetReadings:
        """Read the states (arrays (k, n, ...)) after the steps with these numbers; their order is that of time."""
        return FleetReadings(tuple(group.sample(steps, stamps_ns, states) for group in self._groups), self._places)
