"""Cheapest ways on drawn maps against a 64-neighbour search, known answers and truth."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.ndimage import gaussian_filter

from lab.routes.maps import KnownMap, true_squares
from mapserver.routes.least_cost import Cell, CostField, least_cost_line
from mapserver.routes.route import route
from protocol.arrays import Bools, Floats
from protocol.machine.samples import empty
from protocol.queries.route_requests import WayQuery
from protocol.queries.routing import RouteMachine
from sim.truth import TruthMap
from sitegrid.proof.figures import Row
from tests.reference.least_cost import least_cost

SIZE = 150  # cells per side
HILLS_M, HILL_CELLS, PATCH_CELLS = 2.0, 20.0, 8.0  # std of heights (10 % slopes), feature sizes
SAND, WET, GRAVEL, PAVED = 0.25, 0.06, 0.03, 0.012
MARGIN = 15  # cells between ends and map edge
UNKNOWN = 0.38  # share of a map
SHUNNED = 1.0  # avoidance of bad ground, in std of a drawn field
SLOW = RouteMachine(mass_kg=20_000.0, speed_mps=2.0, power_w=400_000.0)  # neither power nor curves matter
STAMP_NS = 1_767_225_600_000_000_000
MAPS = {"random": 50, "even": 50, "sand": 20, "unknown": 20}


def rows(first_seed: int) -> list[Row]:
    """A row per case, on maps drawn from the first seed."""
    cases: dict[str, Callable[[np.random.Generator], Row]] = {
        "random": _random,
        "even": _even,
        "sand": _sand,
        "unknown": _unknown,
    }
    out = []
    for number, (name, case) in enumerate(cases.items()):
        figures = [case(np.random.default_rng([first_seed, number, k])) for k in range(MAPS[name])]
        columns = {key: np.array([row[key] for row in figures], float) for key in figures[0]}
        out.append(
            {
                "case": f"way_{name}",
                "maps": len(figures),
                **{f"{key}_median_pct": 100 * float(np.median(values)) for key, values in columns.items()},
                "over_worst_pct": 100 * float(columns["over"].max()),
                "not_over": int((columns["over"] <= 0).sum()),
            }
        )
    return out


def drawn(draw: np.random.Generator, size: int = SIZE) -> CostField:
    """Hills and soil patches."""
    height = gaussian_filter(draw.standard_normal((size, size)), HILL_CELLS)
    north, east = np.gradient(HILLS_M * height / height.std())
    patches = _field(draw, PATCH_CELLS, size)
    resistance = np.select([patches > 1.4, patches > 0.6, patches < -1.0], [SAND, WET, PAVED], GRAVEL)
    return CostField(resistance, east, north, np.ones((size, size), bool), 1.0)


def _random(draw: np.random.Generator) -> Row:
    terrain = drawn(draw)
    start, end = _ends(draw)
    there, back = _cost(terrain, start, end), _cost(terrain, end, start)
    return {"over": there / least_cost(terrain, start, end) - 1, "back": abs(back / there - 1)}


def _even(draw: np.random.Generator) -> Row:
    flat = np.zeros((SIZE, SIZE))
    terrain = CostField(flat + GRAVEL, flat, flat, np.ones((SIZE, SIZE), bool), 1.0)
    start, end = (tuple(draw.integers(0, SIZE, 2).tolist()) for _ in range(2))
    return {"over": _cost(terrain, start, end) / (GRAVEL * math.dist(start, end)) - 1 if start != end else 0.0}


def _sand(draw: np.random.Generator) -> Row:
    """Sand between the ends, with a way around."""
    flat = np.zeros((SIZE, SIZE))
    row, column = np.mgrid[:SIZE, :SIZE]
    left, right = np.sort(draw.integers(2 * MARGIN, SIZE - 2 * MARGIN, 2))
    top = draw.integers(SIZE // 2, SIZE - MARGIN)
    sand = (column >= left) & (column <= right) & (row < top)
    terrain = CostField(np.where(sand, SAND, GRAVEL), flat, flat, np.ones((SIZE, SIZE), bool), 1.0)
    start, end = (int(draw.integers(0, top)), MARGIN), (int(draw.integers(0, top)), SIZE - MARGIN)
    result = least_cost_line(terrain, start, end)
    assert result
    through = GRAVEL * math.dist(start, end) * (SIZE - 2 * MARGIN - (right - left + 1)) / (SIZE - 2 * MARGIN)
    through += SAND * math.dist(start, end) * (right - left + 1) / (SIZE - 2 * MARGIN)
    return {"over": result[1] / min(least_cost(terrain, start, end), through) - 1, "of_straight": result[1] / through}


def _unknown(draw: np.random.Generator) -> Row:
    """A server's view of a map, a third undriven, bad ground preferred; judged by truth."""
    terrain = drawn(draw)
    layers = (terrain.resistance, terrain.grade_east, terrain.grade_north)
    c_rr, east, north = (layer.astype(np.float32) for layer in layers)
    truth = TruthMap(0.0, 0.0, c_rr, east, north)
    bad = np.log(terrain.resistance)
    shunned = _field(draw, PATCH_CELLS, SIZE) + SHUNNED * (bad - bad.mean()) / bad.std()
    known = shunned <= np.quantile(shunned, 1 - UNKNOWN)
    start, end = (((column + 0.5), (row + 0.5)) for row, column in _ends(draw, known))
    way = KnownMap({"a": _samples(terrain, known)}).routes().way(WayQuery(start, end, machine=SLOW, max_grade=1.0))
    squares = true_squares(truth)
    costs = [
        route(line, squares, SLOW, stops=(False, False))[1].energy_j for line in (way.line_m, np.array([start, end]))
    ]
    return {"over": costs[0] / costs[1] - 1}


def _samples(terrain: CostField, known: Bools) -> np.ndarray:
    row, column = np.nonzero(known)
    out = empty(len(row))
    out["stamp_ns"] = STAMP_NS + np.arange(len(row)) * 10**6
    out["x_m"], out["y_m"], out["distance_m"] = column + 0.5, row + 0.5, 8.0
    out["c_rr"], out["grade_e"], out["grade_n"] = (
        layer[known] for layer in (terrain.resistance, terrain.grade_east, terrain.grade_north)
    )
    return out


def _cost(terrain: CostField, start: Cell, end: Cell) -> float:
    result = least_cost_line(terrain, start, end)
    assert result
    return result[1]


def _ends(draw: np.random.Generator, allowed: Bools | None = None) -> tuple[Cell, Cell]:
    """Cells on two opposite sides."""
    while True:
        rows_, columns = draw.integers(MARGIN, SIZE - MARGIN, 2), (MARGIN, SIZE - MARGIN)
        ends = [(int(row), column) for row, column in zip(rows_, columns, strict=True)]
        if allowed is None or all(allowed[end] for end in ends):
            return ends[0], ends[1]


def _field(draw: np.random.Generator, cells: float, size: int) -> Floats:
    """Smooth random field, std 1."""
    field = gaussian_filter(draw.standard_normal((size, size)), cells)
    return np.asarray(field / field.std())
