"""Lane maps by the map server's fold and layer, some harmful: displaced or unrepeated lanes, ground shaped anew."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from agents.localisation.lanes.lane_map import LaneMap
from agents.sampling import EVERY_M
from lab.fedback.days import SITES, free_ways
from lab.fedback.rerun import Maps
from mapserver.config import ServerConfig
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.query.views import read_lanes, view_of
from protocol.arrays import Floats, Table
from protocol.machine.samples import empty
from protocol.site.geometry import CellWindow
from protocol.units import DAY_NS
from sim.operators.routes import tour

Rows = Sequence[tuple[str, Table]]  # samples by machine
MapsOf = Callable[[str], Maps]  # of a machine


def lane_map(rows: Iterable[tuple[str, Table]]) -> LaneMap:
    """The server's lanes from samples."""
    grid, config = Grid(1.0, FoldConfig()), ServerConfig()
    for name, table in rows:
        grid.fold(table, name)
    west, south, east, north = grid.bounds() or (0, 0, 1, 1)
    view = view_of(grid, CellWindow(west, south, east - west, north - south), config)
    answer = read_lanes(view, None, None, 1.0, config)
    return LaneMap(1.0, {(tile.x, tile.y): tile for tile in answer.tiles})


def moved(rows: Rows, left_m: float = 0.0, east_m: float = 0.0, from_x_m: float = -1e9) -> Rows:
    """Samples shifted left of the heading, and east; left only beyond from_x_m, fading in over 10 m."""
    out = []
    for name, table in rows:
        table, heading = table.copy(), table["heading_rad"].astype(float)
        share = np.clip((table["x_m"] - from_x_m) / 10, 0, 1) * left_m
        table["x_m"], table["y_m"] = (
            table["x_m"] - share * np.sin(heading) + east_m,
            table["y_m"] + share * np.cos(heading),
        )
        out.append((name, table))
    return out


def turned(rows: Rows) -> Rows:
    """The same routes in the opposite direction, by others."""
    out = []
    for name, table in rows:
        table = table.copy()
        table["heading_rad"] = (table["heading_rad"] + 2 * np.pi) % (2 * np.pi) - np.pi
        out.append((f"{name}-back", table))
    return out


def reshaped(rows: Rows, by_m: float = 100.0) -> Rows:
    """Slopes of places by_m further along each machine's way: other ground, as rough; NaN: none, so lanes alone."""
    out = []
    for name, table in rows:
        table = table.copy()
        for column in ("grade_e", "grade_n"):
            table[column] = np.roll(table[column], round(by_m / EVERY_M)) if np.isfinite(by_m) else np.nan
        out.append((name, table))
    return out


def days_ago(rows: Rows, days: int) -> Rows:
    """An earlier day's: all recordings start at one stamp."""
    out = []
    for name, table in rows:
        table = table.copy()
        table["stamp_ns"] -= days * DAY_NS
        out.append((name, table))
    return out


def renamed(rows: Rows, ending: str) -> Rows:
    """The same by other machines."""
    return [(f"{name}{ending}", table) for name, table in rows]


def along(lines: Iterable[Floats], stamp_ns: int, draw: np.random.Generator, spacing_m: float = 0.5) -> Rows:
    """Samples spacing_m apart on lines (k, 2), a machine each, with slow 1 m errors."""
    out = []
    for number, line in enumerate(lines):
        rows = empty(len(line))
        step = np.gradient(line, axis=0)
        rows["heading_rad"], rows["distance_m"] = np.arctan2(step[:, 1], step[:, 0]), spacing_m
        rows["stamp_ns"] = stamp_ns + np.arange(len(line)) * 125_000_000
        error = np.cumsum(draw.normal(0, 0.05, (len(line), 2)), axis=0) + draw.normal(0, 0.8, 2)
        rows["x_m"], rows["y_m"] = (line + error).T
        rows["cov_xx_m2"] = rows["cov_yy_m2"] = 1.0
        for name in ("c_rr", "c_rr_var", "grade_e", "grade_n", "grade_var"):
            rows[name] = np.nan
        out.append((f"other-{number}", rows))
    return out


def crossing(count: int, draw: np.random.Generator) -> list[Floats]:
    """Straight lines across the site."""
    lines = []
    for _ in range(count):
        middle, angle = draw.uniform((40, 30), (160, 120)), draw.uniform(0, 2 * np.pi)
        lines.append(middle + np.arange(-60, 60, 0.5)[:, None] * (np.cos(angle), np.sin(angle)))
    return lines


def free(seed: int, laps: int = 2) -> list[Floats]:
    """Lines of a day of free driving."""
    ways = (tour(corners, 8.0).legs[0] for corners in free_ways(seed).values())
    return [np.tile(leg.points, (laps, 1)) for leg in ways]


@dataclass(frozen=True)
class Scene:
    """Input of maps, by machine. rows: another day; own: the judged day; begin_ns: its start."""

    rows: Rows
    own: Rows
    begin_ns: int
    seconds: float

    def still(self, rows: Rows) -> MapsOf:
        """One fixed map."""
        lanes = lane_map(rows)
        return lambda _: lambda __: lanes

    def elsewhere(self) -> MapsOf:
        """Of machines on other routes alone: routes take turns with the machines' numbers."""
        route = {name: int(name.rpartition("-")[2]) % len(SITES["driven"].routes) for name, _ in self.rows}
        lanes = {own: lane_map([(n, rows) for n, rows in self.rows if route[n] != own]) for own in set(route.values())}
        return lambda name: lambda _: lanes[route[name]]

    def moves(self, left_m: float) -> MapsOf:
        """The eastern roads seem displaced from half time on."""
        before, after = lane_map(self.rows), lane_map(moved(self.rows, left_m, from_x_m=EAST_M))
        half_ns = self.begin_ns + round(self.seconds / 2 * 1e9)
        return lambda _: lambda stamp_ns: before if stamp_ns < half_ns else after

    def grows(self, names: Callable[[str], Sequence[str]]) -> MapsOf:
        """Map of the same day by the machines in names(machine), growing from nothing, read periodically."""
        kept: dict[tuple[Sequence[str], int], LaneMap | None] = {}

        def maps_of(name: str) -> Maps:
            def at(stamp_ns: int) -> LaneMap | None:
                turn = int((stamp_ns - self.begin_ns) * 1e-9 // READ_S)
                key = tuple(names(name)), turn
                if key not in kept:
                    until_ns = self.begin_ns + round((turn * READ_S - LATE_S) * 1e9)
                    some = [(n, rows[rows["stamp_ns"] < until_ns]) for n, rows in self.own if n in key[0]]
                    kept[key] = lane_map(some) if any(len(rows) for _, rows in some) else None
                return kept[key]

            return at

        return maps_of


EAST_M = 100.0
READ_S, LATE_S = 180.0, 95.0  # reading interval of lanes; delay until samples are final
GROWING = ("young", "alone")  # maps of the same day
_draw = partial(np.random.default_rng, 7)
MAPS: dict[str, Callable[[Scene], MapsOf]] = {
    "mature": lambda scene: scene.still(scene.rows),
    "others": lambda scene: scene.elsewhere(),
    "young": lambda scene: scene.grows(lambda _: [name for name, _ in scene.own]),
    "alone": lambda scene: scene.grows(lambda name: [name]),
    "east2": lambda scene: scene.still(moved(scene.rows, east_m=2.0)),
    "left3": lambda scene: scene.still(moved(scene.rows, 3.0)),
    "moved3": lambda scene: scene.moves(3.0),
    "moved5": lambda scene: scene.moves(5.0),
    "moved8": lambda scene: scene.moves(8.0),
    "two6": lambda scene: scene.still([*scene.rows, *renamed(moved(scene.rows, 6.0), "-two")]),
    "only6": lambda scene: scene.still(moved(scene.rows, 6.0)),
    "both": lambda scene: scene.still([*scene.rows, *turned(moved(scene.rows, 1.0))]),
    "lanes": lambda scene: scene.still(reshaped(scene.rows, np.nan)),
    "reshaped": lambda scene: scene.still(reshaped(scene.rows)),
    "turned": lambda scene: scene.still(turned(scene.rows)),
    "crossed": lambda scene: scene.still([*scene.rows, *along(crossing(60, _draw()), scene.begin_ns, _draw())]),
    "free": lambda scene: scene.still(along(free(5) + free(6), scene.begin_ns, _draw())),
}
