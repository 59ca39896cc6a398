"""The Python client of the map; the base install suffices."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from pathlib import Path
from threading import Event
from typing import Any, TypeVar, cast

import numpy as np
import zenoh

from protocol.queries import answer_codec
from protocol.queries.answers import (
    ChangesAnswer,
    FollowerState,
    GroundChange,
    MachineState,
    MapInfo,
    PointAnswer,
    Region,
    SiteInfo,
    TrustAnswer,
)
from protocol.queries.calibration import CalibrationAnswer
from protocol.queries.commands import AcceptCommand, CalibrateCommand, TrustCommand
from protocol.queries.origin import SERVER, Origin
from protocol.queries.places import Place, around, where_it_lies
from protocol.queries.request import MapQuery, Request
from protocol.queries.requests import AliveQuery, ChangesQuery, InfoQuery, MachinesQuery, PointQuery, RegionQuery
from protocol.queries.roads import Segments, Worklist
from protocol.queries.route_requests import RouteQuery
from protocol.queries.routing import LOADER, NamedMachine, RouteAnswer, RouteMachine, machine_of
from protocol.site.geometry import Bounds
from protocol.site.site_config import Projection
from protocol.wire import keys
from protocol.wire.session import DEFAULT_ENDPOINT, open_session
from sitegrid.features.feature import projection_of
from sitegrid.follower_choice import Answered, Asker
from sitegrid.listener import Listener
from sitegrid.notebook import MapRegion, to_geopandas
from sitegrid.security.join import join
from sitegrid.times import Time, parse_time
from sitegrid.watch import AGAIN_S, watch, watch_async
from sitegrid.whole_answers import Progress, whole_answer

SOLVE_S = 30.0  # the server's time to calibrate a large fleet on a busy host
Layers = str | Sequence[str]
Area = Bounds | tuple[float, float, float, float] | Sequence[Place]
T = TypeVar("T")


class Client:
    """Queries the map server of one site, and its followers.

    `ask` takes every query (`sitegrid.QUERIES`); methods cover the usual ones. origin: who gave the last answer, and
    the lag of its map behind the journal.

    Errors of every call: QueryError (refused), LinkError (no answer), MessageError (unreadable answer). Without an
    answer a query is retried for timeout_s, so a restart of router or server only delays it.

    Common arguments. layers: names, or a comma-separated text; none: all. as_of: the map from samples up to this time:
    nanoseconds, `datetime`, ISO 8601, or "-1h" before the newest sample. after: answer once this journal row is merged;
    waits at most 10 s. Fields that end in _ns are stamps, UTC in nanoseconds; `stamp` converts any time.
    """

    def __init__(self, session: zenoh.Session, endpoint: str, site: str, timeout_s: float = 10.0) -> None:
        self.session, self.site = session, site
        self.origin = SERVER
        self._asker = Asker(session, endpoint, site, timeout_s)
        self._listeners: list[Listener[GroundChange]] = []
        self._site: SiteInfo | None = None

    def ask(self, query: MapQuery[T], *, progress: Progress | None = None) -> T:
        """The complete answer to a query, in however many replies.

        progress: called per piece of a large region with (pieces received, total).
        """
        answer: Any = whole_answer(query, self._answered, progress)
        if isinstance(query, RegionQuery):
            answer = MapRegion.from_region(answer, self.site_info, self.where)
        return cast(T, answer)

    def point(
        self,
        x_m: float | None = None,
        y_m: float | None = None,
        layers: Layers = (),
        *,
        lat: float | None = None,
        lon: float | None = None,
        as_of: Time | None = None,
    ) -> PointAnswer:
        """Layers of the cell at a position in `map` [m], or at latitude and longitude [deg]; NaN: unknown."""
        if lat is not None and lon is not None:
            x_m, y_m = self.to_map(lat, lon)
        if x_m is None or y_m is None:
            raise ValueError("a point is x_m and y_m, or lat and lon")
        return self.ask(PointQuery(float(x_m), float(y_m), _names(layers), as_of_ns=self._as_of(as_of)))

    def region(
        self,
        area: Area,
        layers: Layers = (),
        *,
        as_of: Time | None = None,
        resolution_m: float | None = None,
        progress: Progress | None = None,
    ) -> MapRegion:
        """Layers of all cells of an area, as arrays with coordinates.

        area: a rectangle (west, south, east, north) [m], every cell it touches; or an outline of corners (x, y) [m],
        cells with their centre inside, others NaN. resolution_m: multiple of the cell size; means of the known values.
        A large region arrives in pieces of one map version; progress: as in `ask`.
        """
        query = RegionQuery(area_of(area), _names(layers), resolution_m, as_of_ns=self._as_of(as_of))
        return cast(MapRegion, self.ask(query, progress=progress))

    def route(
        self,
        line: Sequence[Place],
        machine: RouteMachine | NamedMachine | str = LOADER,
        *,
        as_of: Time | None = None,
    ) -> RouteAnswer:
        """Cost of a drive along places in `map` [m]: energy, time, speed, with 90 % intervals.

        machine: its values, a kind (`MACHINES`), or a machine's name on the site.
        """
        places = tuple((float(x), float(y)) for x, y in line)
        driven = machine_of(machine) if isinstance(machine, str) else machine
        return self.ask(RouteQuery(places, machine=driven, as_of_ns=self._as_of(as_of)))

    def info(self, *, after: int = 0) -> MapInfo:
        """State of map and server: site, rows journalled and merged, machines, counters, layers."""
        return self.ask(InfoQuery(after=after))

    def machines(self, *, after: int = 0) -> list[MachineState]:
        """State of each machine: trust, reasons, samples."""
        return list(self.ask(MachinesQuery(after=after)).machines)

    def changes(self, after_id: int = 0) -> list[GroundChange]:
        """Changes of the ground with an id above after_id."""
        return list(self.ask(ChangesQuery(after_id)).changes)

    def watch(
        self, bounds: Area | None = None, layers: Layers = (), *, again_s: float = AGAIN_S, stop: Event | None = None
    ) -> Iterator[Region]:
        """Regions of the map as they change, endlessly; first everything known.

        Values are those of `region`, but ages alone do not count as a change. Outages of server or router are bridged.
        End it with `break` or `stop`.
        """
        area = None if bounds is None else area_of(bounds)
        rectangle = area if area is None or isinstance(area, Bounds) else around(area)
        names = _names(layers)
        return watch(self.ask, lambda part: self.ask(RegionQuery(part, names)), rectangle, again_s, stop or Event())

    def watch_async(
        self, bounds: Area | None = None, layers: Layers = (), *, again_s: float = AGAIN_S, stop: Event | None = None
    ) -> AsyncIterator[Region]:
        """`watch` for `async for`."""
        return watch_async(self.watch(bounds, layers, again_s=again_s, stop=stop))

    def stamp(self, time: Time) -> int:
        """A time as a stamp in nanoseconds; ValueError if it is none."""
        return parse_time(time).stamp("time", lambda: self.info().stamp_ns)

    def site_info(self) -> SiteInfo:
        """The site: name, origin, cells, `crs`. Queried once."""
        if self._site is None:
            self._site = self.info().site
        return self._site

    def where(self) -> str:
        """The map's extent in a sentence."""
        info = self.info()
        return where_it_lies(info.bounds, info.site.cell_m)

    def to_map(self, lat_deg: float, lon_deg: float) -> tuple[float, float]:
        """Position in `map` [m] of latitude and longitude. Needs pyproj."""
        x_m, y_m, _ = self._projection().to_map(lat_deg, lon_deg, 0.0)
        return x_m, y_m

    def to_geodetic(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Latitude and longitude [deg] of a position in `map` [m]. Needs pyproj."""
        lat_deg, lon_deg, _ = self._projection().to_geodetic(x_m, y_m)
        return lat_deg, lon_deg

    def to_geopandas(self, answer: Segments | Worklist | ChangesAnswer) -> Any:
        """Roads, worklist rows or changes as a GeoDataFrame in the site's frame. Needs geopandas."""
        return to_geopandas(answer, self.site_info().crs)

    def followers(self) -> list[FollowerState]:
        """Reachable followers and their lag behind the journal; LinkError if there is no server either."""
        if not (followers := self._asker.followers()):
            self.ask(AliveQuery())
        return followers

    def on_change(self, callback: Callable[[GroundChange], object]) -> Listener[GroundChange]:
        """Call `callback`, on its own thread, with each change found or grown, until the handle is closed.

        Events are not repeated: query `changes` for earlier or missed ones.
        """
        key = keys.changed(self.site)
        listener = Listener(self.session, key, lambda _, data: answer_codec.decode_change(data), callback)
        self._listeners.append(listener)
        return listener

    def trust(self, machine: str, reason: str = "", *, wait_s: float = 30.0) -> TrustAnswer:
        """Use a machine's samples whatever the server finds; returns its new state.

        wait_s: timeout for the map to be folded again, in the following methods too.
        """
        return self._command(TrustCommand(machine, True, reason, wait_s), wait_s)

    def distrust(self, machine: str, reason: str, *, wait_s: float = 30.0) -> TrustAnswer:
        """Exclude a machine's samples from the map, past ones too."""
        return self._command(TrustCommand(machine, False, reason, wait_s), wait_s)

    def judge_automatically(self, machine: str, *, wait_s: float = 30.0) -> TrustAnswer:
        """Let the server decide about a machine's samples again."""
        return self._command(TrustCommand(machine, None, "", wait_s), wait_s)

    def calibrate(self, *, wait_s: float = 30.0) -> CalibrationAnswer:
        """Calibrate all machines with all samples, and update the map; returns the calibration."""
        return self._command(CalibrateCommand(wait_s=wait_s), SOLVE_S + wait_s)

    def correct(
        self,
        machine: str,
        reason: str,
        *,
        zero: float | None = None,
        scale: float | None = None,
        across: float | None = None,
        wait_s: float = 30.0,
    ) -> CalibrationAnswer:
        """Remove these errors from all samples of a machine, whatever the server finds; default 0."""
        command = CalibrateCommand(machine, zero, scale, across, reason=reason, wait_s=wait_s)
        return self._command(command, SOLVE_S + wait_s)

    def calibrate_automatically(self, machine: str, *, wait_s: float = 30.0) -> CalibrationAnswer:
        """Let the server decide about a machine's corrections again."""
        return self._command(CalibrateCommand(machine, auto=True, wait_s=wait_s), SOLVE_S + wait_s)

    def accept(self, store: str, reason: str) -> MapInfo:
        """Let the server's store replace a lost one: machines continue with it."""
        return self._command(AcceptCommand(store, reason), 0.0)

    def close(self) -> None:
        """Close the session and its listeners."""
        for listener in self._listeners:
            listener.close()
        self.session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _answered(self, query: MapQuery[Any], at: Origin | None = None) -> Answered:
        answered = self._asker.ask(query, at=at)
        self.origin = answered.origin  # of the last answer on any thread; informative only
        return answered

    def _as_of(self, time: Time | None) -> int | None:
        return None if time is None else self.stamp(time)

    def _projection(self) -> Projection:
        return projection_of(self.site_info())

    def _command(self, command: Request[T], wait_s: float) -> T:
        key = keys.admin(self.site, command.name)
        return command.decode(self._asker.command(key, command.parameters(), wait_s))


def area_of(area: Area) -> Bounds | tuple[Place, ...]:
    """An area in the form of queries."""
    if isinstance(area, Bounds):
        return area
    given = np.asarray(area, float)
    if given.ndim == 1 and given.size == 4:
        return Bounds(*given.tolist())
    if given.ndim != 2 or given.shape[1] != 2:
        raise ValueError("area: neither west, south, east, north nor corners x, y")
    return tuple(map(tuple, given.tolist()))


def _names(layers: Layers) -> tuple[str, ...]:
    names = layers.split(",") if isinstance(layers, str) else layers
    return tuple(name.strip() for name in names if name.strip())


def connect(
    endpoint: str = DEFAULT_ENDPOINT, site: str | None = None, *, timeout_s: float = 10.0, keys: Path | None = None
) -> Client:
    """Connect to the router at `endpoint`, as a client of `site`; LinkError if there is no router.

    keys: folder of this client's keys, on a site with keys. site: default: that of the keys, else `paper`.
    """
    config = join(endpoint, keys, site=site or "")
    name = site or (config.credentials.identity.site if config.credentials else "paper")
    return Client(open_session(config), config.endpoint, name, timeout_s)
