"""What a program gets as `sitegrid.NAME`: the client, its answers and its errors."""

from protocol.errors import ConfigError, LinkError, MessageError, QueryError, SitegridError
from protocol.queries.answers import (
    ChangesAnswer,
    FollowerState,
    GroundChange,
    HistoryAnswer,
    HistorySpan,
    MachinesAnswer,
    MachineState,
    MapInfo,
    MapVersion,
    PointAnswer,
    PointsAnswer,
    Region,
    SampleCounts,
    ServerAlive,
    SiteInfo,
    TrustAnswer,
)
from protocol.queries.calibration import CalibrationAnswer, CorrectedSpan, MachineCalibration
from protocol.queries.coverage import Coverage, CoverageQuery
from protocol.queries.lanes import LanesAnswer, LanesQuery
from protocol.queries.map_tiles import MapTile, TilesAnswer, TilesQuery
from protocol.queries.origin import Origin
from protocol.queries.reasons import CellReasons, Votes
from protocol.queries.requests import (
    QUERIES,
    CalibrationQuery,
    ChangesQuery,
    HistoryQuery,
    InfoQuery,
    MachinesQuery,
    PointQuery,
    PointsQuery,
    RegionQuery,
    WhyQuery,
)
from protocol.queries.roads import (
    RoadChange,
    RoadSegment,
    Segments,
    SegmentsQuery,
    Worklist,
    WorklistQuery,
    WorklistRow,
)
from protocol.queries.route_requests import RouteQuery, WayQuery
from protocol.queries.routing import LOADER, MACHINES, NamedMachine, RouteAnswer, RouteMachine, RouteSteps, RouteTotals
from protocol.site.geometry import Bounds
from protocol.site.site_config import KnownGround
from protocol.version import package_version
from sitegrid.client import Client, connect
from sitegrid.listener import Listener
from sitegrid.notebook import MapRegion

__all__ = ["Client", "Listener", "connect"]
__all__ += ["ConfigError", "LinkError", "MessageError", "QueryError", "SitegridError"]
__all__ += ["GroundChange", "HistorySpan", "MachineState", "MapInfo", "PointAnswer", "PointsAnswer"]
__all__ += ["Region", "TrustAnswer"]
__all__ += ["CalibrationAnswer", "CorrectedSpan", "MachineCalibration"]
__all__ += ["CellReasons", "FollowerState", "MapTile", "MapVersion", "Origin", "TilesAnswer", "Votes"]
__all__ += ["RoadChange", "RoadSegment", "Segments", "Worklist", "WorklistRow"]
__all__ += ["LOADER", "MACHINES", "NamedMachine", "RouteAnswer", "RouteMachine", "RouteSteps", "RouteTotals"]
__all__ += ["Bounds", "KnownGround", "SampleCounts", "ServerAlive", "SiteInfo"]
__all__ += ["QUERIES", "CalibrationQuery", "ChangesQuery", "HistoryQuery", "InfoQuery", "MachinesQuery"]
__all__ += ["PointQuery", "PointsQuery", "RegionQuery", "RouteQuery", "SegmentsQuery", "TilesQuery", "WayQuery"]
__all__ += ["WhyQuery", "WorklistQuery"]
__all__ += ["ChangesAnswer", "Coverage", "CoverageQuery", "HistoryAnswer", "LanesAnswer", "LanesQuery"]
__all__ += ["MachinesAnswer", "MapRegion"]
__version__ = package_version()
