"""Answers about routes: a drive along a line, and the line of least cost."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence, Set
from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from mapserver.evidence.timeline import Block
from mapserver.query.block_layers import SQUARE_CELLS, BlockLayers, Look, place_square, squares_of
from mapserver.query.named_machines import NamedMachines
from mapserver.query.source import MapSource
from mapserver.routes.ground import Squares, squares_at, steps
from mapserver.routes.least_cost import Cell, CostField, cost_of, least_cost_line, reaches
from mapserver.routes.prices import PRICED, Prices, around, bare
from mapserver.routes.route import LAYERS, STEP_M, route
from protocol.arrays import Bools, Floats, Floats32, Ints
from protocol.errors import QueryError, Refusal
from protocol.queries.places import Place
from protocol.queries.route_requests import DEAREST, REFUSE, TIME, LineQuery, RouteQuery, WayQuery
from protocol.queries.routing import RouteAnswer, RouteMachine
from protocol.site.geometry import Bounds, CellWindow
from protocol.units import GRAVITY_MPS2

EDGE_M = 20.0  # metres beyond known ground that a way may use, around corners
# A way stays in known ground, and this plus half the distance of its ends around them: longer detours rarely pay.
DETOUR = 0.5
LEAST_DETOUR_M = 60.0
MAX_CELLS = 1_000_000  # of a way's window: 1 x 1 km, about a second, 300 MB
# of 64 x 64 cells with known ground: 49 km straight; 120 KB each, twice while read
MOST_SQUARES = 768
GROUND = ("resistance_filled", "grade_east_filled", "grade_north_filled", "visits")


class Routes:
    """Answers about routes of one map; thread-safe. look: at squares, at a time."""

    def __init__(self, source: MapSource, layers: BlockLayers, look: Callable[..., Look]) -> None:
        self._source, self._layers, self._look = source, layers, look
        self._site, self._machines = source.site, NamedMachines(source)

    def route(self, query: RouteQuery) -> RouteAnswer:
        """Cost of a drive along a line."""
        machine = self._machines.resolve(query.machine, query.as_of_ns)
        line = np.array(query.line)
        places = steps(line, STEP_M).position_m
        touched = squares_at(places, self._site.cell_m, SQUARE_CELLS)

        def unpriced(read: Squares) -> set[Block]:
            nobody = ~np.isfinite(read.at(places, ("visits",))["visits"])
            return squares_at(places[nobody], self._site.cell_m, SQUARE_CELLS) if nobody.any() else set()

        look, read = self._read(touched, query, unpriced)
        return self._answer(query, machine, line, look, read, Prices(read, _given(query)))

    def way(self, query: WayQuery) -> RouteAnswer:
        """The line of least cost, and its cost."""
        machine, window = self._machines.resolve(query.machine, query.as_of_ns), self._window(query)
        touched = squares_of(window)
        look, read = self._read(touched, query, lambda read: bare(read, touched))
        prices = Prices(read, _given(query))
        terrain, known = self._terrain(query, machine, window, read, prices)
        ends = start, end = self._cell(query.start, window), self._cell(query.end, window)
        terrain = replace(terrain, is_open=_open(terrain, known, query, window, self._site.cell_m))
        lines = [self._line(query, terrain, known, start, end)]
        if len(lines[0]) > 2 and math.isfinite(cost_of(terrain, np.array(ends))):
            lines.append(np.array(ends))
        corner = np.array([window.column, window.row])
        places = [np.asarray((line[:, ::-1] + 0.5 + corner) * self._site.cell_m, np.float64) for line in lines]
        for line in places:
            line[0], line[-1] = query.start, query.end
        return self._cheapest(query, places, partial(self._answer, query, machine, look=look, read=read, prices=prices))

    def _cheapest(
        self, query: WayQuery, lines: Sequence[Floats], driven: Callable[[Floats], RouteAnswer]
    ) -> RouteAnswer:
        """The line with the cheapest drive, which, unlike the search, stops and takes curves.

        driven: over a line. QueryError of the first if none is possible.
        """
        answers, problems = [], []
        for line in lines:
            try:
                answers.append(driven(line))
            except QueryError as problem:
                problems.append(problem)
        if not answers:
            raise problems[0]
        return min(answers, key=lambda answer: answer.totals.time_s if query.cost == TIME else answer.totals.energy_j)

    def _line(self, query: WayQuery, terrain: CostField, known: Bools, start: Cell, end: Cell) -> Ints:
        for name, cell in (("from", start), ("to", end)):
            if not terrain.is_open[cell]:
                raise _refusal(f"parameter `{name}`: {self._closed(query, terrain, known, cell)}")
        found_line = least_cost_line(terrain, start, end)
        if found_line is None:
            raise _refusal(f"no way: {self._limit(query, terrain, known, start, end)}")
        line, _ = found_line
        return line if len(line) > 1 else np.array([start, end])

    def _closed(self, query: WayQuery, terrain: CostField, known: Bools, cell: Cell) -> str:
        """Why no way leads over a cell."""
        if query.unknown == REFUSE and not known[cell]:
            return "unknown ground; give `unknown` a resistance, or a place that somebody drove over"
        if _steepness(terrain)[cell] > query.max_grade:
            return f"{_steepness(terrain)[cell]:.0%} steep, over `max_grade`"
        return "nearer than `margin` to what no way leads over"

    def _limit(self, query: WayQuery, terrain: CostField, known: Bools, start: Cell, end: Cell) -> str:
        """The limit that prevents a way."""
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
        self,
        query: LineQuery,
        machine: RouteMachine,
        line: Floats,
        look: Look,
        read: Squares,
        prices: Prices,
    ) -> RouteAnswer:
        steps, totals = route(
            line,
            read,
            machine,
            stops=query.stops,
            step_m=query.step_m,
            prices=prices,
            refuse_unknown=query.unknown == REFUSE,
        )
        return RouteAnswer(look.version, look.stamp_ns, line, totals, steps, machine)

    def _read(
        self, squares: Set[Block], query: LineQuery, unpriced: Callable[[Squares], Set[Block]]
    ) -> tuple[Look, Squares]:
        """Layers of squares, and of those around unpriced ground, once that is known.

        All of one map version: repeated reads are cached, unless samples arrive.
        """
        wanted = set(squares)
        while True:
            look, read = self._read_once(wanted, query)
            more = around(unpriced(read)) - wanted
            if not more:
                return look, read
            wanted |= more

    def _read_once(self, squares: Set[Block], query: LineQuery) -> tuple[Look, Squares]:
        look = self._look(squares, LAYERS, query.as_of_ns)
        if (count := len(look.area_turns)) > MOST_SQUARES:
            problem = f"{count} squares of {SQUARE_CELLS} cells with known ground along the line, over {MOST_SQUARES}"
            raise QueryError(Refusal.TOO_LARGE, f"{problem}: ask for it in parts, from place to place")
        layers = self._layers.squares(look, squares, LAYERS)
        nothing = {min(squares): {name: np.full((SQUARE_CELLS, SQUARE_CELLS), np.nan, np.float32) for name in LAYERS}}
        return look, Squares.stacked(self._site.cell_m, SQUARE_CELLS, layers or nothing)

    def _terrain(
        self, query: WayQuery, machine: RouteMachine, window: CellWindow, read: Squares, prices: Prices
    ) -> tuple[CostField, Bools]:
        """Ground of a window, all open, and its known cells."""
        resistance, east, north, visits = (_in_window(read, name, window) for name in GROUND)
        known = np.isfinite(resistance) | np.isfinite(visits)
        if prices.given is None and not known.any():
            raise _refusal("nobody has driven near these places yet: give `unknown` a resistance")
        if to_price := bare(read, squares_of(window)):
            of_bare = prices.squares(to_price)
            price, price_east, price_north = (_in_window(of_bare, name, window) for name in PRICED)
            resistance = np.where(np.isfinite(price), price, resistance)
            east, north = np.where(np.isfinite(price_east), (price_east, price_north), (east, north))
        east_m, north_m = (np.nan_to_num(grade).astype(np.float64) for grade in (east, north))
        crawl = machine.power_w / (machine.mass_kg * GRAVITY_MPS2 * machine.speed_mps)
        crawl = crawl if query.cost == TIME else math.inf
        is_open = np.ones(known.shape, bool)
        return CostField(resistance.astype(np.float64), east_m, north_m, is_open, self._site.cell_m, crawl), known

    def _window(self, query: WayQuery) -> CellWindow:
        """The window searched for a way."""
        ends = np.array([query.start, query.end])
        reach = LEAST_DETOUR_M + DETOUR * math.dist(query.start, query.end)
        low, high = ends.min(axis=0) - reach, ends.max(axis=0) + reach
        if (cells := self._source.run(lambda state: state.grid.bounds())) is not None:
            margin = EDGE_M
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


def _given(query: LineQuery) -> float | None:
    """The query's price of unknown ground, or None."""
    return None if isinstance(query.unknown, str) else query.unknown


def _in_window(squares: Squares, name: str, window: CellWindow) -> Floats32:
    """A layer of squares in a window (rows, columns)."""
    out: Floats32 = np.full((window.rows, window.columns), np.nan, np.float32)
    for place, values in zip(squares.by_place(), squares.layers[name], strict=True):
        place_square({name: out}, window, place, {name: values})
    return out


def _open(terrain: CostField, known: Bools, query: WayQuery, window: CellWindow, cell_m: float) -> Bools:
    """Cells over which a way may lead."""
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


def _steepness(terrain: CostField) -> Floats:
    return np.asarray(np.hypot(terrain.grade_east, terrain.grade_north))


def _refusal(problem: str) -> QueryError:
    return QueryError(Refusal.OUT_OF_RANGE, problem)


def warm_up() -> None:
    """Compile the kernels of routes, or load them, before a query waits for them."""
    resistance, level = np.full((8, 8), 0.02), np.zeros((8, 8))
    terrain = CostField(resistance, level, level, resistance > 0, 1.0)
    least_cost_line(terrain, (0, 0), (7, 5))
    cost_of(terrain, np.array([(0, 0), (7, 5)]))
    ground = {name: resistance.astype(np.float32) for name in LAYERS}
    route(np.array([[1.0, 1.0], [7.0, 7.0]]), Squares.stacked(1.0, 8, {(0, 0): ground}), RouteMachine())
