"""What is driven: four tours of the paper's site, by one machine in turn or by up to eight at once.

All tours go the same way over one stretch, so that tours one after the other are one closed tour: a lone machine drives
those of all others without a detour, and what it needs longer is what others would have driven for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lab.campaign.recordings import PlannedDrive, Setup, toml_of
from protocol.arrays import Floats
from sim.operators.routes import Corners, Leg, Route, tour
from sim.scenario.file import load_scenario
from sim.scenario.ground import GroundConfig, Point
from sim.scenario.tables import ScheduledChange

SITE = "paper_site"
SHARED: Corners = ((96, 50), (96, 82))  # the stretch
# Corners beyond it, round to its begin: concrete and gravel, sand, the slope in dry ground, the slope in wet dirt.
TOURS: dict[str, Corners] = {
    "west": ((82, 88), (44, 84), (26, 66), (24, 30), (38, 15), (80, 16), (90, 28)),
    "north": ((98, 112), (84, 130), (40, 134), (18, 118), (20, 98), (34, 72), (56, 52), (82, 38)),
    "south": ((112, 88), (164, 82), (184, 66), (182, 38), (164, 20), (112, 16), (101, 28)),
    "east": ((102, 110), (118, 132), (166, 132), (186, 116), (182, 96), (168, 72), (138, 54), (110, 38)),
}
ROUNDING_M = 7.0
DRIVE_MPS = 4.0
# Ground that is repaved: around the shared stretch, and where one tour alone goes.
REPAVED: dict[str, tuple[Point, ...]] = {
    "shared": ((82, 46), (112, 46), (112, 84), (82, 84)),
    "west": ((14, 28), (36, 28), (36, 62), (14, 62)),
}
PAVED_WITH = {"shared": "dry concrete", "west": "gravel"}


@dataclass(frozen=True)
class Crew:
    """Machines of one model. tours: which they drive, in turn; each may be several, one after the other."""

    name: str
    count: int
    tours: tuple[tuple[str, ...], ...]
    model: str = "wheel_loader"


EACH = tuple((name,) for name in TOURS)
EIGHT = (Crew("loader", 8, EACH),)
TWO = (Crew("loader", 2, (("west", "north"), ("south", "east"))),)
ONE = (Crew("loader", 1, (tuple(TOURS),)),)
FOUR = (Crew("loader", 4, EACH),)
MIXED = (Crew("loader", 2, EACH[::2]), Crew("truck", 2, EACH[1::2], "dump_truck"))


@dataclass(frozen=True)
class SharedDrive(PlannedDrive):
    """Machines that start together. repaves: whether ground is repaved at half time."""

    crews: tuple[Crew, ...] = FOUR
    repaves: bool = False

    @property
    def scenario_toml(self) -> str:
        """The scenario file of this drive."""
        tours = dict.fromkeys(names for crew in self.crews for names in crew.tours)
        tables = [toml_of({"base": self.setup.scenario, "world": self.setup.world})]
        for names in tours:
            route = {"name": "-".join(names), "corners": corners(names), "rounding_m": ROUNDING_M}
            tables.append(f"[[route]]\n{toml_of(route)}")
        for crew in self.crews:
            routes = ["-".join(names) for names in crew.tours]
            fleet = {"name": crew.name, "count": crew.count, "model": crew.model, "routes": routes, "payload": False}
            tables.append(f"[[fleet]]\n{toml_of({**fleet, 'preset': self.preset, 'drive_mps': DRIVE_MPS})}")
        tables += [f"[[change]]\n{toml_of(vars(change))}" for change in self.changes.values()]
        return "\n\n".join(tables) + "\n"

    @property
    def changes(self) -> dict[str, ScheduledChange]:
        """The ground that is repaved, by its name."""
        if not self.repaves:
            return {}
        return {name: ScheduledChange(self.seconds / 2, PAVED_WITH[name], outline) for name, outline in REPAVED.items()}

    @property
    def machines(self) -> tuple[str, ...]:
        """Names of all, in the order in which the simulator numbers them."""
        return tuple(f"{crew.name}-{i + 1}" for crew in self.crews for i in range(crew.count))

    @property
    def tours(self) -> dict[str, tuple[str, ...]]:
        """What each machine drives, by its name."""
        turns = [crew.tours[i % len(crew.tours)] for crew in self.crews for i in range(crew.count)]
        return dict(zip(self.machines, turns, strict=True))

    @property
    def ground(self) -> GroundConfig:
        """The ground before anything is repaved."""
        return load_scenario(self.setup.scenario).ground


def planned(
    seed: int, seconds: float, crews: tuple[Crew, ...], world: str | None, *, repaves: bool = False
) -> SharedDrive:
    """A drive of the site with the sensors that its scenario has."""
    return SharedDrive(seed, seconds, "dgps", Setup(SITE, (), (), (), world=world), crews, repaves)


def corners(names: Sequence[str]) -> Corners:
    """Corners of tours one after the other; it begins far from the shared stretch, where no two would start."""
    whole = [point for name in names for point in (*SHARED, *TOURS[name])]
    begin = 2 + len(TOURS[names[0]]) // 2
    return (*whole[begin:], *whole[:begin])


def lines() -> dict[str, Leg]:
    """The line of each tour."""
    return {name: _leg(tour(corners((name,)), ROUNDING_M)) for name in TOURS}


def length_m(names: Sequence[str]) -> float:
    """Length of one round of tours one after the other."""
    return tour(corners(names), ROUNDING_M).length_m


def _leg(route: Route) -> Leg:
    (leg,) = route.legs
    return leg


def points(leg: Leg) -> Floats:
    """A closed line (k, 2) whose last point is its first."""
    return np.vstack([leg.points, leg.points[:1]])
