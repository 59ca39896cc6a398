"""Queries for routes as selector parameters (docs/protocol.md, "Routes"): what a line costs, which line costs least.

A query that cannot be answered on any map is refused where it is made, by the name of its parameter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

from protocol.errors import QueryError, Refusal
from protocol.queries import parameters as ps
from protocol.queries.parameters import ANY_ROW, Freshness
from protocol.queries.places import Place, check_count, refusal, take_place, take_places, text_of_places
from protocol.queries.routing import LOADER, MACHINES, NamedMachine, RouteMachine
from protocol.site.site_config import NAME

MAX_LENGTH_M = 100_000.0
MIN_STEP_M, MAX_STEP_M = 1.0, 10_000.0
MAX_STEPS = 10_000
MAX_GRADE = 1.0
MAX_MARGIN_M = 100.0
ENERGY, TIME = "energy", "time"
DEAREST, REFUSE = "dearest", "refuse"  # of unknown ground: as dear as the dearest tenth around, uphill; or not at all

# Parameters of a machine, and its attributes.
_MACHINE = {
    "mass": "mass_kg",
    "speed": "speed_mps",
    "power": "power_w",
    "efficiency": "efficiency",
    "accelerate": "accelerate_mps2",
    "brake": "brake_mps2",
    "lateral": "lateral_mps2",
    "rotating": "rotating",
}
_SAME = ("machine", *_MACHINE, "stops", "step", "unknown", "as_of", "repairs")
ROUTE = ("line", *_SAME)
WAY = ("from", "to", "cost", "max_grade", "margin", "avoid", *_SAME)


@dataclass(frozen=True)
class RouteQuery:
    """What a drive along a line [m] costs a machine.

    stops: whether it stands at the begin and at the end. step_m: of the steps that are answered. unknown: what ground
    that nobody knows is taken for: DEAREST, REFUSE or a rolling resistance coefficient. machine: also one of the site.
    repairs: roads whose ground changed are read from the samples since.
    """

    line: tuple[Place, ...]
    machine: RouteMachine | NamedMachine = LOADER
    stops: tuple[bool, bool] = (True, True)
    step_m: float = 25.0
    unknown: str | float = DEAREST
    as_of_ns: int | None = None
    fresh: Freshness = ANY_ROW
    repairs: bool = True

    name = "route"

    def __post_init__(self) -> None:
        if len(self.line) < 2:
            raise refusal("line", f"{len(self.line)} places; a line has at least two")
        check_count("line", len(self.line))
        for i, (a, b) in enumerate(pairwise(self.line)):
            if a == b:
                raise refusal("line", f"places {i + 1} and {i + 2} are the same")
        length_m = sum(math.dist(a, b) for a, b in pairwise(self.line))
        if length_m > MAX_LENGTH_M:
            raise QueryError(Refusal.TOO_LARGE, f"parameter `line`: {length_m / 1000:.0f} km, over 100 km")
        _check_steps(self.step_m, length_m)
        _check_unknown(self.unknown)


@dataclass(frozen=True)
class WayQuery:
    """The line from one place to another [m] that costs a machine least, and what it costs.

    cost: ENERGY or TIME. max_grade: of ground that it is led over [m/m]. margin_m: how far it stays from ground that it
    may not be led over, and from the places to avoid. The others: as of a route.
    """

    start: Place
    end: Place
    machine: RouteMachine | NamedMachine = LOADER
    cost: str = ENERGY
    max_grade: float = 0.3
    margin_m: float = 0.0
    avoid: tuple[Place, ...] = ()
    stops: tuple[bool, bool] = (True, True)
    step_m: float = 25.0
    unknown: str | float = DEAREST
    as_of_ns: int | None = None
    fresh: Freshness = ANY_ROW
    repairs: bool = True

    name = "way"

    def __post_init__(self) -> None:
        if self.start == self.end:
            raise refusal("to", "the same place as `from`")
        if self.cost not in (ENERGY, TIME):
            raise refusal("cost", f"{self.cost[:40]!r} is neither {ENERGY} nor {TIME}")
        if not 0 < self.max_grade <= MAX_GRADE:
            raise refusal("max_grade", f"{self.max_grade:g} is not above 0 and at most {MAX_GRADE:g}")
        if not 0 <= self.margin_m <= MAX_MARGIN_M:
            raise refusal("margin", f"{self.margin_m:g} m is not between 0 and {MAX_MARGIN_M:g} m")
        check_count("avoid", len(self.avoid))
        _check_steps(self.step_m, math.dist(self.start, self.end))
        _check_unknown(self.unknown)


def encode_route(query: RouteQuery | WayQuery) -> dict[str, str]:
    """Selector parameters."""
    if isinstance(query, RouteQuery):
        out = {"line": text_of_places(query.line)}
    else:
        out = {"from": text_of_places([query.start]), "to": text_of_places([query.end]), "cost": query.cost}
        out |= {"max_grade": ps.text_of(query.max_grade), "margin": ps.text_of(query.margin_m)}
        out |= {"avoid": text_of_places(query.avoid)} if query.avoid else {}
    out |= _of_machine(query.machine)
    stops = ",".join(name for name, is_one in zip(("begin", "end"), query.stops, strict=True) if is_one)
    unknown = query.unknown if isinstance(query.unknown, str) else ps.text_of(query.unknown)
    out |= {"stops": stops or "none", "step": ps.text_of(query.step_m), "unknown": unknown}
    out |= {} if query.repairs else {"repairs": "0"}
    return out | ({"as_of": str(query.as_of_ns)} if query.as_of_ns is not None else {})


def parse_route(parameters: ps.Parameters) -> RouteQuery:
    """Undo `encode_route` of a route; QueryError names what is wrong."""
    return RouteQuery(take_places(parameters, "line"), *_same(parameters))


def parse_way(parameters: ps.Parameters) -> WayQuery:
    """Undo `encode_route` of a way; QueryError names what is wrong."""
    start, end = (take_place(parameters, name) for name in ("from", "to"))
    same = _same(parameters)
    usual = {"max_grade": "0.3", "margin": "0"}
    max_grade, margin_m = (ps.number({**usual, **parameters}, name) for name in usual)
    avoid = take_places(parameters, "avoid") if "avoid" in parameters else ()
    cost = parameters.get("cost", ENERGY)
    return WayQuery(start, end, same[0], cost, max_grade, margin_m, avoid, *same[1:])


def _same(
    parameters: ps.Parameters,
) -> tuple[RouteMachine | NamedMachine, tuple[bool, bool], float, str | float, int | None, Freshness, bool]:
    step_m = ps.number({"step": "25", **parameters}, "step")
    unknown: str | float = parameters.get("unknown", DEAREST)
    if unknown not in (DEAREST, REFUSE):
        unknown = ps.number(parameters, "unknown")
    return (
        _machine(parameters),
        _stops(parameters),
        step_m,
        unknown,
        ps.stamp(parameters, "as_of"),
        ps.freshness(parameters),
        ps.flag(parameters, "repairs", default=True),
    )


def _of_machine(machine: RouteMachine | NamedMachine) -> dict[str, str]:
    if isinstance(machine, NamedMachine):
        of_attribute = {attribute: name for name, attribute in _MACHINE.items()}
        return {"machine": machine.name, **{of_attribute[a]: ps.text_of(value) for a, value in machine.given}}
    return {name: ps.text_of(getattr(machine, attribute)) for name, attribute in _MACHINE.items()}


def _machine(parameters: ps.Parameters) -> RouteMachine | NamedMachine:
    """A machine by the name of its kind or by its own, with those of its values that are given."""
    name = parameters.get("machine", next(iter(MACHINES)))
    given = {attribute: ps.number(parameters, value) for value, attribute in _MACHINE.items() if value in parameters}
    if name not in MACHINES and not NAME.fullmatch(name):
        raise refusal("machine", f"{name[:40]!r} is no name; kinds are {', '.join(MACHINES)}")
    try:
        if name in MACHINES:
            return replace(MACHINES[name], **given)
        return NamedMachine(name, tuple(sorted(given.items())))
    except ValueError as error:
        wrong, _, problem = str(error).partition(": ")
        raise refusal(next(name for name, attribute in _MACHINE.items() if attribute == wrong), problem) from None


def _stops(parameters: ps.Parameters) -> tuple[bool, bool]:
    text = parameters.get("stops", "begin,end")
    parts = {part for part in text.split(",") if part} - {"none"}
    if not parts <= {"begin", "end"}:
        raise refusal("stops", f"{text[:40]!r} is not begin, end, both or none")
    return "begin" in parts, "end" in parts


def _check_steps(step_m: float, length_m: float) -> None:
    if not MIN_STEP_M <= step_m <= MAX_STEP_M:
        raise refusal("step", f"{step_m:g} m is not between {MIN_STEP_M:g} and {MAX_STEP_M:g} m")
    if length_m > step_m * MAX_STEPS:
        problem = f"parameter `step`: {length_m:.0f} m in steps of {step_m:g} m are over {MAX_STEPS}"
        raise QueryError(Refusal.TOO_LARGE, problem)


def _check_unknown(unknown: str | float) -> None:
    if isinstance(unknown, str):
        if unknown not in (DEAREST, REFUSE):
            raise refusal("unknown", f"{unknown[:40]!r} is not {DEAREST}, {REFUSE} or a resistance")
    elif not 0 < unknown <= 1:
        raise refusal("unknown", f"a resistance of {unknown:g} is not above 0 and at most 1")
