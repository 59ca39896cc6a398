"""Draw on ground in metres: lines with arrows, and labels placed in free room."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from mapserver.pictures.frame import Colour, Image, text, text_size
from protocol.arrays import AnyArray, Floats

INK, PAPER = (45, 45, 45), (255, 255, 255)
DASH_PX, ARROW_EVERY_PX = 9, 130
ARROW_AT = 0.75  # share of its piece of line; arrows of short legs that cross in the middle stay apart
LABEL_SCALE, LABEL_PAD = 0.5, 5
REACH_PX = (16, 26, 40, 60, 85, 115, 150, 190)  # distances of a label from its place, nearest first
TURNS = np.arange(16) * np.pi / 8
LEAD_PX = 20.0  # a label farther away gets a leader line
DRAWN, WRITTEN = 1, 255  # values of Canvas.busy: a line, better not covered; words, never covered
COVER_COST_PX = 800.0  # detour that a label takes rather than cover lines alone


@dataclass(frozen=True)
class Canvas:
    """Drawing, north up, its south-west corner at the origin of `map`.

    image: drawn on in place. busy: (height, width), what is drawn so far. `px`: (k, 2), right and down.
    """

    image: Image
    busy: Image
    px_per_m: float

    def pixels(self, points_m: Floats) -> Floats:
        """Pixels of points (k, 2) in `map`."""
        height = self.image.shape[0]
        px: Floats = points_m * np.array([self.px_per_m, -self.px_per_m]) + np.array([-0.5, height - 0.5])
        return px

    def line(self, px: Floats, colour: Colour, *, closed: bool = False, dashed: bool = False, thick: int = 2) -> None:
        """Draw a line with a bright edge."""
        for shade, thickness in ((PAPER, thick + 3), (colour, thick)):
            for piece in _dashes(px, closed=closed) if dashed else [px]:
                whole = closed and not dashed
                cv2.polylines(self.image, [_fixed(piece)], whole, shade, thickness, cv2.LINE_AA, shift=4)
        cv2.polylines(self.busy, [_fixed(px)], closed, DRAWN, thick + 5, shift=4)

    def arrows(self, px: Floats, colour: Colour, *, both_ways: bool = False) -> None:
        """Draw arrow heads along a line, in its direction or alternating."""
        lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(px, axis=0).T))])
        count = max(1, round(lengths[-1] / ARROW_EVERY_PX))
        for k in range(count):
            i = int(np.searchsorted(lengths, (k + ARROW_AT) / count * lengths[-1]))
            before, after = px[max(i - 2, 0)], px[min(i + 2, len(px) - 1)]
            sign = -1 if both_ways and k % 2 else 1
            self.head(px[i], sign * (after - before), colour, 8.0)

    def head(self, at: Floats, direction: Floats, colour: Colour, size_px: float, edge: Colour = PAPER) -> None:
        """Draw one arrow head with an edge, centred on a place."""
        ahead = direction / max(float(np.hypot(*direction)), 1e-9)
        left = np.array([-ahead[1], ahead[0]])
        shape = np.array([1.2 * ahead, 0.8 * left - 0.9 * ahead, -0.5 * ahead, -0.8 * left - 0.9 * ahead])
        outline = [_fixed(at + size_px * shape)]
        cv2.polylines(self.image, outline, True, edge, 3, cv2.LINE_AA, shift=4)
        cv2.fillPoly(self.image, outline, colour, cv2.LINE_AA, shift=4)
        cv2.fillPoly(self.busy, outline, DRAWN, shift=4)

    def dot(self, at: Floats, colour: Colour, radius_px: float) -> None:
        """Draw a dot with a dark edge."""
        centre = _fixed(at).tolist()
        for shade, radius in ((INK, radius_px + 1.5), (colour, radius_px)):
            cv2.circle(self.image, centre, round(radius * 16), shade, cv2.FILLED, cv2.LINE_AA, shift=4)
        cv2.circle(self.busy, centre, round(radius_px * 16), DRAWN, cv2.FILLED, shift=4)

    def write(self, words: str, middle: Floats, scale: float) -> None:
        """Write words around a place inside the picture, on a paler background."""
        width, height = text_size(words, scale)
        left, top, right, bottom = self._box(middle, np.array([width / 2 + 2, height / 2 + 2]))
        below = self.image[top : bottom + 1, left : right + 1]
        below[:] = below // 2 + 127
        self.busy[top : bottom + 1, left : right + 1] = WRITTEN
        text(self.image, words, (left + 2, bottom - 2), INK, scale)

    def label(self, words: str, at: Floats, colour: Colour) -> bool:
        """Write words in a box near a place, off other labels and lines; False if no room is left."""
        width, height = text_size(words, LABEL_SCALE)
        half = np.array([width / 2 + LABEL_PAD, height / 2 + LABEL_PAD])
        shifts = [
            (reach + half * np.abs([math.cos(turn), math.sin(turn)])) * [math.cos(turn), math.sin(turn)]
            for reach in REACH_PX
            for turn in TURNS
        ]
        costs = [self.cost(at + shift, half) + float(np.hypot(*shift)) for shift in shifts]
        best = int(np.argmin(costs))
        if not math.isfinite(costs[best]):
            return False
        left, top, right, bottom = self._box(middle := at + shifts[best], half)
        near = np.clip(at, [left, top], [right, bottom])
        if np.hypot(*(near - at)) > LEAD_PX:
            cv2.line(self.image, _fixed(at).tolist(), _fixed(near).tolist(), colour, 1, cv2.LINE_AA, shift=4)
        cv2.rectangle(self.image, (left, top), (right, bottom), PAPER, cv2.FILLED)
        cv2.rectangle(self.image, (left, top), (right, bottom), colour, 1)
        self.busy[top - 2 : bottom + 3, left - 2 : right + 3] = WRITTEN
        base = (round(middle[0] - width / 2), round(middle[1] + height / 2))
        text(self.image, words, base, colour, LABEL_SCALE)
        return True

    def cost(self, middle: Floats, half: Floats) -> float:
        """Cost of a box: 0 over empty ground, inf over words or outside."""
        left, top, right, bottom = self._box(middle, half)
        height, width = self.busy.shape
        if left < 3 or top < 3 or right > width - 4 or bottom > height - 4:
            return math.inf
        below = self.busy[top : bottom + 1, left : right + 1]
        return math.inf if below.max() == WRITTEN else COVER_COST_PX * float((below == DRAWN).mean())

    def _box(self, middle: Floats, half: Floats) -> tuple[int, int, int, int]:
        (left, top), (right, bottom) = np.rint(middle - half).astype(int), np.rint(middle + half).astype(int)
        return int(left), int(top), int(right), int(bottom)


def beside(px: Floats, shift_px: float) -> Floats:
    """Shift a line to the right of its direction."""
    ahead = np.gradient(px, axis=0)
    right = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)  # y grows downwards
    moved: Floats = px + shift_px * right / np.maximum(np.hypot(*right.T), 1e-9)[:, None]
    return moved


def _dashes(px: Floats, *, closed: bool) -> list[Floats]:
    line = np.vstack([px, px[:1]]) if closed else px
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    even = np.linspace(0.0, lengths[-1], 4 * max(1, round(lengths[-1] / DASH_PX / 2)) + 1)
    places = np.stack([np.interp(even, lengths, line[:, 0]), np.interp(even, lengths, line[:, 1])], axis=1)
    return [places[i : i + 3] for i in range(0, len(places) - 2, 4)]


def _fixed(px: Floats) -> AnyArray:
    """OpenCV's fixed point: four fractional bits."""
    return np.rint(px * 16).astype(np.int32)
