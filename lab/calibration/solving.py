"""One case through the server's ledger, solver, trust, correction, fold and read; maps judged."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lab.calibration.cases import FleetCase, Rows, Tampered, cells, tampered, truth_places
from lab.calibration.drives import Scene
from lab.campaign.true_maps import region_of, window_of
from lab.maps.cases import CELL_M
from lab.maps.methods import folded
from mapserver.calibration.calibrate import Solution, calibrate
from mapserver.calibration.correction import LAST_NS, Correction, corrected, measured
from mapserver.calibration.ledger import StayLedger
from mapserver.calibration.tuning import TUNING, CalibrationTuning
from mapserver.config import ServerConfig
from mapserver.evidence.fold_config import is_foldable
from mapserver.trust.auditor import Auditor
from mapserver.trust.tuning import TUNING as TRUST
from mapserver.trust.tuning import TrustTuning
from protocol.arrays import AnyArray, Bools, Floats, Floats32, Ints, Table
from protocol.machine.samples import SCALE_STD, ZERO_STD
from protocol.site.ground_classes import SLOPE, UNKNOWN, resistance_class, slope_class, wrong_percent
from sitegrid.proof.map_score import border_distance, driven_cells

MAPS = ("before", "after", "oracle")
FIGURES = ("wrong_pct", "interior_pct", "slope_pct")
BATCH = 100  # samples of one machine at a time, in trust's order
INTERIOR_M = 2.0  # from soil borders
OUTLIER = 3.0  # typical errors beyond which samples are ignored


@dataclass(frozen=True)
class JudgedMap:
    """One map: FIGURES; per cell (rows, columns) estimated and true class, and whether passed."""

    figures: Mapping[str, float]
    estimated: Ints
    true: Ints
    passed: Bools


@dataclass(frozen=True)
class CaseResult:
    """One case and seed; maps by name. zeros, scales: errors of corrections, also over their standard deviation.

    applied: errors of the agents' final biases. common: whether the common scale is observed, else why not. distrusted:
    machines with reasons.
    """

    maps: Mapping[str, JudgedMap]
    zeros: Floats
    scales: Floats
    normalised: Floats
    applied: Floats
    common: tuple[bool, str]
    distrusted: Mapping[str, str]


def solved(
    case: FleetCase,
    recorded: Rows,
    true: Scene,
    tuning: CalibrationTuning = TUNING,
    trust: TrustTuning = TRUST,
) -> CaseResult:
    """Calibrate a case's samples and judge its maps."""
    data = tampered(case, recorded, true)
    names = sorted(data.rows)
    distrusted = accused(data.rows, calibrated(data.rows, tuning=tuning), trust)
    result = calibrated(data.rows, set(distrusted), tuning)
    let_in = {names[index] for index in case.let_in}
    shown = [name for name in names if name in let_in or name not in distrusted]
    errors = {name: true_errors(data, name, true, case.spans) for name in shown}
    by_truth = {name: [as_correction(name, error) for error in errors[name]] for name in shown}
    own = {name: of_machine(result, name) for name in shown}
    of_maps: tuple[Mapping[str, Sequence[Correction]], ...] = (dict.fromkeys(shown, ()), own, by_truth)
    maps = {
        title: judged({name: corrected(data.rows[name], of_map[name]) for name in shown}, data, true)
        for title, of_map in zip(MAPS, of_maps, strict=True)
    }
    off = [_off(data.rows[name], own[name], error) for name in shown for error in errors[name]]
    zeros, scales, zero_std, scale_std = np.array(off).T
    normalised = np.concatenate([zeros / zero_std, scales / scale_std])
    applied = np.array([data.rows[name]["applied_zero"][-1] - errors[name][-1].zero for name in shown], np.float64)
    common = result.common.observed, result.common.reason
    return CaseResult(maps, zeros, scales, normalised, applied, common, distrusted)


def served(rows: Rows) -> dict[str, Table]:
    """Samples folded by the server: trusted machines, corrected."""
    distrusted = accused(rows, calibrated(rows))
    result = calibrated(rows, distrusted)
    return {name: corrected(rows[name], of_machine(result, name)) for name in sorted(rows) if name not in distrusted}


def of_machine(result: Solution, name: str) -> list[Correction]:
    """Corrections of one machine."""
    return [each for each in result.corrections if each.machine == name]


def accused(rows: Rows, result: Solution, tuning: TrustTuning = TRUST) -> dict[str, str]:
    """Machines excluded by trust, with reasons; it judges corrected samples in turn."""
    auditor = Auditor(CELL_M, tuning=tuning)
    right = {name: corrected(table, of_machine(result, name)) for name, table in rows.items()}
    for first in range(0, max(map(len, right.values())), BATCH):
        for name, table in sorted(right.items()):
            auditor.add(name, table[first : first + BATCH])
    verdicts = auditor.verdicts(result.machines)
    return {name: ", ".join(verdict.reasons) for name, verdict in verdicts.items() if verdict.contradicts}


def calibrated(rows: Rows, excluded: Collection[str] = (), tuning: CalibrationTuning = TUNING) -> Solution:
    """Result of the server's ledger and solver."""
    config, stays = ServerConfig(), {}
    for name, table in rows.items():
        ledger = StayLedger()
        ledger.add(table[is_foldable(table, config.fold)])
        stays[name] = ledger.stays()
    return calibrate(stays, excluded, tuning=tuning)


def judged(rows: Rows, data: Tampered, true: Scene) -> JudgedMap:
    """The server's map of these samples on truly passed cells."""
    truth, c_rr = true.truth, data.c_rr
    layers = folded(rows.items(), window_of(truth), ("resistance",))
    estimated, classes = resistance_class(layers["resistance"]), resistance_class(c_rr)
    tracks_m = [true.tracks[name].place_m for name in data.passed_by or rows]
    passed = driven_cells(region_of(truth, {}), tracks_m) & (classes != UNKNOWN)
    inner = passed & (border_distance(classes, truth.cell_m) > INTERIOR_M)
    steep = passed & (slope_class(truth.grade_east, truth.grade_north) == SLOPE)

    def wrong(where: Bools) -> float:
        return wrong_percent(estimated[where], classes[where])

    figures = dict(zip(FIGURES, map(wrong, (passed, inner, steep)), strict=True))
    return JudgedMap(figures, estimated, classes, passed)


def as_correction(name: str, error: TrueError) -> Correction:
    """The correction that removes the true error."""
    scale = error.scale / (1 + error.scale)
    return Correction(name, error.from_ns, error.to_ns, error.zero, scale, error.across, ())


def _off(rows: Table, own: Sequence[Correction], error: TrueError) -> tuple[float, float, float, float]:
    """Errors of a machine's bias and scale correction, and their stated standard deviations."""
    if not own:
        return -error.zero, -error.scale, ZERO_STD, SCALE_STD
    stamps = rows["stamp_ns"][(rows["stamp_ns"] >= error.from_ns) & (rows["stamp_ns"] < error.to_ns)]
    count = np.array([((stamps >= each.from_ns) & (stamps < each.to_ns)).sum() for each in own], np.float64)
    weight = count / count.sum()
    zero, scale = weight @ [each.zero for each in own], weight @ [each.scale / (1 - each.scale) for each in own]
    zero_var, scale_var = (weight @ [each.covariance[i][i] for each in own] for i in (0, 1))
    return zero - error.zero, scale - error.scale, math.sqrt(zero_var), math.sqrt(scale_var)


# --- what the truth shows --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TrueError:
    """A machine's true error over a span of stamps, fitted against the truth."""

    from_ns: int
    to_ns: int
    zero: float
    scale: float
    across: float


def true_errors(data: Tampered, name: str, true: Scene, spans: int) -> list[TrueError]:
    """Bias and scale of a machine in equal spans of its samples, least squares against true ground.

    Samples near soil borders and outliers are ignored.
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
    """Bias, scale error k, lateral bias."""
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
