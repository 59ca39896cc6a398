"""Route queries as selector parameters (docs/protocol.md, "Routes"): what a line costs, which line costs least.

Queries that no map can answer are refused at once, by parameter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

from protocol.errors import Refusal
from protocol.queries.parameters import (
    Parameters,
    ValueForm,
    ValueKind,
    choice,
    name_of,
    number,
    read_number,
    refusal,
    text_of,
)
from protocol.queries.places import PLACE, Place, places
from protocol.queries.request import AsOf, Codec, Fresh, Group, Parameter, Size, asked, grouped
from protocol.queries.routing import (
    LOADER,
    MACHINES,
    NamedMachine,
    RouteAnswer,
    RouteMachine,
    decode_answer,
    encode_answer,
)
from protocol.site.site_config import NAME

MAX_LENGTH_M = 100_000.0
MIN_STEP_M, MAX_STEP_M = 1.0, 10_000.0
MAX_STEPS = 10_000
ENERGY, TIME = "energy", "time"
DEAREST, REFUSE = "dearest", "refuse"  # of unknown ground: the cost of the worst tenth nearby, uphill; or no passage

# Machine parameters: attribute and meaning.
_VALUES = {
    "mass": ("mass_kg", "with what it carries [kg]"),
    "speed": ("speed_mps", "highest [m/s]"),
    "power": ("power_w", "at the wheels [W]"),
    "efficiency": ("efficiency", "energy at the wheels over that of the fuel"),
    "accelerate": ("accelerate_mps2", "as it is driven [m/s2]"),
    "brake": ("brake_mps2", "likewise [m/s2]"),
    "lateral": ("lateral_mps2", "sideways in curves [m/s2]"),
    "rotating": ("rotating", "mass with what rotates with it over mass"),
}


def _read_machine(given: Parameters) -> RouteMachine | NamedMachine:
    """A kind or a machine's name, with the values given."""
    name = given.get("machine", next(iter(MACHINES)))
    values = {attribute: read_number(key, given[key]) for key, (attribute, _) in _VALUES.items() if key in given}
    if name not in MACHINES and not NAME.fullmatch(name):
        raise refusal("machine", f"{name[:40]!r} is no name; kinds are {', '.join(MACHINES)}")
    try:
        if name in MACHINES:
            return replace(MACHINES[name], **values)
        return NamedMachine(name, tuple(sorted(values.items())))
    except ValueError as error:
        wrong, _, problem = str(error).partition(": ")
        raise refusal(next(key for key, (attribute, _) in _VALUES.items() if attribute == wrong), problem) from None


def _write_machine(machine: RouteMachine | NamedMachine) -> dict[str, str]:
    if isinstance(machine, NamedMachine):
        given = dict(machine.given)
        values = {key: text_of(given[name]) for key, (name, _) in _VALUES.items() if name in given}
        return {"machine": machine.name, **values}
    return {key: text_of(getattr(machine, attribute)) for key, (attribute, _) in _VALUES.items()}


_MACHINE = Group(
    (
        Parameter("machine", f"a kind ({', '.join(MACHINES)}), for what is not given; or a machine's name", name_of()),
        *(Parameter(key, help_, number()) for key, (_, help_) in _VALUES.items()),
    ),
    _read_machine,
    _write_machine,
)


def _read_stops(name: str, text: str) -> tuple[bool, bool]:
    parts = {part for part in text.split(",") if part} - {"none"}
    if not parts <= {"begin", "end"}:
        raise refusal(name, f"{text[:40]!r} is not begin, end, both or none")
    return "begin" in parts, "end" in parts


def _write_stops(value: tuple[bool, bool]) -> str:
    return ",".join(name for name, is_one in zip(("begin", "end"), value, strict=True) if is_one) or "none"


def _read_unknown(name: str, text: str) -> str | float:
    return text if text in (DEAREST, REFUSE) else read_number(name, text)


def _check_unknown(name: str, value: str | float) -> None:
    if isinstance(value, str):
        if value not in (DEAREST, REFUSE):
            raise refusal(name, f"{value[:40]!r} is not {DEAREST}, {REFUSE} or a resistance")
    elif not 0 < value <= 1:
        raise refusal(name, f"a resistance of {value:g} is not above 0 and at most 1")


STOPS = ValueKind(ValueForm.TEXT, _read_stops, _write_stops)
UNKNOWN = ValueKind(
    ValueForm.TEXT, _read_unknown, lambda value: value if isinstance(value, str) else text_of(value), _check_unknown
)


@dataclass(frozen=True, kw_only=True)
class LineQuery(AsOf[RouteAnswer], Fresh[RouteAnswer]):
    """A query of lines over the map.

    machine: a kind, or one of the site. stops: standing at begin, at end. step_m: of the answer. unknown: unknown
    ground as DEAREST, REFUSE or a rolling resistance coefficient.
    """

    machine: RouteMachine | NamedMachine = grouped(_MACHINE, LOADER)
    stops: tuple[bool, bool] = asked(STOPS, "stops", "begin, end, begin,end or none", (True, True))
    step_m: float = asked(number(MIN_STEP_M, MAX_STEP_M, "m"), "step", "length of the steps of the answer [m]", 25.0)
    unknown: str | float = asked(
        UNKNOWN, "unknown", "ground that nobody knows: dearest, refuse or a resistance", DEAREST
    )

    codec = Codec(encode_answer, decode_answer)

    @property
    def is_long(self) -> bool:
        """See `MapQuery`."""
        return True

    @property
    def may_read_journal(self) -> bool:
        """See `MapQuery`: for a machine of the site."""
        return self.reads_past or isinstance(self.machine, NamedMachine)

    def check_steps(self, length_m: float) -> None:
        """Refuse too many steps."""
        if length_m > self.step_m * MAX_STEPS:
            problem = f"{length_m:.0f} m in steps of {self.step_m:g} m are over {MAX_STEPS}"
            raise refusal("step", problem, Refusal.TOO_LARGE)


@dataclass(frozen=True)
class RouteQuery(LineQuery):
    """What driving a line [m] costs a machine."""

    line: tuple[Place, ...] = asked(places(), "line", "x,y,x,y,... [m], two places or more")

    name = "route"
    help = "what a drive along a line costs a machine: energy and time"
    size = Size.PIECE

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.line) < 2:
            raise refusal("line", f"{len(self.line)} places; a line has at least two")
        for i, (a, b) in enumerate(pairwise(self.line)):
            if a == b:
                raise refusal("line", f"places {i + 1} and {i + 2} are the same")
        length_m = sum(math.dist(a, b) for a, b in pairwise(self.line))
        if length_m > MAX_LENGTH_M:
            raise refusal("line", f"{length_m / 1000:.0f} km, over 100 km", Refusal.TOO_LARGE)
        self.check_steps(length_m)


@dataclass(frozen=True)
class WayQuery(LineQuery):
    """The least expensive line between two places [m], and its cost.

    cost: ENERGY or TIME. max_grade: of the ground [m/m]. margin_m: distance from excluded ground and places to avoid.
    """

    start: Place = asked(PLACE, "from", "x,y [m]")
    end: Place = asked(PLACE, "to", "x,y [m]")
    cost: str = asked(choice({ENERGY: ENERGY, TIME: TIME}), "cost", "energy or time", ENERGY)
    max_grade: float = asked(number(0.0, 1.0, above=True), "max_grade", "steepest ground that it leads over [m/m]", 0.3)
    margin_m: float = asked(
        number(0.0, 100.0, "m"), "margin", "from what it may not lead over, and from `avoid` [m]", 0.0
    )
    avoid: tuple[Place, ...] = asked(places(), "avoid", "x,y,x,y,... [m], as parked machines", ())

    name = "way"
    help = "the line from one place to another that costs a machine least"
    size = Size.SEARCH

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.start == self.end:
            raise refusal("to", "the same place as `from`")
        self.check_steps(math.dist(self.start, self.end))
