"""Positions without GPS: how far off they get, and whether their ellipses say so; what is replayed is in `replays`.

Errors are compared by case and length, with the attitude reference and without, between the profiles.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lab.campaign.experiment import Runner, replay_task
from lab.campaign.recordings import PAPER, PlannedDrive, Setup
from lab.outages.replays import (
    BACK_S,
    BLACKOUT,
    CASES,
    EXPERIMENT,
    GAP_S,
    LENGTHS_S,
    SENSORS,
    SETTLED_S,
    START,
    Courses,
    Filtering,
    placements_s,
)
from lab.positions.configurations import PROFILES
from protocol.errors import SitegridError
from sitegrid.proof.figures import Goal, Report, Row, half_width, judge, rounded

MAX_RATIO = 1.5  # of the error on one drive to that of the profile `paper`


@dataclass(frozen=True)
class Variant:
    """What happens to GPS, with which sensors, and the profile of the filter."""

    case: str
    sensors: str
    profile: str


@dataclass(frozen=True)
class Outcome:
    """One variant on one drive."""

    drive: PlannedDrive
    variant: Variant
    courses: Courses


def run(
    runner: Runner, seeds: Sequence[int], seconds: float, setup: Setup = PAPER, preset: str = "paper"
) -> tuple[Report, list[Outcome]]:
    """Record, replay and compare all cases with all seeds; SitegridError where drives have no room for blackouts."""
    least_s = SETTLED_S + LENGTHS_S[-1] + 1
    if seconds < least_s:
        raise SitegridError(f"seconds: {seconds:g} is too short; blackouts need drives of {least_s:g} s or more")
    drives = [PlannedDrive(seed, seconds, preset, setup) for seed in seeds]
    filterings = [Filtering(sensors, profile) for sensors in SENSORS for profile in PROFILES]
    pairs = [(drive, filtering) for drive in drives for filtering in filterings]
    results = runner.run(EXPERIMENT, [replay_task(filtering, drive) for drive, filtering in pairs])
    outcomes = [
        Outcome(drive, Variant(case, filtering.sensors, filtering.profile), courses)
        for (drive, filtering), result in zip(pairs, results, strict=True)
        for case, courses in result.by_case(seconds).items()
    ]
    variants = [Variant(case, sensors, profile) for case in CASES for sensors in SENSORS for profile in PROFILES]
    by_variant = {v: [o.courses for o in outcomes if o.variant == v] for v in variants}
    rows = [row for v, several in by_variant.items() for row in summarise(v, several)]
    ratios = [row for case in CASES for sensors in SENSORS for row in compare(case, sensors, by_variant)]
    report: Report = {
        "scenario": setup.scenario,
        "preset": preset,
        "seeds": list(seeds),
        "seconds": seconds,
        "placements_s": placements_s(seconds),
        "rows": rows,
        "ratios": ratios,
        "goals": judge(NEVER_WORSE, ratios) + judge(HONEST, rows),
    }
    return report, outcomes


def lengths_s(case: str, courses: Courses) -> list[int]:
    """At which seconds without GPS, or after its loss, a case is looked at."""
    whole = courses.error_m.shape[1] - 1
    if case == START:
        return [length for length in (60, 300) if length < whole] + [whole]
    return list(LENGTHS_S) if case == BLACKOUT else [GAP_S + back for back in BACK_S]


def summarise(variant: Variant, several: Sequence[Courses]) -> list[Row]:
    """One row per length: errors at its end over all seeds (n) and courses, and whether their ellipses hold them."""
    rows = []
    for length in lengths_s(variant.case, several[0]):
        off = np.array([courses.distance_m[:, length] for courses in several])
        by_seed = off.mean(axis=1)
        row = {
            **vars(variant),
            "seconds": length,
            "error_m": float(off.mean()),
            "ci95_m": half_width(by_seed),
            "median_m": float(np.median(off)),
            "largest_m": float(off.max()),
            "coverage95": float(np.mean([courses.inside[:, length] for courses in several])),
            "error_by_seed_m": by_seed.tolist(),
        }
        rows.append(rounded(row, 3))
    return rows


def compare(case: str, sensors: str, by_variant: Mapping[Variant, Sequence[Courses]]) -> list[Row]:
    """`default` over `paper` per length: of the means of all seeds, of the worst seed, and how often a course is worse.

    over: courses whose error is more than MAX_RATIO times that of the same course with `paper`.
    """
    ours, theirs = (by_variant[Variant(case, sensors, profile)] for profile in ("default", "paper"))
    rows = []
    for length in lengths_s(case, ours[0]):
        a, b = (np.array([courses.distance_m[:, length] for courses in several]) for several in (ours, theirs))
        by_seed = a.mean(axis=1) / b.mean(axis=1)
        row = {
            "case": case,
            "sensors": sensors,
            "seconds": length,
            "ratio": float(a.mean() / b.mean()),
            "worst_seed": float(by_seed.max()),
            "largest": float(a.max() / b.mean()),
            "over": int((a > MAX_RATIO * b).sum()),
            "courses": a.size,
        }
        rows.append(rounded(row, 3))
    return rows


NEVER_WORSE = [
    Goal({"case": BLACKOUT, "sensors": "reference", "seconds": length}, figure, "<=", limit)
    for length in LENGTHS_S
    for figure, limit in (("ratio", 1.0), ("worst_seed", MAX_RATIO))
]
HONEST = [
    Goal({"case": BLACKOUT, "sensors": "gyro", "profile": "default", "seconds": LENGTHS_S[-1]}, "median_m", "<=", 12.0),
    *(
        Goal(
            {"case": BLACKOUT, "sensors": sensors, "profile": "default", "seconds": LENGTHS_S[-1]},
            "coverage95",
            ">=",
            0.9,
        )
        for sensors in SENSORS
    ),
]
