"""Picture of a replayed log: estimated track, 95 % ellipses, fixes, truth; axes in metres."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from mapserver.pictures.frame import Axes, Colour, Image, LegendEntry, compose
from mapserver.pictures.plotter import write_image
from protocol.arrays import Floats, Ints
from protocol.site.geometry import Bounds
from sitegrid.logs.consistency import ellipse_limit
from sitegrid.logs.outages import Pattern
from sitegrid.logs.replay import Trace, Track, errors
from sitegrid.logs.run import Recording
from sitegrid.logs.speeds import places
from sitegrid.proof.figures import root_mean_square

MAX_SIDE_PX, MAX_PX_PER_M, MARGIN_M = 1000, 20.0, 5.0
ELLIPSES = 60  # per track
BLANK: Colour = (255, 255, 255)
FIX: Colour = (190, 190, 190)
WITHHELD: Colour = (60, 160, 250)
ELLIPSE: Colour = (220, 180, 140)
TRACK: Colour = (190, 80, 0)
TRUTH: Colour = (50, 140, 50)


def draw_log(path: Path, recording: Recording, pattern: Pattern, trace: Trace) -> None:
    """Draw a replay and write it."""
    write_image(path, picture(recording, pattern, trace))


def picture(recording: Recording, pattern: Pattern, trace: Trace) -> Image:
    """Draw a replay; with a truth, the track of the truth's point."""
    truth = recording.truth
    seconds, fixes = places(recording.readings, recording.log.site)
    begin_s = recording.readings[0].stamp_ns * 1e-9
    dark = np.array([pattern is not None and pattern.withholds(s - begin_s) for s in seconds], bool)
    track = trace.moved(truth.lever_m) if truth else trace
    true = truth.track.position_m if truth else np.zeros((0, 2))
    axes = _axes([track.position_m, true, _usual(fixes)])
    ground = _blank(axes)
    _dots(ground, axes, fixes[~dark], FIX)
    _dots(ground, axes, fixes[dark], WITHHELD)
    _ellipses(ground, axes, track)
    _line(ground, axes, track.position_m, TRACK, 2)
    _line(ground, axes, true, TRUTH, 1)
    entries = [LegendEntry(TRACK, "track"), LegendEntry(ELLIPSE, "95 % ellipses"), LegendEntry(FIX, "fixes")]
    entries += [LegendEntry(WITHHELD, "withheld fixes")] * bool(dark.any()) + [LegendEntry(TRUTH, "truth")] * bool(
        truth
    )
    notes = [f"rms error {_rms_m(track, recording):.2f} m"] if truth else []
    return compose(ground, axes, f"{recording.log.name}: withheld {pattern or 'none'}", entries, notes=notes)


def _rms_m(track: Track, recording: Recording) -> float:
    assert recording.truth
    off = np.hypot(*errors(track, recording.truth.track).T)
    return root_mean_square(off[np.isfinite(off)])


def _usual(fixes: Floats) -> Floats:
    """Fixes without outliers, which would shrink the rest."""
    if not len(fixes):
        return fixes
    low, high = np.percentile(fixes, (1, 99), axis=0)
    usual: Floats = fixes[((fixes >= low) & (fixes <= high)).all(axis=1)]
    return usual


def _axes(lines: Sequence[Floats]) -> Axes:
    """Bounds of these places (n, 2), and a scale for a screen."""
    points = np.concatenate(lines)
    points = points[np.isfinite(points).all(axis=1)]
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(2), np.zeros(2))
    low, high = low - MARGIN_M, high + MARGIN_M
    return Axes(Bounds(*low.tolist(), *high.tolist()), min(MAX_PX_PER_M, MAX_SIDE_PX / float((high - low).max())))


def _blank(axes: Axes) -> Image:
    bounds, scale = axes.bounds, axes.px_per_m
    size = round((bounds.north_m - bounds.south_m) * scale), round((bounds.east_m - bounds.west_m) * scale), 3
    ground: Image = np.full(size, BLANK, np.uint8)
    return ground


def _pixels(ground: Image, axes: Axes, places: Floats) -> Ints:
    """Places (n, 2) as OpenCV's fixed-point pixels, four fractional bits."""
    x = (places[:, 0] - axes.bounds.west_m) * axes.px_per_m
    y = ground.shape[0] - (places[:, 1] - axes.bounds.south_m) * axes.px_per_m
    pixels: Ints = np.rint(np.clip(np.stack([x, y], axis=1), -1e6, 1e6) * 16).astype(np.int32)
    return pixels


def _dots(ground: Image, axes: Axes, places: Floats, colour: Colour) -> None:
    for centre in _pixels(ground, axes, places[np.isfinite(places).all(axis=1)]).tolist():
        cv2.circle(ground, centre, 2 * 16, colour, cv2.FILLED, cv2.LINE_AA, shift=4)


def _line(ground: Image, axes: Axes, places: Floats, colour: Colour, thickness: int) -> None:
    known = np.isfinite(places).all(axis=1)
    pieces = [piece for piece in np.split(places, np.flatnonzero(~known)) if len(piece)]
    lines = [_pixels(ground, axes, piece[np.isfinite(piece).all(axis=1)]) for piece in pieces]
    cv2.polylines(ground, lines, False, colour, thickness, cv2.LINE_AA, shift=4)


def _ellipses(ground: Image, axes: Axes, track: Track) -> None:
    """95 % ellipses evenly along the track."""
    every = max(1, len(track.stamp_ns) // ELLIPSES)
    variances, directions = np.linalg.eigh(track.covariance_m2[::every])
    radii = np.sqrt(ellipse_limit(2) * np.maximum(variances, 0)) * axes.px_per_m * 16
    turns = -np.degrees(np.arctan2(directions[:, 1, 0], directions[:, 0, 0]))
    centres = _pixels(ground, axes, track.position_m[::every])
    for centre, radius, turn in zip(centres.tolist(), np.rint(radii).astype(int).tolist(), turns, strict=True):
        cv2.ellipse(ground, centre, radius, float(turn), 0, 360, ELLIPSE, 1, cv2.LINE_AA, shift=4)
