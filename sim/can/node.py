"""The bus of one simulated machine: true states in, frames of J1939 out, with its steps and rates. Pure.

Torque has the error of the preset's torque sensor, as controllers estimate it, before it is stated in steps of 1 %.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping

import numpy as np

from agents.drivers.can.buses import CanFrame
from agents.drivers.can.config import SignalConfig, all_signals
from agents.drivers.can.line import CanLine
from agents.drivers.can.signals import EXTENDED, Signal, frame_of
from protocol.arrays import Floats, Ints
from protocol.machine.machine_config import SensorConfig
from protocol.machine.readings import Reading, parse_reading
from sim.machines.drive_train import Gearbox, Shafts, shafts
from sim.sensors.noise import generator
from sim.sensors.rigs import Rig
from sim.sensors.sensor_group import SensorUnit
from sim.sensors.sensors import TorqueGroup
from sim.state import STEP_S, FleetState

MAKERS_PGN = 65300  # one that J1939 leaves to makers
SIGNALS = {"pump": SignalConfig(pgn=MAKERS_PGN, start=0, bits=16, scale=5000.0)}  # its pressure [Pa]
# Steps of the world from frame to frame, by PGN: as J1939-71 has them, of ETC1 10 ms. Source and priority of all.
EVERY = {61440: 10, 61442: 1, 61444: 2, 61445: 10, 65134: 2, 65247: 25, 65265: 10, 65266: 10, MAKERS_PGN: 5}
SOURCE, PRIORITY = 0x00, 3
PUMP_RUNS_S, PUMP_RESTS_S = 3.0, 9.0  # on average; assumed
IDLE_PA, MOST_PA = 2e6, 28e6
FUEL_SCALE = 0.02  # standard deviation: controllers know the burnt fuel by the injectors' opening
RETARDER_SCALE = 0.05  # and a retarder's torque by its pressure; assumed


class BusNode:
    """Engine, gearbox, retarder, brakes and pump of a machine, on its bus. sensors: names of those that it feeds."""

    def __init__(self, rig: Rig, index: int, seed: int) -> None:
        """index: its place in the fleet."""
        if not rig.model.drive_train:
            raise ValueError(f"can: a {rig.model.name} has no drive train")
        self._train, self._index = rig.model.drive_train, index
        self._radius_m = rig.machine.wheel_radius_m
        self._gearbox = Gearbox(self._train)
        unit = SensorUnit(index, rig, SensorConfig("torque", "torque"), generator(seed, index, "torque"))
        self._sensor, self._torque_nm = TorqueGroup([unit]), 0.0
        self._pump = Pump(self._train.hydraulics, generator(seed, index, "pump"))
        self._fuel_scale, self._retarder_scale = (
            1.0 + std * generator(seed, index, name).standard_normal()
            for std, name in ((FUEL_SCALE, "fuel"), (RETARDER_SCALE, "retarder"))
        )
        known = all_signals(SIGNALS, "")
        self._groups: dict[int, list[Signal]] = defaultdict(list)
        for signal in known.values():
            self._groups[signal.group - EXTENDED].append(signal)
        self.sensors = frozenset(sensor.name for sensor in rig.feeds.values())
        self._line = CanLine(rig.feeds, known)

    def frames(self, steps: Ints, stamps_ns: Ints, states: FleetState) -> list[CanFrame]:
        """Frames that it sends during these steps (k,), whose states are (k, n, ...)."""
        wheels = states.wheel_radps[:, self._index]
        turning = wheels.mean(axis=1)
        geared = self._gearbox.run(turning)
        known = shafts(self._train, geared, turning, self._sensed(steps, stamps_ns, states), self._pump.run(len(steps)))
        values = self._values(known, wheels)
        out = []
        for i, step in enumerate(steps.tolist()):
            for pgn, every in EVERY.items():
                if step % every == 0:
                    own = [(signal, values[signal.name][i]) for signal in self._groups[pgn] if signal.name in values]
                    identifier = PRIORITY << 26 | pgn << 8 | SOURCE
                    out.append(CanFrame(identifier, True, frame_of(own), float(stamps_ns[i]) * 1e-9))
        return out

    def readings(self, frames: list[CanFrame]) -> list[Reading]:
        """What an agent's own driver makes of frames."""
        taken = [(frame, round(frame.utc_s * 1e9)) for frame in frames]
        made = [one for frame, ns in taken for one in self._line.take(frame.identifier, frame.data, ns)]
        return [parse_reading(one.kind, one.sensor, one.host_ns, one.values) for one in made]

    def _sensed(self, steps: Ints, stamps_ns: Ints, states: FleetState) -> Floats:
        """Torque at the wheels (k,) as the controllers estimate it: held from one estimate to the next."""
        sampled = self._sensor.sample(steps, stamps_ns, states).values[:, 0, 0]
        due = np.flatnonzero(steps % 2 == 0)
        out = np.concatenate([[self._torque_nm], sampled])[np.searchsorted(due, np.arange(len(steps)), side="right")]
        self._torque_nm = float(out[-1])
        return out

    def _values(self, known: Shafts, wheels: Floats) -> Mapping[str, list[float]]:
        speed = np.abs(wheels) * self._radius_m
        columns = {
            "retarder_torque": -known.retarder * self._retarder_scale,
            "driveline_engaged": np.ones(len(speed)),
            "converter_locked": known.locked,
            "gear_shifting": known.shifting,
            "output_speed": np.abs(wheels.mean(axis=1)) * self._train.data_sheet.final_drive,
            "engine_torque": known.torque,
            "engine_speed": known.engine_radps,
            "gear_ratio": known.ratio / self._train.data_sheet.final_drive,
            "gear": known.gear,
            "rear_left_speed": speed[:, 0],
            "rear_right_speed": speed[:, 1],
            "engine_friction": known.losses,
            "vehicle_speed": speed.mean(axis=1),
            "brake_switch": known.braked,
            "fuel_rate": known.litres_ph * self._fuel_scale,
            "pump": IDLE_PA + (MOST_PA - IDLE_PA) * known.hydraulics / (self._train.hydraulics or 1.0),
        }
        return {name: column.tolist() for name, column in columns.items()}


class Pump:
    """Pumps that run now and then, whatever the wheels do. most: that they take, as a share of the engine's torque."""

    def __init__(self, most: float, rng: np.random.Generator) -> None:
        self._most, self._rng = most, rng
        self._left, self._share = 0, 0.0

    def run(self, count: int) -> Floats:
        """The share of the next steps (count,)."""
        out = np.zeros(count)
        for i in range(count if self._most else 0):
            if not self._left:
                runs = self._share == 0.0
                self._left = 1 + int(self._rng.exponential(PUMP_RUNS_S if runs else PUMP_RESTS_S) / STEP_S)
                self._share = self._most * self._rng.uniform(0.2, 1.0) if runs else 0.0
            self._left -= 1
            out[i] = self._share
        return out
