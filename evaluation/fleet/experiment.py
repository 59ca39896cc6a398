"""What calibration by the fleet gives the map: every case before, after, and with the errors that the truth shows.

Recordings of PyBullet drives are replayed by whole pipelines with estimated, smoothed positions. The samples go through
the server's own ledger, solver, correction, fold and read.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from evaluation.campaign.experiment import Runner, replay_task
from evaluation.campaign.figures import Goal, Report, Row, judge, root_mean_square, rounded
from evaluation.fleet import drives
from evaluation.fleet.cases import CASES, PAPER, FleetCase, Rows, Tampered, cells, tampered, truth_places
from evaluation.fleet.drives import Agent, FleetDrive, Scene, planned, scene
from evaluation.maps.cases import CELL_M
from evaluation.maps.score import border_distance, driven_cells
from mapserver.config import ServerConfig
from mapserver.evidence.fold_config import is_foldable
from mapserver.evidence.grid import Grid
from mapserver.fleet.calibration import Calibration, calibrate
from mapserver.fleet.correction import LAST_NS, Correction, corrected, measured
from mapserver.fleet.ledger import Ledger
from mapserver.fleet.solver import SCALE_STD, ZERO_STD
from mapserver.query.views import read_cells, view_of
from mapserver.trust.auditor import Auditor
from protocol.arrays import AnyArray, Bools, Floats, Floats32, Table
from protocol.queries.answers import MapVersion, Region
from protocol.site.geometry import CellWindow
from protocol.site.ground_classes import SLOPE, UNKNOWN, resistance_class, slope_class, wrong_percent

LOADERS = 4  # of a drive of the paper's site with the usual sensors
INTERIOR_M = 2.0
MAPS = ("before", "after", "oracle")
FIGURES = ("wrong_pct", "interior_pct", "slope_pct")
OUTLIER = 3.0  # typical errors beyond which a sample does not count for the true zero and scale
BATCH = 100  # samples of one machine at a time, as trust sees them
DIGITS = 4


def _goals(case: str, **limits: float) -> list[Goal]:
    """At most so much, of the map after."""
    return [Goal({"case": case, "map": "after"}, figure, "<=", limit) for figure, limit in limits.items()]


# Figures that only the map after has.
AFTER_ALONE = (
    *("change_pct", "above_before_pct", "max_above_before_pct", "above_oracle_pct", "max_above_oracle_pct"),
    *("slope_change_pct", "common_scale_observed", "reasons", "distrusted"),
)
# For seeds that nothing was tuned on.
GOALS = (
    *_goals("machines_3", wrong_pct=2.2, interior_pct=0.8, slope_pct=1.0, above_oracle_pct=0.3),
    *_goals("machines_3", max_above_oracle_pct=0.6, max_above_before_pct=0.3, rms_zero=0.0006, rms_scale=0.01),
    Goal({"case": "machines_3", "map": "after"}, "normalised", ">=", 0.3),
    *_goals("machines_3", normalised=1.5),
    *_goals("machines_1", wrong_pct=1.6),
    *_goals("first_180_s", median_wrong_pct=3.5),
    *_goals("bad_machine", wrong_pct=2.8, above_oracle_pct=0.3),
    *(
        goal
        for case in ("gain_1.6", "majority_off", "step_at_half", "haul_road", "rain")
        for goal in _goals(case, above_oracle_pct=0.4)
    ),
    *_goals("loading", change_pct=0.2),
    *(
        goal
        for case in CASES
        if case.tamper == "other_ramps"
        for goal in _goals(case.name, slope_change_pct=1.0, above_before_pct=0.2, common_scale_observed=0)
    ),
)


@dataclass(frozen=True)
class TrueError:
    """What a machine's samples are off by from a stamp to another, fitted against the truth."""

    from_ns: int
    to_ns: int
    zero: float
    scale: float
    across: float


@dataclass(frozen=True)
class CaseResult:
    """One case with one seed. maps: FIGURES by map. zeros, scales: errors of the corrections, over their std too.

    common: whether the common scale is observed, and why not. distrusted: by trust, with reasons.
    """

    maps: Mapping[str, Row]
    zeros: Floats
    scales: Floats
    normalised: Floats
    common: tuple[bool, str]
    distrusted: Mapping[str, str]


def run(
    runner: Runner, seeds: Sequence[int], seconds: float, cases: Sequence[FleetCase] = CASES
) -> tuple[Report, dict[FleetCase, list[CaseResult]]]:
    """Record, replay, calibrate and judge all cases with all seeds; a row per case and map, means over the seeds."""
    wanted = {
        (drive, agent): replay_task(agent, drive)
        for seed in seeds
        for case in cases
        for drive in [_drive(case, seed, seconds)]
        for agent in _agents(case, drive)
    }
    samples = dict(zip(wanted, runner.run(drives.EXPERIMENT, list(wanted.values())), strict=True))
    results: dict[FleetCase, list[CaseResult]] = {case: [] for case in cases}
    for seed in seeds:
        for case in cases:
            drive = _drive(case, seed, seconds)
            true = scene(drive, runner.cache)
            names = sorted(true.tracks)
            rows = {names[agent.index]: samples[drive, agent].samples for agent in _agents(case, drive)}
            results[case].append(solved(case, rows, true))
    table = [summarise(case, name, of_case) for case, of_case in results.items() for name in MAPS]
    known = [goal for goal in GOALS if goal.row["case"] in {case.name for case in cases}]
    return {"seeds": list(seeds), "seconds": seconds, "rows": table, "goals": judge(known, table)}, results


def _drive(case: FleetCase, seed: int, seconds: float) -> FleetDrive:
    """The recording of a case: cases of the paper's site with the usual sensors share one of four loaders."""
    if case.scenario != PAPER:
        return planned(case.scenario, seed, seconds)
    return planned(PAPER, seed, seconds, case.machines if case.preset else LOADERS, case.preset)


def _agents(case: FleetCase, drive: FleetDrive) -> list[Agent]:
    places = range(case.machines or drive.machines)
    return [Agent(index, case.calibrates, case.first_s, index in case.bad) for index in places]


def summarise(case: FleetCase, name: str, results: Sequence[CaseResult]) -> Row:
    """One row: means over the seeds; errors of zeros and scales of `after` alone."""
    maps = [result.maps[name] for result in results]
    wrong = [row["wrong_pct"] for row in maps]
    row: Row = {"case": case.name, "map": name}
    row |= {figure: _mean([each[figure] for each in maps]) for figure in FIGURES}
    after = name == "after"
    zeros, scales, normalised = (
        np.concatenate([getattr(result, part) for result in results]) if after else np.zeros(0)
        for part in ("zeros", "scales", "normalised")
    )
    row |= {
        "rms_zero": root_mean_square(zeros),
        "rms_scale": root_mean_square(scales),
        "normalised": float(np.mean(normalised**2)) if after else math.nan,
        "median_wrong_pct": float(np.median(wrong)),
        "max_wrong_pct": max(wrong),
        "wrong_by_seed_pct": wrong,
    }
    if after:
        row |= _against_others(results)
        row |= {
            "common_scale_observed": sum(result.common[0] for result in results),
            "reasons": sorted({result.common[1] for result in results} - {""}),
            "distrusted": [dict(result.distrusted) for result in results],
        }
    else:
        row |= dict.fromkeys(AFTER_ALONE)
    return rounded(row, DIGITS, rms_zero=6)


def _against_others(results: Sequence[CaseResult]) -> Row:
    """How much more of the map is wrong afterwards than with other maps [points], seed by seed; not below 0 if `above`.

    Of the slope the mean.
    """

    def more(figure: str, other: str) -> list[float]:
        return [result.maps["after"][figure] - result.maps[other][figure] for result in results]

    change, from_oracle, slope = more("wrong_pct", "before"), more("wrong_pct", "oracle"), more("slope_pct", "before")
    return {
        "change_pct": _mean(change),
        "above_before_pct": max(0.0, _mean(change)),
        "max_above_before_pct": max(0.0, *change),
        "above_oracle_pct": max(0.0, _mean(from_oracle)),
        "max_above_oracle_pct": max(0.0, *from_oracle),
        "slope_change_pct": _mean(slope),
    }


def _mean(values: Sequence[float]) -> float:
    """Of the values that are known."""
    known = [value for value in values if math.isfinite(value)]
    return float(np.mean(known)) if known else math.nan


# --- one case --------------------------------------------------------------------------------------------------------


def solved(case: FleetCase, recorded: Rows, true: Scene) -> CaseResult:
    """Calibrate a case's samples, and judge its maps."""
    data = tampered(case, recorded, true)
    names = sorted(data.rows)
    distrusted = accused(data.rows, calibrated(data.rows))
    result = calibrated(data.rows, set(distrusted))
    let_in = {names[index] for index in case.let_in}
    shown = [name for name in names if name in let_in or name not in distrusted]
    errors = {name: true_errors(data, name, true, case.spans) for name in shown}
    by_truth = {name: [_as_correction(name, error) for error in errors[name]] for name in shown}
    own = {name: of_machine(result, name) for name in shown}
    maps = {
        "before": judged({name: data.rows[name] for name in shown}, data, true),
        "after": judged({name: corrected(data.rows[name], own[name]) for name in shown}, data, true),
        "oracle": judged({name: corrected(data.rows[name], by_truth[name]) for name in shown}, data, true),
    }
    off = [_off(data.rows[name], own[name], error) for name in shown for error in errors[name]]
    zeros, scales, zero_std, scale_std = np.array(off).T
    normalised = np.concatenate([zeros / zero_std, scales / scale_std])
    common = result.common.observed, result.common.reason
    return CaseResult(maps, zeros, scales, normalised, common, distrusted)


def of_machine(result: Calibration, name: str) -> list[Correction]:
    """The corrections of one machine."""
    return [each for each in result.corrections if each.machine == name]


def accused(rows: Rows, result: Calibration) -> dict[str, str]:
    """Machines that the server's trust excludes, and why: it judges corrected samples, which come in turn."""
    auditor = Auditor(CELL_M)
    right = {name: corrected(table, of_machine(result, name)) for name, table in rows.items()}
    for first in range(0, max(map(len, right.values())), BATCH):
        for name, table in sorted(right.items()):
            auditor.add(name, table[first : first + BATCH])
    verdicts = auditor.verdicts(result.machines)
    return {name: ", ".join(verdict.reasons) for name, verdict in verdicts.items() if verdict.contradicts}


def calibrated(rows: Rows, excluded: Collection[str] = ()) -> Calibration:
    """What the server's ledger and solver make of samples."""
    config, stays = ServerConfig(), {}
    for name, table in rows.items():
        ledger = Ledger()
        ledger.add(table[is_foldable(table, config.fold)])
        stays[name] = ledger.stays()
    return calibrate(stays, excluded)


def judged(rows: Rows, data: Tampered, true: Scene) -> Row:
    """FIGURES of the server's map of these samples, over the cells that the machines truly passed."""
    truth, config, c_rr = true.truth, ServerConfig(), data.c_rr
    lines, columns = c_rr.shape
    window = CellWindow(round(truth.west_m / truth.cell_m), round(truth.south_m / truth.cell_m), columns, lines)
    grid = Grid(truth.cell_m, config.fold)
    for name, table in rows.items():
        grid.fold(table, name)
    layers = read_cells(view_of(grid, window, config), window, ("resistance",), truth.cell_m, config)
    estimated, classes = resistance_class(layers["resistance"]), resistance_class(c_rr)
    passed = driven_cells(_region(true), [true.tracks[name].place_m for name in data.passed_by or rows]) & (
        classes != UNKNOWN
    )
    inner = passed & (border_distance(classes, truth.cell_m) > INTERIOR_M)
    steep = passed & (slope_class(truth.grade_east, truth.grade_north) == SLOPE)

    def wrong(where: Bools) -> float:
        return wrong_percent(estimated[where], classes[where])

    return {"wrong_pct": wrong(passed), "interior_pct": wrong(inner), "slope_pct": wrong(steep)}


def _region(true: Scene) -> Region:
    """The cells of a scene, without layers."""
    truth = true.truth
    lines, columns = truth.c_rr.shape
    x_m, y_m = (
        np.asarray(corner + (np.arange(n) + 0.5) * truth.cell_m, np.float64)
        for corner, n in ((truth.west_m, columns), (truth.south_m, lines))
    )
    return Region(x_m, y_m, truth.cell_m, {}, MapVersion("", 0, 0), 0)


# --- the errors that the truth shows ---------------------------------------------------------------------------------


def true_errors(data: Tampered, name: str, true: Scene, spans: int) -> list[TrueError]:
    """Zero and scale of what a machine measured, in equal spans of its samples, by least squares to the true ground.

    Samples near borders of soils do not count, nor those further off than OUTLIER typical errors.
    """
    rows = measured(data.rows[name])
    oldest, newest = int(rows["stamp_ns"].min()), int(rows["stamp_ns"].max())
    ends = [0, *((oldest * (spans - i) + newest * i) // spans for i in range(1, spans)), LAST_NS]
    out = []
    for from_ns, to_ns in pairwise(ends):
        part = rows[(rows["stamp_ns"] >= from_ns) & (rows["stamp_ns"] < to_ns)]
        out.append(TrueError(from_ns, to_ns, *_fit(part, data.earlier.get(name, data.c_rr), name, true)))
    return out


def _fit(rows: Table, c_rr: Floats32, name: str, true: Scene) -> tuple[float, float, float]:
    """Zero, scale error k and lateral zero of these samples."""
    track = true.tracks[name].at(rows["stamp_ns"])
    at = cells(truth_places(rows, true, name), true)
    ground, border_m = c_rr[at].astype(np.float64), border_distance(resistance_class(c_rr), true.truth.cell_m)[at]
    ahead = np.stack([np.cos(track.yaw_rad), np.sin(track.yaw_rad)], axis=1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    d, slope = np.sign(rows["speed_mps"].astype(np.float64)), (track.gradient * ahead).sum(axis=1)
    gradient = np.stack([rows["grade_e"], rows["grade_n"]], axis=1)
    across = np.nanmedian(((gradient - track.gradient) * left).sum(axis=1))
    usable = np.isfinite(rows["c_rr"]) & np.isfinite(slope) & (border_m > INTERIOR_M)
    columns, off = np.stack([d, d * (d * ground + slope)], axis=1)[usable], (rows["c_rr"] - ground)[usable]
    first = _least_squares(columns, off)
    residual = np.abs(off - columns @ first)
    near = residual < OUTLIER * 1.4826 * np.median(residual)
    zero, scale = _least_squares(columns[near], off[near]).tolist()
    return zero, scale, float(across)


def _least_squares(A: AnyArray, b: AnyArray) -> Floats:
    return np.asarray(np.linalg.lstsq(A, b, rcond=None)[0], np.float64)


def _as_correction(name: str, error: TrueError) -> Correction:
    """What takes the true error off."""
    scale = error.scale / (1 + error.scale)
    return Correction(name, error.from_ns, error.to_ns, error.zero, scale, error.across, ())


def _off(rows: Table, own: Sequence[Correction], error: TrueError) -> tuple[float, float, float, float]:
    """Errors of a machine's corrections, of the zero and of the scale k, and what they state as standard deviation."""
    if not own:
        return -error.zero, -error.scale, ZERO_STD, SCALE_STD
    stamps = rows["stamp_ns"][(rows["stamp_ns"] >= error.from_ns) & (rows["stamp_ns"] < error.to_ns)]
    count = np.array([((stamps >= each.from_ns) & (stamps < each.to_ns)).sum() for each in own], np.float64)
    weight = count / count.sum()
    zero, scale = weight @ [each.zero for each in own], weight @ [each.scale / (1 - each.scale) for each in own]
    zero_var, scale_var = (weight @ [each.covariance[i][i] for each in own] for i in (0, 1))
    return zero - error.zero, scale - error.scale, math.sqrt(zero_var), math.sqrt(scale_var)
