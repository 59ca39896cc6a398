"""Days on a site: machine routes from repeated lanes to free driving."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lab.campaign.recordings import PlannedDrive, Setup, toml_of
from sim.operators.routes import Corners

OUTER: Corners = ((20, 16), (180, 16), (184, 130), (100, 134), (16, 130))
APART_M = 6.0  # between the two lanes of case `two`
FREE_CORNERS = 8  # of a machine's route on a day of free driving
ROUNDING_M = 8.0
CROSSED_RAD = (0.0, 0.7, 1.57, 2.4)  # angles of mutually crossing rectangles
CROSSED_M = (52.0, 18.0)  # half their sides


@dataclass(frozen=True)
class Site:
    """Four machines. base: scenario. model, preset, speed: of the machines. fixed: days repeat."""

    name: str
    base: str
    preset: str
    model: str = "wheel_loader"
    drive_mps: float = 4.0
    routes: tuple[str, ...] = ()


SITES = {
    site.name: site
    for site in (
        Site("driven", "paper_site_driven", "paper_shared", routes=("west", "east", "middle")),
        Site("loading", "loading", "dgps", routes=("west", "east", "middle", "yard")),
        Site("haul", "haul_road_driven", "dgps_shared", "dump_truck", 8.0, routes=("haul",)),
        Site("slopes", "haul_road_undulating", "dgps_shared", "dump_truck", 8.0, routes=("haul",)),
        Site("free", "paper_site_driven", "paper_shared"),
        Site("crossings", "paper_site_driven", "paper_shared"),
        Site("two", "paper_site_driven", "paper_shared"),
        Site("both", "paper_site_driven", "paper_shared"),
    )
}


@dataclass(frozen=True)
class Day(PlannedDrive):
    """A day of four machines on a site of SITES."""

    site: str = "driven"
    machines: int = 4

    @property
    def names(self) -> tuple[str, ...]:
        """Machine names."""
        return tuple(f"machine-{i + 1}" for i in range(self.machines))

    @property
    def scenario_toml(self) -> str:
        """Scenario file."""
        site = SITES[self.site]
        ways = _ways(self.site, self.seed)
        top: dict[str, Any] = {"base": site.base, "world": self.setup.world}
        fleet = {"name": "machine", "model": site.model, "count": self.machines, "preset": site.preset}
        fleet |= {"drive_mps": site.drive_mps, "gps": (1, 2), "imu": (3,)}
        fleet |= {"routes": site.routes or tuple(ways), "other_way": self.site == "both"}
        if ways:  # giving way is not under test
            top["give_way"] = False
        routes = [
            f"[[route]]\n{toml_of({'name': name, 'corners': corners, 'rounding_m': ROUNDING_M})}"
            for name, corners in ways.items()
        ]
        return "\n\n".join([toml_of(top), *routes, f"[[fleet]]\n{toml_of(fleet)}"]) + "\n"


def day(site: str, seed: int, seconds: float, world: str | None = "fast") -> Day:
    """A day on a site."""
    setup = replace(Setup(SITES[site].base, (), (), (), world=world), preset=SITES[site].preset)
    return Day(seed, seconds, SITES[site].preset, setup, site)


def _ways(site: str, seed: int) -> dict[str, Corners]:
    """Machine routes replacing the scenario's."""
    if site == "free":
        return free_ways(seed)
    if site == "crossings":
        return {f"cross-{i}": _rectangle(angle) for i, angle in enumerate(CROSSED_RAD)}
    if site == "two":
        return {"left": OUTER, "right": _within(OUTER, APART_M)}
    return {"outer": OUTER} if site == "both" else {}


def free_ways(seed: int) -> dict[str, Corners]:
    """Four routes that are never repeated."""
    draw = np.random.default_rng(seed)
    return {f"free-{i}": _free(draw) for i in range(4)}


def _within(corners: Corners, by_m: float) -> Corners:
    """A rectangle's corners, equally inset."""
    x, y = np.array(corners).T
    toward = np.stack([np.sign(x.mean() - x), np.sign(y.mean() - y)], axis=1)
    toward[np.abs(x - x.mean()) < 10, 0] = 0.0
    return tuple(map(tuple, (np.array(corners) + by_m * toward).tolist()))


def _rectangle(turned_rad: float) -> Corners:
    c, s = np.cos(turned_rad), np.sin(turned_rad)
    along, across = np.outer(CROSSED_M[0] * np.array([1, 1, -1, -1]), (c, s)), np.outer([-1, 1, 1, -1], (-s, c))
    return tuple(map(tuple, (np.array([100, 75]) + along + CROSSED_M[1] * across).round(1).tolist()))


def _free(draw: np.random.Generator) -> Corners:
    """Random closed route, in either direction."""
    turn = np.linspace(0, 2 * np.pi, FREE_CORNERS, endpoint=False) * draw.choice((-1, 1)) + draw.uniform(0, 2 * np.pi)
    middle, share = (draw.uniform(75, 125), draw.uniform(65, 85)), draw.uniform(0.6, 1.0, FREE_CORNERS)
    x, y = middle[0] + 55 * share * np.cos(turn), middle[1] + 47 * share * np.sin(turn)
    return tuple(zip(x.round(1).tolist(), y.round(1).tolist(), strict=True))
