"""The simulator: a world, the sensors of its machines and their truth, one bundle of readings at a time."""

from __future__ import annotations

import numpy as np

from protocol.arrays import Bools, Ints, Table
from protocol.machine import MachineConfig
from protocol.readings import Reading
from protocol.site import Projection, SiteConfig
from sim import paper_site
from sim.config import STEP_MS, SimConfig
from sim.fleet import Fleet
from sim.machines import loader
from sim.noise import generators
from sim.sensors import (
    ArticulationNoise,
    ArticulationSensor,
    GpsNoise,
    GpsReceiver,
    ImuNoise,
    InertialUnit,
    Sensor,
    TorqueMeter,
    TorqueNoise,
    WheelEncoder,
    sample_all,
)
from sim.truth import TRACK_DTYPE, TRACK_EVERY, TRACK_VALUES, TruthMap, truth_map
from sim.vehicle import Bodies
from sim.world import FleetState, World, machine_states, stack

STEP_NS = STEP_MS * 1_000_000
MASS_SPREAD = 0.03  # a real machine is up to this much lighter or heavier than its nominal
RADIUS_ERROR = 0.015


class Simulator:
    """Simulates the machines of one site; the same config gives the same readings, bit for bit.

    site, machines: what agents may know. truth_map, tracks(): what only an evaluation may see.
    """

    def __init__(self, config: SimConfig) -> None:
        self.config = config
        self.site: SiteConfig = paper_site.site(config.site)
        self.machines: tuple[MachineConfig, ...] = tuple(
            loader(name, config.gps, config.imus) for name in config.machine_names
        )
        terrain = paper_site.terrain(config.seed, config.roughness_m)
        self.truth_map: TruthMap = truth_map(terrain, paper_site.WIDTH_M, paper_site.DEPTH_M)
        streams = [generators(config.seed, i) for i in range(config.machines)]
        bodies = draw_bodies(self.machines, [s["body"] for s in streams])
        routes = [paper_site.route_of(i) for i in range(config.machines)]
        self._world: World = Fleet(terrain, bodies, routes, config.drive_mps)
        projection = Projection(self.site)
        self._sensors = [
            build_sensors(machine, config, projection, stream)
            for machine, stream in zip(self.machines, streams, strict=True)
        ]
        self._steps = 0
        self._tracks: list[Table] = []

    @property
    def simulated_s(self) -> float:
        """Simulated time since the start."""
        return self._steps * STEP_MS / 1000

    def advance(self) -> dict[str, list[Reading]]:
        """Simulate the span of one bundle; returns the readings of each machine in the order of their stamps."""
        count = self.config.bundle_ms // STEP_MS
        states = stack([self._world.step() for _ in range(count)])
        steps = np.arange(self._steps + 1, self._steps + count + 1)
        stamps_ns = self.config.start_ns + steps * STEP_NS
        self._steps += count
        due = steps % TRACK_EVERY == 0
        if due.any():
            self._tracks.append(_track_rows(stamps_ns[due], states, due))
        return {
            machine.name: sample_all(sensors, steps, stamps_ns, machine_states(states, i))
            for i, (machine, sensors) in enumerate(zip(self.machines, self._sensors, strict=True))
        }

    def tracks(self) -> dict[str, Table]:
        """True way of each machine so far: rows of `truth.TRACK_DTYPE` at 10 Hz."""
        empty = np.empty((0, len(self.machines)), TRACK_DTYPE)
        rows = np.concatenate([empty, *self._tracks])
        return {machine.name: rows[:, i].copy() for i, machine in enumerate(self.machines)}


def draw_bodies(machines: tuple[MachineConfig, ...], rngs: list[np.random.Generator]) -> Bodies:
    """Draw the true bodies of machines around their nominal ones."""
    mass = [m.mass_kg * (1 + MASS_SPREAD * rng.uniform(-1, 1)) for m, rng in zip(machines, rngs, strict=True)]
    radius = [
        m.wheel_radius_m * (1 + RADIUS_ERROR * rng.standard_normal()) for m, rng in zip(machines, rngs, strict=True)
    ]
    return Bodies(np.array(mass), np.array(radius))


def build_sensors(
    machine: MachineConfig, config: SimConfig, projection: Projection, rngs: dict[str, np.random.Generator]
) -> list[Sensor]:
    """Build the sensors that a machine's config names."""
    turn_s = config.outage_period_s / max(config.gps, 1)  # receivers of one machine fail in turn ...
    first_s = config.outage_period_s * rngs["outage"].uniform()  # ... and machines independently of each other
    sensors: list[Sensor] = []
    receivers = 0
    for sensor in machine.sensors:
        rng = rngs[sensor.name]
        if sensor.kind == "gps":
            noise = _gps_noise(config, first_s + receivers * turn_s)
            sensors.append(GpsReceiver(sensor, noise, projection, rng))
            receivers += 1
        elif sensor.kind == "imu":
            sensors.append(InertialUnit(sensor, ImuNoise(), rng))
        elif sensor.kind == "encoder":
            sensors.append(WheelEncoder(sensor))
        elif sensor.kind == "torque":
            sensors.append(TorqueMeter(sensor, TorqueNoise(), rng))
        else:
            sensors.append(ArticulationSensor(sensor, ArticulationNoise(), rng))
    return sensors


def _gps_noise(config: SimConfig, phase_s: float) -> GpsNoise:
    return GpsNoise(
        drift_std_m=config.gps_drift_std_m,
        drift_time_s=config.gps_drift_time_s,
        white_std_m=config.gps_white_std_m,
        outage_s=config.outage_s,
        outage_period_s=config.outage_period_s,
        phase_s=phase_s,
    )


def _track_rows(stamps_ns: Ints, states: FleetState, due: Bools) -> Table:
    rows = np.empty(states.x_m[due].shape, TRACK_DTYPE)
    rows["stamp_ns"] = stamps_ns[:, None]
    values = (states.x_m, states.y_m, states.yaw_rad, states.speed_mps, states.c_rr, states.grade_e, states.grade_n)
    for name, value in zip(TRACK_VALUES, values, strict=True):
        rows[name] = value[due]
    return rows
