"""Routes: machines and driving costs (docs/protocol.md, "Routes")."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields, replace

import numpy as np

from protocol.arrays import Floats
from protocol.errors import MessageError, Refusal
from protocol.queries.answer_codec import (
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
    """A machine for routes; by default a wheel loader with a full bucket.

    mass_kg: with load. speed_mps: highest. power_w: at the wheels. efficiency: energy at the wheels over fuel energy, 0
    to 1. accelerate_mps2, brake_mps2: as driven. lateral_mps2: in curves. rotating: mass with rotating parts over mass.
    ValueError names a bad value.
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
# Typical machines by kind, as simulated; the first is the default.
MACHINES = {
    "loader": LOADER,
    "truck": RouteMachine(mass_kg=47_000.0, power_w=240_000.0, rotating=1.1),
    "empty_truck": RouteMachine(mass_kg=22_000.0, power_w=240_000.0, rotating=1.1),
}


@dataclass(frozen=True)
class NamedMachine:
    """A site's machine by name; its newest samples state its mass, see docs/protocol.md.

    given: overriding attributes of a RouteMachine. ValueError as there.
    """

    name: str
    given: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        replace(LOADER, **dict(self.given))


def machine_of(named: str) -> RouteMachine | NamedMachine:
    """A machine by kind or name."""
    return MACHINES.get(named) or NamedMachine(named)


@dataclass(frozen=True)
class RouteSteps:
    """Steps along a route, n of them.

    distance_m (n,): from the begin to each one's end; x_m, y_m: of its begin, in `map`. resistance, slope, their
    deviations, confidence: means, NaN if unknown. unknown: share of length never driven; unmeasured: driven without
    resistance. energy_j: driving the wheels; braked_j: taken by brakes; speed_mps: mean.
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
    """A whole route. low, high: 90 % interval. lift_m: rise from begin to end.

    unknown, unmeasured: shares of length. unknown_resistance: mean assumed for unknown ground, or 0. energy_j: drive
    force times distance; wheel slip, unknown to the map, adds 1 to 4 % on firm ground, 10 % in sand. fuel_j: energy
    over efficiency.
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
        """Diesel of that energy."""
        return self.fuel_j / DIESEL_J_PER_L


@dataclass(frozen=True)
class RouteAnswer:
    """A route's cost for a machine.

    line_m (k, 2): its course. stamp_ns: the site's now, or the map's time.
    """

    version: MapVersion
    stamp_ns: int
    line_m: Floats
    totals: RouteTotals
    steps: RouteSteps
    machine: RouteMachine

    @property
    def merged(self) -> int:
        """Last merged journal row."""
        return self.version.row


def encode_answer(answer: RouteAnswer) -> bytes:
    """Answer of `route` and `way`: columns as float64 little-endian."""
    steps = {name: np.ascontiguousarray(values, "<f8").tobytes() for name, values in vars(answer.steps).items()}
    line = np.ascontiguousarray(answer.line_m, "<f8").tobytes()
    tables = {"totals": asdict(answer.totals), "steps": steps, "machine": asdict(answer.machine)}
    return pack({"line": line, **tables, "stamp_ns": answer.stamp_ns, **encode_version(answer.version)})


def decode_answer(data: bytes) -> RouteAnswer:
    """Undo `encode_answer`."""
    table = unpack(data, MAX_REPLY_BYTES)
    line = take_column(table, "line")
    tables = take(table, "steps", dict)
    columns = {field.name: take_column(tables, field.name) for field in fields(RouteSteps)}
    if len(line) % 2 or len({len(values) for values in columns.values()}) != 1:
        raise MessageError(Refusal.COLUMN_LENGTH, "columns of a route differ in length", field="steps")
    totals, machine = take_record(RouteTotals, table, "totals"), take_record(RouteMachine, table, "machine")
    version, stamp_ns = decode_version(table), take(table, "stamp_ns", int)
    return RouteAnswer(version, stamp_ns, line.reshape(-1, 2), totals, RouteSteps(**columns), machine)
