"""The cases on which calibration is judged: what is driven, what is wrong with machines or samples, who is let in."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from lab.calibration.drives import Scene
from mapserver.calibration.correction import measured
from protocol.arrays import Bools, Floats, Floats32, Table

Rows = Mapping[str, Table]  # samples by machine
PAPER = "paper_site"
STEEP = 0.13  # gradient beyond which a cell or a place is on a ramp
GAIN, STEP, RAIN, HARDER = 1.6, 0.015, 0.02, 0.25
RAMP_STEPS = (-0.02, 0.005, 0.01, 0.02)
PRESETS = ("paper", "harsh", "standalone")  # of sensors, beside `dgps`, which all other cases have
DIRT = (0.03, 0.05)  # c_rr of the ground that rain makes heavier


@dataclass(frozen=True)
class Tampered:
    """Samples as a case has them, and the true c_rr (rows, columns) of the cells at the end.

    earlier: what it was for a machine that drove before it changed. passed_by: whose cells are judged, all by default.
    """

    rows: Rows
    c_rr: Floats32
    earlier: Mapping[str, Floats32] = field(default_factory=dict)
    passed_by: tuple[str, ...] = ()


Tamper = Callable[[Rows, Scene], Tampered]


@dataclass(frozen=True)
class FleetCase:
    """One case. machines: how many of a drive of the paper's site, or 0 for all of a scenario, take part.

    preset: of sensors, "" for those of the scenario. bad, let_in: machines by their place that have the faults of
    `bad_machine`, and that are in the map by a person's decision, whatever trust says. calibrates, closed_tours: what
    agents do by themselves. spans: in which the true errors are constant. first_s: so much of the recording.
    """

    name: str
    scenario: str = PAPER
    machines: int = 3
    tamper: str = "nothing"
    argument: float = 0.0
    preset: str = ""
    bad: tuple[int, ...] = ()
    let_in: tuple[int, ...] = ()
    calibrates: bool = True
    closed_tours: bool = False
    spans: int = 1
    first_s: float = 0.0


def nothing(rows: Rows, scene: Scene, _: float) -> Tampered:
    """As recorded."""
    return Tampered(rows, scene.truth.c_rr)


def gain(rows: Rows, scene: Scene, factor: float) -> Tampered:
    """The torque of the second machine reads too much."""
    name = sorted(rows)[1]
    table, raw = rows[name].copy(), measured(rows[name])
    d = np.where(table["speed_mps"] >= 0, 1.0, -1.0)
    share = d * raw["c_rr"] + (_gradient(raw) * _ahead(raw)).sum(axis=1)
    table["c_rr"] += d * (factor - 1) * share
    return Tampered({**rows, name: table}, scene.truth.c_rr)


def rolls_harder(rows: Rows, scene: Scene, share: float) -> Tampered:
    """The second machine rolls harder on any ground, with right slopes: soft tyres, or a lie."""
    name = sorted(rows)[1]
    table = rows[name].copy()
    table["c_rr"] *= 1 + share
    return Tampered({**rows, name: table}, scene.truth.c_rr)


def majority_off(rows: Rows, scene: Scene, zero: float) -> Tampered:
    """The zeros of all but the last machine are off by the same."""
    off = {name: _with_zero(rows[name], zero, np.ones(len(rows[name]), np.bool_)) for name in sorted(rows)[:-1]}
    return Tampered({**rows, **off}, scene.truth.c_rr)


def step_at_half(rows: Rows, scene: Scene, zero: float) -> Tampered:
    """The zero of the second machine steps."""
    name = sorted(rows)[1]
    stamps = rows[name]["stamp_ns"]
    late: Bools = stamps >= (int(stamps.min()) + int(stamps.max())) // 2
    return Tampered({**rows, name: _with_zero(rows[name], zero, late)}, scene.truth.c_rr)


def other_ramps(rows: Rows, scene: Scene, step: float) -> Tampered:
    """All ramps are of other ground than what is around them."""
    truth = scene.truth
    out = {}
    for name, table in rows.items():
        gradient = scene.tracks[name].at(table["stamp_ns"]).gradient
        out[name] = _with_ground(table, np.where(np.hypot(*gradient.T) > STEEP, step, 0.0))
    steep = np.hypot(truth.grade_east, truth.grade_north) > STEEP
    return Tampered(out, (truth.c_rr + np.where(steep, step, 0.0)).astype(np.float32))


def rain(rows: Rows, scene: Scene, step: float) -> Tampered:
    """It rains on dirt at half time; two machines drive only before it, and one only after it, whose cells count."""
    truth = scene.truth
    names = sorted(rows)
    stamps = rows[names[0]]["stamp_ns"]
    half_ns = (int(stamps.min()) + int(stamps.max())) // 2
    dirt = (truth.c_rr > DIRT[0]) & (truth.c_rr < DIRT[1])
    out = {name: rows[name][rows[name]["stamp_ns"] < half_ns] for name in names[:-1]}
    late = rows[names[-1]]
    late = late[late["stamp_ns"] >= half_ns]
    row, column = cells(truth_places(late, scene, names[-1]), scene)
    out[names[-1]] = _with_ground(late, np.where(dirt[row, column], step, 0.0))
    wet = (truth.c_rr + np.where(dirt, step, 0.0)).astype(np.float32)
    return Tampered(out, wet, dict.fromkeys(names[:-1], truth.c_rr), (names[-1],))


TAMPERS: dict[str, Callable[[Rows, Scene, float], Tampered]] = {
    each.__name__: each for each in (nothing, gain, rolls_harder, majority_off, step_at_half, other_ramps, rain)
}
FLEETS = tuple(FleetCase(f"machines_{count}", machines=count) for count in (1, 2, 3, 4))
CASES = (
    *FLEETS,
    FleetCase("agents", closed_tours=True),
    FleetCase("first_180_s", first_s=180.0),
    FleetCase("reversing", "loading", machines=0, calibrates=False),
    FleetCase("loading", "loading", machines=0),
    FleetCase("bad_machine", machines=4, bad=(1,)),
    FleetCase("gain_1.6", machines=4, tamper="gain", argument=GAIN, let_in=(1,)),
    FleetCase("rolls_harder", machines=4, tamper="rolls_harder", argument=HARDER),
    FleetCase("majority_off", machines=4, tamper="majority_off", argument=STEP),
    FleetCase("step_at_half", tamper="step_at_half", argument=STEP, spans=2),
    *(FleetCase(f"ramp_of_other_ground_{step:+g}", tamper="other_ramps", argument=step) for step in RAMP_STEPS),
    FleetCase("haul_road", "haul_road", machines=0),
    FleetCase("rain", tamper="rain", argument=RAIN),
    *(FleetCase(f"preset_{preset}", preset=preset) for preset in PRESETS),
)


def tampered(case: FleetCase, rows: Rows, scene: Scene) -> Tampered:
    """The samples of a case."""
    return TAMPERS[case.tamper](rows, scene, case.argument)


def truth_places(table: Table, scene: Scene, name: str) -> Floats:
    """Where a machine truly was (n, 2); outside of the site where that is not known."""
    place = scene.tracks[name].at(table["stamp_ns"]).place_m
    return np.where(np.isfinite(place), place, -1e6)


def cells(place_m: Floats, scene: Scene) -> tuple[Floats, Floats]:
    """Row and column of places (n, 2), of the nearest cell where they are outside."""
    truth = scene.truth
    column, row = np.floor((place_m - [truth.west_m, truth.south_m]) / truth.cell_m).astype(np.int64).T
    rows, columns = truth.c_rr.shape
    return np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)


def _ahead(table: Table) -> Floats:
    """Unit vectors (n, 2) of the headings."""
    heading = table["heading_rad"].astype(np.float64)
    return np.stack([np.cos(heading), np.sin(heading)], axis=1)


def _gradient(table: Table) -> Floats:
    return np.stack([table["grade_e"], table["grade_n"]], axis=1).astype(np.float64)


def _with_zero(table: Table, zero: float, where: Bools) -> Table:
    """Samples of a machine whose accelerometer is off by more, where that holds."""
    out = table.copy()
    d, off = np.where(table["speed_mps"] >= 0, 1.0, -1.0), np.where(where, zero, 0.0)
    out["c_rr"] += d * off
    east, north = (_ahead(table) * off[:, None]).T
    out["grade_e"] -= east
    out["grade_n"] -= north
    return out


def _with_ground(table: Table, step: Floats) -> Table:
    """Samples (n,) of ground with other c_rr by so much (n,)."""
    out = table.copy()
    out["c_rr"] += step
    return out
