"""A shift lead's page: map, sections worth grading, savings of repairs, odd machines, data quality."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from html import escape
from typing import BinaryIO

import cv2

from mapserver.pictures.plotter import MAX_SIDE_PX, draw_resistance
from protocol.errors import QueryError
from protocol.queries.answers import MachineState
from protocol.queries.coverage import Coverage, CoverageQuery
from protocol.queries.requests import MachinesQuery
from protocol.queries.roads import Corners, RoadChange, Worklist, WorklistRow
from sitegrid.export.wanted import Wanted, coarser
from sitegrid.times import utc_text
from sitegrid.trust_sentences import rolls, why

WORST = 10  # sections in the list
STYLE = """body{font:15px/1.4 system-ui,sans-serif;max-width:60em;margin:1em auto;padding:0 1em}h1{margin-bottom:0}
img{max-width:100%}table{border-collapse:collapse}td,th{padding:.15em .7em;border-bottom:1px solid;text-align:right}
td:first-child,th:first-child{text-align:left}"""


def write_html(file: BinaryIO, wanted: Wanted, _: object) -> dict[str, int]:
    """Write the page, self-contained."""
    worklist = wanted.worklist()
    parts = (
        _head(wanted),
        _picture(wanted),
        _section("Worst road sections", _worst(worklist)),
        _section("What repairs saved", _repaired(worklist.changes)),
        _section("Machines that roll unlike the others", _machines(wanted)),
        _section("Data quality", _quality(wanted)),
    )
    for part in parts:
        file.write(part.encode())
    return {"sections": len(parts)}


def _head(wanted: Wanted) -> str:
    name, then = escape(wanted.info.site.name), wanted.roads.as_of_ns or wanted.info.stamp_ns
    head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{name}</title><style>{STYLE}</style>'
    return f"{head}<h1>Ground of {name}</h1><p>As of {utc_text(then)}, journal row {wanted.info.merged}.</p>\n"


def _picture(wanted: Wanted) -> str:
    region = wanted.region(replace(coarser(wanted, MAX_SIDE_PX), layers=("resistance", "grade")))
    _, png = cv2.imencode(".png", draw_resistance(region))
    return f'<img alt="Rolling resistance" src="data:image/png;base64,{base64.b64encode(png.tobytes()).decode()}">\n'


def _section(title: str, parts: Iterable[str]) -> str:
    return f"<h2>{title}</h2>\n{''.join(parts)}\n"


def _sentence(text: str) -> str:
    return f"<p>{escape(text)}</p>\n"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows]
    return f"<table><tr>{''.join(f'<th>{escape(name)}</th>' for name in head)}</tr>{''.join(lines)}</table>\n"


def _worst(worklist: Worklist) -> Iterator[str]:
    lost = f"{worklist.total_kwh_ph:.1f} kWh/h are lost on all roads against a rolling resistance of"
    yield _sentence(f"{lost} {_percent(worklist.target)}, with the traffic of {worklist.hours:.1f} h.")
    if worklist.rows:
        head = ("Section", "around x, y [m]", "length [m]", "resistance", "kWh/h", "90 % between", "l/h")
        yield _table(head, map(_row, worklist.rows[:WORST]))
    else:
        yield _sentence("No section is worse than that for sure.")


def _row(row: WorklistRow) -> Sequence[str]:
    value, low, high = row.kwh_ph
    lost = (f"{value:.1f}", f"{low:.1f} and {high:.1f}", f"{row.litres_ph[0]:.1f}")
    one = row.segment
    return (f"{row.rank}: {one.id}", _around(one.line), f"{one.length_m:.0f}", _percent(one.resistance), *lost)


def _repaired(changes: Sequence[RoadChange]) -> Iterator[str]:
    better = [change for change in changes if change.saved_kwh_ph > 0]
    if not changes:
        yield _sentence("No section changed.")
        return
    saved, lost = (sum(abs(one.saved_kwh_ph) for one in some) for some in (better, {*changes} - {*better}))
    yield _sentence(f"{len(better)} sections became better and save {saved:.1f} kWh/h.")
    yield _sentence(f"{len(changes) - len(better)} became worse and cost {lost:.1f} kWh/h.")
    head = ("Section", "around x, y [m]", "since", "resistance before", "after", "saves kWh/h")
    yield _table(head, map(_change, changes[:WORST]))


def _change(one: RoadChange) -> Sequence[str]:
    values = (_percent(one.before), _percent(one.after), f"{one.saved_kwh_ph:.1f}")
    return (one.id, _around(one.line), utc_text(one.first_ns), *values)


def _around(line: Corners) -> str:
    x_m, y_m = line[len(line) // 2]
    return f"{x_m:.0f}, {y_m:.0f}"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"


def _machines(wanted: Wanted) -> Iterator[str]:
    machines = _known(wanted)
    odd = [f"{one.name} {said}." for one in machines if (said := rolls(one))]
    unknown = "Only the map server knows: write this report from the running site."
    for line in odd or ["None." if machines else unknown]:
        yield _sentence(line)


def _known(wanted: Wanted) -> Sequence[MachineState]:
    """The map server's view of the machines; empty if it does not run."""
    with suppress(QueryError):
        machines: Sequence[MachineState] = wanted.map.ask(MachinesQuery()).machines
        return machines
    return ()


def _quality(wanted: Wanted) -> Iterator[str]:
    ground: Coverage = wanted.map.ask(CoverageQuery(bounds=wanted.roads.bounds, as_of_ns=wanted.roads.as_of_ns))
    since = (f"{area_m2:.0f} m2 in the last {name}" for name, area_m2 in ground.driven_since_m2.items())
    known = f"Resistance known: {ground.known_m2:.0f} m2."
    yield _sentence(f"Driven: {ground.driven_m2:.0f} m2, {', '.join(since)}. {known}")
    info = wanted.info
    total = info.samples_merged + info.samples_too_unsure
    yield _sentence(f"Samples: {total}, of which {info.samples_too_unsure} were too uncertain of their position.")
    counts = ((name, one.samples, one.lost, one.missing) for name, one in sorted(info.machines.items()))
    reasons = {one.name: why(one) for one in _known(wanted)}
    rows = [
        (name, *map(str, numbers), f"NO {reasons.get(name, '')}" if name in info.distrusted else "yes")
        for name, *numbers in counts
    ]
    yield _table(("Machine", "samples", "lost", "missing", "in the map"), rows)
    for line in info.shortfalls:
        yield _sentence(line)
