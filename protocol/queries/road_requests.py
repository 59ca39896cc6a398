"""Queries about roads as selector parameters (docs/protocol.md, "Map queries"); their answers: `roads.py`."""

from __future__ import annotations

from dataclasses import dataclass

from protocol.errors import QueryError, Refusal
from protocol.queries import parameters as ps
from protocol.queries.parameters import ANY_ROW, Freshness
from protocol.site.geometry import Bounds

MAX_LIMIT = 1000  # stretches of one worklist
SEGMENTS = ("from", "to", "as_of", "bounds", "machine")
WORKLIST = ("target", "efficiency", "limit", *SEGMENTS)


@dataclass(frozen=True)
class SegmentsQuery:
    """Roads of the map, segment by segment, and what drove on them.

    from_ns, to_ns: traffic of the hours that begin in from_ns <= time < to_ns, None for all that is remembered.
    as_of_ns: from samples stamped so or earlier. bounds: segments whose middle lies there. machine: traffic of this one
    alone, and what it measured; "" for all.
    """

    from_ns: int | None = None
    to_ns: int | None = None
    as_of_ns: int | None = None
    bounds: Bounds | None = None
    machine: str = ""
    fresh: Freshness = ANY_ROW

    name = "segments"


@dataclass(frozen=True)
class WorklistQuery:
    """Where work on roads pays: segments that cost more than ground of a target c_rr would, the dearest first.

    efficiency: of engine and drive train, for litres. limit: at most so many. The others: as in SegmentsQuery.
    """

    target: float = 0.02
    efficiency: float = 0.35
    limit: int = 100
    from_ns: int | None = None
    to_ns: int | None = None
    as_of_ns: int | None = None
    bounds: Bounds | None = None
    machine: str = ""
    fresh: Freshness = ANY_ROW

    name = "worklist"

    def __post_init__(self) -> None:
        if not 0 < self.target <= 1:
            raise QueryError(Refusal.OUT_OF_RANGE, f"parameter `target`: {self.target:g} is not above 0 and at most 1")
        if not 0 < self.efficiency <= 1:
            problem = f"parameter `efficiency`: {self.efficiency:g} is not above 0 and at most 1"
            raise QueryError(Refusal.OUT_OF_RANGE, problem)
        if not 1 <= self.limit <= MAX_LIMIT:
            problem = f"parameter `limit`: {self.limit} is not between 1 and {MAX_LIMIT}"
            raise QueryError(Refusal.OUT_OF_RANGE, problem)


RoadQuery = SegmentsQuery | WorklistQuery


def encode_roads(query: RoadQuery) -> dict[str, str]:
    """Selector parameters, but for the row that is waited for."""
    parameters = ps.text_of_stamps({"from": query.from_ns, "to": query.to_ns, "as_of": query.as_of_ns})
    if query.bounds:
        parameters["bounds"] = ps.text_of_bounds(query.bounds)
    if query.machine:
        parameters["machine"] = ps.quoted(query.machine)
    if isinstance(query, WorklistQuery):
        numbers = {"target": ps.text_of(query.target), "efficiency": ps.text_of(query.efficiency)}
        parameters |= {**numbers, "limit": str(query.limit)}
    return parameters


def parse_segments(parameters: ps.Parameters) -> SegmentsQuery:
    """Undo `encode_roads`; QueryError says what is wrong with which parameter."""
    bounds = ps.bounds(parameters) if "bounds" in parameters else None
    machine = ps.free_text(parameters, "machine")
    as_of_ns, fresh = ps.stamp(parameters, "as_of"), ps.freshness(parameters)
    return SegmentsQuery(*ps.times(parameters), as_of_ns, bounds, machine, fresh)


def parse_worklist(parameters: ps.Parameters) -> WorklistQuery:
    """As `parse_segments`."""
    same, default = parse_segments(parameters), WorklistQuery()
    target, efficiency = (
        ps.number({name: ps.text_of(getattr(default, name)), **parameters}, name) for name in ("target", "efficiency")
    )
    limit = ps.count({"limit": str(default.limit), **parameters}, "limit")
    return WorklistQuery(target, efficiency, limit, **vars(same))
