"""Places, lines, outlines as selector parameters: x,y,x,y,... in metres of `map`; QueryError."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from protocol.arrays import Bools, Floats, Ints
from protocol.errors import QueryError, Refusal
from protocol.queries.parameters import RECTANGLE, Parameters, ValueForm, ValueKind, read_number, refusal, text_of
from protocol.queries.request import Group, Parameter
from protocol.site.geometry import Bounds

Place = tuple[float, float]

MAX_PLACES = 10_000  # per line or list
MAX_CORNERS = 500  # per outline: all sides are compared pairwise
PLACES_BYTES = 2**19  # of a query's parameters: MAX_PLACES with all digits


def places(most: int = MAX_PLACES) -> ValueKind:
    """Up to `most` places, x,y,x,y,... [m]; left out if none."""

    def read(name: str, text: str) -> tuple[Place, ...]:
        parts = text.split(",")
        if len(parts) % 2:
            raise refusal(name, f"{len(parts)} numbers; places are pairs x,y in metres")
        check_count(name, len(parts) // 2, most)
        numbers = [read_number(name, part) for part in parts]
        return tuple(zip(numbers[::2], numbers[1::2], strict=True))

    return ValueKind(ValueForm.PLACES, read, _write_places, lambda name, value: check_count(name, len(value), most))


def _write_places(value: Sequence[Place]) -> str:
    return ",".join(text_of(number) for place in value for number in place)


def _read_place(name: str, text: str) -> Place:
    numbers = text.split(",")
    if len(numbers) != 2:
        raise refusal(name, f"{len(numbers)} numbers; it is one place, x,y in metres")
    x_m, y_m = (read_number(name, part) for part in numbers)
    return x_m, y_m


PLACE = ValueKind(ValueForm.PLACE, _read_place, lambda value: _write_places((value,)))


def check_count(name: str, count: int, most: int = MAX_PLACES) -> None:
    """Refuse too many places."""
    if count > most:
        raise QueryError(Refusal.TOO_LARGE, f"parameter `{name}`: {count} places, over {most}")


def check_outline(name: str, corners: Sequence[Place]) -> None:
    """Refuse what is no simple polygon: wrong number of corners, no numbers, sides that meet elsewhere."""
    if len(corners) < 3:
        raise refusal(name, f"{len(corners)} corners; an outline has at least three")
    check_count(name, len(corners), MAX_CORNERS)
    corner = np.array(corners, np.float64)
    if not np.isfinite(corner).all():
        raise QueryError(Refusal.NOT_FINITE, f"parameter `{name}`: corner that is no number")
    side = np.roll(corner, -1, axis=0) - corner
    if (still := np.flatnonzero((side == 0).all(axis=1))).size:
        same = int(still[0])
        raise refusal(name, f"corners {same + 1} and {(same + 1) % len(corner) + 1} are the same")
    following = np.roll(side, -1, axis=0)
    if (back := np.flatnonzero((_cross(side, following) == 0) & ((side * following).sum(axis=1) < 0))).size:
        raise refusal(name, f"it turns back on itself at corner {(int(back[0]) + 1) % len(corner) + 1}")
    i, j = _near(corner, side)
    if (meet := np.flatnonzero(_meet(corner, side, i, j))).size:
        first, second = int(i[meet[0]]), int(j[meet[0]])
        raise refusal(name, f"its sides from corners {first + 1} and {second + 1} on cross each other")


_BOUNDS = Parameter("bounds", "west,south,east,north [m]", RECTANGLE)
_POLYGON = Parameter("polygon", "in place of bounds, the corners of an outline: x,y,x,y,... [m]", places(MAX_CORNERS))


def _read_area(given: Parameters) -> Bounds | tuple[Place, ...]:
    if len(given) == 2:
        raise refusal("polygon", "given with `bounds`: a region is a rectangle or an outline")
    area: Bounds | tuple[Place, ...] = (_POLYGON if "polygon" in given else _BOUNDS).read(given)
    return area


def _write_area(area: Bounds | tuple[Place, ...]) -> dict[str, str]:
    return (_BOUNDS if isinstance(area, Bounds) else _POLYGON).write(area)


def _check_area(area: Bounds | tuple[Place, ...]) -> None:
    if not isinstance(area, Bounds):
        check_outline("polygon", area)


AREA = Group((_BOUNDS, _POLYGON), _read_area, _write_area, _check_area)


def around(corners: Sequence[Place]) -> Bounds:
    """Bounding rectangle of an outline."""
    x_m, y_m = zip(*corners, strict=True)
    return Bounds(min(x_m), min(y_m), max(x_m), max(y_m))


def where_it_lies(bounds: Sequence[int] | None, cell_m: float) -> str:
    """Where a map lies, and a guess at wrong numbers; bounds: west, south, east, north in cells, or None."""
    if not bounds:
        return "nothing is driven yet; are these UTM or degrees?"
    west, south, east, north = (edge * cell_m for edge in bounds)
    return f"the map lies at {west:g}..{east:g}, {south:g}..{north:g} m; are these UTM or degrees?"


def _cross(a: Floats, b: Floats) -> Floats:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _near(corner: Floats, side: Floats) -> tuple[Ints, Ints]:
    """Pairs of sides whose rectangles touch, except neighbours."""
    low, high = np.minimum(corner, corner + side), np.maximum(corner, corner + side)
    over = (low[:, None] <= high[None]).all(axis=2)
    i, j = np.nonzero(np.triu(over & over.T, 2))
    apart: Bools = (i != 0) | (j != len(corner) - 1)
    return i[apart], j[apart]


def _meet(corner: Floats, side: Floats, i: Ints, j: Ints) -> Bools:
    """Whether sides i and j (k,) touch."""
    between = corner[j] - corner[i]
    # on which side of the other each end lies
    ends = (
        (_cross(side[i], between), _cross(side[i], between + side[j])),
        (_cross(side[j], -between), _cross(side[j], side[i] - between)),
    )
    apart = [np.sign(one) * np.sign(other) > 0 for one, other in ends]  # collinear sides: their rectangles decide
    return np.asarray(~apart[0] & ~apart[1])
