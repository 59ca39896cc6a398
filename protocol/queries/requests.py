"""Map queries as selector parameters (docs/protocol.md, "Map queries"); their answers: `answers.py`.

The server parses a query once, into a frozen type; an unknown parameter is refused by name. It is one module because
both directions of a parameter have to agree.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from protocol.errors import QueryError, Refusal
from protocol.queries import parameters as ps
from protocol.queries.answers import MapVersion
from protocol.queries.parameters import ANY_ROW, Freshness
from protocol.queries.places import MAX_CORNERS, Place, check_count, check_outline, refusal, take_places, text_of_places
from protocol.queries.roads import (
    SEGMENTS,
    WORKLIST,
    RoadQuery,
    encode_roads,
    parse_segments,
    parse_worklist,
)
from protocol.queries.route_requests import ROUTE, WAY, RouteQuery, WayQuery, encode_route, parse_route, parse_way
from protocol.site.geometry import MAX_CELLS, Bounds

MAX_SPANS = 2000  # of one history
MAX_SPAN_S = 1e9
MAX_RESOLUTION_M = 1000.0
WITHOUT_MEAN = ("heading", "resistance_class", "slope_class", "resistance_class_filled")  # layers, in larger cells


@dataclass(frozen=True)
class When:
    """as_of_ns: the map from samples stamped so or earlier; None: as it is. minus_ns: less the map as of that time.

    repairs: cells of a road whose ground changed, as `worklist` shows it, are read from the samples since.
    """

    as_of_ns: int | None = None
    minus_ns: int | None = None
    repairs: bool = False

    @property
    def times(self) -> tuple[int | None, ...]:
        """Times of the maps that are read: this one, and that which is taken off it."""
        return (self.as_of_ns,) if self.minus_ns is None else (self.as_of_ns, self.minus_ns)


NOW = When()


@dataclass(frozen=True)
class PointQuery:
    """The cell at a position in `map` [m]; no layers means all of them."""

    x_m: float
    y_m: float
    layers: tuple[str, ...] = ()
    fresh: Freshness = ANY_ROW
    when: When = NOW

    name = "point"


@dataclass(frozen=True)
class PointsQuery:
    """The cells at many places in `map` [m]; no layers means all of them."""

    places: tuple[Place, ...]
    layers: tuple[str, ...] = ()
    fresh: Freshness = ANY_ROW
    when: When = NOW

    name = "points"

    def __post_init__(self) -> None:
        if not self.places:
            raise refusal("places", "there is none")
        check_count("places", len(self.places))


@dataclass(frozen=True)
class RegionQuery:
    """All cells that a rectangle touches, or those whose centre lies in an outline; no layers means all of them.

    area: the outline, by its corners in either direction. resolution_m: of larger cells, a multiple of the map's, each
    the mean of what is known in it; None for the cells of the map.
    """

    area: Bounds | tuple[Place, ...]
    layers: tuple[str, ...] = ()
    fresh: Freshness = ANY_ROW
    when: When = NOW
    resolution_m: float | None = None

    name = "region"

    def __post_init__(self) -> None:
        if not isinstance(self.area, Bounds):
            check_outline("polygon", self.area)
        if self.resolution_m is not None and not 0 < self.resolution_m <= MAX_RESOLUTION_M:
            problem = f"{self.resolution_m:g} m is not above 0 and at most {MAX_RESOLUTION_M:g} m"
            raise refusal("resolution", problem)

    @property
    def bounds(self) -> Bounds:
        """The rectangle, or that around the outline."""
        if isinstance(self.area, Bounds):
            return self.area
        x_m, y_m = zip(*self.area, strict=True)
        return Bounds(min(x_m), min(y_m), max(x_m), max(y_m))


@dataclass(frozen=True)
class PieceQuery:
    """One more piece of a region that is answered in pieces; cursor: from its first piece. number: from 0 on."""

    cursor: int
    number: int
    fresh = ANY_ROW

    name = "piece"


@dataclass(frozen=True)
class HistoryQuery:
    """The cell at a position in `map` [m] over time, span by span.

    from_ns, to_ns: samples stamped from_ns <= stamp <= to_ns; to_ns None: the site's now, from_ns None: MAX_SPANS
    before. span_s: length of a span, None for a bucket.
    """

    x_m: float
    y_m: float
    layers: tuple[str, ...] = ()
    from_ns: int | None = None
    to_ns: int | None = None
    span_s: float | None = None
    fresh: Freshness = ANY_ROW

    name = "history"


@dataclass(frozen=True)
class InfoQuery:
    """The state of the map and of its server."""

    fresh: Freshness = ANY_ROW

    name = "info"


@dataclass(frozen=True)
class AliveQuery:
    """Whether the server takes batches: for probes, since it waits for nothing."""

    fresh = ANY_ROW

    name = "alive"


@dataclass(frozen=True)
class MachinesQuery:
    """What the server knows of each machine."""

    fresh: Freshness = ANY_ROW

    name = "machines"


@dataclass(frozen=True)
class CalibrationQuery:
    """What is taken off the samples of each machine, and what is known of its calibration."""

    fresh: Freshness = ANY_ROW

    name = "calibration"


@dataclass(frozen=True)
class ChangesQuery:
    """Changes of the ground with a number beyond `after`."""

    after: int = 0
    fresh = ANY_ROW  # the `after` of this query is not a journal row

    name = "changes"


@dataclass(frozen=True)
class TilesQuery:
    """Tiles of the map: all, or those that differ since a version of it; or all as of a time [ns].

    place: column and row of the tile from which on they are answered, in this order; None for the first answer.
    """

    since: MapVersion | None = None
    as_of_ns: int | None = None
    place: tuple[int, int] | None = None
    fresh = ANY_ROW

    name = "tiles"


@dataclass(frozen=True)
class WhyQuery:
    """Everything that is known of the cell at a position in `map` [m]. repairs: as in `When`."""

    x_m: float
    y_m: float
    as_of_ns: int | None = None
    repairs: bool = False
    fresh = ANY_ROW

    name = "why"


CellQuery = PointQuery | PointsQuery | RegionQuery | PieceQuery | HistoryQuery | WhyQuery
LineQuery = RouteQuery | WayQuery
MapQuery = (
    CellQuery
    | RoadQuery
    | LineQuery
    | TilesQuery
    | InfoQuery
    | AliveQuery
    | MachinesQuery
    | CalibrationQuery
    | ChangesQuery
)


def check_size(columns: int, rows: int) -> None:
    """Refuse a region with too many cells."""
    if columns * rows > MAX_CELLS:
        raise QueryError(Refusal.TOO_LARGE, f"region of {columns} x {rows} cells; at most {MAX_CELLS} are answered")


# --- to parameters ---------------------------------------------------------------------------------------------------


def encode_query(query: MapQuery) -> dict[str, str]:
    """Selector parameters."""
    match query:
        case AliveQuery():
            return {}
        case ChangesQuery():
            return {"after": str(query.after)} if query.after else {}
        case PieceQuery():
            return {"cursor": str(query.cursor), "number": str(query.number)}
        case TilesQuery():
            return _of_tiles(query)
        case WhyQuery():
            place = {"x": ps.text_of(query.x_m), "y": ps.text_of(query.y_m)}
            return place | ps.text_of_stamps({"as_of": query.as_of_ns}) | ({"repairs": "1"} if query.repairs else {})
    parameters = {}
    if isinstance(query, PointQuery | PointsQuery | RegionQuery | HistoryQuery):
        parameters = _of_map(query)
    elif isinstance(query, RoadQuery):
        parameters = encode_roads(query)
    elif isinstance(query, RouteQuery | WayQuery):
        parameters = encode_route(query)
    if query.fresh.after:
        parameters |= {"after": str(query.fresh.after), "wait": ps.text_of(query.fresh.wait_s)}
    return parameters


def reads_past(query: MapQuery) -> bool:
    """Whether the server has to read its journal for a query, which takes a while."""
    if isinstance(query, RoadQuery):
        return True
    if isinstance(query, WhyQuery):
        return query.as_of_ns is not None or query.repairs
    if isinstance(query, TilesQuery | RouteQuery | WayQuery):
        return query.as_of_ns is not None
    if isinstance(query, PointQuery | PointsQuery | RegionQuery):
        return query.when != NOW
    return isinstance(query, HistoryQuery)


def may_read_journal(query: MapQuery) -> bool:
    """Whether the server may have to read its journal, if only as the first one since its start."""
    return reads_past(query) or (isinstance(query, RouteQuery | WayQuery) and query.repairs)


def _of_tiles(query: TilesQuery) -> dict[str, str]:
    parameters = ps.text_of_stamps({"as_of": query.as_of_ns})
    if query.since:
        parameters |= {"store": query.since.store, "row": str(query.since.row), "fact": str(query.since.fact)}
    return parameters | ({"place": f"{query.place[0]},{query.place[1]}"} if query.place else {})


def _of_map(query: PointQuery | PointsQuery | RegionQuery | HistoryQuery) -> dict[str, str]:
    parameters = {"layers": ",".join(query.layers)} if query.layers else {}
    if isinstance(query, RegionQuery):
        parameters |= _of_region(query)
    elif isinstance(query, PointsQuery):
        parameters["places"] = text_of_places(query.places)
    else:
        parameters |= {"x": ps.text_of(query.x_m), "y": ps.text_of(query.y_m)}
    if isinstance(query, HistoryQuery):
        parameters |= ps.text_of_stamps({"from": query.from_ns, "to": query.to_ns})
        return parameters | ({"span": ps.text_of(query.span_s)} if query.span_s is not None else {})
    parameters |= ps.text_of_stamps({"as_of": query.when.as_of_ns, "minus": query.when.minus_ns})
    return parameters | ({"repairs": "1"} if query.when.repairs else {})


def _of_region(query: RegionQuery) -> dict[str, str]:
    resolution = {"resolution": ps.text_of(query.resolution_m)} if query.resolution_m is not None else {}
    if isinstance(query.area, Bounds):
        return {"bounds": ps.text_of_bounds(query.area), **resolution}
    return {"polygon": text_of_places(query.area), **resolution}


# --- from parameters -------------------------------------------------------------------------------------------------


def parse_query(name: str, parameters: Mapping[str, str]) -> MapQuery:
    """Parse the parameters of the query `name`; QueryError says what is wrong with which of them."""
    if name not in _QUERIES:
        raise QueryError(Refusal.UNKNOWN_QUERY, f"query `{name[:40]}` is not known; known: {', '.join(_QUERIES)}")
    known, parse = _QUERIES[name]
    ps.check_known(name, parameters, known)
    return parse(parameters)


def _parse_point(parameters: ps.Parameters) -> PointQuery:
    return PointQuery(*_place(parameters), _layers(parameters), ps.freshness(parameters), _when(parameters))


def _parse_region(parameters: ps.Parameters) -> RegionQuery:
    if {"bounds", "polygon"} <= set(parameters):
        raise refusal("polygon", "given with `bounds`: a region is a rectangle or an outline")
    outline = "polygon" in parameters
    area = take_places(parameters, "polygon", MAX_CORNERS) if outline else ps.bounds(parameters)
    resolution_m = ps.number(parameters, "resolution") if "resolution" in parameters else None
    same = _layers(parameters), ps.freshness(parameters), _when(parameters)
    return RegionQuery(area, *same, resolution_m)


def _parse_points(parameters: ps.Parameters) -> PointsQuery:
    places = take_places(parameters, "places")
    return PointsQuery(places, _layers(parameters), ps.freshness(parameters), _when(parameters))


def _parse_piece(parameters: ps.Parameters) -> PieceQuery:
    return PieceQuery(*(ps.count({name: ps.required(parameters, name)}, name) for name in ("cursor", "number")))


def _parse_history(parameters: ps.Parameters) -> HistoryQuery:
    from_ns, to_ns = ps.times(parameters)
    span_s = ps.number(parameters, "span") if "span" in parameters else None
    if span_s is not None and not 1 <= span_s <= MAX_SPAN_S:
        problem = f"parameter `span`: {span_s:g} s is not between 1 and {MAX_SPAN_S:g} s"
        raise QueryError(Refusal.OUT_OF_RANGE, problem)
    x_m, y_m = _place(parameters)
    return HistoryQuery(x_m, y_m, _layers(parameters), from_ns, to_ns, span_s, ps.freshness(parameters))


def _parse_tiles(parameters: ps.Parameters) -> TilesQuery:
    as_of_ns, place = ps.stamp(parameters, "as_of"), None
    if "place" in parameters:
        numbers = [ps.number({"place": part}, "place") for part in parameters["place"].split(",")]
        if len(numbers) != 2 or any(n != int(n) for n in numbers):
            raise QueryError(Refusal.OUT_OF_RANGE, "parameter `place` must be column,row of a tile")
        place = int(numbers[0]), int(numbers[1])
    if "store" not in parameters and not {"row", "fact"} & set(parameters):
        return TilesQuery(None, as_of_ns, place)
    if as_of_ns is not None:
        raise QueryError(Refusal.OUT_OF_RANGE, "`as_of` with a version: the tiles of a time do not change, ask for all")
    store = ps.required(parameters, "store")
    row, fact = (ps.count({name: ps.required(parameters, name)}, name) for name in ("row", "fact"))
    return TilesQuery(MapVersion(store, row, fact), place=place)


def _parse_why(parameters: ps.Parameters) -> WhyQuery:
    repairs = ps.flag(parameters, "repairs", default=False)
    return WhyQuery(*_place(parameters), ps.stamp(parameters, "as_of"), repairs)


_FRESH = ("after", "wait")
_QUERIES: dict[str, tuple[tuple[str, ...], Callable[[ps.Parameters], MapQuery]]] = {
    "point": (("x", "y", "layers", "as_of", "minus", "repairs", *_FRESH), _parse_point),
    "points": (("places", "layers", "as_of", "minus", "repairs", *_FRESH), _parse_points),
    "region": (("bounds", "polygon", "resolution", "layers", "as_of", "minus", "repairs", *_FRESH), _parse_region),
    "piece": (("cursor", "number"), _parse_piece),
    "history": (("x", "y", "layers", "from", "to", "span", *_FRESH), _parse_history),
    "machines": (_FRESH, lambda parameters: MachinesQuery(ps.freshness(parameters))),
    "calibration": (_FRESH, lambda parameters: CalibrationQuery(ps.freshness(parameters))),
    "changes": (("after",), lambda parameters: ChangesQuery(ps.count(parameters, "after"))),
    "tiles": (("store", "row", "fact", "as_of", "place"), _parse_tiles),
    "why": (("x", "y", "as_of", "repairs"), _parse_why),
    "segments": ((*SEGMENTS, *_FRESH), parse_segments),
    "worklist": ((*WORKLIST, *_FRESH), parse_worklist),
    "route": ((*ROUTE, *_FRESH), parse_route),
    "way": ((*WAY, *_FRESH), parse_way),
    "alive": ((), lambda _: AliveQuery()),
    "info": (_FRESH, lambda parameters: InfoQuery(ps.freshness(parameters))),
}


def _place(parameters: ps.Parameters) -> tuple[float, float]:
    return ps.number(parameters, "x"), ps.number(parameters, "y")


def _layers(parameters: ps.Parameters) -> tuple[str, ...]:
    return tuple(part for part in parameters.get("layers", "").split(",") if part)


def _when(parameters: ps.Parameters) -> When:
    repairs = ps.flag(parameters, "repairs", default=False)
    return When(ps.stamp(parameters, "as_of"), ps.stamp(parameters, "minus"), repairs)
