"""Each of two days on the other's map, against the same drives without a map."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from lab.campaign.experiment import Runner, replay_task
from lab.campaign.figures import judge
from lab.campaign.goals import goals
from lab.fedback.blackout import AT_S, INSIDE, Courses, courses_of, row_of
from lab.fedback.days import day
from lab.fedback.maps import GROWING, MAPS, READ_S, Rows, Scene, days_ago, lane_map
from lab.fedback.nodes import EXPERIMENT, Machine, Nodes
from lab.fedback.rerun import Course, Maps, placed_again, rerun
from protocol.arrays import Floats
from protocol.errors import ConfigError
from sitegrid.proof.figures import Report, Row, rounded

SETTLED_S = 60.0  # judged afterwards
SLOPED = ("mature", "lanes", "reshaped", "turned", "east2", "left3")  # maps of ground that undulates
REPEATED = ("loading", "haul", "two", "both", "crossings", "free")


@dataclass(frozen=True)
class FedbackCase:
    """A site of `days`, a map of `maps`, receivers in use.

    map `row`: each day on all earlier ones; `lost`: loss of GPS.
    """

    site: str
    map: str
    receivers: int = 2

    @property
    def name(self) -> str:
        """Name for people."""
        return f"{self.site}-{self.map}" + "-1gps" * (self.receivers == 1)


CASES = (
    *(FedbackCase("driven", name) for name in MAPS if name not in ("reshaped", "turned")),
    *(FedbackCase("slopes", name) for name in SLOPED),
    FedbackCase("haul", "lanes"),
    FedbackCase("driven", "mature", receivers=1),
    *(FedbackCase(site, "mature") for site in REPEATED),
    FedbackCase("driven", "row"),
    FedbackCase("driven", "lost"),
)
Drives = Mapping[str, Nodes]  # of one day, by machine
Figures = Mapping[str, Floats]  # by machine


def run(
    runner: Runner, seeds: Sequence[int], seconds: float, cases: Sequence[FedbackCase] = CASES
) -> tuple[Report, Courses]:
    """Record, localise once, rerun with each map; a row per case, and courses without GPS.

    Seeds are used in pairs.
    """
    pairs = list(pairwise(seeds))[::2]
    if not pairs:
        raise ConfigError("--seeds", "two days are compared: give 2 or more")
    turns = [turn for a, b in pairs for turn in ((a, b), (b, a))]
    days = _days(runner, cases, [seed for pair in pairs for seed in pair], seconds)
    rows: list[Row] = []
    courses: Courses = {}
    for case in cases:
        of_day = days[case.site, case.receivers]
        if case.map == "lost":
            courses = courses_of(runner, turns, seconds)
            rows += [row_of(after_s, courses) for after_s in AT_S]
            continue
        if case.map == "row":
            rows += _row_of_days(list(of_day.values()))
            continue
        judged = [figures_of_day(case, of_day[first], of_day[second], seconds) for first, second in turns]
        rows.append(_row(case, [figures for figures, _ in judged], [counts for _, counts in judged]))
    report = {"seeds": list(seeds), "seconds": seconds, "rows": rows, "goals": judge(goals("fedback"), rows)}
    return report, courses


def _days(
    runner: Runner, cases: Sequence[FedbackCase], seeds: Sequence[int], seconds: float
) -> Mapping[tuple[str, int], Mapping[int, Drives]]:
    """Drives by site and receivers, then seed."""
    drives = {(case.site, case.receivers, seed): day(case.site, seed, seconds) for case in cases for seed in seeds}
    keys = [(*key, name) for key, drive in drives.items() for name in drive.names]
    tasks = [replay_task(Machine(name, count), drives[site, count, seed]) for site, count, seed, name in keys]
    nodes: dict[tuple[str, int], dict[int, dict[str, Nodes]]] = {}
    for (site, count, seed, name), of_machine in zip(keys, runner.run(EXPERIMENT, tasks), strict=True):
        nodes.setdefault((site, count), {}).setdefault(seed, {})[name] = of_machine
    return nodes


def _rows(drives: Drives) -> Rows:
    return [(name, nodes.rows) for name, nodes in drives.items()]


def figures_of_day(case: FedbackCase, first: Drives, second: Drives, seconds: float) -> tuple[Figures, Counter[str]]:
    """The second day's figures by machine, with and without map; counts of windows.

    A growing map holds positions it aided; as many reruns as reads include them all.
    """
    rows, own, young = days_ago(_rows(first), 1), _rows(second), case.map in GROWING
    begin_ns = int(min(nodes.stamp_ns[0] for nodes in second.values()))
    without = {name: rerun(nodes, lambda _: None, aids=False) for name, nodes in second.items()}
    for _ in range(math.ceil(seconds / READ_S) if young else 1):
        maps_of = MAPS[case.map](Scene(rows, own, begin_ns, seconds))
        aided = {name: rerun(nodes, maps_of(name)) for name, nodes in second.items()}
        own = [(name, placed_again(nodes, without[name], aided[name])) for name, nodes in second.items()]
    figures = _compared(second, without, aided)
    return figures, sum((course.counts for course in aided.values()), Counter[str]())


def _compared(drives: Drives, without: Mapping[str, Course], aided: Mapping[str, Course]) -> Figures:
    columns = [
        {**_figures(nodes, without[name], "without_"), **_figures(nodes, aided[name])} for name, nodes in drives.items()
    ]
    return {key: np.array([column[key] for column in columns]) for key in columns[0]}


def _row_of_days(days: Sequence[Drives]) -> list[Row]:
    """Each day on the map of all earlier, themselves lane-aided days; a row per day from the second.

    offset_m: mean error of all machines of a day, the mode in which a map could drift.
    """
    known: list[tuple[str, Any]] = []
    out: list[Row] = []
    for number, drives in enumerate(days):
        lanes = lane_map(known) if known else None
        maps: Maps = lambda _, lanes=lanes: lanes  # type: ignore[misc] # noqa: E731
        without = {name: rerun(nodes, lambda _: None, aids=False) for name, nodes in drives.items()}
        aided = {name: rerun(nodes, maps) for name, nodes in drives.items()} if known else without
        figures = _compared(drives, without, aided)
        ratios = {
            f"{what}_ratio": float(np.sqrt(figures[f"{what}_m2"].mean() / figures[f"without_{what}_m2"].mean()))
            for what in ("live", "smoothed")
        }
        offsets = {
            name: float(np.hypot(*np.concatenate([course.smoothed_m for course in of_all.values()]).mean(axis=0)))
            for name, of_all in (("offset_m", aided), ("offset_without_m", without))
        }
        share = float(np.mean([course.shares.mean() for course in aided.values()]))
        if known:
            out.append(rounded({"case": f"day {number + 1}", **ratios, **offsets, "aid_share": share}, 2))
        rows = [(name, placed_again(nodes, without[name], aided[name])) for name, nodes in drives.items()]
        known += days_ago(rows, len(days) - number)
    return out


def _figures(nodes: Nodes, course: Course, named: str = "") -> dict[str, float]:
    """Mean squared errors [m2] and shares inside the 95 % ellipse, after settling."""
    settled = nodes.stamp_ns - nodes.stamp_ns[0] >= SETTLED_S * 1e9
    out: dict[str, float] = {}
    for what, off_m, P in (
        ("live", course.live_m, course.live_m2),
        ("smoothed", course.smoothed_m, course.smoothed_m2),
    ):
        e = off_m[settled]
        nees = np.einsum("ni,ni->n", e, np.linalg.solve(P[settled], e[:, :, None])[:, :, 0])
        out |= {
            f"{named}{what}_m2": float((e**2).sum(axis=1).mean()),
            f"{named}{what}_in": float((nees < INSIDE).mean()),
        }
    return out


def _row(case: FedbackCase, days: Sequence[Figures], counts: Sequence[Counter[str]]) -> Row:
    """Errors pooled over days and machines; ratios to no map: overall, 95th percentile, worst, by day."""
    row: Row = {"case": case.name, "days": len(days)}
    for what in ("live", "smoothed"):
        aided, without = (np.array([figures[f"{name}{what}_m2"] for figures in days]) for name in ("", "without_"))
        of_machines, inside = np.sqrt(aided / without).ravel(), [f"{name}{what}_in" for name in ("", "without_")]
        row |= {
            f"{what}_m": float(np.sqrt(aided.mean())),
            f"{what}_ratio": float(np.sqrt(aided.mean() / without.mean())),
            f"{what}_p95": float(np.percentile(of_machines, 95)),
            f"{what}_worst": float(of_machines.max()),
            f"{what}_ellipse_pct": 100 * float(np.mean([figures[inside[0]] for figures in days])),
            f"{what}_ellipse_without_pct": 100 * float(np.mean([figures[inside[1]] for figures in days])),
            f"{what}_by_day": np.sqrt(aided.mean(axis=1) / without.mean(axis=1)).round(2).tolist(),
        }
    return {**rounded(row, 2), "windows": dict(sum(counts, Counter[str]()))}
