"""What cooperation brings: how soon a map is there, and how good, by number of machines, by links and by troubles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lab.calibration import drives as fleet_drives
from lab.campaign.experiment import Runner, replay_task
from lab.cooperation import live, scores
from lab.cooperation.arms import Arm, arms
from lab.cooperation.central import central_tasks
from lab.cooperation.drives import REPAVED, TWO
from lab.cooperation.live import LiveRun
from lab.cooperation.network import FIGURES, SHARE_PCT
from lab.cooperation.scores import ROUNDS, Judging, Scored, minutes_until
from protocol.errors import SitegridError
from sitegrid.proof.figures import Goal, Report, Row, half_width, judge, rounded

WHOLE_S, LEAST_S = 1200.0, 300.0  # of a lone machine's recording
ALONE, FOUR = "one", "four"
DIGITS = 4
DECIDED = ("c_rr_pct", "grade_pct")  # that are shown with what was decided in the end, too
ENDS_ALONE = ("driven_wrong_pct", "driven_slope_wrong_pct", "driven_known_pct", "places_c_rr_pct")  # in the end alone
SPEEDUPS = (Goal({"arm": FOUR}, "speedup", ">=", 3.0),)
ENDS = (Goal({"arm": FOUR}, "c_rr_pct", "<=", 6.0),)
# Sahlholm and Johansson's trucks: 0.17 % grade after six passes.
GRADES = tuple(Goal({"arm": FOUR, "rounds": n}, "grade_pct", "<=", limit) for n, limit in ((1, 0.45), (6, 0.17)))
COSTS = tuple(
    Goal({"arm": arm}, "cost_pct", "<=", limit) for arm, limit in (("bad_machine", 0.05), ("standalone", 0.1))
)
PASSES = tuple(Goal({"ground": name}, "passes", "<=", 2) for name in REPAVED)


@dataclass(frozen=True)
class Plan:
    """What is run. central: the arm whose machines also run in one process."""

    seeds: Sequence[int]
    arms: tuple[Arm, ...]
    central: str = FOUR

    @classmethod
    def full(cls, seeds: Sequence[int], whole_s: float = WHOLE_S) -> Plan:
        """All arms; SitegridError where recordings would be too short."""
        if whole_s < LEAST_S:
            raise SitegridError(f"seconds: {whole_s:g} is too short; a round of all tours takes {LEAST_S:g} s")
        return cls(seeds, arms(whole_s))


# Two machines for 75 s in the fast world: to see that all of it works.
QUICK = Plan((0,), (Arm("two", TWO, 2, 75.0, 16.0, world="fast"),), "two")


@dataclass(frozen=True)
class Outcome:
    """One arm, seed by seed: what ran, None of one process with a perfect link, and its figures."""

    judging: Judging
    runs: Sequence[LiveRun | None]
    scored: Sequence[Scored]


def run(runner: Runner, plan: Plan) -> tuple[Report, Sequence[Outcome]]:
    """Record, run every arm live, one at a time, and judge."""
    pairs = [(arm, seed) for seed in plan.seeds for arm in plan.arms]
    runner.record(list(dict.fromkeys(arm.drive(seed) for arm, seed in pairs)))
    apart = [arm for arm in plan.arms if arm.name == plan.central]
    runner.run(
        fleet_drives.EXPERIMENT, [task for arm in apart for seed in plan.seeds for task in central_tasks(arm, seed)]
    )
    alone = replace(runner, processes=1)  # an arm has all cores: its times are those of its processes
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
    """All tables, and the goals for those that there are."""
    rows = [arm_row(each) for each in outcomes]
    speedups = speedup_rows(rows)
    rounds = [row for each in outcomes if not each.judging.central for row in round_rows(each)]
    repaved = [row for each in outcomes if each.judging.arm.repaves for row in repaved_rows(each)]
    spoiled = [spoiled_row(each) for each in outcomes if each.judging.arm.spoiled]
    judged = (ENDS, rows), (SPEEDUPS, speedups), (GRADES, rounds), (PASSES, repaved), (COSTS, spoiled)
    return {
        "seeds": list(plan.seeds),
        "rows": rows,
        "speedups": speedups,
        "rounds": rounds,
        "repaved": repaved,
        "spoiled": spoiled,
        "false_alarms": alarms(outcomes),
        "goals": [] if plan == QUICK else [goal for goals, table in judged for goal in judge(goals, table)],
    }


# --- rows ------------------------------------------------------------------------------------------------------------


def arm_row(outcome: Outcome) -> Row:
    """One arm: means over the seeds. None until SHARE_PCT was covered in all of them."""
    arm, scored = outcome.judging.arm, outcome.scored
    steps = scored[0].minutes
    covered = {
        "minutes": [each.by_stamp[:, 0] for each in scored],
        "arrived_min": [each.by_arrival[:, 0] for each in scored],
    }
    until = {name: [minutes_until(steps, part, SHARE_PCT) for part in parts] for name, parts in covered.items()}
    ends = {name: _mean([each.end[name] for each in scored]) for name in (*FIGURES, *ENDS_ALONE)}
    row: Row = {
        "arm": outcome.judging.name,
        "machines": arm.machines,
        "link": "perfect" if outcome.judging.central else arm.link.name,
        "recorded_s": arm.seconds,
        **{name: _mean(values) for name, values in until.items()},
        **ends,
        **_link_figures(outcome),
        "by_seed": {**until, "driven_wrong_pct": [each.end["driven_wrong_pct"] for each in scored]},
        "over_time": _over_time(scored),
    }
    return rounded(row, DIGITS)


def _link_figures(outcome: Outcome) -> Row:
    """What a machine's link carried in an hour of its work, and how the replay went; None of one process."""
    runs, arm = [each for each in outcome.runs if each], outcome.judging.arm
    names = ("sent_mb_per_h", "received_mb_per_h", "delivered", "late_s", "same_pct")
    same = _mean([each.same_pct for each in outcome.scored if each.same_pct is not None])
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
    """FIGURES by stamps and the share that is covered by arrival, at each step, means over the seeds."""
    with np.errstate(invalid="ignore"):
        stamped, arrived = (
            np.mean([getattr(each, name) for each in scored], axis=0) for name in ("by_stamp", "by_arrival")
        )
    return [
        {"minutes": float(at), **dict(zip(FIGURES, then.tolist(), strict=True)), "arrived_covered_pct": float(there)}
        for at, then, there in zip(scored[0].minutes, stamped, arrived[:, 0], strict=True)
    ]


def speedup_rows(rows: Sequence[Row]) -> list[Row]:
    """How many times sooner than a lone machine each arm has covered SHARE_PCT, paired; None where one never had."""
    lone = next((row for row in rows if row["arm"] == ALONE), None)
    out = []
    for row in rows if lone else ():
        pairs = zip(lone["by_seed"]["minutes"], row["by_seed"]["minutes"], strict=True) if lone else ()
        times = [pair[0] / pair[1] for pair in pairs]
        out.append({"arm": row["arm"], "speedup": _mean(times), "ci95": half_width(np.array(times)), "by_seed": times})
    return [rounded(row, DIGITS) for row in out]


def round_rows(outcome: Outcome) -> list[Row]:
    """After each of ROUNDS: means over the seeds, and with what was decided in the end; NaN where one drove fewer."""
    names = ("minutes", *FIGURES)
    nothing: Row = {**dict.fromkeys(names, math.nan), "decided": dict.fromkeys(names, math.nan)}
    out = []
    for number, rounds in enumerate(ROUNDS):
        of_seeds = [each.rounds[number] if number < len(each.rounds) else nothing for each in outcome.scored]
        row: Row = {"arm": outcome.judging.name, "rounds": rounds}
        row |= {name: _mean([each[name] for each in of_seeds]) for name in names}
        row |= {f"decided_{name}": _mean([each["decided"][name] for each in of_seeds]) for name in DECIDED}
        out.append(rounded({**row, "by_seed": {"grade_pct": [each["grade_pct"] for each in of_seeds]}}, DIGITS))
    return out


def repaved_rows(outcome: Outcome) -> list[Row]:
    """Each ground that is repaved: medians over the seeds, None where one did not show it."""
    out = []
    for parts in zip(*(each.repaved for each in outcome.scored), strict=True):
        row: Row = {"ground": parts[0]["ground"], "cells": parts[0]["cells"]}
        for name in ("passes", "least_passes", "minutes", "arrived_min"):
            values = [part[name] for part in parts]
            row[name] = None if None in values else float(np.median(values))
        by_seed = {
            name: [part[name] for part in parts]
            for name in ("passes", "least_passes", "by_pass_pct", "driven_by_pass_pct")
        }
        out.append(rounded({**row, "by_seed": by_seed}, DIGITS))
    return out


def spoiled_row(outcome: Outcome) -> Row:
    """What the machine that is not as the others costs these: means over the seeds, 0 where the map is better."""
    parts = [each.spoiled for each in outcome.scored]
    names = ("cost_pct", "let_in_pct", "estimated_cost_pct")
    row: Row = {
        "arm": outcome.judging.name,
        **{name: max(0.0, _mean([part[name] for part in parts])) for name in names},
    }
    row["excluded"] = sum(bool(part["excluded"]) for part in parts)
    row["excluded_min"] = _mean([part["excluded_min"] for part in parts if part["excluded_min"] is not None])
    row["by_seed"] = {name: [part[name] for part in parts] for name in names}
    return rounded(row, DIGITS)


def alarms(outcomes: Sequence[Outcome]) -> Row:
    """Changes that were listed where there was none, of all live arms."""
    live_ones = [each for outcome in outcomes if not outcome.judging.central for each in outcome.scored]
    count, area = sum(each.alarms for each in live_ones), sum(each.km2_days for each in live_ones)
    return rounded({"count": count, "km2_days": area, "per_km2_day": count / area if area else None}, 8, per_km2_day=1)


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else math.nan
