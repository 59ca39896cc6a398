"""`sitegrid query`: ask the map from the command line.

It is one module because all queries share their options and their tables.
"""

from __future__ import annotations

import math
import re
import time
from argparse import SUPPRESS, ArgumentParser, Namespace
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from protocol.arrays import Floats32
from protocol.errors import ConfigError
from protocol.files import whole_file
from protocol.queries.answers import CheckpointCounts, GroundChange, MachineState, PointAnswer, PointsAnswer, Region
from protocol.queries.calibration import CalibrationAnswer, MachineCalibration
from protocol.queries.parameters import Freshness, text_of
from protocol.queries.pieces import Progress
from protocol.queries.places import where_it_lies
from protocol.queries.requests import parse_query
from protocol.queries.roads import RoadSegment
from protocol.queries.route_requests import RouteQuery, WayQuery
from protocol.queries.routing import RouteAnswer
from sitegrid.client import Client, connect
from sitegrid.explanations import calibrated, why
from sitegrid.options.groups import Subparsers, add_action, add_network, add_site, sentence
from sitegrid.options.values import HELP as TIME_HELP
from sitegrid.options.values import OutputFile, SiteTime, named_text, parse_time, positive, utc_text
from sitegrid.process import streams
from sitegrid.process.lifetime import note, plain, say, stop_flag, tell, wait
from sitegrid.process.progress import EVERY_S

HELP = "ask the map"
Answer = tuple[Any, Iterable[str]]  # a table for programs, None where all is printed already; lines for people
Ask = Callable[[Client, Namespace, tuple[str, ...]], Answer]  # the names are layers
HISTORY_LAYERS = ("resistance", "confidence", "grade", "visits", "weight")  # of a table for people, unless named


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    _add_common(parser)
    queries = parser.add_subparsers(metavar="QUERY", required=True)
    point = _add_query(queries, _point, "the cell at a position, in metres")
    _add_numbers(point, "x_m", "y_m")
    _add_when(point)
    points = _add_query(queries, _points, "the cells at many positions, in metres")
    points.add_argument("places", type=float, nargs="+", metavar="X_M Y_M", help="positions, in metres")
    _add_when(points)
    region = _add_query(queries, _region, "the cells of a rectangle or an outline, in metres")
    area = "west, south, east, north; or the corners x y x y x y ... of an outline"
    region.add_argument("area", type=float, nargs="+", metavar="M", help=area)
    larger = "edge of larger cells in metres, a multiple of the map's: means of what is known in each"
    region.add_argument("--resolution", type=positive, metavar="M", help=larger)
    region.add_argument("--out", type=OutputFile((".npz",)), help="write coordinates and layers into this .npz file")
    _add_when(region)
    history = _add_query(queries, _history, "the cell at a position over time")
    _add_numbers(history, "x_m", "y_m")
    _add_times(history, ("from", "samples from this time on"), ("to", "samples up to this time; default the newest"))
    history.add_argument("--span", type=positive, metavar="SECONDS", help="length of one span; default 5 minutes")
    for ask, summary in (
        (_segments, "roads that the map shows, and what drove on them"),
        (_worklist, "stretches of road where work pays, the dearest first"),
    ):
        roads = _add_query(queries, ask, summary)
        hours = ("from", "traffic of the hours from this time on"), ("to", "traffic of the hours before this time")
        _add_times(roads, *hours, ("as-of", "the map as of this time"))
        alone = "traffic of this machine alone, and what it measured"
        roads.add_argument("--machine", default="", metavar="NAME", help=alone)
    roads.add_argument("--target", type=positive, default=0.02, help="rolling resistance of good ground (default 0.02)")
    route = _add_query(queries, _route, "what a drive along a line costs a machine: energy and time")
    route.add_argument("line", type=float, nargs="+", metavar="X_M Y_M", help="places of the line, in metres")
    _add_drive(route)
    way = _add_query(queries, _way, "the line from one place to another that costs least")
    _add_numbers(way, "from_x_m", "from_y_m", "to_x_m", "to_y_m")
    _add_drive(way)
    _add_query(queries, _machines, "state of each machine: samples, trust, reasons")
    _add_query(queries, _calibration, "what is taken off the samples of each machine")
    changes = _add_query(queries, _changes, "list of ground changes: place and time")
    changes.add_argument("--follow", action="store_true", help="print new changes as they are detected, until stopped")
    _add_query(queries, _info, "state of the map and its server")
    _add_query(queries, _followers, "followers that answer, and how far behind they are")
    _add_query(queries, _alive, "whether the map server takes batches: for probes")


def _add_query(queries: Subparsers, ask: Ask, summary: str) -> ArgumentParser:
    query = add_action(queries, ask.__name__.removeprefix("_"), summary, sentence(summary))
    _add_common(query, again=True)
    query.set_defaults(ask=ask)
    return query


def _add_common(parser: ArgumentParser, *, again: bool = False) -> None:
    """Options of every query, before its name and after it."""
    add_network(parser, again=again)
    add_site(parser, again=again)
    after = "wait until this journal row is in the map; for changes: list those after this number"
    parser.add_argument("--after", type=int, default=SUPPRESS if again else 0, help=after)
    layers = "layers, comma-separated; default all"
    parser.add_argument("--layers", default=SUPPRESS if again else "", help=layers)


def _add_numbers(query: ArgumentParser, *names: str) -> None:
    for name in names:
        query.add_argument(name, type=float)


def _add_drive(query: ArgumentParser) -> None:
    examples = (
        "machine=truck (a kind, or a machine's name), mass=30000, speed=6, unknown=refuse, step=50; "
        "of a way cost=time, margin=5, max_grade=0.1"
    )
    option = f"anything that docs/protocol.md (Routes) lists, as {examples}; may be repeated"
    query.add_argument("--set", action="append", type=named_text, default=[], metavar="NAME=VALUE", help=option)
    _add_times(query, ("as-of", "the map as of this time"))


def _add_when(query: ArgumentParser) -> None:
    _add_times(query, ("as-of", "the map as of this time"), ("minus", "subtract the map as of this time"))
    since = "read roads whose ground changed, as the worklist shows it, from the samples since"
    query.add_argument("--repairs", action="store_true", help=since)


def _add_times(query: ArgumentParser, *options: tuple[str, str]) -> None:
    for name, summary in options:
        dest = f"{name.replace('-', '_')}_time"
        query.add_argument(f"--{name}", dest=dest, type=parse_time, metavar="TIME", help=summary)
    query.epilog = f"TIME: {TIME_HELP}."
    # argparse knows no public way to say that -2h is a value as -2 is one, not an option
    query._negative_number_matcher = re.compile(r"-\.?\d.*")  # noqa: SLF001


def run(arguments: Namespace) -> int:
    """Ask once and print the answer; changes, while they are followed, until stopped."""
    layers = tuple(part for part in arguments.layers.split(",") if part)
    with connect(arguments.endpoint, arguments.site, keys=arguments.keys) as client:
        table, lines = arguments.ask(client, arguments, layers)
    if table is not None:
        say(plain(table)) if arguments.json else tell(*lines)
    return 0


def _point(client: Client, arguments: Namespace, layers: tuple[str, ...]) -> Answer:
    when = _stamps(client, as_of=arguments.as_of_time, minus=arguments.minus_time)
    rest = {"repairs": arguments.repairs, "after": arguments.after}
    point = client.point(arguments.x_m, arguments.y_m, layers, **when, **rest)
    table = {"x_m": point.x_m, "y_m": point.y_m, **point.values, **_version(point)}
    head = f"cell at {point.x_m:g}, {point.y_m:g} m{_as_of(when, point.stamp_ns)}"
    lines = [head, *(f"  {name:18} {_value(value)}" for name, value in point.values.items())]
    return table, lines + (
        [] if np.isfinite([*point.values.values()]).any() else _off_map(client, point.x_m, point.y_m)
    )


def _off_map(client: Client, x_m: float, y_m: float) -> list[str]:
    """Where the map lies, for who asks for another place."""
    info = client.info()
    west, south, east, north = (edge * info.site.cell_m for edge in info.bounds or (0, 0, 0, 0))
    is_inside = west <= x_m < east and south <= y_m < north
    if is_inside or not info.bounds:
        return []
    return [f"nobody was there: {where_it_lies(info.bounds, info.site.cell_m)}"]


def _points(client: Client, arguments: Namespace, layers: tuple[str, ...]) -> Answer:
    when = _stamps(client, as_of=arguments.as_of_time, minus=arguments.minus_time)
    rest = {"repairs": arguments.repairs, "after": arguments.after}
    answer = client.points(_places_of(arguments.places), layers, **when, **rest)
    places = {"x_m": answer.x_m.tolist(), "y_m": answer.y_m.tolist()}
    table = {**places, **{name: values.tolist() for name, values in answer.layers.items()}, **_version(answer)}
    rows = (
        [f"{x:g}", f"{y:g}", *(_value(float(values[i])) for values in answer.layers.values())]
        for i, (x, y) in enumerate(zip(answer.x_m, answer.y_m, strict=True))
    )
    return table, _table(["x", "y", *answer.layers], rows)


def _places_of(numbers: Sequence[float]) -> list[tuple[float, float]]:
    if len(numbers) % 2:
        raise ConfigError("sitegrid query", f"{len(numbers)} numbers; places are pairs x y in metres")
    return list(zip(numbers[::2], numbers[1::2], strict=True))


def _region(client: Client, arguments: Namespace, layers: tuple[str, ...]) -> Answer:
    area = arguments.area if len(arguments.area) == 4 else _places_of(arguments.area)
    when = _stamps(client, as_of=arguments.as_of_time, minus=arguments.minus_time)
    try:
        rest = {"repairs": arguments.repairs, "after": arguments.after, "resolution_m": arguments.resolution}
        region = client.region(area, layers, **when, **rest, progress=_pieces_shown())
    except ValueError as error:
        raise ConfigError("sitegrid query region", str(error)) from None
    if arguments.out:
        arrays: dict[str, Any] = {"x_m": region.x_m, "y_m": region.y_m, **region.layers}
        with whole_file(arguments.out) as file:
            np.savez_compressed(file, **arrays)
    summary = {name: _statistics(values) for name, values in region.layers.items()}
    size = {"columns": len(region.x_m), "rows": len(region.y_m)}
    b = region.bounds
    place = f"{b.west_m:g}..{b.east_m:g} x {b.south_m:g}..{b.north_m:g} m, {region.cell_m:g} m cells"
    lines = [f"{place}{_as_of(when, region.stamp_ns)}, journal row {region.merged}"]
    for name, row in summary.items():
        span = f"min {row['min']:.4g}   mean {row['mean']:.4g}   max {row['max']:.4g}"
        lines.append(f"  {name:18} {row['known']:7d} known   {span}")
    table = {**size, **_version(region), "layers": summary}
    if arguments.out:
        table["file"] = str(arguments.out)
        lines.append(f"written to {arguments.out}")
    return table, lines


def _version(answer: PointAnswer | PointsAnswer | Region | RouteAnswer) -> dict[str, Any]:
    version = answer.version
    return {"store": version.store, "merged": version.row, "fact": version.fact, "stamp_ns": answer.stamp_ns}


def _pieces_shown() -> Progress:
    """What shows on standard error, now and then, how much of a large region is here."""
    next_s = time.monotonic() + EVERY_S

    def show(here: int, count: int) -> None:
        nonlocal next_s
        if time.monotonic() >= next_s:
            next_s = time.monotonic() + EVERY_S
            note(f"{here} of {count} pieces")

    return show


def _history(client: Client, arguments: Namespace, layers: tuple[str, ...]) -> Answer:
    layers = layers or (() if arguments.json else HISTORY_LAYERS)
    times = _stamps(client, **{"from": arguments.from_time, "to": arguments.to_time})
    spans = client.history(arguments.x_m, arguments.y_m, layers, **times, span_s=arguments.span, after=arguments.after)
    table = {"spans": [{"first_ns": s.first_ns, "last_ns": s.last_ns, **s.values} for s in spans]}
    if not spans:
        return table, ["nobody was there"]
    rows = ([utc_text(s.first_ns), *map(_value, s.values.values())] for s in spans)
    return table, _table(["from (UTC)", *spans[0].values], rows)


def _road_times(client: Client, arguments: Namespace) -> dict[str, Any]:
    times = {"from": arguments.from_time, "to": arguments.to_time, "as_of": arguments.as_of_time}
    return {**_stamps(client, **times), "machine": arguments.machine, "after": arguments.after}


def _segments(client: Client, arguments: Namespace, _: tuple[str, ...]) -> Answer:
    answer = client.segments(**_road_times(client, arguments))
    if not answer.segments:
        return answer, ["no roads are known"]
    head = ["stretch", "around", "m", "resistance", "+-", "grade", "passes/h there", "back", "t/h there", "back"]
    rows = (
        [
            *_place(one),
            f"{one.length_m:.0f}",
            *map(_value, (one.resistance, one.resistance_std, one.grade, *one.passes_ph, *one.tonnes_ph)),
        ]
        for one in answer.segments
    )
    km = sum(one.length_m for one in answer.segments) / 1000
    return answer, [f"{km:.2f} km of roads, traffic of {answer.hours:.2f} h", *_table(head, rows)]


def _worklist(client: Client, arguments: Namespace, _: tuple[str, ...]) -> Answer:
    answer = client.worklist(arguments.target, **_road_times(client, arguments))
    total = f"{answer.total_kwh_ph:.2f} kWh/h lost on all roads against a resistance of {answer.target:g}"
    if not answer.rows and not answer.changes:
        return answer, [f"{total}: no stretch is worse for sure"]
    head = ["", "stretch", "around", "kWh/h", "low..high", "l/h", "s/h", "resistance", "+-", "a day", "machines"]
    head += ["since", "before"]
    rows = (
        [
            str(row.rank),
            *_place(row.segment),
            f"{row.kwh_ph[0]:.2f}",
            f"{row.kwh_ph[1]:.2f}..{row.kwh_ph[2]:.2f}",
            f"{row.litres_ph[0]:.2f}",
            f"{row.seconds_ph[0]:.0f}",
            *map(_value, (row.segment.resistance, row.segment.resistance_std)),
            "-" if row.segment.trend is None else f"{row.segment.trend:+.4f}",
            str(row.segment.machines),
            utc_text(row.since_ns),
            "-" if row.before is None else _value(row.before),
        ]
        for row in answer.rows
    )
    lines = [f"{total}, traffic of {answer.hours:.2f} h", *_table(head, rows)]
    if any(row.segment.guessed for row in answer.rows):
        lines.append("no machine stated its mass on some of them: what is lost there is a guess")
    lines += [
        f"{utc_text(one.first_ns)} {one.id}: resistance {_value(one.before)} -> {_value(one.after)}, "
        f"saves {one.saved_kwh_ph:.2f} kWh/h"
        for one in answer.changes
    ]
    return answer, lines


def _place(segment: RoadSegment) -> list[str]:
    x_m, y_m = segment.line[len(segment.line) // 2]
    return [segment.id, f"{x_m:.0f}, {y_m:.0f}"]


def _machines(client: Client, arguments: Namespace, _: tuple[str, ...]) -> Answer:
    machines = client.machines(after=arguments.after)
    head = ["machine", "trusted", "since", "samples", "lost", "newest", "accelerometer zero", "torque gain", "why"]
    return {"machines": machines}, _table(head, map(_machine_row, machines))


def _machine_row(machine: MachineState) -> list[str]:
    trusted = ("yes" if machine.trusted else "NO") + (f", by {machine.by}" if machine.by else "")
    since = utc_text(machine.since_ns) if machine.since_ns else "-"
    counts = [str(machine.samples), str(machine.lost)]
    calibration = [calibrated(machine, name) or "-" for name in ("zero", "torque_gain")]
    return [machine.name, trusted, since, *counts, utc_text(machine.newest_ns), *calibration, why(machine) or "-"]


def _calibration(client: Client, arguments: Namespace, _: tuple[str, ...]) -> Answer:
    answer = client.calibration(after=arguments.after)
    return answer, calibration_table(answer)


def calibration_table(answer: CalibrationAnswer) -> list[str]:
    """A line for each machine, and what is known of their common scale."""
    head = ["machine", "zero", "+-", "scale", "+-", "across", "+-", "known by", "taken off since", "by"]
    lines = _table(head, map(_calibration_row, answer.machines))
    if answer.common_scale_unknown:
        lines.append(f"nothing shows the mean scale of all machines: {answer.common_scale_unknown}")
    return lines


def _calibration_row(machine: MachineCalibration) -> list[str]:
    """Zeros and slopes in m/m; of what counts, the newest span."""
    values = (machine.zero, machine.zero_std, machine.scale, machine.scale_std, machine.across, machine.across_std)
    shown = [f"{name} {'+'.join(by)}" for name, by in (("zero", machine.zero_by), ("scale", machine.scale_by)) if by]
    newest, decided = "nothing", "-"
    if machine.spans:
        span = machine.spans[-1]
        since = utc_text(span.from_ns) if span.from_ns else "ever"
        newest = f"{span.zero:g}, {span.scale:g}, {span.across:g} {since}"
        decided = machine.by + (f": {machine.reason}" if machine.reason else "")
    return [machine.name, *map(_value, values), "; ".join(shown) or "-", newest, decided]


def _changes(client: Client, arguments: Namespace, _: tuple[str, ...]) -> Answer:
    if arguments.follow:
        _follow_changes(client, arguments)
        return None, ()
    changes = client.changes(arguments.after)
    return {"changes": changes}, [*map(_change_line, changes)] or ["no change of the ground was found"]


def _follow_changes(client: Client, arguments: Namespace) -> None:
    """First what is known, then what is found; listens before it asks, so that none is missed in between."""
    stop = stop_flag()

    def show(change: GroundChange) -> None:
        say(plain(change)) if arguments.json else tell(_change_line(change))
        if not streams.is_open():
            stop.set()

    listener = client.on_change(show)
    for change in client.changes(arguments.after):
        show(change)
    wait(stop)
    listener.close()


def _change_line(change: GroundChange) -> str:
    west, south, east, north = change.bounds
    parts = [f"{change.id}: {utc_text(change.first_ns)} to {utc_text(change.last_ns)}"]
    parts += [f"{west:g}..{east:g} x {south:g}..{north:g} m", f"{change.cells} cells"]
    resistance = ("resistance", change.resistance_before, change.resistance_after)
    for name, before, after in (resistance, ("grade", change.grade_before, change.grade_after)):
        if before is not None or after is not None:
            parts.append(f"{name} {_value(before)} -> {_value(after)}")
    return "  ".join(parts)


def _info(client: Client, arguments: Namespace, _: tuple[str, ...]) -> Answer:
    info = client.info(after=arguments.after)
    return info, [
        f"site {info.site.name}: {info.cells} cells driven, bounds {info.bounds and list(info.bounds)}",
        f"  journal row {info.journalled}, merged {info.merged}, snapshot {info.snapshot}",
        f"  {_checkpoints(info.checkpoints)}",
        f"  samples merged {info.samples_merged}, too unsure of their place {info.samples_too_unsure}",
        *(
            f"  {name}: {m.samples} samples, {m.lost} lost, {m.spools} spools"
            for name, m in sorted(info.machines.items())
        ),
        *(f"  {name}: {count}" for name, count in sorted(info.counters.items())),
    ]


def _route(client: Client, arguments: Namespace, _: tuple[str, ...]) -> Answer:
    return _driven(client, arguments, "route", {"line": _numbers(arguments.line)})


def _way(client: Client, arguments: Namespace, _: tuple[str, ...]) -> Answer:
    ends = {name: _numbers([getattr(arguments, f"{name}_{axis}_m") for axis in "xy"]) for name in ("from", "to")}
    return _driven(client, arguments, "way", ends)


def _driven(client: Client, arguments: Namespace, name: str, places: Mapping[str, str]) -> Answer:
    """What a drive costs, in a line of totals and a table of steps."""
    times = {key: str(stamp) for key, stamp in _stamps(client, as_of=arguments.as_of_time).items() if stamp}
    query = parse_query(name, {**places, **dict(arguments.set), **{k.removesuffix("_ns"): v for k, v in times.items()}})
    assert isinstance(query, RouteQuery | WayQuery)
    answer = client.drive(replace(query, fresh=Freshness(arguments.after)))
    totals, steps, machine = answer.totals, answer.steps, answer.machine
    corners = (
        []
        if name == "route"
        else [f"{len(answer.line_m)} places: " + " ".join(f"{x:.0f},{y:.0f}" for x, y in answer.line_m)]
    )
    kwh = f"{totals.energy_j / 3.6e6:.2f} kWh ({totals.energy_low_j / 3.6e6:.2f}..{totals.energy_high_j / 3.6e6:.2f})"
    taken = f"{totals.time_s:.0f} s ({totals.time_low_s:.0f}..{totals.time_high_s:.0f})"
    ground = f"{totals.unknown:.0%} unknown, {totals.unmeasured:.0%} driven and not measured"
    lines = [
        f"{totals.length_m:.0f} m, {totals.lift_m:+.1f} m up, {ground}",
        f"{machine.mass_kg / 1000:.1f} t, at most {machine.speed_mps:g} m/s, {machine.power_w / 1000:.0f} kW",
        f"{kwh}, {totals.litres:.2f} l of diesel, {totals.braked_j / 3.6e6:.2f} kWh braked, {taken}",
        *corners,
    ]
    head = ["m", "from", "resistance", "+-", "slope %", "unknown", "kWh", "braked", "s", "km/h"]
    rows = [
        [
            f"{steps.distance_m[i]:.0f}",
            f"{steps.x_m[i]:.0f},{steps.y_m[i]:.0f}",
            f"{steps.resistance[i]:.4f}",
            f"{steps.resistance_std[i]:.4f}",
            f"{100 * steps.slope[i]:+.1f}",
            f"{steps.unknown[i]:.0%}",
            f"{steps.energy_j[i] / 3.6e6:.3f}",
            f"{steps.braked_j[i] / 3.6e6:.3f}",
            f"{steps.time_s[i]:.1f}",
            f"{3.6 * steps.speed_mps[i]:.1f}",
        ]
        for i in range(len(steps.distance_m))
    ]
    columns = {name: column.tolist() for name, column in vars(steps).items()}
    shown = {"line": answer.line_m.tolist(), "totals": asdict(totals), "steps": columns, "machine": asdict(machine)}
    table = {**shown, **_version(answer)}
    return table, [*lines, *_table(head, rows)]


def _numbers(values: Sequence[float]) -> str:
    return ",".join(text_of(value) for value in values)


def _followers(client: Client, _: Namespace, __: tuple[str, ...]) -> Answer:
    followers = client.followers()
    return followers, [*map(str, followers)] or ["no follower answers"]


def _alive(client: Client, _: Namespace, __: tuple[str, ...]) -> Answer:
    alive = client.alive()
    return alive, [f"batches are taken: journal row {alive.journalled}, merged {alive.merged}"]


def _checkpoints(counts: CheckpointCounts) -> str:
    """What makes maps of the past quick."""
    newest = f", samples until {utc_text(counts.newest_ns)}" if counts.newest_ns else ""
    damaged = f", {counts.passed_over} damaged" if counts.passed_over else ""
    return f"checkpoints {counts.count} ({counts.bytes / 1e6:.0f} MB){newest}{damaged}"


def _stamps(client: Client, **times: SiteTime | None) -> dict[str, Any]:
    """Times of options as the client's arguments: `as_of` becomes `as_of_ns`."""

    def now_ns() -> int:
        return client.info().stamp_ns

    given = {name: time for name, time in times.items() if time}
    return {f"{name}_ns": time.stamp(f"--{name.replace('_', '-')}", now_ns) for name, time in given.items()}


def _as_of(when: Mapping[str, int], stamp_ns: int) -> str:
    """What to say of the time of an answer, nothing where it is the map as it is."""
    as_of = f", as of {utc_text(stamp_ns)}" if "as_of_ns" in when else ""
    return as_of + (f", minus that of {utc_text(when['minus_ns'])}" if "minus_ns" in when else "")


def _value(value: float | None) -> str:
    return "unknown" if value is None or math.isnan(value) else f"{value:.4g}"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    lines = [head, *rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return ["  ".join(map(str.ljust, line, widths)).rstrip() for line in lines]


def _statistics(values: Floats32) -> dict[str, float]:
    known = values[np.isfinite(values)]
    if not known.size:
        return {"known": 0, "min": math.nan, "mean": math.nan, "max": math.nan}
    return {"known": known.size, "min": float(known.min()), "mean": float(known.mean()), "max": float(known.max())}
