"""Scenario files: read with their base; inconsistencies are refused in one line."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from protocol.config import from_table
from protocol.errors import ConfigError
from protocol.files import load_toml
from protocol.rotations import wrap_angle
from sim.machines.model import MachineModel, load_model
from sim.operators.driver import bend
from sim.operators.routes import Leg, Route
from sim.scenario.tables import FleetConfig, Scenario
from sim.sensors.presets import parse_preset
from sim.sensors.rigs import machine_config

FOLDER = Path(__file__).parent
MARGIN_M = 3.0  # from a route to the edges of the map
STEERING_SHARE = 0.9  # of a machine's steering that a route may need; the rest is for corrections
MAX_GAP_M, MAX_BEND_DEG = 0.5, 10.0  # between the end of a leg and the start of the next


def load_scenario(name: str) -> Scenario:
    """Read a scenario by library name or TOML path; ConfigError names the place of a fault."""
    path = Path(name) if name.endswith(".toml") else FOLDER / f"{name}.toml"
    if not name.endswith(".toml") and not path.is_file():
        known = ", ".join(sorted(p.stem for p in FOLDER.glob("*.toml")))
        raise ConfigError("scenario", f"there is no {name!r}; known: {known}, or the path of a .toml file")
    table, where = _load(path, ()), str(path) if name.endswith(".toml") else f"scenario {name}"
    listed = _tables(table.pop("preset", []), f"{where} [[preset]]")
    presets = [parse_preset(t, f"{where} [[preset]] {i + 1}") for i, t in enumerate(listed)]
    scenario = from_table(Scenario, table, where)
    scenario = replace(scenario, presets={preset.name: preset for preset in presets})
    check(scenario, where)
    return scenario


def check(scenario: Scenario, where: str) -> None:
    """Refuse inconsistencies with a ConfigError that names the place."""
    routes = {route.name: route.build() for route in scenario.route}
    margin_m = MARGIN_M + scenario.driving.widest_m
    for name, route in routes.items():
        place = f'{where} [[route]] "{name}"'
        _check_joints(route, place)
        points = np.vstack([leg.points for leg in route.legs])
        outside = points[~scenario.ground.contains(points, margin_m)]
        if len(outside):
            x, y = outside[0]
            size = f"{scenario.ground.width_m:g} x {scenario.ground.depth_m:g} m"
            raise ConfigError(place, f"leaves the map at ({x:.0f}, {y:.0f}): keep {margin_m:g} m inside its {size}")
    for fleet in scenario.fleet:
        place = f'{where} [[fleet]] "{fleet.name}"'
        try:
            _check_fleet(scenario, fleet, routes)
        except (ValueError, ConfigError) as error:
            raise ConfigError(place, str(error)) from None


def _check_fleet(scenario: Scenario, fleet: FleetConfig, routes: Mapping[str, Route]) -> None:
    model = load_model(fleet.model)
    machine_config(fleet.name, model, scenario.preset(fleet.preset), fleet.gps, fleet.imu, fleet.attitude)
    for name in fleet.routes:
        if name not in routes:
            raise ValueError(f"routes: there is no {name!r}; there are {', '.join(routes)}")
        if fleet.other_way and not routes[name].legs[0].closed:
            raise ValueError(f"other_way: route {name!r} is no closed loop")
        for leg in routes[name].legs:
            _check_curvature(leg, model, name)
            if leg.payload_kg is not None and not 0 <= leg.payload_kg <= model.payload_kg:
                problem = f"{leg.payload_kg:g} kg is more than a {model.name} carries, {model.payload_kg:g} kg"
                raise ValueError(f"route {name!r} payload_kg: {problem}")


def _check_curvature(leg: Leg, model: MachineModel, route: str) -> None:
    curvature = np.abs(leg.curvature())
    rear, front = np.array(model.rear_to_joint_m), np.array(model.front_to_joint_m)
    radii = np.arange(1.0, 30.0, 0.05)
    can = radii[bend(rear, front, 1 / radii) <= STEERING_SHARE * model.max_articulation_rad][0]
    if curvature.max() * can > 1:
        x, y = leg.points[curvature.argmax()]
        problem = f"the curve at ({x:.0f}, {y:.0f}) has a radius of {1 / curvature.max():.1f} m"
        raise ValueError(f"route {route!r}: {problem}; a {model.name} needs {can:.1f} m: move corners apart")


def _check_joints(route: Route, place: str) -> None:
    """Legs of a cycle must meet, with the machine's heading unchanged."""
    if route.legs[0].closed:
        return
    for i, leg in enumerate(route.legs):
        after = route.legs[(i + 1) % len(route.legs)]
        gap = float(np.hypot(*(after.points[0] - leg.points[-1])))
        if gap > MAX_GAP_M:
            raise ConfigError(place, f"leg {i + 1} ends {gap:.1f} m from where the next begins")
        turn = after.headings()[0] - leg.headings()[1] + math.pi * (after.reverse != leg.reverse)
        bent = abs(math.degrees(wrap_angle(turn)))
        if bent > MAX_BEND_DEG:
            what = "turn around" if after.reverse == leg.reverse else "reverse"
            raise ConfigError(place, f"after leg {i + 1} machines would have to {what} with a bend of {bent:.0f} deg")


def _load(path: Path, seen: tuple[Path, ...]) -> dict[str, Any]:
    """A TOML file over its base, key by key, also within tables."""
    if path in seen:
        raise ConfigError(path, "is its own base")
    table = load_toml(path)
    base = table.pop("base", None)
    if base is None:
        return table
    if not isinstance(base, str):
        raise ConfigError(path, "base: the name of a scenario, or the path of a .toml file")
    below = path.parent / base if base.endswith(".toml") else FOLDER / f"{base}.toml"
    known = _load(below, (*seen, path))
    mine = {key: {**known.get(key, {}), **value} if isinstance(value, dict) else value for key, value in table.items()}
    return {**known, **mine}


def _tables(value: Any, where: str) -> list[dict[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(t, dict) for t in value):
        raise ConfigError(where, "tables are expected")
    return value
