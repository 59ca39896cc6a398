"""Pictures of the map, as in the paper: BGR, north up. Only `write_image` uses a disk."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from mapserver.pictures.frame import EDGE, MAX_NAME, PAPER, Axes, Colour, Image, LegendEntry, compose, text, text_size
from protocol.arrays import AnyArray, Floats, Ints
from protocol.files import write_whole
from protocol.queries.answers import Region
from protocol.site.ground_classes import SLOPE, UNKNOWN, ZONES, resistance_class, slope_class, wrong_percent

Box = tuple[int, int, int, int]  # left, top, right, bottom [px]

MAX_SIDE_PX, MAX_AREA_PX, MAX_CELL_PX = 1240, 800_000, 64  # limits of the ground, without margins
ARROW_SPACING_PX = 34
UNKNOWN_COLOUR, WRONG_COLOUR = (228, 228, 228), (255, 0, 255)
GROUND_COLOURS = tuple(zone.bgr for zone in ZONES)
EASY, HARD = GROUND_COLOURS[0], GROUND_COLOURS[-1]
# bright, unlike any ground; a dark edge separates them from pale ground
TRACK_COLOURS: tuple[Colour, ...] = (
    (255, 255, 255), (255, 240, 0), (0, 150, 255), (255, 110, 255), (170, 255, 170), (255, 190, 150), (150, 190, 255),
)  # fmt: skip


@dataclass(frozen=True)
class DrawnTrack:
    """A machine's positions in `map` [m], oldest first; NaN breaks the line."""

    name: str
    x_m: Floats
    y_m: Floats


class NamedLayers(Protocol):
    """Layers by name: a Region, or a dictionary of arrays."""

    def __getitem__(self, layer: str, /) -> AnyArray:
        """Values (rows, columns), southernmost row first."""
        ...


@dataclass(frozen=True)
class _Scale:
    """Whole pixels per `shrink` cells, to keep cells crisp."""

    axes: Axes
    cell_px: int
    shrink: int

    def pixels(self, x_m: AnyArray, y_m: AnyArray, height_px: int) -> Floats:
        """Positions as pixels (n, 2); the last row is south."""
        x_px = (np.asarray(x_m, np.float64) - self.axes.bounds.west_m) * self.axes.px_per_m
        y_px = height_px - (np.asarray(y_m, np.float64) - self.axes.bounds.south_m) * self.axes.px_per_m
        return np.stack([x_px, y_px], axis=-1) - 0.5  # pixel centres


def draw_resistance(
    region: Region, tracks: Sequence[DrawnTrack] = (), title: str = "Rolling resistance", notes: Sequence[str] = ()
) -> Image:
    """Draw the layer `resistance` in the paper's classes, dark where it is easy to roll. notes: lines below the legend.

    A layer `resistance_filled` is drawn pale in the gaps.
    """
    entries = [LegendEntry(GROUND_COLOURS[i], f"{zone.name}  {zone.c_rr:g}") for i, zone in enumerate(ZONES)]
    scale = _scale(region)
    ground = _paint(resistance_class(region["resistance"]), entries, scale)
    if "resistance_filled" in region.layers:
        pale = [LegendEntry(_pale(entry.colour), entry.text) for entry in entries]
        filled = _paint(resistance_class(region["resistance_filled"]), pale, scale)
        gaps = (ground == UNKNOWN_COLOUR).all(axis=-1)
        ground[gaps] = filled[gaps]
        entries = [*entries, LegendEntry(pale[1].colour, "pale: filled in")]
    return _finish(ground, scale, entries, tracks, title, notes)


def draw_grade(region: Region, tracks: Sequence[DrawnTrack] = (), title: str = "Grade") -> Image:
    """Draw `grade_east`, `grade_north` as flat and slope, with uphill arrows."""
    entries = [LegendEntry(EASY, "flat"), LegendEntry(HARD, "slope > 7.5 deg")]
    scale, classes = _scale(region), slope_class(region["grade_east"], region["grade_north"])
    ground = _paint(classes, entries, scale)
    _draw_arrows(ground, region, classes, scale)
    return _finish(ground, scale, entries, tracks, title, ["arrows: uphill"] if (classes == SLOPE).any() else ())


def draw_difference(region: Region, truth: NamedLayers, kind: Literal["resistance", "grade"]) -> Image:
    """Draw where the map's class differs from the truth; the title has the wrong share of known ground."""
    classes, true = _classes(region, kind), _classes(truth, kind)
    if classes.shape != true.shape:
        raise ValueError(f"truth has shape {true.shape}, the map {classes.shape}")
    colours = GROUND_COLOURS if kind == "resistance" else (EASY, HARD)
    names = [zone.name for zone in ZONES] if kind == "resistance" else ["flat", "slope"]
    entries = [LegendEntry(_pale(colour), f"right: {name}") for colour, name in zip(colours, names, strict=True)]
    entries.append(LegendEntry(WRONG_COLOUR, "wrong class"))
    known = (classes != UNKNOWN) & (true != UNKNOWN)
    shown = np.where(known, np.where(classes == true, classes, len(entries) - 1), UNKNOWN)
    scale, wrong = _scale(region), wrong_percent(classes, true)
    share = "no known cells" if math.isnan(wrong) else f"{wrong:.2f} % of {known.sum()} known cells wrong"
    what = "Rolling resistance" if kind == "resistance" else "Grade"
    return _finish(_paint(shown, entries, scale), scale, entries, (), f"{what} against truth: {share}")


def side_by_side(images: Sequence[Image]) -> Image:
    """Join pictures in a row, tops aligned."""
    height = max(image.shape[0] for image in images)
    padded = [np.pad(i, ((0, height - i.shape[0]), (0, 0), (0, 0)), constant_values=255) for i in images]
    return np.concatenate(padded, axis=1)


def write_image(path: Path, image: Image) -> None:
    """Write a picture atomically; the suffix sets the format."""
    done, data = cv2.imencode(path.suffix, image)
    if not done:
        raise ValueError(f"{path}: cannot encode the picture")
    write_whole(path, data.tobytes())


# --- the ground ------------------------------------------------------------------------------------------------------


def _classes(layers: NamedLayers, kind: str) -> Ints:
    if kind == "resistance":
        return resistance_class(layers["resistance"])
    return slope_class(layers["grade_east"], layers["grade_north"])


def _pale(colour: Colour) -> Colour:
    blue, green, red = (round(0.42 * c + 0.58 * 255) for c in colour)
    return blue, green, red


def _scale(region: Region) -> _Scale:
    columns, rows = len(region.x_m), len(region.y_m)
    longest = max(columns, rows)
    shrink = math.ceil(longest / MAX_SIDE_PX)
    fit = min(MAX_SIDE_PX // longest, math.isqrt(MAX_AREA_PX // (columns * rows)), MAX_CELL_PX)
    cell_px = max(1, fit)
    return _Scale(Axes(region.bounds, cell_px / (shrink * region.cell_m)), cell_px, shrink)


def _paint(classes: Ints, entries: Sequence[LegendEntry], scale: _Scale) -> Image:
    """The classes as a picture, north up."""
    palette = np.array([*(entry.colour for entry in entries), UNKNOWN_COLOUR], np.uint8)
    shown = _commonest(classes, len(entries), scale.shrink)
    cells = palette[shown[::-1]]  # UNKNOWN, -1, takes the last colour
    return np.ascontiguousarray(cells.repeat(scale.cell_px, axis=0).repeat(scale.cell_px, axis=1))


def _commonest(classes: Ints, count: int, shrink: int) -> Ints:
    """Commonest known class per `shrink` x `shrink` cells: thin tracks must stay visible."""
    if shrink == 1:
        return classes
    padding = [(0, -size % shrink) for size in classes.shape]
    padded = np.pad(classes, padding, constant_values=UNKNOWN)
    rows, columns = padded.shape[0] // shrink, padded.shape[1] // shrink
    groups = padded.reshape(rows, shrink, columns, shrink)
    votes = np.stack([(groups == c).sum(axis=(1, 3)) for c in range(count)])
    return np.where(votes.any(axis=0), votes.argmax(axis=0), UNKNOWN)


def _draw_arrows(ground: Image, region: Region, classes: Ints, scale: _Scale) -> None:
    step = max(1, round(ARROW_SPACING_PX * scale.shrink / scale.cell_px))
    picked = np.zeros(classes.shape, bool)
    picked[step // 2 :: step, step // 2 :: step] = True
    rows, columns = np.nonzero(picked & (classes == SLOPE))
    east, north = (region[layer][rows, columns].astype(np.float64) for layer in ("grade_east", "grade_north"))
    half = 0.32 * ARROW_SPACING_PX * np.stack([east, -north], axis=-1) / np.hypot(east, north)[:, None]
    middle = scale.pixels(region.x_m[columns], region.y_m[rows], ground.shape[0])
    for tail, tip in zip(_fixed(middle - half), _fixed(middle + half), strict=True):
        for colour, thickness in ((EDGE, 3), (PAPER, 1)):
            cv2.arrowedLine(ground, tail.tolist(), tip.tolist(), colour, thickness, cv2.LINE_AA, shift=4, tipLength=0.4)


def _finish(
    ground: Image,
    scale: _Scale,
    entries: Sequence[LegendEntry],
    tracks: Sequence[DrawnTrack],
    title: str,
    notes: Sequence[str] = (),
) -> Image:
    """Draw the tracks, and frame the ground."""
    _draw_tracks(ground, tracks, scale)
    machines = [LegendEntry(colour, track.name) for track, colour in zip(tracks, _colours(tracks), strict=True)]
    return compose(ground, scale.axes, title, [*entries, LegendEntry(UNKNOWN_COLOUR, "unknown")], machines, notes)


# --- tracks ----------------------------------------------------------------------------------------------------------


def _fixed(pixels: Floats) -> NDArray[np.int32]:
    """Pixels with four binary places, for OpenCV's shift."""
    return np.rint(np.clip(pixels, -1e6, 1e6) * 16).astype(np.int32)


def _draw_tracks(ground: Image, tracks: Sequence[DrawnTrack], scale: _Scale) -> None:
    height, width = ground.shape[:2]
    ends: list[tuple[DrawnTrack, Colour, Floats]] = []
    for track, colour in zip(tracks, _colours(tracks), strict=True):
        pixels = scale.pixels(track.x_m, track.y_m, height)
        finite = np.isfinite(pixels).all(axis=1)
        pieces = np.split(pixels, np.flatnonzero(~finite))
        lines = [_fixed(piece[np.isfinite(piece).all(axis=1)]) for piece in pieces]
        for shade, thickness in ((EDGE, 2), (colour, 1)):  # thin, to leave the ground visible
            cv2.polylines(ground, [line for line in lines if len(line)], False, shade, thickness, cv2.LINE_AA, shift=4)
        if finite.any() and ((end := pixels[finite][-1]) >= 0).all() and end[0] < width and end[1] < height:
            ends.append((track, colour, end))
    taken: list[Box] = [(int(x) - 6, int(y) - 6, int(x) + 6, int(y) + 6) for _, _, (x, y) in ends]
    for track, colour, end in ends:
        centre = _fixed(end).tolist()
        cv2.circle(ground, centre, 6 * 16, EDGE, cv2.FILLED, cv2.LINE_AA, shift=4)
        cv2.circle(ground, centre, 4 * 16, colour, cv2.FILLED, cv2.LINE_AA, shift=4)
        _label(ground, track.name, colour, (round(end[0]), round(end[1])), taken)


def _colours(tracks: Sequence[DrawnTrack]) -> list[Colour]:
    return [TRACK_COLOURS[i % len(TRACK_COLOURS)] for i in range(len(tracks))]


def _label(ground: Image, name: str, colour: Colour, at: tuple[int, int], taken: list[Box]) -> None:
    """Label a position without overlaps; the legend has all names."""
    name = name[:MAX_NAME]
    (width, height), (x, y) = text_size(name), at
    sides = [(x + 11, y + height // 2), (x - 11 - width, y + height // 2)]
    for left, base in [*sides, (x - width // 2, y - 13), (x - width // 2, y + 13 + height)]:
        box = (left - 4, base - height - 4, left + width + 4, base + 5)
        inside = box[0] >= 0 and box[1] >= 0 and box[2] <= ground.shape[1] and box[3] <= ground.shape[0]
        if inside and not any(_overlap(box, other) for other in taken):
            taken.append(box)
            cv2.rectangle(ground, box[:2], box[2:], EDGE, cv2.FILLED)
            text(ground, name, (left, base), colour)
            return


def _overlap(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
