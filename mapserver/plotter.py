"""The paper's plotter: pictures of the map as BGR images, north up. Pure drawing; only `write_image` touches a disk."""

from __future__ import annotations

import math
import os
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.arrays import AnyArray, Floats, Ints
from protocol.geometry import Bounds
from protocol.ground import FLAT, SLOPE, UNKNOWN, ZONES, resistance_class, slope_class, wrong_percent
from protocol.queries import Region

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]
Box = tuple[int, int, int, int]  # left, top, right, bottom [px]

MAX_SIDE_PX, MAX_AREA_PX, MAX_CELL_PX = 1280, 800_000, 64  # of the map itself, without margins
LEFT, TOP, BOTTOM, PAD = 64, 66, 52, 18
LINE_PX, SWATCH_PX = 24, 16
MAX_LISTED = 24
ARROW_SPACING_PX = 34
FONT, FONT_SCALE = cv2.FONT_HERSHEY_DUPLEX, 0.46
INK, PAPER, UNKNOWN_COLOUR, WRONG_COLOUR, EDGE = (
    (45, 45, 45),
    (255, 255, 255),
    (228, 228, 228),
    (255, 0, 255),
    (25,) * 3,
)
FLAT_COLOUR, SLOPE_COLOUR = ZONES[0].bgr, ZONES[1].bgr
# Bright, and none of them a colour of the ground; a dark edge sets them off from pale ground.
TRACK_COLOURS: tuple[Colour, ...] = (
    (255, 255, 255), (255, 240, 0), (0, 150, 255), (255, 110, 255), (170, 255, 170), (255, 190, 150), (150, 190, 255),
)  # fmt: skip


@dataclass(frozen=True)
class Track:
    """Where a machine has been, oldest first, in `map` [m]; NaN breaks the line."""

    name: str
    x_m: Floats
    y_m: Floats


class Layers(Protocol):
    """Anything that gives layers by name: a Region, or a dictionary of arrays."""

    def __getitem__(self, layer: str, /) -> AnyArray:
        """Values (rows, columns), row 0 the southernmost."""
        ...


@dataclass(frozen=True)
class _Entry:
    """One class of the picture: its colour and its words in the legend."""

    colour: Colour
    text: str


@dataclass(frozen=True)
class _View:
    """The map's place in the picture: whole pixels per `shrink` cells, so that cells stay crisp."""

    bounds: Bounds
    cell_px: int
    shrink: int
    cell_m: float

    @property
    def px_per_m(self) -> float:
        return self.cell_px / (self.shrink * self.cell_m)

    def pixels(self, x_m: AnyArray, y_m: AnyArray, height_px: int) -> Floats:
        """Positions as (n, 2) pixels of the map's own picture, whose last row is the south."""
        x_px = (np.asarray(x_m, np.float64) - self.bounds.west_m) * self.px_per_m
        y_px = height_px - (np.asarray(y_m, np.float64) - self.bounds.south_m) * self.px_per_m
        return np.stack([x_px, y_px], axis=-1) - 0.5  # pixel centres


def draw_resistance(region: Region, tracks: Sequence[Track] = (), title: str = "Rolling resistance") -> Image:
    """Draw the layer `resistance` in the paper's classes and colours."""
    entries = [_Entry(zone.bgr, f"{zone.name}  {zone.c_rr:g}") for zone in ZONES]
    view = _view(region)
    ground = _paint(resistance_class(region["resistance"]), entries, view)
    return _compose(ground, view, entries, tracks, title)


def draw_grade(region: Region, tracks: Sequence[Track] = (), title: str = "Grade") -> Image:
    """Draw the layers `grade_east`, `grade_north` as flat and slope, with arrows that point uphill."""
    entries = [_Entry(FLAT_COLOUR, "flat"), _Entry(SLOPE_COLOUR, "slope > 7.5 deg")]
    view, classes = _view(region), slope_class(region["grade_east"], region["grade_north"])
    ground = _paint(classes, entries, view)
    _draw_arrows(ground, region, classes, view)
    return _compose(ground, view, entries, tracks, title, note="arrows: uphill" if (classes == SLOPE).any() else "")


def draw_difference(region: Region, truth: Layers, kind: Literal["resistance", "grade"]) -> Image:
    """Draw where the map's class differs from the truth; the title says how much of the known ground is wrong."""
    classes, true = _classes(region, kind), _classes(truth, kind)
    if classes.shape != true.shape:
        raise ValueError(f"truth has shape {true.shape}, the map {classes.shape}")
    colours = [zone.bgr for zone in ZONES] if kind == "resistance" else [FLAT_COLOUR, SLOPE_COLOUR]
    names = [zone.name for zone in ZONES] if kind == "resistance" else ["flat", "slope"]
    entries = [_Entry(_pale(colour), f"right: {name}") for colour, name in zip(colours, names, strict=True)]
    entries.append(_Entry(WRONG_COLOUR, "wrong class"))
    known = (classes != UNKNOWN) & (true != UNKNOWN)
    shown = np.where(known, np.where(classes == true, classes, len(entries) - 1), UNKNOWN)
    view, wrong = _view(region), wrong_percent(classes, true)
    share = "no known cells" if math.isnan(wrong) else f"{wrong:.2f} % of {known.sum()} known cells wrong"
    what = "Rolling resistance" if kind == "resistance" else "Grade"
    return _compose(_paint(shown, entries, view), view, entries, (), f"{what} against truth: {share}")


def side_by_side(images: Sequence[Image]) -> Image:
    """Compose pictures into one row, aligned at their tops."""
    height = max(image.shape[0] for image in images)
    padded = [np.pad(i, ((0, height - i.shape[0]), (0, 0), (0, 0)), constant_values=255) for i in images]
    return np.concatenate(padded, axis=1)


def write_image(path: Path, image: Image) -> None:
    """Write a picture (format by the suffix) so that a viewer sees the old one or the new one, never half of it."""
    done, data = cv2.imencode(path.suffix, image)
    if not done:
        raise ValueError(f"{path}: cannot encode the picture")
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}")
    try:
        temporary.write_bytes(data.tobytes())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


# --- the ground ------------------------------------------------------------------------------------------------------


def _classes(layers: Layers, kind: str) -> Ints:
    if kind == "resistance":
        return resistance_class(layers["resistance"])
    return slope_class(layers["grade_east"], layers["grade_north"])


def _pale(colour: Colour) -> Colour:
    blue, green, red = (round(0.42 * c + 0.58 * 255) for c in colour)
    return blue, green, red


def _view(region: Region) -> _View:
    columns, rows = len(region.x_m), len(region.y_m)
    longest = max(columns, rows)
    shrink = math.ceil(longest / MAX_SIDE_PX)
    fit = min(MAX_SIDE_PX // longest, math.isqrt(MAX_AREA_PX // (columns * rows)), MAX_CELL_PX)
    return _View(region.bounds, max(1, fit), shrink, region.cell_m)


def _paint(classes: Ints, entries: Sequence[_Entry], view: _View) -> Image:
    """Picture of the classes, north up, without margins."""
    palette = np.array([*(entry.colour for entry in entries), UNKNOWN_COLOUR], np.uint8)
    shown = _commonest(classes, len(entries), view.shrink)
    cells = palette[shown[::-1]]  # UNKNOWN, -1, takes the last colour
    return np.ascontiguousarray(cells.repeat(view.cell_px, axis=0).repeat(view.cell_px, axis=1))


def _commonest(classes: Ints, count: int, shrink: int) -> Ints:
    """Commonest known class of each `shrink` x `shrink` cells: a thin track must not vanish from a large map."""
    if shrink == 1:
        return classes
    padding = [(0, -size % shrink) for size in classes.shape]
    padded = np.pad(classes, padding, constant_values=UNKNOWN)
    rows, columns = padded.shape[0] // shrink, padded.shape[1] // shrink
    groups = padded.reshape(rows, shrink, columns, shrink)
    votes = np.stack([(groups == c).sum(axis=(1, 3)) for c in range(count)])
    return np.where(votes.any(axis=0), votes.argmax(axis=0), UNKNOWN)


def _draw_arrows(ground: Image, region: Region, classes: Ints, view: _View) -> None:
    step = max(1, round(ARROW_SPACING_PX / (view.px_per_m * view.cell_m)))
    picked = np.zeros(classes.shape, bool)
    picked[step // 2 :: step, step // 2 :: step] = True
    rows, columns = np.nonzero(picked & (classes == SLOPE))
    east, north = (region[layer][rows, columns].astype(np.float64) for layer in ("grade_east", "grade_north"))
    half = 0.32 * ARROW_SPACING_PX * np.stack([east, -north], axis=-1) / np.hypot(east, north)[:, None]
    middle = view.pixels(region.x_m[columns], region.y_m[rows], ground.shape[0])
    for tail, tip in zip(_fixed(middle - half), _fixed(middle + half), strict=True):
        cv2.arrowedLine(ground, tail.tolist(), tip.tolist(), PAPER, 1, cv2.LINE_AA, shift=4, tipLength=0.4)


# --- tracks ----------------------------------------------------------------------------------------------------------


def _fixed(pixels: Floats) -> NDArray[np.int32]:
    """Pixels with four binary places, as OpenCV draws them between the pixels."""
    return np.rint(np.clip(pixels, -1e6, 1e6) * 16).astype(np.int32)


def _draw_tracks(ground: Image, tracks: Sequence[Track], view: _View) -> None:
    height, width = ground.shape[:2]
    ends: list[tuple[Track, Colour, Floats]] = []
    for track, colour in zip(tracks, _track_colours(tracks), strict=True):
        pixels = view.pixels(track.x_m, track.y_m, height)
        finite = np.isfinite(pixels).all(axis=1)
        pieces = np.split(pixels, np.flatnonzero(~finite))
        lines = [_fixed(piece[np.isfinite(piece).all(axis=1)]) for piece in pieces]
        cv2.polylines(ground, [line for line in lines if len(line)], False, EDGE, 3, cv2.LINE_AA, shift=4)
        cv2.polylines(ground, [line for line in lines if len(line)], False, colour, 1, cv2.LINE_AA, shift=4)
        if finite.any() and (0 <= (end := pixels[finite][-1])).all() and end[0] < width and end[1] < height:
            ends.append((track, colour, end))
    taken: list[Box] = [(int(x) - 6, int(y) - 6, int(x) + 6, int(y) + 6) for _, _, (x, y) in ends]
    for track, colour, end in ends:
        centre = _fixed(end).tolist()
        cv2.circle(ground, centre, 6 * 16, EDGE, cv2.FILLED, cv2.LINE_AA, shift=4)
        cv2.circle(ground, centre, 4 * 16, colour, cv2.FILLED, cv2.LINE_AA, shift=4)
        _label(ground, track.name, colour, (round(end[0]), round(end[1])), taken)


def _track_colours(tracks: Sequence[Track]) -> list[Colour]:
    return [TRACK_COLOURS[i % len(TRACK_COLOURS)] for i in range(len(tracks))]


def _label(ground: Image, name: str, colour: Colour, at: tuple[int, int], taken: list[Box]) -> None:
    """Write a name beside a position where it covers no other; the legend has it in any case."""
    (width, height), (x, y) = _text_size(name), at
    sides = [(x + 10, y + height // 2), (x - 10 - width, y + height // 2)]
    for left, base in [*sides, (x - width // 2, y - 12), (x - width // 2, y + 12 + height)]:
        box = (left - 2, base - height - 3, left + width + 2, base + 4)
        inside = box[0] >= 0 and box[1] >= 0 and box[2] <= ground.shape[1] and box[3] <= ground.shape[0]
        if inside and not any(_overlap(box, other) for other in taken):
            taken.append(box)
            _text(ground, name, (left, base), EDGE, thickness=4)
            _text(ground, name, (left, base), colour)
            return


def _overlap(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


# --- the sheet around the map ----------------------------------------------------------------------------------------


def _compose(
    ground: Image, view: _View, entries: Sequence[_Entry], tracks: Sequence[Track], title: str, note: str = ""
) -> Image:
    """Set the painted ground into a sheet: title, axes, legend, machines, north arrow, scale bar."""
    _draw_tracks(ground, tracks, view)
    listed = [*entries, _Entry(UNKNOWN_COLOUR, "unknown")]
    machines = [_Entry(c, t.name) for t, c in zip(tracks[:MAX_LISTED], _track_colours(tracks), strict=False)]
    notes = [note] if note else []
    if len(tracks) > MAX_LISTED:
        notes.append(f"and {len(tracks) - MAX_LISTED} more machines")
    texts = [*(entry.text for entry in [*listed, *machines]), *notes]
    panel_width = max(180, SWATCH_PX + 10 + max(_text_size(text)[0] for text in texts))
    panel_height = LINE_PX * (len(texts) + bool(machines)) + 2 * LINE_PX + 70
    height, width = ground.shape[:2]
    panel_left = LEFT + width + PAD + 8
    title_scale = min(0.75, 0.75 * 1500 / max(1, _text_size(title, 0.75)[0]))
    sheet_width = max(panel_left + panel_width, LEFT + _text_size(title, title_scale)[0]) + PAD
    sheet = np.full((TOP + max(height + BOTTOM, panel_height), sheet_width, 3), 255, np.uint8)
    sheet[TOP : TOP + height, LEFT : LEFT + width] = ground
    _text(sheet, title, (LEFT, 30), INK, title_scale)
    _draw_axes(sheet, view, width, height)
    bottom = _draw_legend(sheet, listed, machines, notes, (panel_left, TOP))
    _draw_compass(sheet, view, (panel_left, bottom + LINE_PX))
    return sheet


def _draw_axes(sheet: Image, view: _View, width: int, height: int) -> None:
    """Frame, ticks with metres, and the names of the axes, outside the map."""
    right, bottom = LEFT + width, TOP + height
    cv2.rectangle(sheet, (LEFT - 1, TOP - 1), (right, bottom), INK, 1)
    for metres in _ticks(view.bounds.west_m, width / view.px_per_m, max(2, width // 90)):
        x = LEFT + round((metres - view.bounds.west_m) * view.px_per_m)
        cv2.line(sheet, (x, bottom), (x, bottom + 5), INK, 1)
        _text(sheet, _metres(metres), (x - _text_size(_metres(metres))[0] // 2, bottom + 20), INK)
    for metres in _ticks(view.bounds.south_m, height / view.px_per_m, max(2, height // 70)):
        y = bottom - round((metres - view.bounds.south_m) * view.px_per_m)
        cv2.line(sheet, (LEFT - 6, y), (LEFT - 1, y), INK, 1)
        _text(sheet, _metres(metres), (LEFT - 11 - _text_size(_metres(metres))[0], y + 5), INK)
    _text(sheet, "east [m]", (LEFT + width // 2 - _text_size("east [m]")[0] // 2, bottom + 42), INK)
    _text(sheet, "north [m]", (6, TOP - 14), INK)


def _nice(length: float) -> float:
    """Largest of 1, 2, 5 x 10^k that is not above `length`."""
    power = 10.0 ** math.floor(math.log10(length))
    return power * max(step for step in (1, 2, 5) if step * power <= length * (1 + 1e-9))


def _ticks(start_m: float, length_m: float, most: int) -> list[float]:
    step = _nice(length_m / most)
    while length_m / step > most:
        step = _nice(step * 2.5)
    first, last = math.ceil(start_m / step - 1e-9), math.floor((start_m + length_m) / step + 1e-9)
    return [i * step for i in range(first, last + 1)]


def _metres(value: float) -> str:
    return f"{round(value, 6) + 0.0:.10g}"


def _draw_legend(
    sheet: Image, entries: Sequence[_Entry], machines: Sequence[_Entry], notes: Sequence[str], at: tuple[int, int]
) -> int:
    """Swatches of the classes, lines of the machines; returns the pixel row below."""
    left, y = at
    for entry in entries:
        box = ((left, y), (left + SWATCH_PX, y + SWATCH_PX))
        cv2.rectangle(sheet, *box, entry.colour, cv2.FILLED)
        cv2.rectangle(sheet, *box, INK, 1)
        _text(sheet, entry.text, (left + SWATCH_PX + 10, y + 13), INK)
        y += LINE_PX
    y += LINE_PX // 2 if machines else 0
    for machine in machines:
        ends = ((left, y + 8), (left + SWATCH_PX, y + 8))
        cv2.line(sheet, *ends, EDGE, 5)
        cv2.line(sheet, *ends, machine.colour, 3)
        _text(sheet, machine.text, (left + SWATCH_PX + 10, y + 13), INK)
        y += LINE_PX
    for note in notes:
        _text(sheet, note, (left, y + 13), INK)
        y += LINE_PX
    return y


def _draw_compass(sheet: Image, view: _View, at: tuple[int, int]) -> None:
    """Arrow to the north and a bar of known length."""
    left, y = at
    arrow = np.array([(left + 8, y), (left + 15, y + 26), (left + 8, y + 20), (left + 1, y + 26)], np.int32)
    cv2.fillPoly(sheet, [arrow], INK, cv2.LINE_AA)
    _text(sheet, "N", (left + 3, y + 42), INK)
    length_m = _nice(130 / view.px_per_m)
    start, end, base = left + 36, left + 36 + round(length_m * view.px_per_m), y + 36
    cv2.line(sheet, (start, base), (end, base), INK, 2)
    for x in (start, end):
        cv2.line(sheet, (x, base - 5), (x, base + 5), INK, 2)
    _text(sheet, f"{_metres(length_m)} m", (start, base - 12), INK)


def _text_size(text: str, scale: float = FONT_SCALE) -> tuple[int, int]:
    (width, height), _ = cv2.getTextSize(text, FONT, scale, 1)
    return width, height


def _text(
    sheet: Image, text: str, at: tuple[int, int], colour: Colour, scale: float = FONT_SCALE, thickness: int = 1
) -> None:
    cv2.putText(sheet, text, at, FONT, scale, colour, thickness, cv2.LINE_AA)
