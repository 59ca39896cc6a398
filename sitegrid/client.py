"""The Python client of the map. It needs the base install only.

It is one module because it is one class: all that a program may ask.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import zenoh

from protocol.errors import QueryError, Refusal
from protocol.queries import answer_codec, requests
from protocol.queries.answers import (
    FollowerState,
    GroundChange,
    HistorySpan,
    MachineState,
    MapInfo,
    MapVersion,
    PointAnswer,
    PointsAnswer,
    Region,
    ServerAlive,
    TrustAnswer,
)
from protocol.queries.calibration import CalibrationAnswer, decode_calibration
from protocol.queries.commands import AcceptCommand, CalibrateCommand, TrustCommand, encode_command
from protocol.queries.map_tiles import TilesAnswer, decode_tiles
from protocol.queries.origin import SERVER, Origin
from protocol.queries.parameters import Freshness
from protocol.queries.pieces import Progress, joined
from protocol.queries.places import Place
from protocol.queries.reasons import CellReasons, decode_why
from protocol.queries.roads import Segments, SegmentsQuery, Worklist, WorklistQuery, decode_segments, decode_worklist
from protocol.queries.route_requests import RouteQuery, WayQuery
from protocol.queries.routing import LOADER, NamedMachine, RouteAnswer, RouteMachine, decode_answer, machine_of
from protocol.site.geometry import Bounds
from protocol.wire import keys
from protocol.wire.session import DEFAULT_ENDPOINT, open_session
from sitegrid.asking import Answered, Asker
from sitegrid.listener import Listener
from sitegrid.security.join import join

SOLVE_S = 30.0  # likewise, that it has to calibrate a fleet for: a large one on a busy host
REGION_ATTEMPTS = 3
Layers = str | Sequence[str]


class Client:
    """Asks the map server of one site, and its followers where there are any.

    origin: who gave the last answer, and how far behind the journal its map was.
    Every call may raise QueryError (refused), LinkError (no answer) or MessageError (an answer that cannot be read). A
    question that nobody takes, or whose server ends, is asked again for timeout_s: a restart of router or server shows
    as an answer that comes later.
    Arguments of several methods: layers: names, or a text of them with commas; none for all. after: answer once this
    journal row is merged, and wait for it at most wait_s [s]. as_of_ns: from samples stamped so or earlier. minus_ns:
    less the values as of that time. repairs: cells of a road whose ground changed, as `worklist` shows it, are read
    from the samples since.
    Times are stamps, UTC in nanoseconds.
    """

    def __init__(self, session: zenoh.Session, endpoint: str, site: str, timeout_s: float = 10.0) -> None:
        self.session, self.site = session, site
        self.origin = SERVER
        self._asker = Asker(session, endpoint, site, timeout_s)
        self._listeners: list[Listener[GroundChange]] = []

    def point(
        self,
        x_m: float,
        y_m: float,
        layers: Layers = (),
        *,
        as_of_ns: int | None = None,
        minus_ns: int | None = None,
        repairs: bool = False,
        after: int = 0,
        wait_s: float = 10.0,
    ) -> PointAnswer:
        """Layers of the cell at a position in `map`; NaN is unknown."""
        when, fresh = requests.When(as_of_ns, minus_ns, repairs), Freshness(after, wait_s)
        query = requests.PointQuery(float(x_m), float(y_m), _names(layers), fresh, when)
        return answer_codec.decode_point(self._ask(query))

    def points(
        self,
        places: Sequence[Place],
        layers: Layers = (),
        *,
        as_of_ns: int | None = None,
        minus_ns: int | None = None,
        repairs: bool = False,
        after: int = 0,
        wait_s: float = 10.0,
    ) -> PointsAnswer:
        """Layers of the cells at many places (x, y) in `map`, as arrays in their order; NaN is unknown."""
        when, fresh = requests.When(as_of_ns, minus_ns, repairs), Freshness(after, wait_s)
        query = requests.PointsQuery(tuple((float(x), float(y)) for x, y in places), _names(layers), fresh, when)
        return answer_codec.decode_points(self._ask(query))

    def region(
        self,
        area: Bounds | tuple[float, float, float, float] | Sequence[Place],
        layers: Layers = (),
        *,
        resolution_m: float | None = None,
        as_of_ns: int | None = None,
        minus_ns: int | None = None,
        repairs: bool = False,
        after: int = 0,
        wait_s: float = 10.0,
        progress: Progress | None = None,
    ) -> Region:
        """Layers of all cells of an area, as arrays with coordinates.

        area: cells that a rectangle (west, south, east, north) [m] touches, or those whose centre lies in an outline of
        corners (x, y) [m]; others are NaN. resolution_m: of larger cells, a multiple of the map's, each the mean of
        what is known in it.
        A large region comes in pieces, all of one version of the map; progress is called with each, as (here, of all).
        """
        when, fresh = requests.When(as_of_ns, minus_ns, repairs), Freshness(after, wait_s)
        query = requests.RegionQuery(_area(area), _names(layers), fresh, when, resolution_m)
        for _ in range(REGION_ATTEMPTS - 1):
            try:
                return joined(self._pieces(query), progress)
            except QueryError as error:
                if error.reason != Refusal.EXPIRED:  # else that version of the map is not kept any more: begin again
                    raise
        return joined(self._pieces(query), progress)

    def history(
        self,
        x_m: float,
        y_m: float,
        layers: Layers = (),
        *,
        from_ns: int | None = None,
        to_ns: int | None = None,
        span_s: float | None = None,
        after: int = 0,
        wait_s: float = 10.0,
    ) -> tuple[HistorySpan, ...]:
        """Layers of the cell at a position in `map`, span by span, oldest first; spans without samples are skipped.

        from_ns, to_ns: both included; without them the newest 2000 spans until now. span_s: default one bucket.
        """
        fresh = Freshness(after, wait_s)
        query = requests.HistoryQuery(float(x_m), float(y_m), _names(layers), from_ns, to_ns, span_s, fresh)
        return answer_codec.decode_history(self._ask(query)).spans

    def tiles(self, since: MapVersion | None = None, *, as_of_ns: int | None = None) -> TilesAnswer:
        """The map in tiles of 8-bit layers, for pages that draw it: those that differ since a version, or all.

        They come in several replies. What changes meanwhile may be in it, and differs since the answer's version.
        """
        first = answer = decode_tiles(self._ask(requests.TilesQuery(since, as_of_ns)))
        tiles = list(first.tiles)
        while answer.next_place:
            answer = decode_tiles(self._ask(requests.TilesQuery(since, as_of_ns, answer.next_place)))
            if _goes_back(first, answer):
                return self.tiles(as_of_ns=as_of_ns)
            tiles += answer.tiles
        return replace(first, tiles=tuple(tiles), next_place=None)

    def why(self, x_m: float, y_m: float, *, as_of_ns: int | None = None, repairs: bool = False) -> CellReasons:
        """Everything that is known of the cell at a position in `map`: votes, passes, machines, changes."""
        return decode_why(self._ask(requests.WhyQuery(float(x_m), float(y_m), as_of_ns, repairs)))

    def segments(
        self,
        *,
        from_ns: int | None = None,
        to_ns: int | None = None,
        as_of_ns: int | None = None,
        bounds: Bounds | None = None,
        machine: str = "",
        after: int = 0,
        wait_s: float = 10.0,
    ) -> Segments:
        """Roads that the map shows, segment by segment, and what drove on them from one hour to another.

        machine: traffic of this one alone, and what it measured.
        """
        fresh = Freshness(after, wait_s)
        return decode_segments(self._ask(SegmentsQuery(from_ns, to_ns, as_of_ns, bounds, machine, fresh)))

    def worklist(
        self,
        target: float = 0.02,
        *,
        efficiency: float = 0.35,
        limit: int = 100,
        from_ns: int | None = None,
        to_ns: int | None = None,
        as_of_ns: int | None = None,
        bounds: Bounds | None = None,
        machine: str = "",
        after: int = 0,
        wait_s: float = 10.0,
    ) -> Worklist:
        """Stretches of road that cost more than ground of a target c_rr would, the dearest first.

        efficiency: of engine and drive train, for litres of diesel. machine: what this one alone loses.
        """
        query = WorklistQuery(
            target, efficiency, limit, from_ns, to_ns, as_of_ns, bounds, machine, Freshness(after, wait_s)
        )
        return decode_worklist(self._ask(query))

    def route(
        self,
        line: Sequence[tuple[float, float]],
        machine: RouteMachine | NamedMachine | str = LOADER,
        *,
        stops: tuple[bool, bool] = (True, True),
        step_m: float = 25.0,
        unknown: str | float = "dearest",
        as_of_ns: int | None = None,
        repairs: bool = True,
        after: int = 0,
        wait_s: float = 10.0,
    ) -> RouteAnswer:
        """What a drive along a line of places in `map` [m] costs a machine: energy, time, speed, with 90 % intervals.

        machine: its values, the name of a kind (`MACHINES`), or its own name on the site. stops: whether it stands at
        the begin and at the end. step_m: of the steps that are answered. unknown: what ground that nobody knows is
        taken for: "dearest" (as dear as the dearest tenth of the ground around is uphill; the totals say how dear
        that was), "refuse", or a rolling resistance coefficient.
        """
        fresh = Freshness(after, wait_s)
        places = tuple((float(x), float(y)) for x, y in line)
        return self.drive(RouteQuery(places, _machine(machine), stops, step_m, unknown, as_of_ns, fresh, repairs))

    def way(
        self,
        start: tuple[float, float],
        end: tuple[float, float],
        machine: RouteMachine | NamedMachine | str = LOADER,
        *,
        cost: str = "energy",
        max_grade: float = 0.3,
        margin_m: float = 0.0,
        avoid: Sequence[tuple[float, float]] = (),
        stops: tuple[bool, bool] = (True, True),
        step_m: float = 25.0,
        unknown: str | float = "dearest",
        as_of_ns: int | None = None,
        repairs: bool = True,
        after: int = 0,
        wait_s: float = 10.0,
    ) -> RouteAnswer:
        """The line from one place to another [m] that costs a machine least, and what it costs.

        cost: "energy" or "time". max_grade: of ground that it is led over [m/m]. margin_m: how far it stays from what
        it may not be led over, and from the places to avoid, as parked machines. The others: as of `route`.
        """
        ends = [(float(x), float(y)) for x, y in (start, end, *avoid)]
        query = WayQuery(
            ends[0],
            ends[1],
            _machine(machine),
            cost,
            max_grade,
            margin_m,
            tuple(ends[2:]),
            stops,
            step_m,
            unknown,
            as_of_ns,
            Freshness(after, wait_s),
            repairs,
        )
        return self.drive(query)

    def drive(self, query: RouteQuery | WayQuery) -> RouteAnswer:
        """What a drive costs, of a query that is made already."""
        return decode_answer(self._ask(query))

    def alive(self) -> ServerAlive:
        """Whether the server takes batches: for probes, since it waits for nothing."""
        return answer_codec.decode_alive(self._ask(requests.AliveQuery()))

    def followers(self) -> list[FollowerState]:
        """Followers that answer, and how far behind the journal each is; LinkError where there is no server either."""
        if not (followers := self._asker.followers()):
            self.alive()
        return followers

    def info(self, *, after: int = 0, wait_s: float = 10.0) -> MapInfo:
        """State of the map and its server: site, rows journalled and merged, machines, counters, layers."""
        return answer_codec.decode_info(self._ask(requests.InfoQuery(Freshness(after, wait_s))))

    def machines(self, *, after: int = 0, wait_s: float = 10.0) -> list[MachineState]:
        """What the server knows of each machine: whether it is trusted, why, and what it sent."""
        asked = requests.MachinesQuery(Freshness(after, wait_s))
        return list(answer_codec.decode_machines(self._ask(asked)).machines)

    def calibration(self, *, after: int = 0, wait_s: float = 10.0) -> CalibrationAnswer:
        """What the server takes off the samples of each machine, and what it knows of their calibration."""
        return decode_calibration(self._ask(requests.CalibrationQuery(Freshness(after, wait_s))))

    def changes(self, after: int = 0) -> list[GroundChange]:
        """Changes of the ground with an id beyond `after`: when, where, how many cells, from what to what."""
        changes = list(answer_codec.decode_changes(self._ask(requests.ChangesQuery(after))).changes)
        if len(changes) < answer_codec.MAX_CHANGES:
            return changes
        return changes + self.changes(changes[-1].id)

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
        return self._command(TrustCommand(machine, True, reason, wait_s))

    def distrust(self, machine: str, reason: str, *, wait_s: float = 30.0) -> TrustAnswer:
        """Leave a machine's samples out of the map, earlier ones too."""
        return self._command(TrustCommand(machine, False, reason, wait_s))

    def judge_automatically(self, machine: str, *, wait_s: float = 30.0) -> TrustAnswer:
        """Leave it to the server again whether a machine's samples are used."""
        return self._command(TrustCommand(machine, None, "", wait_s))

    def calibrate(self, *, wait_s: float = 30.0) -> CalibrationAnswer:
        """Calibrate all machines with all samples that there are, and have the map follow; what is known then."""
        return self._calibrate(CalibrateCommand(wait_s=wait_s))

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
        return self._calibrate(CalibrateCommand(machine, zero, scale, across, reason=reason, wait_s=wait_s))

    def calibrate_automatically(self, machine: str, *, wait_s: float = 30.0) -> CalibrationAnswer:
        """Leave it to the server again what is taken off a machine's samples."""
        return self._calibrate(CalibrateCommand(machine, auto=True, wait_s=wait_s))

    def accept(self, store: str, reason: str) -> MapInfo:
        """Let the map server's store take the place of another one, which is gone: machines go on with it."""
        command = AcceptCommand(store, reason)
        key = keys.admin(self.site, command.name)
        return answer_codec.decode_info(self._asker.command(key, encode_command(command), 0.0))

    def close(self) -> None:
        """Close the session and its listeners."""
        for listener in self._listeners:
            listener.close()
        self.session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _ask(self, query: requests.MapQuery) -> bytes:
        return self._answered(query).data

    def _answered(self, query: requests.MapQuery, *, at: Origin | None = None) -> Answered:
        answered = self._asker.ask(query, at=at)
        self.origin = answered.origin  # of the last answer of any thread: nothing here goes on with it
        return answered

    def _pieces(self, query: requests.RegionQuery) -> Iterator[Region]:
        """The region, or piece after piece of it, all from whom has the first one."""
        answered = self._answered(query)
        yield (first := answer_codec.decode_region(answered.data))
        if first.piece:
            for number in range(1, first.piece.count):
                piece = requests.PieceQuery(first.piece.cursor, number)
                yield answer_codec.decode_region(self._answered(piece, at=answered.origin).data)

    def _command(self, command: TrustCommand) -> TrustAnswer:
        key = keys.admin(self.site, command.name)
        return answer_codec.decode_machine(self._asker.command(key, encode_command(command), command.wait_s))

    def _calibrate(self, command: CalibrateCommand) -> CalibrationAnswer:
        key = keys.admin(self.site, command.name)
        return decode_calibration(self._asker.command(key, encode_command(command), SOLVE_S + command.wait_s))


def _machine(machine: RouteMachine | NamedMachine | str) -> RouteMachine | NamedMachine:
    return machine_of(machine) if isinstance(machine, str) else machine


def _area(area: Bounds | Sequence[float] | Sequence[Place]) -> Bounds | tuple[Place, ...]:
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


def _goes_back(first: TilesAnswer, answer: TilesAnswer) -> bool:
    """Whether another store, or a process that is behind the first one, answers the rest of the tiles."""
    before, now = first.version, answer.version
    same = (before.store, first.whole) == (now.store, answer.whole)
    return not same or now.row < before.row or now.fact < before.fact


def connect(
    endpoint: str = DEFAULT_ENDPOINT, site: str | None = None, *, timeout_s: float = 10.0, keys: Path | None = None
) -> Client:
    """Connect to the router at `endpoint` and ask for the map of `site`; LinkError if no router is there.

    keys: folder of this client's keys, on a site that has them. site: default that of the keys, else `paper`.
    """
    config = join(endpoint, keys, site=site or "")
    name = site or (config.credentials.identity.site if config.credentials else "paper")
    return Client(open_session(config), config.endpoint, name, timeout_s)
