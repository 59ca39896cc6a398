"""A figure's frame: title, axes in metres, legend, north arrow, scale bar."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.site.geometry import Bounds

Image = NDArray[np.uint8]  # (height, width, 3), BGR
Colour = tuple[int, int, int]

LEFT, TOP, BOTTOM, PAD = 84, 66, 52, 18  # margins around the ground [px]
LINE_PX, SWATCH_PX, MIN_PANEL_PX = 24, 16, 180
COMPASS_PX, BAR_PX = 94, 130
MAX_LISTED, MAX_NAME = 24, 21  # machines in the legend, letters per name
FONT, FONT_SCALE, TITLE_SCALE, MAX_TITLE_PX = cv2.FONT_HERSHEY_DUPLEX, 0.46, 0.75, 1490
INK, PAPER, EDGE = (45, 45, 45), (255, 255, 255), (25, 25, 25)


@dataclass(frozen=True)
class LegendEntry:
    """A line of the legend."""

    colour: Colour
    text: str


@dataclass(frozen=True)
class Axes:
    """The ground's bounds in `map` [m], and its scale."""

    bounds: Bounds
    px_per_m: float


def compose(
    ground: Image,
    axes: Axes,
    title: str,
    classes: Sequence[LegendEntry],
    machines: Sequence[LegendEntry] = (),
    notes: Sequence[str] = (),
) -> Image:
    """Frame the painted ground. notes: lines below the legend."""
    named = [LegendEntry(machine.colour, machine.text[:MAX_NAME]) for machine in machines[:MAX_LISTED]]
    if len(machines) > MAX_LISTED:
        notes = [f"and {len(machines) - MAX_LISTED} more machines", *notes]
    words = [*(entry.text for entry in [*classes, *named]), *notes]
    panel_width = max(MIN_PANEL_PX, SWATCH_PX + 10 + max(text_size(word)[0] for word in words))
    panel_height = LINE_PX * (len(words) + 1) + COMPASS_PX
    height, width = ground.shape[:2]
    panel_left = LEFT + width + PAD + 8
    title_scale = TITLE_SCALE * min(1.0, MAX_TITLE_PX / max(1, text_size(title, TITLE_SCALE)[0]))
    figure_width = max(panel_left + panel_width, LEFT + text_size(title, title_scale)[0]) + PAD
    figure = np.full((TOP + max(height + BOTTOM, panel_height), figure_width, 3), 255, np.uint8)
    figure[TOP : TOP + height, LEFT : LEFT + width] = ground
    text(figure, title, (LEFT, 30), INK, title_scale)
    _draw_axes(figure, axes, width, height)
    below = _draw_legend(figure, classes, named, notes, (panel_left, TOP))
    _draw_compass(figure, axes, (panel_left, below + LINE_PX))
    return figure


def text_size(words: str, scale: float = FONT_SCALE) -> tuple[int, int]:
    """Width and height [px] of text."""
    (width, height), _ = cv2.getTextSize(words, FONT, scale, 1)
    return width, height


def text(figure: Image, words: str, at: tuple[int, int], colour: Colour, scale: float = FONT_SCALE) -> None:
    """Write text from the left end of its base line."""
    cv2.putText(figure, words, at, FONT, scale, colour, 1, cv2.LINE_AA)


def _draw_axes(figure: Image, axes: Axes, width: int, height: int) -> None:
    """Border, ticks and names of the axes."""
    right, bottom, bounds, px_per_m = LEFT + width, TOP + height, axes.bounds, axes.px_per_m
    cv2.rectangle(figure, (LEFT - 1, TOP - 1), (right, bottom), INK, 1)
    widest = max(text_size(_metres(round(m)))[0] for m in (bounds.west_m, bounds.east_m))
    for metres in _ticks(bounds.west_m, width, px_per_m, max(min(80, width // 3), widest + 6)):
        x, label = LEFT + round((metres - bounds.west_m) * px_per_m), _metres(metres)
        cv2.line(figure, (x, bottom), (x, bottom + 5), INK, 1)
        text(figure, label, (x - text_size(label)[0] // 2, bottom + 20), INK)
    for metres in _ticks(bounds.south_m, height, px_per_m, max(18, min(60, height // 3))):
        y, label = bottom - round((metres - bounds.south_m) * px_per_m), _metres(metres)
        cv2.line(figure, (LEFT - 6, y), (LEFT - 1, y), INK, 1)
        text(figure, label, (LEFT - 11 - text_size(label)[0], y + 5), INK)
    text(figure, "east [m]", (LEFT + width // 2 - text_size("east [m]")[0] // 2, bottom + 42), INK)
    text(figure, "north [m]", (LEFT - 11 - text_size("north [m]")[0], TOP - 14), INK)


def _nice(length: float) -> float:
    """Largest of 1, 2, 5 x 10^k up to `length`."""
    power = 10.0 ** math.floor(math.log10(length))
    return power * max(step for step in (1, 2, 5) if step <= length / power * (1 + 1e-9))


def _ticks(start_m: float, length_px: int, px_per_m: float, gap_px: float) -> list[float]:
    """Round positions [m] along an axis, at least `gap_px` apart."""
    step = _nice(gap_px / px_per_m)
    while step * px_per_m < gap_px:
        step = _nice(step * 2.5)
    first, last = math.ceil(start_m / step - 1e-9), math.floor((start_m + length_px / px_per_m) / step + 1e-9)
    return [i * step for i in range(first, last + 1)]


def _metres(value: float) -> str:
    return f"{round(value, 6) + 0.0:.10g}"


def _draw_legend(
    figure: Image,
    classes: Sequence[LegendEntry],
    machines: Sequence[LegendEntry],
    notes: Sequence[str],
    at: tuple[int, int],
) -> int:
    """Returns the pixel row below."""
    left, y = at
    for entry in classes:
        box = ((left, y), (left + SWATCH_PX, y + SWATCH_PX))
        cv2.rectangle(figure, *box, entry.colour, cv2.FILLED)
        cv2.rectangle(figure, *box, INK, 1)
        text(figure, entry.text, (left + SWATCH_PX + 10, y + 13), INK)
        y += LINE_PX
    y += LINE_PX // 2 if machines else 0
    for machine in machines:
        ends = ((left, y + 8), (left + SWATCH_PX, y + 8))
        cv2.line(figure, *ends, EDGE, 5)
        cv2.line(figure, *ends, machine.colour, 3)
        text(figure, machine.text, (left + SWATCH_PX + 10, y + 13), INK)
        y += LINE_PX
    for note in notes:
        text(figure, note, (left, y + 13), INK)
        y += LINE_PX
    return y


def _draw_compass(figure: Image, axes: Axes, at: tuple[int, int]) -> None:
    left, y = at
    arrow = np.array([(left + 8, y), (left + 15, y + 26), (left + 8, y + 20), (left + 1, y + 26)], np.int32)
    cv2.fillPoly(figure, [arrow], INK, cv2.LINE_AA)
    text(figure, "N", (left + 3, y + 42), INK)
    length_m = _nice(BAR_PX / axes.px_per_m)
    start, end, base = left + 36, left + 36 + round(length_m * axes.px_per_m), y + 36
    cv2.line(figure, (start, base), (end, base), INK, 2)
    for x in (start, end):
        cv2.line(figure, (x, base - 5), (x, base + 5), INK, 2)
    text(figure, f"{_metres(length_m)} m", (start, base - 12), INK)
