"""The simulator: drivers, world, sensors and truth, one bundle of readings at a time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agents.drivers.can.buses import CanFrame
from protocol.arrays import Bools, Floats, Ints, Table
from protocol.errors import ConfigError
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Reading
from protocol.site.site_config import Projection, SiteConfig
from sim.can.node import BusNode
from sim.config import SimConfig, resolve
from sim.machines.chassis import Bodies
from sim.machines.model import MachineModel
from sim.operators.course import APART_M, Start, build_course, crew_of, spread_starts
from sim.operators.driver import DRIVER_STEPS, LOOK_OUT_STEPS, at_start, drive, look_out, no_commands
from sim.operators.habits import draw_habits
from sim.scenario.ground import build_terrain, with_zone
from sim.scenario.tables import Scenario
from sim.sensors.noise import generator
from sim.sensors.rigs import draw_bodies
from sim.sensors.sensors import FleetReadings, Sensors
from sim.state import STEP_S, FleetState, stack
from sim.terrain.terrain import Terrain
from sim.truth import TRACK_DTYPE, TRACK_EVERY, TRACK_VALUES, WORK, TruthMap, truth_map
from sim.worlds.fast import FastWorld
from sim.worlds.world import World

STEP_MS = 10
STEP_NS = STEP_MS * 1_000_000
BUNDLE_MS = 50  # simulated time per bundle: five steps, 20 Hz
START_NS = 1_767_225_600_000_000_000  # 2026-01-01T00:00:00Z, fixed so that a seed repeats a run


class Simulator:
    """Simulates the machines of one site; reproducible bit for bit.

    site, machines: what agents may know. truth_map, tracks(): for comparisons only. former_truth_maps: (second of a
    change, ground before). buses: of machines with CAN, by name. frames: of the last span.
    """

    def __init__(self, config: SimConfig, scenario: Scenario | None = None, *, bundle_ms: int = BUNDLE_MS) -> None:
        """scenario: replaces the config's. bundle_ms: a multiple of STEP_MS."""
        self.config, self._bundle_ms = config, bundle_ms
        self.scenario: Scenario = scenario or resolve(config)
        self.site: SiteConfig = self.scenario.site
        rigs = self.scenario.rigs()
        self.machines: tuple[MachineConfig, ...] = tuple(rig.machine for rig in rigs)
        self.models: tuple[MachineModel, ...] = tuple(rig.model for rig in rigs)
        self.terrain: Terrain = build_terrain(self.scenario.ground, self.scenario.seed)
        self._changes = sorted(self.scenario.change, key=lambda change: change.at_s)

        routes, speeds, shares = zip(*self.scenario.journeys(), strict=True)
        try:
            starts = spread_starts(routes, shares, APART_M if self.scenario.give_way else 0.0)
        except ValueError as error:
            raise ConfigError(f"scenario {config.scenario}", str(error)) from None
        self._course = build_course(routes, speeds)
        seed = self.scenario.seed
        self._crew, self._commands = crew_of(self.models), no_commands(len(starts))
        self._habits = draw_habits(self.scenario.driving, [generator(seed, i, "driver") for i in range(len(starts))])
        self._drivers = at_start(starts, self._habits)
        bodies = draw_bodies(rigs, seed)
        self._world = build_world(self.scenario.world, self.terrain, self.models, bodies, starts)
        for machine, start in enumerate(starts):
            if start.payload_kg:
                self._world.set_payload(machine, start.payload_kg)
        self._sensors = Sensors(rigs, seed, Projection(self.site))
        self.buses = {rig.machine.name: BusNode(rig, i, seed) for i, rig in enumerate(rigs) if rig.can}
        self.frames: dict[str, list[CanFrame]] = {}
        self._steps = 0
        self._work_j: Floats = np.zeros(len(starts))
        self._tracks: list[Table] = []
        self.former_truth_maps: list[tuple[float, TruthMap]] = []

    @property
    def simulated_s(self) -> float:
        """Time since the start."""
        return self._steps * STEP_MS / 1000

    @property
    def bundles(self) -> int | None:
        """Bundles in the run; None: endless."""
        seconds = self.scenario.seconds
        return -int(-seconds * 1000 // self._bundle_ms) if seconds else None

    @property
    def state(self) -> FleetState:
        """True state."""
        return self._world.state

    def advance(self) -> dict[str, list[Reading]]:
        """Simulate one bundle; returns each machine's readings by stamp."""
        span = self.sense()
        readings = {machine.name: span.readings(i) for i, machine in enumerate(self.machines)}
        for name, bus in self.buses.items():
            readings[name] = sorted([*readings[name], *bus.readings(self.frames[name])], key=lambda one: one.stamp_ns)
        return readings

    def sense(self) -> FleetReadings:
        """Simulate one bundle; returns all readings as columns, without those on buses."""
        count = self._bundle_ms // STEP_MS
        states = stack([self.step() for _ in range(count)])
        steps = np.arange(self._steps - count + 1, self._steps + 1)
        stamps_ns = START_NS + steps * STEP_NS
        due = steps % TRACK_EVERY == 0
        work_j = self._work_j + STEP_S * np.cumsum(np.maximum(states.drive_n * states.speed_mps, 0.0), axis=0)
        self._work_j = work_j[-1]
        if due.any():
            self._tracks.append(_track_rows(stamps_ns[due], states, work_j, due))
        self.frames = {name: bus.frames(steps, stamps_ns, states) for name, bus in self.buses.items()}
        return self._sensors.sample(steps, stamps_ns, states)

    def close(self) -> None:
        """Close the world."""
        self._world.close()

    def tracks(self) -> dict[str, Table]:
        """True tracks so far by machine: rows of `truth.TRACK_DTYPE`, 10 Hz."""
        empty = np.empty((0, len(self.machines)), TRACK_DTYPE)
        rows = np.concatenate([empty, *self._tracks])
        return {machine.name: rows[:, i].copy() for i, machine in enumerate(self.machines)}

    @property
    def truth_map(self) -> TruthMap:
        """The current ground."""
        ground = self.scenario.ground
        return truth_map(self.terrain, ground.width_m, ground.depth_m, self.site.cell_m)

    def step(self) -> FleetState:
        """Simulate STEP_S without sensors; returns the new true state."""
        state = self._world.state
        while self._changes and self._changes[0].at_s <= self.simulated_s:
            self._change_ground()
        if self._steps % LOOK_OUT_STEPS == 0 and self.scenario.give_way and len(self.machines) > 1:
            self._drivers = look_out(self._course, self._crew, self._drivers, state)
        if self._steps % DRIVER_STEPS == 0:
            carried = self._drivers.payload_kg
            dt = DRIVER_STEPS * STEP_S
            self._drivers, self._commands = drive(self._course, self._crew, self._habits, self._drivers, state, dt)
            for machine in np.flatnonzero(self._drivers.payload_kg != carried).tolist():
                self._world.set_payload(machine, float(self._drivers.payload_kg[machine]))
        self._steps += 1
        commands = self._commands
        return self._world.advance(commands.steer_rad, commands.drive_n, commands.brake_n)

    def _change_ground(self) -> None:
        change = self._changes.pop(0)
        self.former_truth_maps.append((change.at_s, self.truth_map))
        self.terrain = with_zone(self.terrain, change.zone)
        self._world.set_terrain(self.terrain)


def build_world(
    name: str, terrain: Terrain, models: Sequence[MachineModel], bodies: Bodies, starts: Sequence[Start]
) -> World:
    """Create the world `pybullet` or `fast`, joints on their starts."""
    rear_m = np.array([model.rear_to_joint_m for model in models])
    heading = np.array([start.heading_rad for start in starts])
    joint = np.array([start.joint_m for start in starts])
    base = joint - rear_m[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    places: Floats = np.column_stack([base, heading])
    if name == "fast":
        return FastWorld(terrain, models, bodies, places)
    from sim.worlds.bullet import BulletWorld  # the fast world needs no PyBullet

    return BulletWorld(terrain, models, bodies, places)


def _track_rows(stamps_ns: Ints, states: FleetState, work_j: Floats, due: Bools) -> Table:
    rows = np.empty(states.x_m[due].shape, TRACK_DTYPE)
    rows["stamp_ns"] = stamps_ns[:, None]
    for name, field in TRACK_VALUES.items():
        rows[name] = getattr(states, field)[due]
    rows[WORK] = work_j[due]
    return rows
