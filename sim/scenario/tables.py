"""Tables of a scenario's TOML file."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from protocol.config import require_between
from protocol.site.site_config import NAME, SiteConfig
from sim.machines.model import load_model
from sim.operators.habits import DrivingConfig
from sim.operators.routes import ROUNDING_M, Leg, Route, open_leg, tour
from sim.scenario.ground import GroundConfig, Point, ZoneConfig
from sim.sensors.presets import Preset, load_preset
from sim.sensors.rigs import Faults, Rig, machine_config

WORLDS = ("pybullet", "fast")
MAX_MACHINES = 1000
GOLDEN = 0.618  # spreads any number of machines over a route


@dataclass(frozen=True)
class LegConfig:
    """One leg of a work cycle: corners [m], direction, and the event at its end."""

    corners: tuple[Point, ...]
    reverse: bool = False
    rounding_m: float = ROUNDING_M
    wait_s: float = 0.0
    payload_kg: float | None = None

    def __post_init__(self) -> None:
        _check_line(self.corners, self.rounding_m, 2)
        require_between(self, 0, 86400, "wait_s")


@dataclass(frozen=True)
class RouteConfig:
    """Route: `corners` of a closed loop, or a repeated chain of `leg`s."""

    name: str
    corners: tuple[Point, ...] = ()
    rounding_m: float = ROUNDING_M
    leg: tuple[LegConfig, ...] = ()

    def __post_init__(self) -> None:
        if bool(self.corners) == bool(self.leg):
            raise ValueError("either corners or legs are needed, not both")
        if self.corners:
            _check_line(self.corners, self.rounding_m, 3)

    def build(self) -> Route:
        """The lines to drive."""
        if self.corners:
            return tour(self.corners, self.rounding_m)
        return Route(tuple(_leg(leg) for leg in self.leg))


@dataclass(frozen=True)
class FleetConfig:
    """Machines of one kind. name: of a single machine; with count: name-1, name-2, ...

    routes: assigned in turn; other_way: every second round in the opposite direction. start: share of the cycle where
    the first begins. gps, imu, attitude: sensor numbers in the URDF. payload: whether it is weighed; None: if a route
    changes it. doppler: whether receivers state velocities. can: J1939 drive train in place of wheel sensors.
    """

    name: str
    routes: tuple[str, ...]
    count: int | None = None
    model: str = "wheel_loader"
    preset: str = "dgps"
    drive_mps: float = 4.0
    start: float = 0.0
    other_way: bool = False
    gps: tuple[int, ...] = (1, 2)
    imu: tuple[int, ...] = (3,)
    attitude: tuple[int, ...] = ()
    payload: bool | None = None
    doppler: bool = False
    can: bool = False

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise ValueError(f"name: {self.name!r} is not a name (lower-case letters, digits, - and _)")
        if not self.routes:
            raise ValueError("routes: none is named")
        require_between(self, 1, MAX_MACHINES, "count")
        require_between(self, 0.5, 12, "drive_mps")
        require_between(self, 0, 1, "start")

    @property
    def size(self) -> int:
        """Number of machines."""
        return 1 if self.count is None else self.count

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the machines."""
        return (self.name,) if self.count is None else tuple(f"{self.name}-{i + 1}" for i in range(self.count))


@dataclass(frozen=True)
class FaultConfig(Faults):
    """Faults of one machine."""

    machine: str = ""


@dataclass(frozen=True)
class ScheduledChange:
    """Ground that becomes another soil. at_s: simulated seconds after the start."""

    at_s: float
    soil: str
    outline: tuple[Point, ...]

    def __post_init__(self) -> None:
        if not self.at_s > 0:
            raise ValueError(f"at_s: {self.at_s!r} is not positive")
        self.zone  # noqa: B018 - checks soil and outline

    @property
    def zone(self) -> ZoneConfig:
        """The new ground."""
        return ZoneConfig(self.soil, self.outline)


@dataclass(frozen=True)
class Scenario:
    """A simulation. world: pybullet, or fast. give_way: drivers wait for machines ahead. driving: their habits."""

    description: str
    site: SiteConfig
    ground: GroundConfig
    route: tuple[RouteConfig, ...]
    fleet: tuple[FleetConfig, ...]
    world: str = "pybullet"
    seed: int = 0
    seconds: float = 120.0
    give_way: bool = True
    driving: DrivingConfig = field(default_factory=DrivingConfig)
    fault: tuple[FaultConfig, ...] = ()
    change: tuple[ScheduledChange, ...] = ()
    presets: Mapping[str, Preset] = field(default_factory=dict)
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.world not in WORLDS:
            raise ValueError(f"world: {self.world!r} is neither {' nor '.join(WORLDS)}")
        if not (0 <= self.seed < 2**63 and 0 <= self.seconds <= 1e7):
            raise ValueError("seed, seconds: negative, or too large")
        _check_once("route", [route.name for route in self.route])
        if sum(fleet.size for fleet in self.fleet) > MAX_MACHINES:
            raise ValueError(f"fleet: more than {MAX_MACHINES} machines")
        machines = self.machine_names
        _check_once("machine", machines)
        if unknown := next((f.machine for f in self.fault if f.machine not in machines), None):
            raise ValueError(f"fault: there is no machine {unknown!r}; there are {_few(machines)}")

    @property
    def machine_names(self) -> tuple[str, ...]:
        """Names of all machines."""
        return self.names or tuple(name for fleet in self.fleet for name in fleet.names)

    def preset(self, name: str) -> Preset:
        """Preset of this scenario or of the library."""
        return self.presets[name] if name in self.presets else load_preset(name)

    def rigs(self) -> list[Rig]:
        """Sensors of every machine."""
        rigs: list[Rig] = []
        faults = {f.machine: f for f in self.fault}
        fleets = [fleet for fleet in self.fleet for _ in range(fleet.size)]
        for fleet, name in zip(fleets, self.machine_names, strict=True):
            model, preset = load_model(fleet.model), self.preset(fleet.preset)
            payload = self._loads(fleet) if fleet.payload is None else fleet.payload
            sensors = fleet.gps, fleet.imu, fleet.attitude
            config = machine_config(
                name, model, preset, *sensors, payload=payload, doppler=fleet.doppler, can=fleet.can
            )
            if model.skid_grip and self.world != "fast":
                raise ValueError(f'fleet: {fleet.name}: machines that skid-steer need world = "fast"')
            rigs.append(Rig(config, model, preset, faults.get(name, Faults()), fleet.can))
        return rigs

    def journeys(self) -> list[tuple[Route, float, float]]:
        """Route, speed [m/s] and starting share of the cycle per machine."""
        built = {route.name: route.build() for route in self.route}
        journeys = []
        for fleet in self.fleet:
            for i in range(fleet.size):
                turn, lap = i % len(fleet.routes), i // len(fleet.routes)
                route = built[fleet.routes[turn]]
                if fleet.other_way and lap % 2:
                    route = route.reversed()
                journeys.append((route, fleet.drive_mps, (fleet.start + lap * GOLDEN) % 1.0))
        return journeys

    def _loads(self, fleet: FleetConfig) -> bool:
        legs = itertools.chain.from_iterable(route.leg for route in self.route if route.name in fleet.routes)
        return any(leg.payload_kg is not None for leg in legs)


def _check_line(corners: Sequence[Point], rounding_m: float, least: int) -> None:
    if len(corners) < least:
        raise ValueError(f"corners: {len(corners)} are too few, at least {least} are needed")
    if not all(map(math.isfinite, itertools.chain.from_iterable(corners))):
        raise ValueError("corners: not a number")
    steps = np.hypot(*np.diff(np.array(corners), axis=0).T)
    if not steps.min() > 1:
        raise ValueError("corners: two neighbours are less than 1 m apart")
    if not 0.1 <= rounding_m <= 100:
        raise ValueError(f"rounding_m: {rounding_m!r} is not between 0.1 and 100")


def _check_once(what: str, names: Sequence[str]) -> None:
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"two {what}s are named {twice[0]!r}")


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")


def _leg(config: LegConfig) -> Leg:
    line = open_leg(config.corners, config.rounding_m)
    return replace(line, reverse=config.reverse, wait_s=config.wait_s, payload_kg=config.payload_kg)
