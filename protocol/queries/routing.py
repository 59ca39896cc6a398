"""Routes: machines that drive them, and what a drive costs (docs/protocol.md, "Routes")."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields, replace

import numpy as np

from protocol.arrays import Floats
from protocol.errors import MessageError, Refusal
from protocol.queries.answer_codec import (
    MAX_ITEMS,
    MAX_REPLY_BYTES,
    decode_version,
    encode_version,
    take_column,
    take_record,
)
from protocol.queries.answers import MapVersion
from protocol.units import DIESEL_J_PER_L
from protocol.wire.fields import pack, take, unpack

MAX_MASS_KG = 1e6
MAX_ROTATING = 2.0


@dataclass(frozen=True)
class RouteMachine:
    """A machine as a route needs it; the defaults are those of a wheel loader with its bucket full.

    mass_kg: with what it carries. speed_mps: its highest. power_w: at the wheels. efficiency: energy at the wheels over
    that of the fuel, 0 to 1. accelerate_mps2, brake_mps2: as it is driven. lateral_mps2: sideways, in curves. rotating:
    mass with what rotates with it over mass. ValueError names a value that is not usable.
    """

    mass_kg: float = 22_500.0
    speed_mps: float = 8.0
    power_w: float = 140_000.0
    efficiency: float = 0.35
    accelerate_mps2: float = 0.8
    brake_mps2: float = 0.5
    lateral_mps2: float = 0.9
    rotating: float = 1.07

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{field.name}: {value:g} is not positive")
        if self.mass_kg > MAX_MASS_KG:
            raise ValueError(f"mass_kg: {self.mass_kg:g} is over {MAX_MASS_KG:g}")
        if self.efficiency > 1:
            raise ValueError(f"efficiency: {self.efficiency:g} is over 1")
        if not 1 <= self.rotating <= MAX_ROTATING:
            raise ValueError(f"rotating: {self.rotating:g} is not between 1 and {MAX_ROTATING:g}")


LOADER = RouteMachine()
# By the name of their kind, the first one where none is named: typical ones, as the simulator has them.
MACHINES = {
    "loader": LOADER,
    "truck": RouteMachine(mass_kg=47_000.0, power_w=240_000.0, rotating=1.1),
    "empty_truck": RouteMachine(mass_kg=22_000.0, power_w=240_000.0, rotating=1.1),
}


@dataclass(frozen=True)
class NamedMachine:
    """A machine of the site, by its name: its mass is what its newest samples state, see docs/protocol.md.

    given: attributes of a RouteMachine and their values, by name, which hold whatever is known. ValueError as there.
    """

    name: str
    given: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        replace(LOADER, **dict(self.given))


def machine_of(named: str) -> RouteMachine | NamedMachine:
    """A machine by the name of its kind, or by its own."""
    return MACHINES.get(named) or NamedMachine(named)


@dataclass(frozen=True)
class RouteSteps:
    """n steps along a route, in its direction.

    distance_m (n,): from the begin of the route to the end of each; length_m; x_m, y_m: of its begin, in `map`.
    resistance, slope, their deviations and confidence: means, NaN where nothing is known of them. unknown: share of
    its length where nobody was; unmeasured: where machines were and none could tell the resistance. energy_j: what
    drives the wheels; braked_j: what brakes take; speed_mps: mean.
    """

    distance_m: Floats
    length_m: Floats
    x_m: Floats
    y_m: Floats
    resistance: Floats
    resistance_std: Floats
    slope: Floats
    slope_std: Floats
    confidence: Floats
    unknown: Floats
    unmeasured: Floats
    energy_j: Floats
    braked_j: Floats
    time_s: Floats
    speed_mps: Floats


@dataclass(frozen=True)
class RouteTotals:
    """All of a route. low, high: its 90 % interval. lift_m: how much higher its end is.

    unknown, unmeasured: shares of its length, as of the steps. unknown_resistance: what its unknown ground was taken
    for, the mean of it; 0 where none is unknown.

    energy_j: drive force times way. At the wheels it is more by their slip, which the map does not know: 1 to 4 % on
    firm ground, 10 % in sand. fuel_j: over the machine's efficiency.
    """

    length_m: float
    lift_m: float
    unknown: float
    unmeasured: float
    unknown_resistance: float
    energy_j: float
    energy_low_j: float
    energy_high_j: float
    braked_j: float
    fuel_j: float
    time_s: float
    time_low_s: float
    time_high_s: float

    @property
    def litres(self) -> float:
        """Of diesel, with so much energy."""
        return self.fuel_j / DIESEL_J_PER_L


@dataclass(frozen=True)
class RouteAnswer:
    """What a route costs this machine.

    line_m (k, 2): where it leads. stamp_ns: the site's now, or the time that the map is of.
    """

    version: MapVersion
    stamp_ns: int
    line_m: Floats
    totals: RouteTotals
    steps: RouteSteps
    machine: RouteMachine

    @property
    def merged(self) -> int:
        """The last journal row in the map."""
        return self.version.row


def encode_answer(answer: RouteAnswer) -> bytes:
    """Answer of `route` and `way`: columns as float64 little-endian."""
    steps = {name: np.ascontiguousarray(values, "<f8").tobytes() for name, values in vars(answer.steps).items()}
    line = np.ascontiguousarray(answer.line_m, "<f8").tobytes()
    tables = {"totals": asdict(answer.totals), "steps": steps, "machine": asdict(answer.machine)}
    return pack({"line": line, **tables, "stamp_ns": answer.stamp_ns, **encode_version(answer.version)})


def decode_answer(data: bytes) -> RouteAnswer:
    """Undo `encode_answer`."""
    table = unpack(data, MAX_REPLY_BYTES, MAX_ITEMS)
    line = take_column(table, "line")
    tables = take(table, "steps", dict)
    columns = {field.name: take_column(tables, field.name) for field in fields(RouteSteps)}
    if len(line) % 2 or len({len(values) for values in columns.values()}) != 1:
        raise MessageError(Refusal.COLUMN_LENGTH, "columns of a route differ in length", field="steps")
    totals, machine = take_record(RouteTotals, table, "totals"), take_record(RouteMachine, table, "machine")
    version, stamp_ns = decode_version(table), take(table, "stamp_ns", int)
    return RouteAnswer(version, stamp_ns, line.reshape(-1, 2), totals, RouteSteps(**columns), machine)
