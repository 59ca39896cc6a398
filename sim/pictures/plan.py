"""The plan of a scenario, to scale: zones, heights, coming changes, routes with stops, machines."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from mapserver.pictures.frame import Axes, Colour, Image, LegendEntry, compose
from protocol.arrays import Floats
from protocol.site.geometry import Bounds
from protocol.site.ground_classes import ZONES
from sim.machines.model import MachineModel
from sim.operators.routes import Leg, Route
from sim.pictures.canvas import INK, Canvas, beside
from sim.scenario.ground import RampConfig, build_terrain, soil_index
from sim.scenario.tables import Scenario, ScheduledChange
from sim.state import FleetState
from sim.terrain.terrain import Terrain

WIDTH_PX, HEIGHT_PX = 1380, 900  # largest size of the ground
PALE = 0.6  # strength of the zone colours
LANE_PX = 4.0  # between routes on shared ground
MAX_NAMED = 12  # more machines are drawn as dots
MACHINE: Colour = (0, 200, 255)
CONTOUR_SHARE, CONTOUR_SCALE = 0.2, 0.45  # contours need this share of the steepest slope
ROOM_PX = np.array([12.0, 12.0])  # half the size of the room for an arrow or a number
Stop = tuple[Floats, str, Colour]  # place [px], event
# Dark, to stand out from pale ground and from each other.
ROUTE_COLOURS: tuple[Colour, ...] = (
    (130, 30, 10), (150, 0, 140), (10, 70, 150), (20, 20, 20), (10, 90, 10), (30, 10, 130), (110, 100, 0),
)  # fmt: skip


def draw_plan(scenario: Scenario, models: Sequence[MachineModel], start: FleetState) -> Image:
    """Draw the plan in a frame with axes in metres and a legend. start: state of the machines."""
    ground = scenario.ground
    terrain = build_terrain(replace(ground, roughness_m=0.0), 0)
    px_per_m = min(WIDTH_PX / ground.width_m, HEIGHT_PX / ground.depth_m)
    step_m = _contour_step_m(terrain)
    image = _paint(terrain, px_per_m, step_m)
    canvas = Canvas(image, np.zeros(image.shape[:2], np.uint8), px_per_m)
    colours = [ROUTE_COLOURS[i % len(ROUTE_COLOURS)] for i in range(len(scenario.route))]
    routes = [config.build() for config in scenario.route]
    both = {name for fleet in scenario.fleet if fleet.other_way for name in fleet.routes}

    for change in scenario.change:
        _hatch(canvas, change)
    lanes = [
        _draw_route(canvas, route, colour, i - (len(routes) - 1) / 2, both_ways=config.name in both)
        for i, (config, route, colour) in enumerate(zip(scenario.route, routes, colours, strict=True))
    ]
    stops = [_draw_stops(canvas, route, lane, c) for route, lane, c in zip(routes, lanes, colours, strict=True)]
    heads = _draw_machines(canvas, models, start)
    for ramp in ground.ramp:
        _draw_ramp(canvas, ramp, terrain, step_m)
    for at, words, colour in itertools.chain.from_iterable(stops):
        canvas.label(words, at, colour)
    _label_machines(canvas, scenario, heads)
    for change in scenario.change:
        _label_change(canvas, change)
    for config, lane, colour in zip(scenario.route, lanes, colours, strict=True):
        longest = max(lane, key=len)
        canvas.label(config.name, longest[len(longest) // 3], colour)

    soils = [LegendEntry(_pale(zone.bgr), f"{zone.name}  {zone.c_rr:g}") for zone in ZONES]
    lines = [
        LegendEntry(colour, f"{config.name} {route.length_m:.0f} m")
        for config, route, colour in zip(scenario.route, routes, colours, strict=True)
    ]
    axes = Axes(Bounds(0.0, 0.0, ground.width_m, ground.depth_m), px_per_m)
    return compose(image, axes, scenario.description, soils, lines, _notes(scenario, step_m))


def _notes(scenario: Scenario, step_m: float) -> list[str]:
    notes = [f"contours every {step_m:g} m"] if scenario.ground.ramp else []
    if any(leg.reverse for config in scenario.route for leg in config.leg):
        notes.append("dashed: in reverse")
    if scenario.change:
        notes.append("hatched: will change")
    return notes


# --- the ground ------------------------------------------------------------------------------------------------------


def _paint(terrain: Terrain, px_per_m: float, step_m: float) -> Image:
    rows, columns = (max(1, round((n - 1) * terrain.cell_m * px_per_m)) for n in terrain.heights_m.shape)
    x, y = np.meshgrid((np.arange(columns) + 0.5) / px_per_m, (np.arange(rows)[::-1] + 0.5) / px_per_m)
    palette = np.array([_pale(zone.bgr) for zone in ZONES], float)
    height, east, north = terrain.surface(x, y)
    slope = np.hypot(east, north)
    steep = slope > CONTOUR_SHARE * max(float(slope.max()), 1e-3)
    # Distance to the next contour [px]: height difference over gradient.
    above = np.abs(height - step_m * np.clip(np.rint(height / step_m), *_levels(height, step_m)))
    distance = np.where(steep, above / np.maximum(slope, 1e-9) * px_per_m, np.inf)
    line = 0.6 * np.clip(1.3 - distance, 0.0, 1.0)[..., None]
    image: Image = np.rint((1 - line) * palette[terrain.zone(x, y)] + line * INK).astype(np.uint8)
    return image


def _pale(colour: Colour) -> Colour:
    blue, green, red = (round(PALE * c + (1 - PALE) * 255) for c in colour)
    return blue, green, red


def _contour_step_m(terrain: Terrain) -> float:
    """A round step for few contours."""
    rise = float(np.ptp(terrain.heights_m))
    return next((step for step in (0.5, 1.0, 2.0, 5.0, 10.0) if rise <= 8 * step), 20.0)


def _levels(heights: Floats, step_m: float) -> tuple[int, int]:
    """Lowest and highest contour strictly inside the heights, in steps."""
    lowest, highest = float(heights.min()) / step_m, float(heights.max()) / step_m
    return math.floor(lowest + 1e-6) + 1, math.ceil(highest - 1e-6) - 1


def _draw_ramp(canvas: Canvas, ramp: RampConfig, terrain: Terrain, step_m: float) -> None:
    """Draw an arrow uphill with its angle, and contour heights, where the slope has most room."""
    lines = _across(canvas, ramp, terrain)
    arrows = [canvas.pixels(np.linspace(line[0], line[-1], 9))[1:-1] for line in lines]
    if (best := _freest(canvas, arrows)) is not None:
        arrow = arrows[best]
        ahead = arrow if ramp.rise_m > 0 else arrow[::-1]
        canvas.line(ahead[[0, -1]], INK)
        canvas.head(ahead[-1], ahead[-1] - ahead[0], INK, 8.0)
        angle = math.degrees(math.atan2(abs(ramp.rise_m), float(np.hypot(*ramp.run_m))))
        canvas.label(f"{angle:.0f} deg uphill", arrow[len(arrow) // 2], INK)
    crossed = [_crossings(line, terrain, step_m) for line in lines]
    rows = [canvas.pixels(points) for points, _ in crossed]
    if (best := _freest(canvas, rows)) is not None:
        for place, level in zip(rows[best], crossed[best][1], strict=True):
            canvas.write(f"{level:g}", place, CONTOUR_SCALE)


def _crossings(line: Floats, terrain: Terrain, step_m: float) -> tuple[Floats, Floats]:
    """Contour crossings of a line (k, 2) along a slope: points (m, 2), heights (m,)."""
    heights = terrain.height(line[:, 0], line[:, 1])
    order = np.argsort(heights)
    lowest, highest = _levels(heights, step_m)
    levels: Floats = step_m * np.arange(lowest, highest + 1, dtype=float)
    points = [np.interp(levels, heights[order], line[order, k]) for k in (0, 1)]
    return np.stack(points, axis=1), levels


def _freest(canvas: Canvas, rows: Sequence[Floats]) -> int | None:
    """Index of the row of places (k, 2) [px] that hides least; None if all leave the picture or cover words."""
    costs = [sum(canvas.cost(place, ROOM_PX) for place in row) for row in rows]
    best = int(np.argmin(costs)) if costs else 0
    return best if costs and math.isfinite(costs[best]) else None


def _across(canvas: Canvas, ramp: RampConfig, terrain: Terrain) -> list[Floats]:
    """Lines (k, 2) from foot to top inside the picture, middle first."""
    size = np.array([(n - 1) * terrain.cell_m for n in reversed(terrain.heights_m.shape)])
    side = np.array([-ramp.run_m[1], ramp.run_m[0]]) / np.hypot(*ramp.run_m)
    line = np.array(ramp.foot_m) + np.linspace(0.0, 1.0, 60)[:, None] * ramp.run_m
    reach = float(np.hypot(*size))
    moved = [line + shift * side for shift in np.arange(-reach, reach, 10.0 / canvas.px_per_m)]
    inside = [m for m in moved if (m >= 0).all() and (m <= size).all()]
    return sorted(inside, key=lambda m: float(np.hypot(*(m.mean(axis=0) - size / 2))))


def _hatch(canvas: Canvas, change: ScheduledChange) -> None:
    """Hatch ground that will change in its later colour, with an outline."""
    outline = canvas.pixels(np.array(change.outline))
    inside = np.zeros(canvas.busy.shape, np.uint8)
    cv2.fillPoly(inside, [np.rint(outline).astype(np.int32)], 1)
    rows, columns = np.indices(inside.shape)
    stripes = (inside > 0) & ((rows + columns) % 18 < 8)
    canvas.image[stripes] = _pale(ZONES[soil_index(change.soil)].bgr)
    canvas.line(outline, INK, closed=True, dashed=True, thick=1)


def _label_change(canvas: Canvas, change: ScheduledChange) -> None:
    words = f"after {change.at_s:g} s: {change.soil}"
    canvas.label(words, canvas.pixels(np.array(change.outline)).mean(axis=0), INK)


# --- routes and machines ---------------------------------------------------------------------------------------------


def _draw_route(canvas: Canvas, route: Route, colour: Colour, lane: float, *, both_ways: bool) -> list[Floats]:
    """Draw the legs, each shifted to its right, so that both directions stay apart; returns their pixels."""
    lines = []
    for leg in route.legs:
        shift = LANE_PX * (lane if leg.closed else 1.0)
        px = canvas.pixels(leg.points)
        px = beside(np.vstack([px, px[:1]]) if leg.closed else px, shift)
        canvas.line(px, colour, dashed=leg.reverse)
        lines.append(px)
    for px in lines:
        canvas.arrows(px, colour, both_ways=both_ways)
    return lines


def _draw_stops(canvas: Canvas, route: Route, lane: Sequence[Floats], colour: Colour) -> list[Stop]:
    stops = [(px[-1], words, colour) for px, words in zip(lane, stops_of(route.legs), strict=True) if words]
    for at, _, _ in stops:
        canvas.dot(at, colour, 5.0)
    return stops


def stops_of(legs: Sequence[Leg]) -> list[str]:
    """The event at the end of each leg in words; empty at most changes of direction."""
    known = [leg.payload_kg for leg in legs if leg.payload_kg is not None]
    carried = known[-1] if known else 0.0
    words = []
    for leg in legs:
        after = carried if leg.payload_kg is None else leg.payload_kg
        moved = f"{abs(after - carried) / 1000:g} t"
        what = f"loads {moved}" if after > carried else f"dumps {moved}" if after < carried else ""
        waits = f"{leg.wait_s:g} s" if leg.wait_s else ""
        words.append(f"{what} in {waits}" if what and waits else what or (f"waits {waits}" if waits else ""))
        carried = after
    return words


def _draw_machines(canvas: Canvas, models: Sequence[MachineModel], start: FleetState) -> Floats:
    """Draw arrow heads at the joints, or dots if there are many; returns the places (n, 2) [px]."""
    ahead = np.stack([np.cos(start.yaw_rad), np.sin(start.yaw_rad)], axis=1)
    rear_m = np.array([model.rear_to_joint_m for model in models])
    places = canvas.pixels(np.stack([start.x_m, start.y_m], axis=1) + rear_m[:, None] * ahead)
    few = len(models) <= MAX_NAMED
    for at, direction in zip(places, ahead * [1, -1], strict=True):
        if few:
            canvas.head(at, direction, MACHINE, 13.0, edge=INK)
        else:
            canvas.dot(at, MACHINE, 3.5)
    return places


def _label_machines(canvas: Canvas, scenario: Scenario, places: Floats) -> None:
    """Name all machines if they are few, else the faulty ones."""
    faulty = {fault.machine for fault in scenario.fault}
    for name, at in zip(scenario.machine_names, places, strict=True):
        if len(places) <= MAX_NAMED or name in faulty:
            canvas.label(f"{name}, faulty" if name in faulty else name, at, INK)
