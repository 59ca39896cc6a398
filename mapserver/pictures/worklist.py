"""A picture for the foreman: where to grade, and why."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

import cv2
import numpy as np

from mapserver.pictures.frame import INK, Axes, Colour, Image, LegendEntry, compose, text, text_size
from protocol.arrays import Floats, Ints
from protocol.queries.roads import RoadChange, RoadSegment, Segments, Worklist
from protocol.site.geometry import Bounds

TOP = 10
LEAST_HOURS = 0.5  # of traffic, for losses an hour, as on the live page: less does not say what an hour costs
WIDE_PX, MARGIN_M = 1200, 25.0
MOST_PX_PER_M = 8.0
GROUND: Colour = (238, 240, 240)
UNKNOWN: Colour = (190, 190, 190)
WORST: Colour = (40, 30, 215)
REPAIRED: Colour = (60, 150, 40)
# by resistance over the target, lightest if there is nothing to do
STEPS: tuple[tuple[float, Colour, str], ...] = (
    (1.25, (170, 200, 170), "near the target or better"),
    (2.0, (140, 200, 235), "up to twice the target"),
    (np.inf, (90, 150, 235), "worse"),
)
ARROW_PASSES = 0.75  # share of passes in one direction that gets an arrow


def draw_worklist(roads: Segments, worklist: Worklist) -> Image:
    """Roads, the ten most expensive sections in red with ranks, and arrows of one-way traffic."""
    rows = worklist.rows[:TOP]
    lines = [np.array(one.line) for one in roads.segments]
    points = np.concatenate([np.zeros((1, 2)) if not lines else lines[0][:1], *lines])
    west, south = points.min(axis=0) - MARGIN_M
    east, north = points.max(axis=0) + MARGIN_M
    px_per_m = min(MOST_PX_PER_M, WIDE_PX / (east - west))
    axes = Axes(Bounds(west, south, east, north), px_per_m)
    size = (round((north - south) * px_per_m), round((east - west) * px_per_m), 3)
    ground: Image = np.full(size, GROUND, np.uint8)
    thick = max(3, round(5 * px_per_m))
    for one in roads.segments:
        _line(ground, axes, one, _colour(one, worklist.target), thick)
    repaired, _ = _changes(worklist)
    for change in repaired:
        cv2.polylines(ground, [_pixels(axes, np.array(change.line), len(ground))], False, REPAIRED, thick // 2)
    for row in rows:
        _line(ground, axes, row.segment, WORST, thick)
    for one in roads.segments:
        _arrow(ground, axes, one)
    for place, row in enumerate(rows, 1):
        _number(ground, axes, row.segment, str(place))
    classes = [LegendEntry(WORST, f"costs most: the first {len(rows)}")] if rows else []
    classes += [LegendEntry(colour, words) for _, colour, words in STEPS] + [LegendEntry(UNKNOWN, "not known")]
    classes += [LegendEntry(REPAIRED, "repaired")] if repaired else []
    return compose(ground, axes, _title(worklist), classes, notes=_notes(worklist))


def _title(worklist: Worklist) -> str:
    against = f"a resistance of {worklist.target:g}, from {60 * worklist.hours:.0f} min of traffic"
    if worklist.hours < LEAST_HOURS:
        return f"Worth grading against {against}; losses an hour are shown after {60 * LEAST_HOURS:.0f} min"
    return f"Worth grading: {worklist.total_kwh_ph:.1f} kWh an hour lost against {against}"


def _notes(worklist: Worklist) -> Sequence[str]:
    notes, is_short = [""], worklist.hours < LEAST_HOURS
    for place, row in enumerate(worklist.rows[:TOP], 1):
        value, low, high = row.kwh_ph
        one = row.segment
        known = f"{one.resistance:.3f} +- {one.resistance_std:.3f}" if one.resistance and one.resistance_std else "?"
        passes_ph = sum(one.passes_ph)
        if is_short:
            notes.append(f"{place}  resistance {known}, {passes_ph * worklist.hours:.0f} passes")
        else:
            notes.append(f"{place}  {value:.2f} kWh/h ({low:.2f} to {high:.2f}), {row.litres_ph[0]:.2g} l/h")
            notes.append(f"     resistance {known}, {passes_ph:.0f} passes/h" + " (mass guessed)" * one.guessed)
        if row.before is not None:
            notes.append(f"     since {_time(row.since_ns)}, {row.before:.3f} before")
    ranks = [row.rank for row in worklist.rows[:TOP]]
    if len(set(ranks)) < len(ranks):
        notes.append("Those that cost nearly the same may stand in either order.")
    for changes, words, effect in zip(_changes(worklist), ("repaired", "worse"), ("saved", "more lost"), strict=True):
        if changes and not is_short:
            kwh_ph = abs(sum(change.saved_kwh_ph for change in changes))
            notes.append(f"{len(changes)} {words} since they were known: {kwh_ph:.1f} kWh an hour {effect}")
    return notes


def _changes(worklist: Worklist) -> tuple[list[RoadChange], list[RoadChange]]:
    """Repaired sections, and deteriorated ones."""
    better = [change for change in worklist.changes if change.after < change.before]
    return better, [change for change in worklist.changes if change.after >= change.before]


def _time(stamp_ns: int) -> str:
    return datetime.fromtimestamp(stamp_ns // 10**9, UTC).strftime("%d %b %H:%M UTC")


def _colour(one: RoadSegment, target: float) -> Colour:
    if one.resistance is None:
        return UNKNOWN
    return next(colour for most, colour, _ in STEPS if one.resistance <= most * target)


def _pixels(axes: Axes, line: Floats, height: int) -> Ints:
    x = (line[:, 0] - axes.bounds.west_m) * axes.px_per_m
    y = height - (line[:, 1] - axes.bounds.south_m) * axes.px_per_m
    return np.rint(np.stack([x, y], axis=1)).astype(np.int32)


def _line(ground: Image, axes: Axes, one: RoadSegment, colour: Colour, thick: int) -> None:
    cv2.polylines(ground, [_pixels(axes, np.array(one.line), len(ground))], False, colour, thick, cv2.LINE_AA)


def _arrow(ground: Image, axes: Axes, one: RoadSegment) -> None:
    there, back = one.passes_ph
    if max(there, back) <= ARROW_PASSES * (there + back) or there + back == 0:
        return
    line = np.array(one.line) if there > back else np.array(one.line)[::-1]
    middle = len(line) // 2
    begin, end = _pixels(axes, line[[max(middle - 1, 0), min(middle + 1, len(line) - 1)]], len(ground)).tolist()
    cv2.arrowedLine(ground, begin, end, INK, 1, cv2.LINE_AA, tipLength=0.5)


def _number(ground: Image, axes: Axes, one: RoadSegment, words: str) -> None:
    line = np.array(one.line)
    ((x, y),) = _pixels(axes, line[len(line) // 2 :][:1], len(ground)).tolist()
    width, height = text_size(words, 0.6)
    x, y = min(x + 10, ground.shape[1] - width - 4), max(y - 10, height + 4)
    cv2.rectangle(ground, (x - 4, y - height - 4), (x + width + 4, y + 5), (255, 255, 255), cv2.FILLED)
    cv2.rectangle(ground, (x - 4, y - height - 4), (x + width + 4, y + 5), WORST, 1)
    text(ground, words, (x, y), WORST, 0.6)
