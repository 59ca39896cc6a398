"""The Python client of the map. It needs the base install only."""

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

SOLVE_S = 30.0  # that the server has to calibrate a fleet for: a large one on a busy host
Layers = str | Sequence[str]
Area = Bounds | tuple[float, float, float, float] | Sequence[Place]
T = TypeVar("T")


class Client:
    """Asks the map server of one site, and its followers where there are any.

    `ask` takes every query (`sitegrid.QUERIES`); methods are for the usual ones.
    origin: who gave the last answer, and how far behind the journal its map was.
    Every call may raise QueryError (refused), LinkError (no answer) or MessageError (an answer that cannot be read). A
    question that nobody takes, or whose server ends, is asked again for timeout_s: a restart of router or server shows
    as an answer that comes later.
    Arguments of several methods: layers: names, or a text of them with commas; none for all. as_of: the map from
    samples of this time or earlier: a stamp in nanoseconds, a `datetime`, ISO 8601, or "-1h" before the newest sample.
    after: answer once this journal row is merged, and wait for it at most 10 s.
    Fields that end in _ns are stamps, UTC in nanoseconds; `stamp` makes one of any time.
    """

    def __init__(self, session: zenoh.Session, endpoint: str, site: str, timeout_s: float = 10.0) -> None:
        self.session, self.site = session, site
        self.origin = SERVER
        self._asker = Asker(session, endpoint, site, timeout_s)
        self._listeners: list[Listener[GroundChange]] = []
        self._site: SiteInfo | None = None

    def ask(self, query: MapQuery[T], *, progress: Progress | None = None) -> T:
        """The whole answer to a query, however many replies it comes in.

        progress: called with each piece of a large region, as (here, of all).
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
        """Layers of the cell at a position in `map` [m], or in latitude and longitude [deg]; NaN is unknown."""
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

        area: cells that a rectangle (west, south, east, north) [m] touches, or those whose centre lies in an outline of
        corners (x, y) [m]; others are NaN. resolution_m: of larger cells, a multiple of the map's, each the mean of
        what is known in it.
        A large region comes in pieces, all of one version of the map; progress: as of `ask`.
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
        """What a drive along a line of places in `map` [m] costs a machine: energy, time, speed, with 90 % intervals.

        machine: its values, the name of a kind (`MACHINES`), or its own name on the site.
        """
        places = tuple((float(x), float(y)) for x, y in line)
        driven = machine_of(machine) if isinstance(machine, str) else machine
        return self.ask(RouteQuery(places, machine=driven, as_of_ns=self._as_of(as_of)))

    def info(self, *, after: int = 0) -> MapInfo:
        """State of the map and its server: site, rows journalled and merged, machines, counters, layers."""
        return self.ask(InfoQuery(after=after))

    def machines(self, *, after: int = 0) -> list[MachineState]:
        """What the server knows of each machine: whether it is trusted, why, and what it sent."""
        return list(self.ask(MachinesQuery(after=after)).machines)

    def changes(self, after_id: int = 0) -> list[GroundChange]:
        """Changes of the ground with an id beyond this one: when, where, how many cells, from what to what."""
        return list(self.ask(ChangesQuery(after_id)).changes)

    def watch(
        self, bounds: Area | None = None, layers: Layers = (), *, again_s: float = AGAIN_S, stop: Event | None = None
    ) -> Iterator[Region]:
        """Regions of what changed in the map, again and again; the first ones are all that there is.

        What they hold is what `region` says then, but for ages, which change with every sample. A map server or router
        that is away is waited for; what changed meanwhile comes then. End it by `break`, or by `stop`.
        """
        area = None if bounds is None else area_of(bounds)
        rectangle = area if area is None or isinstance(area, Bounds) else around(area)
        names = _names(layers)
        return watch(self.ask, lambda part: self.ask(RegionQuery(part, names)), rectangle, again_s, stop or Event())

    def watch_async(
        self, bounds: Area | None = None, layers: Layers = (), *, again_s: float = AGAIN_S, stop: Event | None = None
    ) -> AsyncIterator[Region]:
        """As `watch`, for `async for`."""
        return watch_async(self.watch(bounds, layers, again_s=again_s, stop=stop))

    def stamp(self, time: Time) -> int:
        """A time as a stamp in nanoseconds; ValueError where it is none."""
        return parse_time(time).stamp("time", lambda: self.info().stamp_ns)

    def site_info(self) -> SiteInfo:
        """The site: its name, origin, cells, and `crs`. It is asked for once."""
        if self._site is None:
            self._site = self.info().site
        return self._site

    def where(self) -> str:
        """Where the map lies, in a sentence: for who finds nothing at a place."""
        info = self.info()
        return where_it_lies(info.bounds, info.site.cell_m)

    def to_map(self, lat_deg: float, lon_deg: float) -> tuple[float, float]:
        """Position in `map` [m] of a place on Earth. It needs pyproj."""
        x_m, y_m, _ = self._projection().to_map(lat_deg, lon_deg, 0.0)
        return x_m, y_m

    def to_geodetic(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Latitude and longitude [deg] of a position in `map` [m]. It needs pyproj."""
        lat_deg, lon_deg, _ = self._projection().to_geodetic(x_m, y_m)
        return lat_deg, lon_deg

    def to_geopandas(self, answer: Segments | Worklist | ChangesAnswer) -> Any:
        """Roads, stretches or changes as a GeoDataFrame in the site's frame. It needs geopandas."""
        return to_geopandas(answer, self.site_info().crs)

    def followers(self) -> list[FollowerState]:
        """Followers that answer, and how far behind the journal each is; LinkError where there is no server either."""
        if not (followers := self._asker.followers()):
            self.ask(AliveQuery())
        return followers

    def on_change(self, callback: Callable[[GroundChange], object]) -> Listener[GroundChange]:
        """Call `callback`, on a thread of its own, with each change that is found or grows, until the handle is closed.

        Events are not repeated: ask `changes` for what was before, or was missed.
        """
        key = keys.changed(self.site)
        listener = Listener(self.session, key, lambda _, data: answer_codec.decode_change(data), callback)
        self._listeners.append(listener)
        return listener

    def trust(self, machine: str, reason: str = "", *, wait_s: float = 30.0) -> TrustAnswer:
        """Use a machine's samples whatever the server finds; returns its state then.

        wait_s: how long to wait for the map to be folded again, here as below.
        """
        return self._command(TrustCommand(machine, True, reason, wait_s), wait_s)

    def distrust(self, machine: str, reason: str, *, wait_s: float = 30.0) -> TrustAnswer:
        """Leave a machine's samples out of the map, earlier ones too."""
        return self._command(TrustCommand(machine, False, reason, wait_s), wait_s)

    def judge_automatically(self, machine: str, *, wait_s: float = 30.0) -> TrustAnswer:
        """Leave it to the server again whether a machine's samples are used."""
        return self._command(TrustCommand(machine, None, "", wait_s), wait_s)

    def calibrate(self, *, wait_s: float = 30.0) -> CalibrationAnswer:
        """Calibrate all machines with all samples that there are, and have the map follow; what is known then."""
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
        """Take these errors off all samples of a machine, whatever the server finds; 0 for what is not given."""
        command = CalibrateCommand(machine, zero, scale, across, reason=reason, wait_s=wait_s)
        return self._command(command, SOLVE_S + wait_s)

    def calibrate_automatically(self, machine: str, *, wait_s: float = 30.0) -> CalibrationAnswer:
        """Leave it to the server again what is taken off a machine's samples."""
        return self._command(CalibrateCommand(machine, auto=True, wait_s=wait_s), SOLVE_S + wait_s)

    def accept(self, store: str, reason: str) -> MapInfo:
        """Let the map server's store take the place of another one, which is gone: machines go on with it."""
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
        self.origin = answered.origin  # of the last answer of any thread: nothing here goes on with it
        return answered

    def _as_of(self, time: Time | None) -> int | None:
        return None if time is None else self.stamp(time)

    def _projection(self) -> Projection:
        return projection_of(self.site_info())

    def _command(self, command: Request[T], wait_s: float) -> T:
        key = keys.admin(self.site, command.name)
        return command.decode(self._asker.command(key, command.parameters(), wait_s))


def area_of(area: Area) -> Bounds | tuple[Place, ...]:
    """An area as a query has it."""
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
    """Connect to the router at `endpoint` and ask for the map of `site`; LinkError if no router is there.

    keys: folder of this client's keys, on a site that has them. site: default that of the keys, else `paper`.
    """
    config = join(endpoint, keys, site=site or "")
    name = site or (config.credentials.identity.site if config.credentials else "paper")
    return Client(open_session(config), config.endpoint, name, timeout_s)
