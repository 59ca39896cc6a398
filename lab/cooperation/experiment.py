"""Benefit of cooperation: time and quality of the map by number of machines, links and faults."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lab.calibration import drives as fleet_drives
from lab.campaign.experiment import Runner, replay_task
from lab.campaign.figures import judge
from lab.campaign.goals import goals
from lab.campaign.summary import column, mean, median, strict, summary
from lab.cooperation import live, scores
from lab.cooperation.drives import TWO, Arm, arms
from lab.cooperation.live import LiveRun
from lab.cooperation.maps import central_tasks
from lab.cooperation.network import FIGURES, SHARE_PCT
from lab.cooperation.scores import ROUNDS, Judging, Scored, minutes_until
from protocol.errors import SitegridError
from sitegrid.proof.figures import Report, Row, half_width, rounded

WHOLE_S, LEAST_S = 1200.0, 300.0  # of a lone machine's recording
ALONE = "one"
DIGITS = 4
DECIDED = ("c_rr_pct", "grade_pct")  # also reported with the final decisions


@dataclass(frozen=True)
class Plan:
    """Scope. central: the arm that also runs in one process."""

    seeds: Sequence[int]
    arms: tuple[Arm, ...]
    central: str = "four"

    @classmethod
    def full(cls, seeds: Sequence[int], whole_s: float = WHOLE_S) -> Plan:
        """All arms; SitegridError if recordings are too short."""
        if whole_s < LEAST_S:
            raise SitegridError(f"seconds: {whole_s:g} is too short; a round of all tours takes {LEAST_S:g} s")
        return cls(seeds, arms(whole_s))


# Smoke test: two machines for 75 s in the fast world.
QUICK = Plan((0,), (Arm("two", TWO, 2, 75.0, 16.0, world="fast"),), "two")


@dataclass(frozen=True)
class Outcome:
    """One arm by seed: live run, None for one process with a perfect link, and figures."""

    judging: Judging
    runs: Sequence[LiveRun | None]
    scored: Sequence[Scored]


def run(runner: Runner, plan: Plan) -> tuple[Report, Sequence[Outcome]]:
    """Record, run the arms live one after another, and judge."""
    pairs = [(arm, seed) for seed in plan.seeds for arm in plan.arms]
    runner.record(list(dict.fromkeys(arm.drive(seed) for arm, seed in pairs)))
    apart = [arm for arm in plan.arms if arm.name == plan.central]
    runner.run(
        fleet_drives.EXPERIMENT, [task for arm in apart for seed in plan.seeds for task in central_tasks(arm, seed)]
    )
    alone = replace(runner, processes=1)  # an arm needs all cores for valid times
    runs = alone.run(live.EXPERIMENT, [replay_task(arm, arm.drive(seed)) for arm, seed in pairs])
    by_pair = dict(zip(pairs, runs, strict=True))
    judgings = [*(Judging(arm) for arm in plan.arms), *(Judging(arm, central=True) for arm in apart)]
    tasks = [replay_task(judging, judging.arm.drive(seed)) for judging in judgings for seed in plan.seeds]
    results = iter(runner.run(scores.EXPERIMENT, tasks))
    outcomes = [
        Outcome(
            judging,
            [None if judging.central else by_pair[judging.arm, seed] for seed in plan.seeds],
            [next(results) for _ in plan.seeds],
        )
        for judging in judgings
    ]
    return report(plan, outcomes), outcomes


def report(plan: Plan, outcomes: Sequence[Outcome]) -> Report:
    """All tables, and the available goals."""
    rows = [arm_row(each) for each in outcomes]
    speedups = speedup_rows(rows)
    rounds = [row for each in outcomes if not each.judging.central for row in round_rows(each)]
    repaved = [row for each in outcomes if each.judging.arm.repaves for row in repaved_rows(each)]
    spoiled = [spoiled_row(each) for each in outcomes if each.judging.arm.spoiled]
    tables = {
        "cooperation": rows,
        "cooperation_speedups": speedups,
        "cooperation_rounds": rounds,
        "cooperation_repaved": repaved,
        "cooperation_spoiled": spoiled,
    }
    return {
        "seeds": list(plan.seeds),
        "rows": rows,
        "speedups": speedups,
        "rounds": rounds,
        "repaved": repaved,
        "spoiled": spoiled,
        "false_alarms": alarms(outcomes),
        "goals": [] if plan == QUICK else [row for name, table in tables.items() for row in judge(goals(name), table)],
    }


# --- rows ------------------------------------------------------------------------------------------------------------


def arm_row(outcome: Outcome) -> Row:
    """One arm: means over seeds; minutes are NaN unless all reached SHARE_PCT."""
    arm, scored = outcome.judging.arm, outcome.scored
    by_seed = [
        {
            "minutes": minutes_until(each.minutes, each.by_stamp[:, 0], SHARE_PCT),
            "arrived_min": minutes_until(each.minutes, each.by_arrival[:, 0], SHARE_PCT),
            **each.end,
        }
        for each in scored
    ]
    link = "perfect" if outcome.judging.central else arm.link.name
    named = {"arm": outcome.judging.name, "machines": arm.machines, "link": link, "recorded_s": arm.seconds}
    others = {**_link_figures(outcome), "over_time": _over_time(scored)}
    return rounded(summary(named, by_seed, strict(mean), **others), DIGITS)


def _link_figures(outcome: Outcome) -> Row:
    """Traffic of a machine's link per hour, and quality of the replay; None for one process."""
    runs, arm = [each for each in outcome.runs if each], outcome.judging.arm
    names = ("sent_mb_per_h", "received_mb_per_h", "delivered", "late_s", "same_pct")
    same = mean([each.same_pct for each in outcome.scored])
    if not runs:
        return dict(zip(names, (None, None, None, None, same), strict=True))
    hours = arm.machines * arm.seconds / 3600 * len(runs)
    sent, received = (
        sum(map(sum, column)) for column in ([r.sent_bytes for r in runs], [r.received_bytes for r in runs])
    )
    late_s = max(each.late_s for each in runs)
    figures = (sent / hours / 1e6, received / hours / 1e6, all(each.delivered for each in runs), late_s, None)
    return dict(zip(names, figures, strict=True))


def _over_time(scored: Sequence[Scored]) -> list[Row]:
    """Means over seeds at each step: FIGURES by stamp, coverage by arrival."""
    with np.errstate(invalid="ignore"):
        stamped, arrived = (
            np.mean([getattr(each, name) for each in scored], axis=0) for name in ("by_stamp", "by_arrival")
        )
    return [
        {"minutes": float(at), **dict(zip(FIGURES, then.tolist(), strict=True)), "arrived_covered_pct": float(there)}
        for at, then, there in zip(scored[0].minutes, stamped, arrived[:, 0], strict=True)
    ]


def speedup_rows(rows: Sequence[Row]) -> list[Row]:
    """Speed-up to SHARE_PCT against a lone machine, paired by seed; NaN if never reached."""
    out = []
    for lone in (row for row in rows if row["arm"] == ALONE):
        for row in rows:
            pairs = zip(column(lone["by_seed"], "minutes"), column(row["by_seed"], "minutes"), strict=True)
            times = [alone / together for alone, together in pairs]
            by_seed = [{"speedup": each} for each in times]
            out.append(summary({"arm": row["arm"]}, by_seed, strict(mean), ci95=half_width(np.array(times))))
    return rounded(out, DIGITS)


def round_rows(outcome: Outcome) -> list[Row]:
    """After each of ROUNDS: means over seeds, also with final decisions; NaN if a seed has fewer."""
    names = ("minutes", *FIGURES)
    nothing: Row = {**dict.fromkeys(names, math.nan), "decided": dict.fromkeys(names, math.nan)}
    out = []
    for number, rounds in enumerate(ROUNDS):
        of_seeds = [each.rounds[number] if number < len(each.rounds) else nothing for each in outcome.scored]
        by_seed = [
            {name: each[name] for name in names} | {f"decided_{name}": each["decided"][name] for name in DECIDED}
            for each in of_seeds
        ]
        out.append(summary({"arm": outcome.judging.name, "rounds": rounds}, by_seed, strict(mean)))
    return rounded(out, DIGITS)


def repaved_rows(outcome: Outcome) -> list[Row]:
    """Per repaved ground: medians over seeds, NaN if a seed missed it; shares by pass."""
    out = []
    for parts in zip(*(each.repaved for each in outcome.scored), strict=True):
        names = ("passes", "least_passes", "minutes", "arrived_min")
        by_seed = [{name: part[name] for name in names} for part in parts]
        by_pass = {name: column(parts, name) for name in ("by_pass_pct", "driven_by_pass_pct")}
        named = {"ground": parts[0]["ground"], "cells": parts[0]["cells"]}
        out.append(summary(named, by_seed, strict(median), **by_pass))
    return rounded(out, DIGITS)


def spoiled_row(outcome: Outcome) -> Row:
    """Cost of the deviating machine to the others: means over seeds, 0 if the map improves."""
    parts = [each.spoiled for each in outcome.scored]
    by_seed = [{name: part[name] for name in ("cost_pct", "let_in_pct", "estimated_cost_pct")} for part in parts]
    excluded = {
        "excluded": sum(bool(part["excluded"]) for part in parts),
        "excluded_min": mean(column(parts, "excluded_min")),
    }
    named = {"arm": outcome.judging.name}
    return rounded(summary(named, by_seed, lambda values: max(0.0, mean(values)), **excluded), DIGITS)


def alarms(outcomes: Sequence[Outcome]) -> Row:
    """False changes of all live arms."""
    live_ones = [each for outcome in outcomes if not outcome.judging.central for each in outcome.scored]
    count, area = sum(each.alarms for each in live_ones), sum(each.km2_days for each in live_ones)
    return rounded({"count": count, "km2_days": area, "per_km2_day": count / area if area else None}, 8, per_km2_day=1)
