"""Answers as text: a table for programs, and lines for people."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from protocol.arrays import Floats32
from protocol.queries.answers import (
    ChangesAnswer,
    CheckpointCounts,
    GroundChange,
    HistoryAnswer,
    MachinesAnswer,
    MachineState,
    MapInfo,
    PointAnswer,
    PointsAnswer,
    Region,
    ServerAlive,
)
from protocol.queries.calibration import CalibrationAnswer, MachineCalibration
from protocol.queries.places import where_it_lies
from protocol.queries.reasons import CellReasons
from protocol.queries.request import Compared
from protocol.queries.requests import (
    AliveQuery,
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
from protocol.queries.roads import Fuel, RoadSegment, Segments, SegmentsQuery, Worklist, WorklistQuery
from protocol.queries.route_requests import LineQuery, RouteQuery
from protocol.queries.routing import RouteAnswer
from protocol.site.ground_classes import BOUNDARIES, ZONES
from sitegrid.client import Client
from sitegrid.notebook import unit_of
from sitegrid.process.lifetime import plain
from sitegrid.times import utc_text
from sitegrid.trust_sentences import calibrated, why

Answer = tuple[Any, Iterable[str]]  # table for programs, lines for people


def record_text(_: Client, __: Any, answer: Any) -> Answer:
    """Fields of an answer without a table of its own."""
    table = plain(answer)
    lines = []
    for name, value in table.items():
        parts = value.items() if isinstance(value, dict) else ()
        lines.append(name if parts else f"{name}  {_words(value)}")
        lines += [f"  {key}  {_words(part)}" for key, part in parts]
    return table, lines


def _words(value: Any) -> str:
    """A value of JSON as people write it."""
    if value is None or isinstance(value, bool):
        return {None: "-", True: "yes", False: "no"}[value]
    if isinstance(value, float):
        return _value(value)
    return " ".join(map(_words, value)) if isinstance(value, list) else str(value)


def _point(client: Client, query: PointQuery, point: PointAnswer) -> Answer:
    table = {"x_m": point.x_m, "y_m": point.y_m, **point.values, **_version(point)}
    head = f"cell at {point.x_m:.12g}, {point.y_m:.12g} m{_as_of(query, point.stamp_ns)}"
    if not np.isfinite([*point.values.values()]).any():
        return table, [head, _nobody_was_there(client, point.x_m, point.y_m)]
    kinds = {} if query.minus_ns else _names_of_classes(client)
    return table, [head, *(f"  {name:22} {_worded(name, value, kinds)}" for name, value in point.values.items())]


def _nobody_was_there(client: Client, x_m: ArrayLike, y_m: ArrayLike) -> str:
    """What to say where all of an answer is unknown; where the map lies, if none of the places (n,) is on it."""
    info = client.info()
    if not info.bounds:
        return "nothing is driven yet"
    west, south, east, north = (edge * info.site.cell_m for edge in info.bounds)
    x, y = np.asarray(x_m), np.asarray(y_m)
    if ((west <= x) & (x < east)).any() and ((south <= y) & (y < north)).any():
        return "nobody was there"
    return f"nobody was there: {where_it_lies(info.bounds, info.site.cell_m)}"


def _names_of_classes(client: Client) -> dict[str, Sequence[str]]:
    """Names of classes by layer; of resistance, unless the site has other boundaries."""
    grounds = tuple(zone.name for zone in ZONES) if client.info().boundaries == BOUNDARIES else ()
    return {"resistance_class": grounds, "resistance_class_filled": grounds, "slope_class": ("flat", "slope")}


def _worded(name: str, value: float, kinds: dict[str, Sequence[str]]) -> str:
    """A value of a layer with its unit, a class with its name."""
    if math.isnan(value):
        return _value(value)
    if names := kinds.get(name):
        return f"{value:g}, {names[int(value)]}"
    return f"{_value(value)} {unit_of(name)}".removesuffix(" 1")


def _why(client: Client, _: WhyQuery, reasons: CellReasons) -> Answer:
    """What is known of a cell: where from, its values, and its votes by kind of ground."""
    place = f"cell at {reasons.x_m:.12g}, {reasons.y_m:.12g} m"
    if not reasons.metres:
        return reasons, [place, _nobody_was_there(client, reasons.x_m, reasons.y_m)]
    by = f"{reasons.metres:.3g} m driven by {', '.join(reasons.machines)}, last at {utc_text(reasons.newest_ns)}"
    changed = f"changed at {utc_text(reasons.changed_ns)}" if reasons.changed_ns else "no change of the ground"
    kinds = _names_of_classes(client)
    columns = {"now": reasons.values} | ({"before the change": reasons.before} if reasons.changed_ns else {})
    rows = [
        [name, *(_worded(name, _nan(column.get(name)), kinds) for column in columns.values())]
        for name in reasons.values
    ]
    values = _table(["", *columns], rows)
    votes = zip(reasons.resistance.centres, reasons.resistance.votes, reasons.resistance.before, strict=True)
    held = [[f"{at:.4f}", f"{now:.3g}", f"{old:.3g}"] for at, now, old in votes if now or old]
    return reasons, [f"{place}: {by}; {changed}", *values, *_table(["votes: c_rr", "m", "m before"], held)]


def _nan(value: float | None) -> float:
    return math.nan if value is None else value


def _points(client: Client, __: PointsQuery, answer: PointsAnswer) -> Answer:
    places = {"x_m": answer.x_m.tolist(), "y_m": answer.y_m.tolist()}
    table = {**places, **{name: values.tolist() for name, values in answer.layers.items()}, **_version(answer)}
    rows = (
        [f"{x:g}", f"{y:g}", *(_value(float(values[i])) for values in answer.layers.values())]
        for i, (x, y) in enumerate(zip(answer.x_m, answer.y_m, strict=True))
    )
    lines = _table(["x", "y", *answer.layers], rows)
    return table, lines if _is_known(answer.layers) else [*lines, _nobody_was_there(client, answer.x_m, answer.y_m)]


def _is_known(layers: Mapping[str, Any]) -> bool:
    return any(np.isfinite(values).any() for values in layers.values())


def _region(client: Client, query: RegionQuery, region: Region) -> Answer:
    summary = {name: _statistics(values) for name, values in region.layers.items()}
    size = {"columns": len(region.x_m), "rows": len(region.y_m)}
    b = region.bounds
    place = f"{b.west_m:g}..{b.east_m:g} x {b.south_m:g}..{b.north_m:g} m, {region.cell_m:g} m cells"
    lines = [f"{place}{_as_of(query, region.stamp_ns)}, journal row {region.merged}"]
    table = {**size, **_version(region), "layers": summary}
    if not _is_known(region.layers):
        return table, [*lines, _nobody_was_there(client, region.x_m, region.y_m)]
    head = ["layer", "known cells", "least", "mean", "most", "unit"]
    rows = (
        [name, str(row["known"]), *(_value(row[part]) for part in ("min", "mean", "max")), unit_of(name)]
        for name, row in summary.items()
    )
    return table, [*lines, *_table(head, rows)]


def _version(answer: PointAnswer | PointsAnswer | Region | RouteAnswer) -> dict[str, Any]:
    version = answer.version
    return {"store": version.store, "merged": version.row, "fact": version.fact, "stamp_ns": answer.stamp_ns}


def _history(client: Client, __: HistoryQuery, answer: HistoryAnswer) -> Answer:
    table = {"spans": [{"first_ns": s.first_ns, "last_ns": s.last_ns, **s.values} for s in answer.spans]}
    if not answer.spans:
        return table, [_nobody_was_there(client, answer.x_m, answer.y_m)]
    rows = ([utc_text(s.first_ns), *map(_value, s.values.values())] for s in answer.spans)
    return table, _table(["from (UTC)", *answer.spans[0].values], rows)


def _segments(_: Client, __: SegmentsQuery, answer: Segments) -> Answer:
    if not answer.segments:
        return answer, ["no roads are known"]
    head = ["section", "around", "m", "resistance", "+-", "grade", "passes/h there", "back", "t/h there", "back"]
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


def _worklist(_: Client, __: WorklistQuery, answer: Worklist) -> Answer:
    total = f"{answer.total_kwh_ph:.2f} kWh/h lost on all roads against a resistance of {answer.target:g}"
    total += f", calculated from {60 * answer.hours:.0f} minutes of traffic"
    if not answer.rows and not answer.changes:
        return answer, [f"{total}: no section is worse beyond doubt"]
    head = ["", "section", "around", "kWh/h", "low..high", "l/h", "s/h", "resistance", "+-", "a day", "machines"]
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
            "-" if row.segment.trend is None else f"{row.segment.trend:+z.4f}",
            str(row.segment.machines),
            utc_text(row.since_ns),
            "-" if row.before is None else _value(row.before),
        ]
        for row in answer.rows
    )
    lines = [total, *_table(head, rows)]
    lines += [f"{row.segment.id}: {fuel_text(row.segment.fuel)}" for row in answer.rows if row.segment.fuel]
    if any(row.segment.guessed for row in answer.rows):
        lines.append("no machine stated its mass on some of them: their losses are guesses")
    lines += [
        f"{utc_text(one.first_ns)} {one.id}: resistance {_value(one.before)} -> {_value(one.after)}, "
        f"saves {one.saved_kwh_ph:.2f} kWh/h{f'; {fuel_text(one.fuel)}' if one.fuel else ''}"
        for one in answer.changes
    ]
    return answer, lines


def fuel_text(fuel: Fuel) -> str:
    """Predicted and burned litres, their intervals, and the share of driving that they cover."""
    (predicted, low, high), (burned, least, most) = fuel.predicted_ph, fuel.burned_ph
    pairs = f"predicted {predicted:.2f} ({low:.2f} to {high:.2f}), burned {burned:.2f} ({least:.2f} to {most:.2f}) l/h"
    return f"{pairs}, of {100 * fuel.share:.0f} % of the driving"


def _place(segment: RoadSegment) -> list[str]:
    x_m, y_m = segment.line[len(segment.line) // 2]
    return [segment.id, f"{x_m:.0f}, {y_m:.0f}"]


def _machines(_: Client, __: MachinesQuery, answer: MachinesAnswer) -> Answer:
    head = ["machine", "trusted", "since", "samples", "lost", "newest", "accelerometer zero", "torque gain", "why"]
    return {"machines": answer.machines}, _table(head, map(_machine_row, answer.machines))


def _machine_row(machine: MachineState) -> list[str]:
    trusted = ("yes" if machine.trusted else "NO") + (f", by {machine.by}" if machine.by else "")
    since = utc_text(machine.since_ns) if machine.since_ns else "-"
    counts = [str(machine.samples), str(machine.lost)]
    calibration = [calibrated(machine, name) or "-" for name in ("zero", "torque_gain")]
    return [machine.name, trusted, since, *counts, utc_text(machine.newest_ns), *calibration, why(machine) or "-"]


def _calibration(_: Client, __: CalibrationQuery, answer: CalibrationAnswer) -> Answer:
    return answer, calibration_table(answer)


def calibration_table(answer: CalibrationAnswer) -> list[str]:
    """One line per machine, and the state of the common scale."""
    head = ["machine", "zero", "+-", "scale", "+-", "across", "+-", "known by", "taken off since", "by"]
    lines = _table(head, map(_calibration_row, answer.machines))
    if answer.common_scale_unknown:
        lines.append(f"nothing shows the mean scale of all machines: {answer.common_scale_unknown}")
    return lines


def _calibration_row(machine: MachineCalibration) -> list[str]:
    """Bias and slopes in m/m; of the corrections the newest span."""
    values = (machine.zero, machine.zero_std, machine.scale, machine.scale_std, machine.across, machine.across_std)
    shown = [f"{name} {'+'.join(by)}" for name, by in (("zero", machine.zero_by), ("scale", machine.scale_by)) if by]
    newest, decided = "nothing", "-"
    if machine.spans:
        span = machine.spans[-1]
        since = utc_text(span.from_ns) if span.from_ns else "ever"
        newest = f"{span.zero:zg}, {span.scale:zg}, {span.across:zg} {since}"
        decided = machine.by + (f": {machine.reason}" if machine.reason else "")
    return [machine.name, *map(_value, values), "; ".join(shown) or "-", newest, decided]


def _changes(_: Client, __: ChangesQuery, answer: ChangesAnswer) -> Answer:
    lines = [*map(change_line, answer.changes)]
    return {"changes": answer.changes}, lines or ["no change of the ground was found"]


def change_line(change: GroundChange) -> str:
    """Time, place, old and new ground."""
    west, south, east, north = change.bounds
    parts = [f"{change.id}: {utc_text(change.first_ns)} to {utc_text(change.last_ns)}"]
    parts += [f"{west:g}..{east:g} x {south:g}..{north:g} m", f"{change.cells} cells"]
    resistance = ("resistance", change.resistance_before, change.resistance_after)
    for name, before, after in (resistance, ("grade", change.grade_before, change.grade_after)):
        if before is not None or after is not None:
            parts.append(f"{name} {_value(before)} -> {_value(after)}")
    return "  ".join(parts)


def _info(_: Client, __: InfoQuery, info: MapInfo) -> Answer:
    west, south, east, north = (edge * info.site.cell_m for edge in info.bounds or (0, 0, 0, 0))
    return info, [
        f"site {info.site.name}: {info.cells} cells driven, in {west:g}..{east:g} x {south:g}..{north:g} m",
        f"  journal row {info.journalled}, merged {info.merged}, snapshot {info.snapshot}",
        f"  {_checkpoints(info.checkpoints)}",
        f"  samples merged {info.samples_merged}; rejected, position too uncertain: {info.samples_too_unsure}",
        *(
            f"  {name}: {m.samples} samples, {m.lost} lost, spool opened {m.spools} times"
            for name, m in sorted(info.machines.items())
        ),
        *(f"  {name}: {count}" for name, count in sorted(info.counters.items())),
    ]


def _drive(_: Client, query: LineQuery, answer: RouteAnswer) -> Answer:
    """Totals in a line, steps in a table."""
    totals, steps, machine = answer.totals, answer.steps, answer.machine
    corners = (
        []
        if isinstance(query, RouteQuery)
        else [f"{len(answer.line_m)} places: " + " ".join(f"{x:.0f},{y:.0f}" for x, y in answer.line_m)]
    )
    kwh = f"{totals.energy_j / 3.6e6:.2f} kWh ({totals.energy_low_j / 3.6e6:.2f}..{totals.energy_high_j / 3.6e6:.2f})"
    taken = f"{totals.time_s:.0f} s ({totals.time_low_s:.0f}..{totals.time_high_s:.0f})"
    ground = f"{totals.unknown:.0%} unknown, {totals.unmeasured:.0%} driven and not measured"
    lines = [
        f"{totals.length_m:.0f} m, {totals.lift_m:+z.1f} m up, {ground}",
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
            f"{100 * steps.slope[i]:+z.1f}",
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


def _alive(_: Client, __: AliveQuery, alive: ServerAlive) -> Answer:
    return alive, [f"batches are taken: journal row {alive.journalled}, merged {alive.merged}"]


def _checkpoints(counts: CheckpointCounts) -> str:
    newest = f", samples until {utc_text(counts.newest_ns)}" if counts.newest_ns else ""
    damaged = f", {counts.passed_over} damaged" if counts.passed_over else ""
    return f"checkpoints {counts.count} ({counts.bytes / 1e6:.0f} MB){newest}{damaged}"


def _as_of(query: Compared[Any], stamp_ns: int) -> str:
    """Note on the time of an answer; empty for the current map."""
    as_of = f", as of {utc_text(stamp_ns)}" if query.as_of_ns else ""
    return as_of + (f", minus that of {utc_text(query.minus_ns)}" if query.minus_ns else "")


def _value(value: float | None) -> str:
    return "unknown" if value is None or math.isnan(value) else f"{value:z.4g}"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    lines = [head, *rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return ["  ".join(map(str.ljust, line, widths)).rstrip() for line in lines]


def _statistics(values: Floats32) -> dict[str, float]:
    known = values[np.isfinite(values)]
    if not known.size:
        return {"known": 0, "min": math.nan, "mean": math.nan, "max": math.nan}
    return {"known": known.size, "min": float(known.min()), "mean": float(known.mean()), "max": float(known.max())}


AS_TEXT: dict[str, Callable[..., Answer]] = {
    "point": _point,
    "why": _why,
    "points": _points,
    "region": _region,
    "history": _history,
    "segments": _segments,
    "worklist": _worklist,
    "route": _drive,
    "way": _drive,
    "machines": _machines,
    "calibration": _calibration,
    "changes": _changes,
    "info": _info,
    "alive": _alive,
}
