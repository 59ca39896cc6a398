"""Answers to map queries: pages come from a source, layers are derived here."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Set
from dataclasses import replace
from typing import Any

import numpy as np

from mapserver.change.detection import reach_blocks
from mapserver.evidence.timeline import Block
from mapserver.journal.facts import Facts
from mapserver.layers import cell_layers
from mapserver.layers.gap_filling import AREA_LAYERS
from mapserver.past.cell_history import CellHistory
from mapserver.query import roads
from mapserver.query.areas import cells_to_a_side, finer, inside, means
from mapserver.query.block_layers import BlockLayers, Look, around_squares
from mapserver.query.cell_reasons import reasons
from mapserver.query.coverage import coverage
from mapserver.query.map_tiles import Tiles, cut, tiles_of
from mapserver.query.on_site import check_on_site
from mapserver.query.region_pieces import PIECE_BYTES, LookAt, OpenRegions, PieceGrid, RegionReading
from mapserver.query.road_maps import RoadMaps
from mapserver.query.routes import Routes
from mapserver.query.source import MapSource, MapState
from mapserver.query.views import (
    PastMaps,
    View,
    bounds_of,
    check_blocks,
    check_past,
    parts_of,
    read_lanes,
    view_now,
    widened,
)
from protocol.arrays import Bools, Floats, Floats32, Ints
from protocol.errors import QueryError, Refusal
from protocol.queries import answer_codec as codec
from protocol.queries.answers import (
    ChangesAnswer,
    HistoryAnswer,
    HistorySpan,
    MachinesAnswer,
    MapVersion,
    PointAnswer,
    PointsAnswer,
    Region,
)
from protocol.queries.coverage import Coverage, CoverageQuery
from protocol.queries.lanes import LanesAnswer, LanesQuery
from protocol.queries.map_tiles import TilesAnswer, TilesQuery
from protocol.queries.reasons import CellReasons
from protocol.queries.request import Compared, MapQuery, Size
from protocol.queries.requests import (
    MAX_SPANS,
    WITHOUT_MEAN,
    AliveQuery,
    CalibrationQuery,
    ChangesQuery,
    HistoryQuery,
    InfoQuery,
    MachinesQuery,
    PieceQuery,
    PointQuery,
    PointsQuery,
    RegionQuery,
    WhyQuery,
)
from protocol.queries.roads import RoadQuery, SegmentsQuery, WorklistQuery
from protocol.queries.route_requests import RouteQuery, WayQuery
from protocol.site.geometry import MAX_CELLS, Bounds, CellWindow, GridGeometry

# of a search: a quarter of the budget
BYTES = {Size.SMALL: 16_384, Size.PIECE: PIECE_BYTES, Size.SEARCH: 2**23}
# counters of `info`: blocks and squares with layers from the cache, and derived ones
LAYERS_KEPT, LAYERS_DERIVED = "layers_kept", "layers_derived"
ROADS_MADE, ROADS_MADE_MS = "roads_made", "roads_made_ms"  # present road maps, and their total time
WITHOUT_DIFFERENCE = ("heading",)  # axes, which are periodic in half a turn


class Answers:
    """Answers the queries of one map. Thread-safe."""

    def __init__(self, source: MapSource, roads_of_map: RoadMaps | None = None) -> None:
        """roads_of_map: if others read them too."""
        self._source = source
        self._site, self._config = source.site, source.config
        self._layers = BlockLayers(self._site.cell_m, self._config)
        self._routes = Routes(source, self._layers, self._look_at_squares)
        self._open = OpenRegions()
        self._roads = roads_of_map or RoadMaps(source)
        self._tiles = Tiles(source, self._layers)
        self._past_tiles: TilesAnswer | None = None  # the last ones, which readers fetch in pieces
        self._answers: dict[type[MapQuery[Any]], Callable[[Any], Any]] = {
            PointQuery: self.point,
            PointsQuery: self.points,
            RegionQuery: self.region,
            PieceQuery: self.piece,
            TilesQuery: self.tiles,
            WhyQuery: self.why,
            CoverageQuery: self.coverage,
            LanesQuery: self.lanes,
            HistoryQuery: self.history,
            SegmentsQuery: lambda query: roads.segments(self._roads.read, query),
            WorklistQuery: lambda query: roads.worklist(self._roads.read, query),
            RouteQuery: self._routes.route,
            WayQuery: self._routes.way,
            MachinesQuery: self.machines,
            ChangesQuery: self.changes,
            CalibrationQuery: lambda _: source.calibration(),
            AliveQuery: lambda _: source.alive(),
            InfoQuery: lambda _: self.info(),
        }

    def begin(self) -> None:
        """See `RoadMaps`."""
        self._roads.begin()

    def renew(self) -> float:
        """See `RoadMaps`."""
        return self._roads.renew()

    @property
    def _reach(self) -> int:
        return reach_blocks(self._site.cell_m, self._config.change)

    @property
    def _past(self) -> PastMaps:
        return PastMaps(self._source.location, self._source.past, self._config)

    def reads_past(self, query: MapQuery[Any]) -> bool:
        """Whether a query reads the journal, also for a piece of an open region."""
        return query.reads_past or (isinstance(query, PieceQuery) and self._open.is_past(query.cursor))

    def size(self, query: MapQuery[Any]) -> int:
        """Approximate size of the answer and its making [bytes]."""
        if not isinstance(query, RegionQuery):
            return BYTES[query.size]
        window, _ = self._window(query)
        layers = len(query.layers or cell_layers.LAYERS)
        return min(PIECE_BYTES, 4 * window.columns * window.rows * layers + BYTES[Size.SMALL])

    def answer(self, query: MapQuery[Any]) -> bytes:
        """Answer one query; QueryError if it is wrong."""
        check_on_site(query, self._site, lambda: self._source.run(lambda state: state.grid.bounds()))
        if query.after and isinstance(query, RoadQuery) and query.as_of_ns is None:
            self._roads.reach(query.after)
        return query.encode(self._answers[type(query)](query))

    def machines(self, _: MachinesQuery) -> MachinesAnswer:
        """State of each machine."""
        rows: Any = self._source.machines()  # tables with the fields of their records
        return MachinesAnswer(tuple(rows), self._version())

    def changes(self, query: ChangesQuery) -> ChangesAnswer:
        """Changes of the ground, up to an answer's limit."""
        return ChangesAnswer(tuple(self._source.changes(query.after_id)[: codec.MAX_CHANGES]), self._version())

    def info(self) -> dict[str, Any]:
        """State of the map, with the names of its layers."""
        names = {"layers": [*cell_layers.LAYERS, *AREA_LAYERS], "boundaries": list(self._config.read.boundaries)}
        info = self._source.info()
        layers = Counter({LAYERS_KEPT: self._layers.used, LAYERS_DERIVED: self._layers.derived})
        made = Counter({ROADS_MADE: self._roads.made, ROADS_MADE_MS: round(1e3 * self._roads.made_s)})
        counters = {**info["counters"], **+layers, **+made}
        return {**info, "counters": counters, "checkpoints": self._source.past.checkpoints.state, **names}

    def point(self, query: PointQuery) -> PointAnswer:
        """Layers of the cell at a position."""
        names, place = _names(query), np.array([(query.x_m, query.y_m)])
        if not query.reads_past and (kept := self._source.run(lambda state: self._kept_point(state, place, names))):
            return kept
        one = self._at(place, names, query)
        values = {name: float(layer[0]) for name, layer in one.layers.items()}
        return PointAnswer(float(one.x_m[0]), float(one.y_m[0]), values, one.version, one.stamp_ns)

    def _kept_point(self, state: MapState, place: Floats, names: tuple[str, ...]) -> PointAnswer | None:
        """Layers of a cell of the present map, if cached."""
        (cell,) = self._site.geometry.cell_of(place)
        values = self._layers.kept_cell(state, tuple(cell.tolist()), names)
        if values is None:
            return None
        x_m, y_m = ((cell + 0.5) * self._site.cell_m).tolist()
        return PointAnswer(x_m, y_m, values, state.version, state.newest_ns)

    def points(self, query: PointsQuery) -> PointsAnswer:
        """Layers of the cells at positions."""
        return self._at(np.array(query.places), _names(query), query)

    def _at(self, places: Floats, names: tuple[str, ...], query: Compared[Any]) -> PointsAnswer:
        """Layers of the cells at places (n, 2), minus those of another time if the query asks for it."""
        cells = self._site.geometry.cell_of(places)
        (layers, version, stamp_ns), *others = (self._layers_at(cells, names, as_of_ns) for as_of_ns in query.times)
        for older, its_version, _ in others:
            layers = {name: values - older[name] for name, values in layers.items()}
            version = replace(version, row=min(version.row, its_version.row))
        x_m, y_m = ((cells + 0.5) * self._site.cell_m).T
        return PointsAnswer(x_m, y_m, layers, version, stamp_ns)

    def region(self, query: RegionQuery) -> Region:
        """Layers of an area, or its first piece; `piece` has the others."""
        (window, count), names = self._window(query), _names(query)
        if window.columns * window.rows * count**2 > MAX_CELLS:
            problem = (
                f"region of {window.columns * count} x {window.rows * count} cells; at most {MAX_CELLS} are answered"
            )
            raise QueryError(Refusal.TOO_LARGE, problem)
        outline = () if isinstance(query.area, Bounds) else query.area
        pieces = PieceGrid.of_layers(window, len(names), count)
        if pieces.count > 1:
            self._open.make_room()
        sources = self._sources(finer(window, count), names, query)
        reading = RegionReading(window, names, sources, count, outline, query.reads_past)
        if pieces.count == 1:
            return self._read(reading, window)
        return self._piece(reading, pieces, 0, self._open.open(reading))

    def piece(self, query: PieceQuery) -> Region:
        """Another piece of an open region."""
        return self._piece(*self._open.reading(query.cursor, query.number), query.number, query.cursor)

    def history(self, query: HistoryQuery) -> HistoryAnswer:
        """Layers of a cell by span of time."""
        names = _of_cells(query.layers)
        now_ns, facts = self._source.run(lambda state: (state.newest_ns, state.facts))
        span_s = query.span_s or self._config.fold.bucket_s
        from_ns, to_ns = _time_of(query, now_ns, span_s)
        cell = self._cell(query.x_m, query.y_m)
        past, version = self._past.history((cell.column, cell.row), (from_ns, to_ns), round(span_s * 1e9), facts)
        x_m, y_m = (float(self._site.geometry.centres(index, 1)[0]) for index in (cell.column, cell.row))
        return HistoryAnswer(x_m, y_m, self._spans(past, names), version, now_ns)

    def tiles(self, query: TilesQuery) -> TilesAnswer:
        """Tiles of the present or a past map."""
        if query.as_of_ns is None:
            return self._tiles.answer(query)
        fact = self._source.run(lambda state: state.version.fact)
        kept = self._past_tiles
        if query.place is None or kept is None or (kept.stamp_ns, kept.version.fact) != (query.as_of_ns, fact):
            self._past_tiles = kept = self._tiles_as_of(query.as_of_ns)
        return cut(kept, query.place)

    def _tiles_as_of(self, as_of_ns: int) -> TilesAnswer:
        version, views = self._past_parts(None, as_of_ns)
        tiles = tuple(tile for window, view in views for tile in tiles_of(view, window, self._layers))
        return TilesAnswer(version, as_of_ns, self._site.cell_m, whole=True, tiles=tiles)

    def why(self, query: WhyQuery) -> CellReasons:
        """All that is known of a cell."""
        window = self._cell(query.x_m, query.y_m)
        if query.as_of_ns is None:
            view = self._source.run(lambda state: view_now(state, window))
        else:
            version, facts = self._source.run(lambda state: (state.version, state.facts))
            view = self._past.view(window, query.as_of_ns, facts, version)
        names = self._source.run(_names_in)
        return reasons(view, (window.column, window.row), names, self._site.cell_m, self._config)

    def coverage(self, query: CoverageQuery) -> Coverage:
        """Driven and known ground."""
        names, window = self._source.run(_names_in), self._window_of(query.bounds)
        if query.as_of_ns is None:
            view = self._known(window)
            version, views, stamp_ns = view.version, iter([(window, view)]), view.stamp_ns
        else:
            (version, views), stamp_ns = self._past_parts(window, query.as_of_ns), query.as_of_ns
        return coverage(views, version, stamp_ns, names, self._site.cell_m, self._config)

    def lanes(self, query: LanesQuery) -> LanesAnswer:
        """Metres driven by heading."""
        window = self._window_of(query.bounds)
        return read_lanes(self._known(window), window, query.since_ns, self._site.cell_m, self._config)

    def _window_of(self, bounds: Bounds | None) -> CellWindow | None:
        """Cells of a rectangle; None for all."""
        return self._site.geometry.window(bounds) if bounds else None

    def _known(self, window: CellWindow | None) -> View:
        """The present view of a window, or the whole map; refuses too much."""

        def look(state: MapState) -> View:
            area = window or bounds_of(state)
            check_blocks(len(state.grid.blocks_in(area)), "ask for less with `bounds`")
            return view_now(state, area)

        return self._source.run(look)

    def _past_parts(
        self, window: CellWindow | None, as_of_ns: int
    ) -> tuple[MapVersion, Iterator[tuple[CellWindow, View]]]:
        """A past map of a window, or the whole one, part by part: never all of it is in memory."""
        version, facts, parts = self._source.run(
            lambda state: (state.version, state.facts, parts_of(state, window or bounds_of(state)))
        )
        return version, ((part, self._past.view(part, as_of_ns, facts, version)) for part in parts)

    def _version(self) -> MapVersion:
        return self._source.run(lambda state: state.version)

    def _cell(self, x_m: float, y_m: float) -> CellWindow:
        column, row = self._site.geometry.cell_of(np.array([x_m, y_m])).tolist()
        return CellWindow(column, row, 1, 1)

    def _window(self, query: RegionQuery) -> tuple[CellWindow, int]:
        """The answer's cells, and map cells to a side."""
        count = cells_to_a_side(query.resolution_m, self._site.cell_m)
        return GridGeometry(count * self._site.cell_m).window(query.bounds), count

    def _sources(self, window: CellWindow, names: tuple[str, ...], query: Compared[Any]) -> tuple[LookAt, ...]:
        """Where pieces of a window come from: one look, or of the past one each, as its evidence is not shared."""
        version, facts = self._source.run(lambda state: (state.version, state.facts))

        def source(as_of_ns: int | None) -> LookAt:
            if as_of_ns is None:
                look = self._source.run(lambda state: self._layers.look(state, window, names))
                return lambda _: look
            return lambda piece: self._look_back(piece, names, as_of_ns, facts, version)

        return tuple(map(source, query.times))

    def _layers_at(
        self, cells: Ints, names: tuple[str, ...], as_of_ns: int | None
    ) -> tuple[dict[str, Floats32], MapVersion, int]:
        """Layers (n,) of cells (n, 2) [column, row], their map's version and time."""
        if as_of_ns is None:
            look = self._source.run(lambda state: self._layers.look_cells(state, cells, names))
            return self._layers.at_cells(look, cells, names), look.version, look.stamp_ns
        window = _around(cells)
        version, facts, parts = self._source.run(lambda state: (state.version, state.facts, parts_of(state, window)))
        out: dict[str, Floats32] = {name: np.full(len(cells), np.nan, np.float32) for name in names}
        for part in parts:
            inside = _is_in(cells, part)
            if inside.any():
                look = self._look_back(_around(cells[inside]), names, as_of_ns, facts, version)
                for name, values in self._layers.at_cells(look, cells[inside], names).items():
                    out[name][inside] = values
        return out, version, as_of_ns

    def _look_at_squares(self, squares: Set[Block], names: tuple[str, ...], as_of_ns: int | None) -> Look:
        """Sources of area layers in squares."""
        if as_of_ns is None:
            return self._source.run(lambda state: self._layers.look_squares(state, squares, names))
        version, facts = self._source.run(lambda state: (state.version, state.facts))
        return self._look_back(around_squares(squares), names, as_of_ns, facts, version)

    def _look_back(
        self, window: CellWindow, names: tuple[str, ...], as_of_ns: int, facts: Facts, version: MapVersion
    ) -> Look:
        """Sources of a window as of a time; refuses too much."""
        wide = widened(window, cell_layers.margin_cells(names, self._site.cell_m, self._config.read))
        self._source.run(lambda state: check_past(state, wide, self._reach))
        return self._layers.look_at(self._past.view(wide, as_of_ns, facts, version))

    def _piece(self, reading: RegionReading, pieces: PieceGrid, number: int, cursor: int) -> Region:
        return replace(self._read(reading, pieces.piece(number)), piece=pieces.place(number, cursor))

    def _read(self, reading: RegionReading, window: CellWindow) -> Region:
        """Layers of a window inside the reading's; means part by part."""
        if reading.count == 1:
            return self._cells(reading, window)
        parts, geometry = PieceGrid.of_means(window, reading.count), GridGeometry(reading.count * self._site.cell_m)
        layers = {name: np.empty((window.rows, window.columns), np.float32) for name in reading.layers}
        for part in map(parts.piece, range(parts.count)):
            cells = self._cells(reading, finer(part, reading.count))
            row, column = part.row - window.row, part.column - window.column
            for name, values in cells.layers.items():
                layers[name][row : row + part.rows, column : column + part.columns] = means(values, reading.count)
        x_m, y_m = geometry.centres(window.column, window.columns), geometry.centres(window.row, window.rows)
        return replace(cells, x_m=x_m, y_m=y_m, cell_m=geometry.cell_m, layers=layers)

    def _cells(self, reading: RegionReading, window: CellWindow) -> Region:
        """Layers of map cells."""
        newer, *others = (self._map(source(window), reading.layers, window) for source in reading.sources)
        layers, version = dict(newer.layers), newer.version
        for older in others:
            layers = {name: values - older[name] for name, values in layers.items()}
            version = replace(version, row=min(newer.merged, older.merged))
        if reading.outline:
            within = inside(reading.outline, window, self._site.cell_m)
            layers = {name: np.where(within, values, np.float32(np.nan)) for name, values in layers.items()}
        return replace(newer, layers=layers, version=version)

    def _map(self, look: Look, names: tuple[str, ...], window: CellWindow) -> Region:
        geometry = self._site.geometry
        return Region(
            x_m=geometry.centres(window.column, window.columns),
            y_m=geometry.centres(window.row, window.rows),
            cell_m=self._site.cell_m,
            layers=self._layers.read(look, window, names),
            version=look.version,
            stamp_ns=look.stamp_ns,
        )

    def _spans(self, past: CellHistory, names: tuple[str, ...]) -> tuple[HistorySpan, ...]:
        values = cell_layers.read(past.evidence, names, self._config.read, past.last_ns[:, None])
        columns = (past.first_ns.tolist(), past.last_ns.tolist(), *(values[name][:, 0].tolist() for name in names))
        return tuple(
            HistorySpan(first_ns, last_ns, dict(zip(names, of_span, strict=True)))
            for first_ns, last_ns, *of_span in zip(*columns, strict=True)
        )


def _around(cells: Ints) -> CellWindow:
    """The least window with cells (n, 2)."""
    first, last = cells.min(axis=0), cells.max(axis=0)
    return CellWindow(*first.tolist(), *(last - first + 1).tolist())


def _is_in(cells: Ints, window: CellWindow) -> Bools:
    """Which cells (n, 2) a window has."""
    place = cells - (window.column, window.row)
    return np.asarray(((place >= 0) & (place < (window.columns, window.rows))).all(axis=1))


def _names_in(state: MapState) -> list[str]:
    """Machines in the map."""
    return [name for name in state.machines() if name not in state.facts.excluded]


def _of_cells(names: tuple[str, ...]) -> tuple[str, ...]:
    names = cell_layers.select(names)
    if filled := [name for name in names if name in AREA_LAYERS]:
        problem = f"layer `{filled[0]}` is made from a cell's neighbours, a history is of one cell: leave it out"
        raise QueryError(Refusal.UNKNOWN_LAYER, problem)
    return names


def _names(query: PointQuery | PointsQuery | RegionQuery) -> tuple[str, ...]:
    """Checked layers of a query; none means all, if possible with a difference or mean."""
    without: tuple[str, ...] = ()
    if query.minus_ns is not None:
        without = WITHOUT_DIFFERENCE
        _refuse_any(query.layers, without, "has no difference; ask for it without `minus`, as of each time")
    if isinstance(query, RegionQuery) and query.resolution_m is not None:
        without += WITHOUT_MEAN
        _refuse_any(query.layers, WITHOUT_MEAN, "has no mean; ask for it without `resolution`")
    return tuple(name for name in cell_layers.select(query.layers) if name not in without)


def _refuse_any(names: tuple[str, ...], without: tuple[str, ...], problem: str) -> None:
    if refused := [name for name in names if name in without]:
        raise QueryError(Refusal.OUT_OF_RANGE, f"layer `{refused[0]}` {problem}")


def _time_of(query: HistoryQuery, now_ns: int, span_s: float) -> tuple[int, int]:
    """First and last stamp of a history; refuses too many spans in advance."""
    span_ns = round(span_s * 1e9)
    to_ns = query.to_ns or max(now_ns, query.from_ns or 1)
    from_ns = query.from_ns or max(1, (to_ns // span_ns - MAX_SPANS + 1) * span_ns)
    spans = to_ns // span_ns - from_ns // span_ns + 1
    if spans > MAX_SPANS:
        problem = f"{spans} spans of {span_s:g} s; at most {MAX_SPANS} are answered: a longer `span`, or less time"
        raise QueryError(Refusal.TOO_LARGE, problem)
    return from_ns, to_ns
