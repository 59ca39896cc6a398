"""Effect of calibration on the map: every case before, after, and with true errors removed.

Recordings of PyBullet drives are replayed by whole pipelines with estimated, smoothed positions, then pass the server's
ledger, solver, trust, correction, fold and read.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lab.calibration import drives
from lab.calibration.cases import CASES, PAPER, FleetCase
from lab.calibration.drives import Agent, FleetDrive, planned, scene
from lab.calibration.solving import MAPS, CaseResult, solved
from lab.campaign.experiment import Runner, replay_task
from lab.campaign.figures import judge
from lab.campaign.goals import goals
from lab.campaign.summary import column, mean, median, summary
from mapserver.calibration.tuning import TUNING, CalibrationTuning
from mapserver.trust.tuning import TUNING as TRUST
from mapserver.trust.tuning import TrustTuning
from sitegrid.proof.figures import Report, Row, root_mean_square, rounded

LOADERS = 4  # on the paper's site with usual sensors
DIGITS = 4


def run(
    runner: Runner,
    seeds: Sequence[int],
    seconds: float,
    cases: Sequence[FleetCase] = CASES,
    tuning: CalibrationTuning = TUNING,
    trust: TrustTuning = TRUST,
) -> tuple[Report, dict[FleetCase, list[CaseResult]]]:
    """Record, replay, calibrate and judge all cases and seeds; a row per case and map, means over seeds."""
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
            results[case].append(solved(case, rows, true, tuning, trust))
    table = [row_of(case.name, name, of_case) for case, of_case in results.items() for name in MAPS]
    known = [goal for goal in goals("calibration") if goal.row["case"] in {case.name for case in cases}]
    return {"seeds": list(seeds), "seconds": seconds, "rows": table, "goals": judge(known, table)}, results


def _drive(case: FleetCase, seed: int, seconds: float) -> FleetDrive:
    """Recording of a case; cases on the paper's site with usual sensors share one of four loaders."""
    if case.scenario != PAPER:
        return planned(case.scenario, seed, seconds)
    return planned(PAPER, seed, seconds, case.machines if case.preset else LOADERS, case.preset)


def _agents(case: FleetCase, drive: FleetDrive) -> list[Agent]:
    places = range(case.machines or drive.machines)
    own = (case.calibrates, case.closed_tours)
    return [Agent(index, *own, case.first_s, index in case.bad) for index in places]


def row_of(case: str, name: str, results: Sequence[CaseResult]) -> Row:
    """One map of a case: means over seeds, and errors of biases and scales.

    change, from_oracle, slope_change: wrong cells against before and the oracle [points].
    """
    by_seed = [figures_of(result, name) for result in results]
    wrong, change, from_oracle = (column(by_seed, each) for each in ("wrong_pct", "change_pct", "from_oracle_pct"))
    row = summary(
        {"case": case, "map": name},
        by_seed,
        rms_zero=_rms(results, {"before": "applied", "after": "zeros"}.get(name)),
        rms_scale=_rms(results, {"after": "scales"}.get(name)),
        normalised=_rms(results, {"after": "normalised"}.get(name)) ** 2,
        median_wrong_pct=median(wrong),
        max_wrong_pct=max(wrong),
        above_before_pct=max(0.0, mean(change)),
        max_above_before_pct=max(0.0, *change),
        above_oracle_pct=max(0.0, mean(from_oracle)),
        max_above_oracle_pct=max(0.0, *from_oracle),
        common_scale_observed=sum(result.common[0] for result in results),
        reasons=sorted({result.common[1] for result in results} - {""}),
        distrusted=[dict(result.distrusted) for result in results],
    )
    return rounded(row, DIGITS, rms_zero=6)


def _rms(results: Sequence[CaseResult], errors: str | None) -> float:
    """RMS over all seeds; NaN for maps without corrections."""
    return root_mean_square(np.concatenate([getattr(result, errors) for result in results])) if errors else math.nan


def figures_of(result: CaseResult, name: str) -> Row:
    """Wrong cells of one map and seed [%], also against before and the oracle."""
    own, before, oracle = (result.maps[each].figures for each in (name, "before", "oracle"))
    return {
        **own,
        "change_pct": own["wrong_pct"] - before["wrong_pct"],
        "from_oracle_pct": own["wrong_pct"] - oracle["wrong_pct"],
        "slope_change_pct": own["slope_pct"] - before["slope_pct"],
    }
