"""The second day on the map of the first, both ways round, against the same drives without a map."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from lab.campaign.experiment import Experiment, Runner, Task, replay_task
from lab.fedback.days import day
from lab.fedback.maps import GROWING, MAPS, Scene
from lab.fedback.nodes import Nodes, watch
from lab.fedback.rerun import Course, rerun
from protocol.arrays import Floats
from protocol.errors import ConfigError
from sitegrid.proof.figures import Report, Row, rounded

SETTLED_S = 60.0  # judged is what comes after
INSIDE = 5.991  # normalised error squared of the 95 % ellipse
REPEATED = ("loading", "haul", "two", "both", "crossings", "free")


@dataclass(frozen=True)
class FedbackCase:
    """A site of `days`, and a map of `maps`."""

    site: str
    map: str

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.site}-{self.map}"


CASES = (*(FedbackCase("driven", name) for name in MAPS), *(FedbackCase(site, "mature") for site in REPEATED))


@dataclass(frozen=True)
class Machine:
    """One machine of a day."""

    name: str


def solve(task: Task[Machine], cache: Path) -> Nodes:
    """The nodes of one machine's drive."""
    assert task.drive
    return watch(task.drive.folder(cache), task.variant.name)


EXPERIMENT = Experiment("fedback", Nodes, solve)


def run(
    runner: Runner, seeds: Sequence[int], seconds: float, cases: Sequence[FedbackCase] = CASES
) -> tuple[Report, None]:
    """Record, localise once, and filter again with each map; a row per case. Seeds count in pairs."""
    pairs = list(pairwise(seeds))[::2]
    if not pairs:
        raise ConfigError("--seeds", "two days are compared: give 2 or more")
    days = {(case.site, seed): day(case.site, seed, seconds) for case in cases for pair in pairs for seed in pair}
    tasks = {(key, name): replay_task(Machine(name), drive) for key, drive in days.items() for name in drive.names}
    nodes = dict(zip(tasks, runner.run(EXPERIMENT, list(tasks.values())), strict=True))
    of_day = {key: {name: nodes[key, name] for name in drive.names} for key, drive in days.items()}
    rows = []
    for case in cases:
        turns = [turn for a, b in pairs for turn in ((a, b), (b, a))]
        judged = [_day(case, of_day[case.site, first], of_day[case.site, second], seconds) for first, second in turns]
        rows.append(_row(case, [figures for figures, _ in judged], [counts for _, counts in judged]))
    return {"seeds": list(seeds), "seconds": seconds, "rows": rows}, None


Figures = Mapping[str, Floats]  # by machine


def _day(
    case: FedbackCase, first: Mapping[str, Nodes], second: Mapping[str, Nodes], seconds: float
) -> tuple[Figures, Counter[str]]:
    """Figures of the machines of the second day, with the map and without, and what became of windows."""
    rows, own = ([(name, nodes.rows) for name, nodes in machines.items()] for machines in (first, second))
    scene = Scene(rows, own, int(min(nodes.stamp_ns[0] for nodes in second.values())), seconds)
    maps_of, young = MAPS[case.map](scene), case.map in GROWING
    columns, counts = [], Counter[str]()
    for name, nodes in second.items():
        without = rerun(nodes, lambda _: None, aids=False)
        aided = rerun(nodes, maps_of(name), young=young)
        columns.append({**_figures(nodes, without, "without_"), **_figures(nodes, aided)})
        counts += aided.counts
    return {key: np.array([column[key] for column in columns]) for key in columns[0]}, counts


def _figures(nodes: Nodes, course: Course, named: str = "") -> dict[str, float]:
    """Mean squared errors [m2] and shares inside the 95 % ellipse, once the filter has settled."""
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
    """Errors pooled over days and machines; ratios to those without a map: of all, 95th percentile, worst, by day."""
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
