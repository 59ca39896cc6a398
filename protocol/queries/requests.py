"""Map queries (docs/protocol.md, "Map queries"), declared once, here or beside their answers.

A new one is a class in QUERIES, and a function of the map server.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from protocol.queries import answer_codec as codec
from protocol.queries import answers
from protocol.queries.calibration import CalibrationAnswer, decode_calibration, encode_calibration
from protocol.queries.coverage import CoverageQuery
from protocol.queries.lanes import LanesQuery
from protocol.queries.map_tiles import TilesQuery
from protocol.queries.parameters import METRES, STAMP, WORDS, check_order, count, number, refusal
from protocol.queries.places import AREA, Place, around, places
from protocol.queries.reasons import CellReasons, decode_why, encode_why
from protocol.queries.request import AskFirst, AsOf, Codec, Compared, Fresh, MapQuery, Size, asked, grouped, parse
from protocol.queries.roads import SegmentsQuery, WorklistQuery
from protocol.queries.route_requests import RouteQuery, WayQuery
from protocol.site.geometry import Bounds

MAX_SPANS = 2000  # per history
MAX_RESOLUTION_M = 1000.0
WITHOUT_MEAN = ("heading", "resistance_class", "slope_class", "resistance_class_filled")  # no layers of larger cells
X, Y = "east of the site's origin [m]", "north of it [m]"
LAYERS = "names, comma-separated; without it all"


@dataclass(frozen=True)
class PointQuery(Compared[answers.PointAnswer], Fresh[answers.PointAnswer]):
    """The cell at a position in `map` [m]; no layers means all."""

    x_m: float = asked(METRES, "x", X)
    y_m: float = asked(METRES, "y", Y)
    layers: tuple[str, ...] = asked(WORDS, "layers", LAYERS, ())

    name = "point"
    help = "layers of the cell at a position, in metres"
    codec = Codec(codec.encode_point, codec.decode_point)


@dataclass(frozen=True)
class PointsQuery(Compared[answers.PointsAnswer], Fresh[answers.PointsAnswer]):
    """The cells at many positions in `map` [m]; no layers means all."""

    places: tuple[Place, ...] = asked(places(), "places", "x,y,x,y,... [m]")
    layers: tuple[str, ...] = asked(WORDS, "layers", LAYERS, ())

    name = "points"
    help = "layers of the cells at many positions, in metres"
    codec = Codec(codec.encode_points, codec.decode_points)
    size = Size.PIECE

    def __post_init__(self) -> None:
        if not self.places:
            raise refusal("places", "there is none")
        super().__post_init__()

    @property
    def is_long(self) -> bool:
        """See `MapQuery`."""
        return True


@dataclass(frozen=True)
class RegionQuery(Compared[answers.Region], Fresh[answers.Region]):
    """Cells that a rectangle touches, or with centre in an outline; no layers means all.

    area: rectangle, or corners of the outline in either direction. resolution_m: edge of larger cells, a multiple of
    the map's, as means of known cells; None for the map's.
    """

    area: Bounds | tuple[Place, ...] = grouped(AREA)
    layers: tuple[str, ...] = asked(WORDS, "layers", LAYERS, ())
    resolution_m: float | None = asked(
        number(0.0, MAX_RESOLUTION_M, "m", above=True),
        "resolution",
        "edge of larger cells [m], a multiple of the map's: means of what is known in each",
        None,
    )

    name = "region"
    help = "layers of the cells of a rectangle or an outline, in metres"
    codec = Codec(codec.encode_region, codec.decode_region)
    size = Size.PIECE

    @property
    def is_long(self) -> bool:
        """See `MapQuery`."""
        return self.resolution_m is not None

    @property
    def bounds(self) -> Bounds:
        """The rectangle, or the outline's."""
        return self.area if isinstance(self.area, Bounds) else around(self.area)


@dataclass(frozen=True)
class PieceQuery(MapQuery[answers.Region]):
    """Another piece of a region; cursor: of its first piece; number: from 0."""

    cursor: int = asked(count(is_stated=True), "cursor", "of the first piece")
    number: int = asked(count(is_stated=True), "number", "of the piece, from 0 on")

    name = "piece"
    help = "one more piece of a large region"
    codec = Codec(codec.encode_region, codec.decode_region)
    ask_first = AskFirst.SERVER_ALONE
    size = Size.PIECE

    @property
    def may_read_journal(self) -> bool:
        """See `MapQuery`: for a region of the past."""
        return True


@dataclass(frozen=True)
class HistoryQuery(Fresh[answers.HistoryAnswer]):
    """The cell at a position in `map` [m] over time.

    from_ns, to_ns: bounds of stamps, included; default: to the site's now, from MAX_SPANS earlier. span_s: of one span,
    None for a bucket.
    """

    x_m: float = asked(METRES, "x", X)
    y_m: float = asked(METRES, "y", Y)
    layers: tuple[str, ...] = asked(WORDS, "layers", LAYERS, ())
    from_ns: int | None = asked(STAMP, "from", "samples from this time on", None)
    to_ns: int | None = asked(STAMP, "to", "samples up to this time; default the newest", None)
    span_s: float | None = asked(
        number(1.0, 1e9, "s"), "span", "length of one span [s]; default that of a bucket, 5 minutes", None
    )

    name = "history"
    help = "the cell at a position over time"
    codec = Codec(codec.encode_history, codec.decode_history)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_order(self.from_ns, self.to_ns)

    @property
    def reads_past(self) -> bool:
        """See `MapQuery`."""
        return True


@dataclass(frozen=True)
class InfoQuery(Fresh[answers.MapInfo]):
    """State of map and server."""

    name = "info"
    help = "state of the map and its server"
    codec = Codec(codec.encode_info, codec.decode_info)
    ask_first = AskFirst.SERVER


@dataclass(frozen=True)
class AliveQuery(MapQuery[answers.ServerAlive]):
    """Whether the server takes batches; for probes, it never waits."""

    name = "alive"
    help = "whether the map server takes batches: for probes"
    codec = Codec(codec.encode_alive, codec.decode_alive)
    ask_first = AskFirst.SERVER_ALONE


@dataclass(frozen=True)
class MachinesQuery(Fresh[answers.MachinesAnswer]):
    """The server's view of each machine."""

    name = "machines"
    help = "state of each machine: samples, trust, reasons"
    codec = Codec(codec.encode_machines, codec.decode_machines)
    ask_first = AskFirst.SERVER_ALONE


@dataclass(frozen=True)
class CalibrationQuery(Fresh[CalibrationAnswer]):
    """Corrections of machines' samples, and their calibration."""

    name = "calibration"
    help = "what is taken off the samples of each machine"
    codec = Codec(encode_calibration, decode_calibration)
    ask_first = AskFirst.SERVER_ALONE


@dataclass(frozen=True)
class ChangesQuery(MapQuery[answers.ChangesAnswer]):
    """Changes of the ground with an id above after_id."""

    after_id: int = asked(count(), "after", "with a number beyond this one", 0)

    name = "changes"
    help = "changes of the ground: place and time"
    codec = Codec(codec.encode_changes, codec.decode_changes)
    ask_first = AskFirst.SERVER


@dataclass(frozen=True)
class WhyQuery(AsOf[CellReasons]):
    """All about the cell at a position in `map` [m]."""

    x_m: float = asked(METRES, "x", X)
    y_m: float = asked(METRES, "y", Y)

    name = "why"
    help = "why the cell at a position has its value"
    codec = Codec(encode_why, decode_why)


QUERIES: dict[str, type[MapQuery[Any]]] = {
    cls.name: cls
    for cls in (
        PointQuery,
        PointsQuery,
        RegionQuery,
        PieceQuery,
        HistoryQuery,
        MachinesQuery,
        CalibrationQuery,
        ChangesQuery,
        TilesQuery,
        WhyQuery,
        SegmentsQuery,
        WorklistQuery,
        RouteQuery,
        WayQuery,
        AliveQuery,
        InfoQuery,
        CoverageQuery,
        LanesQuery,
    )
}


def parse_query(name: str, parameters: Mapping[str, str]) -> MapQuery[Any]:
    """Parse a query; QueryError names the wrong parameter."""
    return parse("query", QUERIES, name, parameters)
