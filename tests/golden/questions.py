"""Every query and command with every option, for the selectors in `selectors.txt`.

`PYTHONPATH=. python tests/golden/questions.py` rewrites them, only after a deliberate change of the wire and
docs/protocol.md.
"""

from __future__ import annotations

from protocol.queries.answers import MapVersion
from protocol.queries.commands import AcceptCommand, CalibrateCommand, TrustCommand
from protocol.queries.coverage import CoverageQuery
from protocol.queries.lanes import LanesQuery
from protocol.queries.map_tiles import TilesQuery
from protocol.queries.requests import (
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
from protocol.queries.roads import SegmentsQuery, WorklistQuery
from protocol.queries.route_requests import RouteQuery, WayQuery
from protocol.queries.routing import MACHINES, NamedMachine
from protocol.site.geometry import Bounds
from tests.paths import GOLDEN

SELECTORS = GOLDEN / "selectors.txt"
T0 = 1_750_000_000_000_000_000
FRESH = {"after": 17, "wait_s": 2.5}
WHEN = {"as_of_ns": T0, "minus_ns": T0 - 10**9}
RECTANGLE = Bounds(0.0, -3.5, 200.0, 150.0)
ROADS = {"from_ns": T0, "to_ns": T0 + 10**12, "as_of_ns": T0 + 10**13, "bounds": RECTANGLE, "machine": "loader-1"}
LINE = ((0.0, 0.0), (30.0, 40.0))
LATER = {"as_of_ns": T0, **FRESH}

QUESTIONS = (
    PointQuery(12.0, -40.5),
    PointQuery(12.0, -40.5, ("resistance", "visits"), **FRESH, **WHEN),
    PointsQuery(((1.5, -2.0), (3.0, 4.0))),
    PointsQuery(((1.5, -2.0), (3.0, 4.0)), ("visits",), **FRESH, **WHEN),
    RegionQuery(RECTANGLE),
    RegionQuery(RECTANGLE, ("resistance",), 4.0, **FRESH, **WHEN),
    RegionQuery(((0.0, 0.0), (9.0, 0.5), (3.0, 8.0)), as_of_ns=T0, **FRESH),
    PieceQuery(7, 2),
    HistoryQuery(12.0, 40.5),
    HistoryQuery(12.0, 40.5, ("grade",), T0, T0 + 10**12, 3600.0, **FRESH),
    TilesQuery(),
    TilesQuery(MapVersion("0123456789abcdef", 17, 3), place=(-3, 12)),
    TilesQuery(as_of_ns=T0, place=(-3, 12)),
    WhyQuery(12.0, 40.5),
    WhyQuery(12.0, 40.5, as_of_ns=T0),
    SegmentsQuery(),
    SegmentsQuery(**ROADS, **FRESH),
    WorklistQuery(),
    WorklistQuery(0.03, 0.4, 10, **ROADS, **FRESH),
    RouteQuery(LINE),
    RouteQuery(LINE, machine=MACHINES["truck"], stops=(False, True), step_m=50.0, unknown="refuse", **LATER),
    RouteQuery(LINE, machine=NamedMachine("truck-1", (("mass_kg", 3e4), ("speed_mps", 6.0))), stops=(False, False)),
    WayQuery(*LINE),
    WayQuery(*LINE, "time", 0.1, 5.0, LINE, stops=(True, False), step_m=10.0, unknown=0.05, **LATER),
    MachinesQuery(),
    MachinesQuery(**FRESH),
    CalibrationQuery(**FRESH),
    ChangesQuery(),
    ChangesQuery(3),
    InfoQuery(**FRESH),
    AliveQuery(),
    CoverageQuery(),
    CoverageQuery(RECTANGLE, as_of_ns=T0, **FRESH),
    LanesQuery(),
    LanesQuery(RECTANGLE, T0),
)
COMMANDS = (
    TrustCommand("loader-2", True),
    TrustCommand("loader-2", False, "moved; x = 3 %", 60.0),
    TrustCommand("loader-2", None),
    AcceptCommand("0123456789abcdef", "disk died"),
    CalibrateCommand(wait_s=60.0),
    CalibrateCommand("loader-2", 0.004, -0.03, 0.0, reason="levelled; 12 May"),
    CalibrateCommand("loader-2", auto=True),
)


def selectors() -> list[str]:
    """Name and parameters of each, sorted by name."""
    sent = [(one.name, one.parameters()) for one in (*QUESTIONS, *COMMANDS)]
    return [f"{name}?{';'.join(f'{key}={parameters[key]}' for key in sorted(parameters))}" for name, parameters in sent]


if __name__ == "__main__":
    SELECTORS.write_text("\n".join(selectors()) + "\n")
