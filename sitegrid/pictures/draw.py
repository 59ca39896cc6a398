"""Pictures of the current map with machine tracks."""

from __future__ import annotations

import math
import threading
import time
from argparse import Namespace
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import zenoh

from mapserver.pictures.frame import Image
from mapserver.pictures.plotter import (
    DrawnTrack,
    draw_difference,
    draw_grade,
    draw_resistance,
    side_by_side,
    write_image,
)
from mapserver.pictures.profile import draw_drive
from mapserver.pictures.worklist import draw_worklist
from protocol.arrays import Floats32
from protocol.errors import ConfigError
from protocol.queries.answers import MachineState, Region
from protocol.queries.parameters import text_of
from protocol.queries.requests import RegionQuery
from protocol.queries.roads import SegmentsQuery, WorklistQuery
from protocol.queries.route_requests import LineQuery, RouteQuery, WayQuery
from protocol.site.geometry import Bounds
from protocol.wire import keys
from protocol.wire.codec import receive_pose
from protocol.wire.latest_values import LatestValues
from protocol.wire.messages import Pose
from sim.truth import TruthMap
from sitegrid.client import Client, connect
from sitegrid.listener import Listener
from sitegrid.options.parameters import dest, given, spread
from sitegrid.process.lifetime import note, say
from sitegrid.trust_sentences import calibrations

AROUND_M = 30.0  # map shown around a drive
STEP_M, MOST_STEPS = 5.0, 1000  # drive profile
MAX_POSES = 50_000  # per machine: nearly three hours at 5 Hz
LAYERS = ("resistance", "grade_east", "grade_north")
SAMPLES_FOLLOW = "the map follows a minute or two later"  # the smoother's lag is known to agents only


def run(arguments: Namespace) -> int:
    """Draw the requested picture."""
    files = {"picture": str(arguments.out)}
    with connect(arguments.endpoint, arguments.site, keys=arguments.keys) as client:
        if query := _query(client, arguments):
            draw_line(client, arguments.out, query, arguments.bounds)
        elif arguments.worklist:
            draw_roads(client, arguments.out, arguments.bounds)
        else:
            draw(client, arguments.out, arguments.bounds, [], arguments.truth)
            if arguments.truth:
                files["difference"] = str(beside(arguments.out))
    say(files) if arguments.json else note("\n".join(files.values()))
    return 0


def _query(client: Client, arguments: Namespace) -> LineQuery | None:
    """The drive to draw, if any."""
    cls: type[LineQuery] = RouteQuery if arguments.line else WayQuery
    if places := arguments.line or arguments.between:
        ends = {"from": arguments.between and places[:2], "to": arguments.between and places[2:]}
        vars(arguments).update(spread({"line": arguments.line, **ends}))
        arguments.asked_step = arguments.asked_step or text_of(_step_m(places))
        query = given(cls, arguments, lambda: client.info().stamp_ns)
        assert isinstance(query, LineQuery)
        return query
    if options := [name for name, value in vars(arguments).items() if name.startswith(dest("")) and value is not None]:
        option = options[0].removeprefix(dest("")).replace("_", "-")
        raise ConfigError(f"--{option}", "is of a drive: give `--line` or `--between` too")
    return None


def _step_m(places: Sequence[float]) -> float:
    """Profile step: finer than a pixel on usual sites, bounded in number."""
    even = places[: len(places) // 2 * 2]
    corners = zip(even[::2], even[1::2], strict=True)
    length_m = sum(math.dist(a, b) for a, b in pairwise(corners))
    return max(STEP_M, length_m / MOST_STEPS) if math.isfinite(length_m) else STEP_M


def draw_line(client: Client, out: Path, query: LineQuery, bounds: list[float] | None) -> None:
    """Draw a drive and the map around it."""
    answer = client.ask(query)
    low, high = answer.line_m.min(axis=0) - AROUND_M, answer.line_m.max(axis=0) + AROUND_M
    chosen = _bounds(client, bounds) if bounds else Bounds(*low.tolist(), *high.tolist())
    layers = "resistance", "resistance_filled"
    region = client.ask(RegionQuery(chosen, layers, as_of_ns=query.as_of_ns))
    write_image(out, draw_drive(region, answer))


def draw_roads(client: Client, out: Path, bounds: list[float] | None) -> None:
    """Draw roads and worklist."""
    chosen = _bounds(client, bounds) if bounds else None
    write_image(out, draw_worklist(client.ask(SegmentsQuery(bounds=chosen)), client.ask(WorklistQuery(bounds=chosen))))


def draw(
    client: Client,
    out: Path,
    bounds: list[float] | None,
    tracks: list[DrawnTrack],
    truth: Path | None = None,
    empty: str = SAMPLES_FOLLOW,
) -> Region:
    """Draw the map, and beside it the difference from a true map if given.

    empty: note in the title while driven ground has no values yet.
    """
    region = client.region(_bounds(client, bounds), LAYERS)
    image = side_by_side(draw_both(region, tracks, empty, client.machines()))
    difference = side_by_side(draw_differences(region, truth)) if truth else None
    write_image(out, image)
    if difference is not None:
        write_image(beside(out), difference)
    return region


def beside(out: Path) -> Path:
    """File of the difference from a true map."""
    return out.with_stem(f"{out.stem}-difference")


def draw_both(
    region: Region, tracks: list[DrawnTrack], empty: str = SAMPLES_FOLLOW, machines: Sequence[MachineState] = ()
) -> list[Image]:
    """Resistance and grade; an empty map's title says why. machines: calibrated ones are noted."""
    resistance = draw_resistance(region, tracks, _title(region, tracks, empty), calibrations(machines))
    return [resistance, draw_grade(region, tracks)]


def _title(region: Region, tracks: list[DrawnTrack], empty: str) -> str:
    if np.isfinite(region["resistance"]).any():
        return "Rolling resistance"
    if np.isfinite(region["grade_east"]).any():
        return "Rolling resistance: unknown, no machine measures drive torque"
    return f"Rolling resistance: {empty}" if tracks else "Rolling resistance"


def draw_differences(region: Region, truth: Path) -> list[Image]:
    """Difference of resistance and grade from a true map."""
    layers = truth_layers(TruthMap.load(truth), region)
    return [draw_difference(region, layers, name) for name in ("resistance", "grade")]


def _bounds(client: Client, given: list[float] | None) -> Bounds:
    """The given rectangle, or the known map's."""
    if given:
        try:
            return Bounds(*given)
        except ValueError as error:
            raise ConfigError("--bounds", str(error)) from None
    info = client.info()
    cells, cell_m = info.bounds, info.site.cell_m
    if cells is None:
        return Bounds(0, 0, 16 * cell_m, 16 * cell_m)
    west, south, east, north = (cell * cell_m for cell in cells)
    return Bounds(west, south, east, north)


def truth_layers(truth: TruthMap, region: Region) -> dict[str, Floats32]:
    """True layers on a region's cells, NaN beyond the simulated site."""
    if abs(truth.cell_m - region.cell_m) > 1e-9:
        raise ConfigError("--truth", f"has cells of {truth.cell_m:g} m, the map of {region.cell_m:g} m")
    column = round((region.bounds.west_m - truth.west_m) / truth.cell_m)
    row = round((region.bounds.south_m - truth.south_m) / truth.cell_m)
    layers = {"resistance": truth.c_rr, "grade_east": truth.grade_east, "grade_north": truth.grade_north}
    return {name: _cut(values, row, column, region[next(iter(region.layers))].shape) for name, values in layers.items()}


def _cut(values: Floats32, row: int, column: int, shape: tuple[int, ...]) -> Floats32:
    out = np.full(shape, np.nan, np.float32)
    top, left = max(0, -row), max(0, -column)
    bottom, right = min(shape[0], values.shape[0] - row), min(shape[1], values.shape[1] - column)
    if bottom > top and right > left:
        out[top:bottom, left:right] = values[row + top : row + bottom, column + left : column + right]
    return out


class TrackRecorder:
    """Subscribes to a site's poses."""

    def __init__(self, session: zenoh.Session, site: str) -> None:
        self._lock = threading.Lock()
        self._poses: LatestValues[list[Pose]] = LatestValues(time.monotonic)
        self._listener = Listener(session, keys.poses_all(site), receive_pose, self._on_pose)

    def poses(self) -> dict[str, list[Pose]]:
        """All poses so far by machine."""
        with self._lock:
            return {name: list(poses) for name, poses, _ in sorted(self._poses.items())}

    def tracks(self) -> list[DrawnTrack]:
        """All poses so far as lines."""
        return [
            DrawnTrack(name, np.array([p.x_m for p in poses]), np.array([p.y_m for p in poses]))
            for name, poses in self.poses().items()
        ]

    def close(self) -> None:
        """Stop listening."""
        self._listener.close()

    def _on_pose(self, pose: Pose) -> None:
        with self._lock:
            poses = self._poses.get(pose.machine) or []
            poses.append(pose)
            self._poses.hear(pose.machine, poses)
            if len(poses) > MAX_POSES:
                del poses[: MAX_POSES // 10]
