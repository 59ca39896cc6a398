"""Routes answered: what a drive along a line costs, and which line costs least, on the map as it is or was."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence, Set
from dataclasses import replace

import cv2
import numpy as np

from mapserver.query.block_layers import SQUARE_CELLS, BlockLayers, Look, place_square, squares_of
from mapserver.query.named_machines import NamedMachines
from mapserver.query.source import MapSource
from mapserver.routes.ground import Squares, dearest
from mapserver.routes.least_cost import Cell, Terrain, least_cost_line, reaches
from mapserver.routes.route import LAYERS, route
from protocol.arrays import Bools, Floats, Floats32, Ints
from protocol.errors import QueryError, Refusal
from protocol.queries.places import Place
from protocol.queries.route_requests import DEAREST, REFUSE, TIME, RouteQuery, WayQuery
from protocol.queries.routing import RouteAnswer, RouteMachine
from protocol.site.geometry import Bounds, CellWindow
from protocol.units import GRAVITY_MPS2

AROUND_M = 20.0  # so far around a line the map is read: it says what unknown ground may be like
# A way is looked for within the known ground, and no further from a rectangle around its ends than half of their
# distance, and this: a detour that leads further away costs more than most ground between.
DETOUR = 0.5
LEAST_DETOUR_M = 60.0
MAX_CELLS = 1_000_000  # of the window of a way: 1 x 1 km, searched in about a second, with 300 MB
GROUND = ("resistance_filled", "grade_east_filled", "grade_north_filled", "visits")


class Routes:
    """Answers of one map; for any thread. look: at squares, now or as of a time, with the ages of roads or without."""

    def __init__(self, source: MapSource, layers: BlockLayers, look: Callable[..., Look]) -> None:
        self._source, self._layers, self._look = source, layers, look
        self._site, self._machines = source.site, NamedMachines(source)

    def route(self, query: RouteQuery) -> RouteAnswer:
        """What a drive along a line costs."""
        self._require_on_site("line", query.line)
        machine = self._machines.resolve(query.machine, query.as_of_ns)
        line = np.array(query.line)
        squares = _squares_along(line, self._site.cell_m)
        look, read = self._read(squares, query)
        return self._answer(query, machine, line, look, read)

    def way(self, query: WayQuery) -> RouteAnswer:
        """The line that costs least, and what it costs."""
        for name, ends in (("from", [query.start]), ("to", [query.end]), ("avoid", query.avoid)):
            self._require_on_site(name, ends)
        machine, window = self._machines.resolve(query.machine, query.as_of_ns), self._window(query)
        look, read = self._read(squares_of(window), query)
        terrain, known = self._terrain(query, machine, window, read)
        start, end = (self._cell(place, window) for place in (query.start, query.end))
        is_open = _open(terrain, known, query, window, self._site.cell_m)
        line = self._line(query, replace(terrain, is_open=is_open), known, start, end)
        corner = np.array([window.column, window.row])
        places = np.asarray((line[:, ::-1] + 0.5 + corner) * self._site.cell_m, np.float64)
        places[0], places[-1] = query.start, query.end
        return self._answer(query, machine, places, look, read)

    def _line(self, query: WayQuery, terrain: Terrain, known: Bools, start: Cell, end: Cell) -> Ints:
        for name, cell in (("from", start), ("to", end)):
            if not terrain.is_open[cell]:
                raise _refusal(f"parameter `{name}`: {self._closed(query, terrain, known, cell)}")
        found_line = least_cost_line(terrain, start, end)
        if found_line is None:
            raise _refusal(f"no way: {self._limit(query, terrain, known, start, end)}")
        line, _ = found_line
        return line if len(line) > 1 else np.array([start, end])

    def _closed(self, query: WayQuery, terrain: Terrain, known: Bools, cell: Cell) -> str:
        """Why no way leads over a cell."""
        if query.unknown == REFUSE and not known[cell]:
            return "unknown ground; give `unknown` a resistance, or a place that somebody drove over"
        if _steepness(terrain)[cell] > query.max_grade:
            return f"{_steepness(terrain)[cell]:.0%} steep, over `max_grade`"
        return "nearer than `margin` to what no way leads over"

    def _limit(self, query: WayQuery, terrain: Terrain, known: Bools, start: Cell, end: Cell) -> str:
        """Which limit has to give so that there is a way."""
        window = CellWindow(0, 0, *terrain.is_open.shape[::-1])
        for name, eased in (
            ("margin", replace(query, margin_m=0.0, avoid=())),
            ("max_grade", replace(query, margin_m=0.0, avoid=(), max_grade=1.0)),
            ("unknown", replace(query, margin_m=0.0, avoid=(), unknown=DEAREST)),
        ):
            is_open = _open(terrain, known, eased, window, self._site.cell_m)
            if reaches(replace(terrain, is_open=is_open), start, end):
                return f"`{name}` leaves none"
        return "`max_grade` and `unknown` together leave none"

    def _answer(
        self, query: RouteQuery | WayQuery, machine: RouteMachine, line: Floats, look: Look, read: Squares | None
    ) -> RouteAnswer:
        unknown = None if isinstance(query.unknown, str) else query.unknown
        if read is None:  # no evidence anywhere near
            nothing = {name: np.full((1, 1), np.nan) for name in LAYERS}
            read = Squares.stacked(self._site.cell_m, 1, {(0, 0): nothing})
        steps, totals = route(
            line,
            read,
            machine,
            stops=query.stops,
            step_m=query.step_m,
            unknown_resistance=unknown,
            refuse_unknown=query.unknown == REFUSE,
        )
        return RouteAnswer(look.version, look.stamp_ns, line, totals, steps, machine)

    def _read(self, squares: Set[tuple[int, int]], query: RouteQuery | WayQuery) -> tuple[Look, Squares | None]:
        look = self._look(squares, LAYERS, query.as_of_ns, repairs=query.repairs)
        layers = self._layers.squares(look, squares, LAYERS)
        return look, Squares.stacked(self._site.cell_m, SQUARE_CELLS, layers) if layers else None

    def _terrain(
        self, query: WayQuery, machine: RouteMachine, window: CellWindow, read: Squares | None
    ) -> tuple[Terrain, Bools]:
        """Ground of a window, open everywhere, and which cells of it are known."""
        shape = (window.rows, window.columns)
        values: dict[str, Floats32] = {name: np.full(shape, np.nan, np.float32) for name in GROUND}
        if read:
            for i, (x, y) in enumerate(read.places.tolist()):
                for name, layer in values.items():
                    place_square(layer, window, (x, y), read.layers[name][i])
        resistance, east, north, visits = values.values()
        measured, driven = np.isfinite(resistance), np.isfinite(visits)
        known = measured | (driven & measured.any())
        if (unmeasured := known & ~measured).any():
            resistance = np.where(unmeasured, _nearest(resistance, measured), resistance)
        # whoever chooses a way must not choose what nobody knows: it may be as steep as it may be soft
        cost = query.unknown if isinstance(query.unknown, float) else dearest(resistance + np.hypot(east, north))
        if not known.any() and isinstance(query.unknown, str):
            raise _refusal("nobody has driven near these places yet: give `unknown` a resistance")
        crawl = machine.power_w / (machine.mass_kg * GRAVITY_MPS2 * machine.speed_mps)
        priced = np.where(known, resistance, cost).astype(np.float64)
        east_m, north_m = (np.nan_to_num(grade).astype(np.float64) for grade in (east, north))
        crawl = crawl if query.cost == TIME else math.inf
        return Terrain(priced, east_m, north_m, np.ones(shape, bool), self._site.cell_m, crawl), known

    def _window(self, query: WayQuery) -> CellWindow:
        """Where a way is looked for."""
        ends = np.array([query.start, query.end])
        reach = LEAST_DETOUR_M + DETOUR * math.dist(query.start, query.end)
        low, high = ends.min(axis=0) - reach, ends.max(axis=0) + reach
        if (cells := self._source.run(lambda state: state.grid.bounds())) is not None:
            margin = AROUND_M
            first, last = (np.array(cells[side : side + 2]) * self._site.cell_m for side in (0, 2))
            low = np.maximum(low, np.minimum(first, ends.min(axis=0)) - margin)
            high = np.minimum(high, np.maximum(last, ends.max(axis=0)) + margin)
        window = self._site.geometry.window(Bounds(*low, *high))
        if window.columns * window.rows > MAX_CELLS:
            problem = f"{window.columns} x {window.rows} cells to look for a way in, over {MAX_CELLS}"
            raise QueryError(Refusal.TOO_LARGE, f"{problem}: ask for it in parts, from place to place")
        return window

    def _cell(self, place: Place, window: CellWindow) -> Cell:
        column, row = (math.floor(value / self._site.cell_m) for value in place)
        return row - window.row, column - window.column

    def _require_on_site(self, name: str, places: Sequence[Place]) -> None:
        for x, y in places:
            if max(abs(x), abs(y)) > self._site.extent_m:
                problem = f"{x:g}, {y:g} m is off the site, which reaches {self._site.extent_m:g} m from its origin"
                raise _refusal(f"parameter `{name}`: {problem}")


def _squares_along(line: Floats, cell_m: float) -> set[tuple[int, int]]:
    """Squares within AROUND_M of a line (n, 2)."""
    edge_m = SQUARE_CELLS * cell_m
    lengths = np.hypot(*np.diff(line, axis=0).T)
    way = np.concatenate([[0.0], np.cumsum(lengths)])
    at = np.append(np.arange(0.0, way[-1], min(AROUND_M, edge_m) / 2), way[-1])
    places = np.stack([np.interp(at, way, axis) for axis in line.T], axis=1)
    near = [places + AROUND_M * np.array([x, y]) for x in (-1, 0, 1) for y in (-1, 0, 1)]
    return set(map(tuple, np.unique(np.floor(np.concatenate(near) / edge_m).astype(int), axis=0).tolist()))


def _open(terrain: Terrain, known: Bools, query: WayQuery, window: CellWindow, cell_m: float) -> Bools:
    """Over which cells a way may lead."""
    is_open = _steepness(terrain) <= query.max_grade
    if query.unknown == REFUSE:
        is_open &= known
    for x, y in query.avoid:
        column, row = math.floor(x / cell_m) - window.column, math.floor(y / cell_m) - window.row
        if 0 <= row < is_open.shape[0] and 0 <= column < is_open.shape[1]:
            is_open[row, column] = False
    if query.margin_m and not is_open.all():
        distance = cv2.distanceTransform(is_open.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        is_open &= distance * cell_m > query.margin_m
    return np.ascontiguousarray(is_open)


def _nearest(values: Floats32, known: Bools) -> Floats32:
    """Values (rows, columns), in each cell that of the nearest known one."""
    _, label = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    by_label = np.zeros(label.max() + 1, np.float32)
    by_label[label[known]] = values[known]
    return np.asarray(by_label[label], np.float32)


def _steepness(terrain: Terrain) -> Floats:
    return np.asarray(np.hypot(terrain.grade_east, terrain.grade_north))


def _refusal(problem: str) -> QueryError:
    return QueryError(Refusal.OUT_OF_RANGE, problem)


def warm_up() -> None:
    """Compile the kernels of routes, or read them from their cache, before somebody who asks waits for them."""
    resistance, level = np.full((8, 8), 0.02), np.zeros((8, 8))
    terrain = Terrain(resistance, level, level, resistance > 0, 1.0)
    least_cost_line(terrain, (0, 0), (7, 5))
    ground = {name: resistance.astype(np.float32) for name in LAYERS}
    route(np.array([[1.0, 1.0], [7.0, 7.0]]), Squares.stacked(1.0, 8, {(0, 0): ground}), RouteMachine())
