"""Recordings of fleets on roads with random soil patches, some repaired at half time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from lab.calibration.drives import Agent, FleetDrive
from lab.campaign.recordings import Setup, toml_of
from protocol.arrays import Floats
from sim.scenario.file import load_scenario
from sim.scenario.ground import ZoneConfig

SOILS = ("dry concrete", "gravel", "dry dirt", "wet dirt", "sand")
SHARES = (0.1, 0.15, 0.35, 0.25, 0.15)  # of the patches
LENGTH_M, GAP_M = (8.0, 60.0), (0.0, 50.0)  # of a patch along the route, and to the next
HALF_WIDTH_M = 14.0
CORNER_M = 4.0  # between corners of an outline
# Repairable soils, and their repair: c_rr falls by factors of 2 and 3.
BAD, REPAIRED = ("dry dirt", "wet dirt"), "gravel"
REPAIRS = 0.5  # share of the bad patches


@dataclass(frozen=True)
class RoadDrive(FleetDrive):
    """A scenario's machines on soil patches drawn from the seed. repairs: some change at half time."""

    repairs: bool = False

    @property
    def scenario_toml(self) -> str:
        """Scenario file."""
        ground = load_scenario(self.setup.scenario).ground
        patches, repaired = self._patches()
        table = {**asdict(ground), "zone": [asdict(zone) for zone in (*ground.zone, *patches)]}
        changes = [{"at_s": self.seconds / 2, **asdict(zone)} for zone in repaired]
        top = {"base": self.setup.scenario, "ground": table} | ({"change": changes} if changes else {})
        return "\n".join(f"{name} = {inline(value)}" for name, value in top.items()) + "\n"

    def agent(self, index: int) -> Agent:
        """A machine's agent."""
        return Agent(index, closed_tours=True)

    def _patches(self) -> tuple[list[ZoneConfig], list[ZoneConfig]]:
        """Patches along all routes, and repaired ones in their later state."""
        draw = np.random.default_rng([self.seed, 21])
        patches: list[ZoneConfig] = []
        for route in load_scenario(self.setup.scenario).route:
            for leg in route.build().legs:
                patches += _along(leg.points, leg.spacing_m, draw)
        repaired = [
            ZoneConfig(REPAIRED, patch.outline)
            for patch, drawn in zip(patches, draw.random(len(patches)), strict=True)
            if self.repairs and patch.soil in BAD and drawn < REPAIRS
        ]
        return patches, repaired


def planned(scenario: str, seed: int, seconds: float, *, repairs: bool = False) -> RoadDrive:
    """Drive of a scenario with its own sensors."""
    preset = load_scenario(scenario).fleet[0].preset
    return RoadDrive(seed, seconds, preset, Setup(scenario, (), (), ()), repairs=repairs)


def _along(points: Floats, spacing_m: float, draw: np.random.Generator) -> list[ZoneConfig]:
    """Consecutive patches across a line."""
    out, at_m, end_m = [], draw.uniform(*GAP_M), (len(points) - 1) * spacing_m
    while at_m < end_m:
        length_m = draw.uniform(*LENGTH_M)
        soil = SOILS[int(draw.choice(len(SOILS), p=SHARES))]
        stretch = points[int(at_m / spacing_m) : int(min(at_m + length_m, end_m) / spacing_m) + 1]
        if len(stretch) * spacing_m > 2 * CORNER_M:
            out.append(ZoneConfig(soil, _outline(stretch[:: int(CORNER_M / spacing_m)])))
        at_m += length_m + draw.uniform(*GAP_M)
    return out


def _outline(line: Floats) -> tuple[tuple[float, float], ...]:
    """A band around a line."""
    along = np.gradient(line, axis=0)
    left = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.hypot(*along.T)[:, None] * HALF_WIDTH_M
    corners = np.concatenate([line + left, (line - left)[::-1]]).round(2)
    return tuple((x, y) for x, y in corners.tolist())


def inline(value: object) -> str:
    """A plain value as inline TOML."""
    if isinstance(value, dict):
        inner = ", ".join(f"{name} = {inline(part)}" for name, part in value.items() if part is not None)
        return f"{{ {inner} }}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return f"[{', '.join(map(inline, value))}]"
    return toml_of({"value": value}).removeprefix("value = ")
