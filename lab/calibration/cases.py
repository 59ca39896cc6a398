"""Cases for calibration: the drive, the faults of machines or samples, forced admissions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from lab.calibration.drives import Scene
from mapserver.calibration.correction import measured
from protocol.arrays import Bools, Floats, Floats32, Table

Rows = Mapping[str, Table]  # samples by machine
PAPER = "paper_site"
STEEP = 0.13  # gradient beyond which a cell or place is on a ramp
GAIN, STEP, RAIN, HARDER = 1.6, 0.015, 0.02, 0.25
RAMP_STEPS = (-0.02, 0.005, 0.01, 0.02)
PRESETS = ("paper", "harsh", "standalone")  # sensor presets besides `dgps`, which all other cases use
DIRT = (0.03, 0.05)  # c_rr of ground that rain makes heavier


@dataclass(frozen=True)
class Tampered:
    """Samples of a case, and the true final c_rr (rows, columns) of cells.

    earlier: the c_rr for a machine that drove before the change. passed_by: machines whose cells are judged, default
    all.
    """

    rows: Rows
    c_rr: Floats32
    earlier: Mapping[str, Floats32] = field(default_factory=dict)
    passed_by: tuple[str, ...] = ()


Tamper = Callable[[Rows, Scene], Tampered]


@dataclass(frozen=True)
class FleetCase:
    """One case. machines: number of participants on the paper's site; 0: all of a scenario.

    preset: of sensors, "": the scenario's. bad: indices of machines with `bad_machine`'s faults. let_in: indices
    trusted by decision. calibrates, closed_tours: agent options. spans: with constant true errors. first_s: used part
    of the recording.
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
    """The second machine's torque reads too high."""
    name = sorted(rows)[1]
    table, raw = rows[name].copy(), measured(rows[name])
    d = np.where(table["speed_mps"] >= 0, 1.0, -1.0)
    share = d * raw["c_rr"] + (_gradient(raw) * _ahead(raw)).sum(axis=1)
    table["c_rr"] += d * (factor - 1) * share
    return Tampered({**rows, name: table}, scene.truth.c_rr)


def rolls_harder(rows: Rows, scene: Scene, share: float) -> Tampered:
    """The second machine rolls harder everywhere, slopes correct: soft tyres, or a lie."""
    name = sorted(rows)[1]
    table = rows[name].copy()
    table["c_rr"] *= 1 + share
    return Tampered({**rows, name: table}, scene.truth.c_rr)


def majority_off(rows: Rows, scene: Scene, zero: float) -> Tampered:
    """All but the last machine share a bias."""
    off = {name: _with_zero(rows[name], zero, np.ones(len(rows[name]), np.bool_)) for name in sorted(rows)[:-1]}
    return Tampered({**rows, **off}, scene.truth.c_rr)


def step_at_half(rows: Rows, scene: Scene, zero: float) -> Tampered:
    """The second machine's bias steps at half time."""
    name = sorted(rows)[1]
    stamps = rows[name]["stamp_ns"]
    late: Bools = stamps >= (int(stamps.min()) + int(stamps.max())) // 2
    return Tampered({**rows, name: _with_zero(rows[name], zero, late)}, scene.truth.c_rr)


def other_ramps(rows: Rows, scene: Scene, step: float) -> Tampered:
    """All ramps are of other ground than their surroundings."""
    truth = scene.truth
    out = {}
    for name, table in rows.items():
        gradient = scene.tracks[name].at(table["stamp_ns"]).gradient
        out[name] = _with_ground(table, np.where(np.hypot(*gradient.T) > STEEP, step, 0.0))
    steep = np.hypot(truth.grade_east, truth.grade_north) > STEEP
    return Tampered(out, (truth.c_rr + np.where(steep, step, 0.0)).astype(np.float32))


def rain(rows: Rows, scene: Scene, step: float) -> Tampered:
    """Rain on dirt at half time; two machines drive before it, one after it, whose cells are judged."""
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
    """Samples of a case."""
    return TAMPERS[case.tamper](rows, scene, case.argument)


def truth_places(table: Table, scene: Scene, name: str) -> Floats:
    """True places (n, 2); off the site where unknown."""
    place = scene.tracks[name].at(table["stamp_ns"]).place_m
    return np.where(np.isfinite(place), place, -1e6)


def cells(place_m: Floats, scene: Scene) -> tuple[Floats, Floats]:
    """Row and column of places (n, 2), clipped to the site."""
    truth = scene.truth
    column, row = np.floor((place_m - [truth.west_m, truth.south_m]) / truth.cell_m).astype(np.int64).T
    rows, columns = truth.c_rr.shape
    return np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)


def _ahead(table: Table) -> Floats:
    """Unit heading vectors (n, 2)."""
    heading = table["heading_rad"].astype(np.float64)
    return np.stack([np.cos(heading), np.sin(heading)], axis=1)


def _gradient(table: Table) -> Floats:
    return np.stack([table["grade_e"], table["grade_n"]], axis=1).astype(np.float64)


def _with_zero(table: Table, zero: float, where: Bools) -> Table:
    """Samples with an added accelerometer bias where selected."""
    out = table.copy()
    d, off = np.where(table["speed_mps"] >= 0, 1.0, -1.0), np.where(where, zero, 0.0)
    out["c_rr"] += d * off
    east, north = (_ahead(table) * off[:, None]).T
    out["grade_e"] -= east
    out["grade_n"] -= north
    return out


def _with_ground(table: Table, step: Floats) -> Table:
    """Samples (n,) on ground of c_rr changed by step (n,)."""
    out = table.copy()
    out["c_rr"] += step
    return out
