"""A picture of a drive: the line on the map, with resistance, slope, speed and energy below."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mapserver.pictures.frame import INK, LEFT, PAD, Colour, Image, text, text_size
from mapserver.pictures.plotter import DrawnTrack, draw_resistance
from protocol.arrays import Floats
from protocol.queries.answers import Region
from protocol.queries.routing import RouteAnswer, RouteTotals
from protocol.units import JOULE_PER_KWH

CHART_PX, GAP_PX, LEAST_WIDTH_PX = 110, 34, 640
GRID: Colour = (225, 225, 225)
UNKNOWN: Colour = (228, 228, 228)  # the same grey as on the map
LINE: Colour = (180, 90, 20)


@dataclass(frozen=True)
class _Chart:
    """Values (n,) of steps."""

    title: str
    values: Floats
    from_zero: bool = True


def draw_drive(region: Region, answer: RouteAnswer) -> Image:
    """Draw the map with a route, and charts of its drive.

    region: around the line, with `resistance` and `resistance_filled`.
    """
    totals, machine = answer.totals, answer.machine
    tracks = [DrawnTrack("end", *answer.line_m.T), DrawnTrack("start", *answer.line_m[:1].T)]
    notes = [
        f"{totals.length_m:.0f} m, {totals.lift_m:+.1f} m up",
        _unknown(totals),
        f"{machine.mass_kg / 1000:.1f} t, {machine.power_w / 1000:.0f} kW",
        f"{totals.litres:.2f} l of diesel",
    ]
    kwh, low, high = (j / JOULE_PER_KWH for j in (totals.energy_j, totals.energy_low_j, totals.energy_high_j))
    title = f"{kwh:.2f} kWh ({low:.2f} to {high:.2f}), {totals.time_s:.0f} s"
    top = draw_resistance(region, tracks, title, notes)
    below = _profile(answer, max(LEAST_WIDTH_PX, top.shape[1]))
    padding = below.shape[1] - top.shape[1]
    return np.concatenate([np.pad(top, ((0, 0), (0, padding), (0, 0)), constant_values=255), below])


def _unknown(totals: RouteTotals) -> str:
    taken = f", taken as {totals.unknown_resistance:.3f}" if totals.unknown else ""
    return f"{totals.unknown:.0%} of it unknown{taken}"


def _profile(answer: RouteAnswer, width: int) -> Image:
    steps = answer.steps
    charts = (
        _Chart("rolling resistance", steps.resistance),
        _Chart("slope [%]", 100 * steps.slope, from_zero=False),
        _Chart("speed [km/h]", 3.6 * steps.speed_mps),
        _Chart("energy so far [kWh]", np.cumsum(steps.energy_j) / JOULE_PER_KWH),
    )
    figure: Image = np.full(((CHART_PX + GAP_PX) * len(charts) + GAP_PX, width, 3), 255, np.uint8)
    ends = np.concatenate([[0.0], steps.distance_m])
    x = (LEFT + ends / ends[-1] * (width - LEFT - PAD)).round().astype(int)
    for number, chart in enumerate(charts):
        _draw(figure, chart, x, steps.unknown, GAP_PX + number * (CHART_PX + GAP_PX))
    bottom = GAP_PX + len(charts) * (CHART_PX + GAP_PX) - GAP_PX
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        words = f"{share * ends[-1]:.0f}" + " m" * (share == 1.0)
        at = LEFT + round(share * (width - LEFT - PAD)) - text_size(words)[0] // 2
        text(figure, words, (min(at, width - text_size(words)[0] - 4), bottom + 20), INK)
    return figure


def _draw(figure: Image, chart: _Chart, x: Floats, unknown: Floats, top: int) -> None:
    """Draw one chart at a pixel row; unknown ground is grey."""
    low, high = float(chart.values.min()), float(chart.values.max())
    low = min(low, 0.0) if chart.from_zero else low
    span = max(high - low, 1e-9 + 0.02 * abs(high))
    bottom, right = top + CHART_PX, figure.shape[1] - PAD
    y = (bottom - (chart.values - low) / span * (CHART_PX - 8)).round().astype(int)
    for i in np.flatnonzero(unknown > 0.5).tolist():
        cv2.rectangle(figure, (int(x[i]), top), (int(x[i + 1]), bottom), UNKNOWN, cv2.FILLED)
    cv2.rectangle(figure, (LEFT, top), (right, bottom), GRID, 1)
    corners = np.stack([np.repeat(x, 2)[1:-1], np.repeat(y, 2)], axis=1).astype(np.int32)
    cv2.polylines(figure, [corners], False, LINE, 2, cv2.LINE_AA)
    text(figure, chart.title, (LEFT, top - 6), INK)
    for value, row in ((high, top + 12), (low, bottom)):
        words = f"{value:.3g}"
        text(figure, words, (LEFT - 8 - text_size(words)[0], row), INK)
