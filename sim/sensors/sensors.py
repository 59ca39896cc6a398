"""All sensors of all machines: true states in, raw readings out, as columns; reading objects only on demand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from protocol.arrays import Ints
from protocol.machine.readings import Reading
from protocol.site.site_config import Projection
from sim.sensors.drivetrain import ArticulationBank, EncoderBank, PayloadBank, TorqueBank
from sim.sensors.gps import GpsBank
from sim.sensors.inertial import AttitudeBank, ImuBank
from sim.sensors.noise import generator
from sim.sensors.rigs import Rig
from sim.sensors.sensor_group import Bank, Block, Unit
from sim.state import FleetState

_BANKS: dict[str, type[Bank]] = {
    "imu": ImuBank,
    "attitude": AttitudeBank,
    "torque": TorqueBank,
    "encoder": EncoderBank,
    "articulation": ArticulationBank,
    "payload": PayloadBank,
}


@dataclass(frozen=True)
class Span:
    """What all sensors said over a span of time. places: of each machine, block and column of each of its sensors."""

    blocks: tuple[Block, ...]
    places: Sequence[Sequence[tuple[int, int]]]

    def readings(self, machine: int) -> list[Reading]:
        """Readings of one machine in the order of their stamps; of one stamp, in the order of its sensors."""
        found = [reading for block, unit in self.places[machine] for reading in self.blocks[block].readings(unit)]
        found.sort(key=lambda reading: reading.stamp_ns)
        return found


class Sensors:
    """The sensors of a fleet.

    Readings of one sensor depend on the seed, its machine's place in the fleet and its name alone: not on other
    machines and sensors, nor on how many steps are sampled at a time.
    """

    def __init__(self, rigs: Sequence[Rig], seed: int, projection: Projection) -> None:
        groups: dict[tuple[str, int, str], list[Unit]] = {}
        places: list[list[tuple[tuple[str, int, str], int]]] = []
        for i, rig in enumerate(rigs):
            places.append([])
            for sensor in rig.machine.sensors:
                key = (sensor.kind, rig.preset.rate_hz(sensor.kind), sensor.frame)
                group = groups.setdefault(key, [])
                places[i].append((key, len(group)))
                group.append(Unit(i, rig, sensor, generator(seed, i, sensor.name)))
        number = {key: i for i, key in enumerate(groups)}
        self._places = [[(number[key], unit) for key, unit in of_machine] for of_machine in places]
        self._banks = [
            GpsBank(units, seed, projection) if kind == "gps" else _BANKS[kind](units)
            for (kind, _, _), units in groups.items()
        ]

    def sample(self, steps: Ints, stamps_ns: Ints, states: FleetState) -> Span:
        """Read off the states (arrays (k, n, ...)) after the steps with these numbers; their order is that of time."""
        return Span(tuple(bank.sample(steps, stamps_ns, states) for bank in self._banks), self._places)
