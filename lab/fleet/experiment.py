"""What calibration by the fleet gives the map: every case before, after, and with the errors that the truth shows.

Recordings of PyBullet drives are replayed by whole pipelines with estimated, smoothed positions. The samples go through
the server's own ledger, solver, trust, correction, fold and read.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lab.campaign.experiment import Runner, replay_task
from lab.fleet import drives
from lab.fleet.cases import CASES, PAPER, FleetCase
from lab.fleet.drives import Agent, FleetDrive, planned, scene
from lab.fleet.solving import FIGURES, MAPS, CaseResult, solved
from sitegrid.proof.figures import Goal, Report, Row, judge, root_mean_square, rounded

LOADERS = 4  # of a drive of the paper's site with the usual sensors
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
    Goal({"case": "agents", "map": "before"}, "rms_zero", "<=", 0.0012),
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
    own = (case.calibrates, case.closed_tours)
    return [Agent(index, *own, case.first_s, index in case.bad) for index in places]


def summarise(case: FleetCase, name: str, results: Sequence[CaseResult]) -> Row:
    """One row: means over the seeds; of `before` the errors of the zeros that agents applied in the end."""
    maps = [result.maps[name] for result in results]
    wrong = [each.figures["wrong_pct"] for each in maps]
    row: Row = {"case": case.name, "map": name}
    row |= {figure: _mean([each.figures[figure] for each in maps]) for figure in FIGURES}
    after = name == "after"
    zeros, scales, normalised, applied = (
        np.concatenate([getattr(result, part) for result in results]) if name == of_map else np.zeros(0)
        for part, of_map in (("zeros", "after"), ("scales", "after"), ("normalised", "after"), ("applied", "before"))
    )
    row |= {
        "rms_zero": root_mean_square(applied if name == "before" else zeros),
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
        return [result.maps["after"].figures[figure] - result.maps[other].figures[figure] for result in results]

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
