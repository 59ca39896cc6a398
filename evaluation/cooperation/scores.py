"""Figures of one arm with one seed: its map over time and after rounds, of repaved ground, with one machine spoiled."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import cKDTree

from evaluation.campaign.experiment import Experiment, Task, read_result, replay_task
from evaluation.campaign.figures import Row
from evaluation.cooperation import live
from evaluation.cooperation.arms import BAD, Arm
from evaluation.cooperation.central import central_timeline
from evaluation.cooperation.drives import SharedDrive, length_m
from evaluation.cooperation.live import LiveRun
from evaluation.cooperation.maps import Layers, Timeline
from evaluation.cooperation.network import LAYERS, Network, figures, network
from evaluation.fleet.cases import GAIN, Rows, gain
from evaluation.fleet.drives import Scene, scene
from evaluation.fleet.solving import served
from evaluation.ground.truth import LoadTrack, true_ground
from evaluation.maps.methods import folded
from evaluation.maps.score import DrivenScore, region_of, score_driven, true_layers, window_of
from evaluation.paper.maps import with_true_values
from mapserver.change.change_log import KIND as CHANGE
from mapserver.trust.decisions import KIND as TRUST
from protocol.arrays import AnyArray, Bools, Floats, Ints
from protocol.site.ground_classes import UNKNOWN, resistance_class
from sim.scenario.ground import Point
from sim.simulator import START_NS

STEP_S = 15.0  # between two maps over time
AFTER_S = 30.0  # of a recording's end, when all its samples become final and are sent
SHARE_PCT = 90.0  # of the network's cells, or of those that were repaved
ROUNDS = (1, 2, 3, 4, 5, 6)  # of its tours, that every machine has driven
PASSES = 12  # over repaved ground that are looked at, at most
REACH_M = 1.0  # from a load centre: cells further off were not driven, and no map could know what became of them
NEAR_M = 6.0  # of repaved ground: a change that is listed there is no false alarm
CENTRAL = "central"


@dataclass(frozen=True)
class Judging:
    """An arm to be judged, as it ran, or as one process with a perfect link has it."""

    arm: Arm
    central: bool = False

    @property
    def name(self) -> str:
        """Short and unique."""
        return CENTRAL if self.central else self.arm.name


@dataclass(frozen=True)
class Scored:
    """Figures of one arm with one seed.

    minutes (t,): of the maps over time; by_stamp, by_arrival (t, FIGURES): of them. rounds: rows, one per round that
    all machines drove; `decided`: with what was decided about machines in the end. end: of the last map. repaved: a row
    per ground. spoiled: what the last machine costs the others. alarms: how often a change was listed where there was
    none, in so many km2 days. same_pct: of one process with a perfect link, its samples that the live agents sent too,
    bit for bit.
    """

    minutes: Floats
    by_stamp: Floats
    by_arrival: Floats
    rounds: list[Row]
    end: Row
    repaved: list[Row]
    spoiled: Row
    alarms: int
    km2_days: float
    same_pct: float | None = None


def minutes_until(minutes: Floats, values: Floats, limit: float) -> float:
    """When a figure (t,) was at a limit first, between two maps in proportion; NaN for never."""
    reached = np.flatnonzero(values >= limit)
    if not len(reached):
        return float("nan")
    i = int(reached[0])
    before, at = (float(values[i - 1]), float(minutes[i - 1])) if i else (0.0, 0.0)
    return at + (float(minutes[i]) - at) * (limit - before) / (float(values[i]) - before)


# --- in the worker processes -----------------------------------------------------------------------------------------


def _solve(task: Task[Judging], cache: Path) -> Scored:
    arm, seed = task.variant.arm, task.seed
    drive = arm.drive(seed)
    true = scene(drive, cache)
    names = arm.names(drive)
    cells = network(true_ground(drive.ground, seed), [true.tracks[name] for name in drive.machines])
    if drive.repaves:
        cells = cells.part(~np.any([inside(outline, cells.place_m) for outline in outlines(drive).values()], axis=0))
    window = window_of(true.truth)
    if task.variant.central:
        run, lines = None, [central_timeline(arm, seed, cache, arrived=arrived) for arrived in (False, True)]
        known_then = lines[0]
    else:
        run = _live(arm, drive, cache)
        lines = [Timeline.of_run(run, arrived=arrived) for arrived in (False, True)]
        known_then = Timeline.of_run(run, decided=True)
    steps_s = np.arange(STEP_S, arm.seconds + AFTER_S + 1e-9, STEP_S)
    times = [START_NS + round(second * 1e9) for second in steps_s]
    over_time = [
        np.array([list(figures(layers, cells).values()) for layers in line.maps(times, window)]) for line in lines
    ]
    (last,) = lines[0].maps([times[-1] + 10**12], window)
    at = [rounds_ns(true, drive, names, rounds) for rounds in ROUNDS]
    ends = [stamp for stamp in at if stamp is not None]
    after = [[figures(layers, cells) for layers in line.maps(ends, window)] for line in (lines[0], known_then)]
    alarms, area = (0, 0.0) if run is None else false_alarms(run, drive, last, arm.seconds)
    return Scored(
        minutes=steps_s / 60,
        by_stamp=over_time[0],
        by_arrival=over_time[1],
        rounds=[
            {"rounds": i + 1, "minutes": (stamp - START_NS) / 60e9, **then, "decided": later}
            for i, (stamp, then, later) in enumerate(zip(ends, *after, strict=True))
        ],
        end={
            **figures(last, cells),
            **driven_figures(last, true, names),
            "places_c_rr_pct": places_c_rr_pct(lines[0], true, names, cells),
        },
        repaved=repaved_rows(drive, lines[0], lines[1], true, names) if drive.repaves else [],
        spoiled=spoiled_costs(run, lines[0], last, true, names, arm) if run and arm.spoiled else {},
        alarms=alarms,
        km2_days=area,
        same_pct=same_pct(lines[0], _live(arm, drive, cache)) if task.variant.central else None,
    )


def same_pct(central: Timeline, run: LiveRun) -> float:
    """Share of the samples of one process that the live agents' samples are, bit for bit."""
    own, theirs = ({row.tobytes() for row in table} for table in (central.samples, run.samples))
    return 100.0 * len(own & theirs) / max(1, len(own))


def _live(arm: Arm, drive: SharedDrive, cache: Path) -> LiveRun:
    return read_result(LiveRun, live.EXPERIMENT.file(replay_task(arm, drive), cache))


def rounds_ns(true: Scene, drive: SharedDrive, names: Sequence[str], rounds: int) -> int | None:
    """When all of these machines had driven so many rounds of their tours; None where one did not."""
    stamps = []
    for name in names:
        track = true.tracks[name]
        if track.driven_m[-1] < (driven_m := rounds * length_m(drive.tours[name])):
            return None
        stamps.append(int(track.stamp_ns[np.searchsorted(track.driven_m, driven_m)]))
    return max(stamps)


def driven_figures(layers: Layers, true: Scene, names: Sequence[str]) -> Row:
    """J of the cells that these machines' load centres truly passed, and how many of them are known."""
    score = driven_score(layers, true, names)
    figures_of = (score.wrong_resistance_pct, score.wrong_grade_pct, score.known_pct)
    return dict(zip(("driven_wrong_pct", "driven_slope_wrong_pct", "driven_known_pct"), figures_of, strict=True))


def places_c_rr_pct(line: Timeline, true: Scene, names: Sequence[str], cells: Network) -> float:
    """`c_rr_pct` of a map of the same samples with true values: what comes of their places alone."""
    exact = {name: with_true_values(rows, true, name) for name, rows in line.by_machine(names).items()}
    return figures(folded(exact.items(), window_of(true.truth), LAYERS), cells)["c_rr_pct"]


def driven_score(layers: Mapping[str, AnyArray], true: Scene, names: Sequence[str]) -> DrivenScore:
    """A map against the truth, where these machines truly passed."""
    tracks = [true.tracks[name].place_m for name in names]
    return score_driven(region_of(true.truth, layers), true_layers(true.truth), tracks)


# --- ground that is repaved ------------------------------------------------------------------------------------------


def outlines(drive: SharedDrive) -> dict[str, tuple[Point, ...]]:
    """Ground that is repaved, by its name."""
    return {name: change.outline for name, change in drive.changes.items()}


def inside(outline: Sequence[Point], place_m: Floats, margin_m: float = 0.0) -> Bools:
    """Which places (n, 2) lie in an outline, or so near to it."""
    corners = np.array(outline, np.float32)
    off_m = [cv2.pointPolygonTest(corners, (x, y), measureDist=True) for x, y in place_m.tolist()]
    return np.array(off_m) >= -margin_m


def repaved_rows(
    drive: SharedDrive, line: Timeline, arrivals: Timeline, true: Scene, names: Sequence[str]
) -> list[Row]:
    """Of each ground that is repaved: after how many passes, and when, SHARE_PCT of its cells have the new class.

    Cells of the network that lie 2 m inside. A pass begins after the change, and counts as it leaves the ground.
    least_passes: when SHARE_PCT of the cells had been driven at all since the change.
    """
    tracks = [true.tracks[name] for name in names]
    before = network(true_ground(drive.ground, drive.seed), ())
    rows = []
    for name, change in drive.changes.items():
        changed_ns = START_NS + round(change.at_s * 1e9)
        cells = before.part(inside(change.outline, before.place_m, -2.0))
        new = resistance_class(true.truth.c_rr[cells.row, cells.column])
        cells, new = cells.part(new != resistance_class(cells.c_rr)), new[new != resistance_class(cells.c_rr)]
        by_machine = [passes(track, inside(change.outline, track.place_m), changed_ns) for track in tracks]
        ends = np.sort(np.concatenate(by_machine))[:PASSES]
        shown_then = (_classes(layers, cells) for layers in line.maps(ends.tolist(), window_of(true.truth)))
        shown_pct = [100.0 * float((classes == new).mean()) for classes in shown_then]
        reached_pct = [driven_pct(tracks, cells.place_m, changed_ns, end) for end in ends.tolist()]
        shown, reached = _first(shown_pct), _first(reached_pct)
        row: Row = {
            "ground": name,
            "cells": len(new),
            "passes": None if shown is None else shown + 1,
            "least_passes": None if reached is None else reached + 1,
            "minutes": None,
            "arrived_min": None,
        }
        if shown is not None:
            arrived_ns = int(arrivals.time_ns[arrivals.samples["stamp_ns"] <= ends[shown]].max())
            minutes = [(stamp - changed_ns) / 60e9 for stamp in (int(ends[shown]), arrived_ns)]
            row |= {"minutes": minutes[0], "arrived_min": minutes[1]}
        rows.append(row | {"by_pass_pct": shown_pct, "driven_by_pass_pct": reached_pct})
    return rows


def _first(shares_pct: Sequence[float]) -> int | None:
    return next((i for i, share in enumerate(shares_pct) if share >= SHARE_PCT), None)


def driven_pct(tracks: Iterable[LoadTrack], place_m: Floats, from_ns: int, to_ns: int) -> float:
    """Share of places (n, 2) that load centres came within REACH_M of between two stamps."""
    whole = np.concatenate([track.place_m[(track.stamp_ns > from_ns) & (track.stamp_ns <= to_ns)] for track in tracks])
    off_m, _ = cKDTree(whole[np.isfinite(whole[:, 0])]).query(place_m)
    return 100.0 * float((off_m <= REACH_M).mean())


def passes(track: LoadTrack, there: Bools, from_ns: int) -> Ints:
    """Stamps (k,) at which a machine left a ground that it had come to after a time; there (n,): when it was on it."""
    begins = np.flatnonzero(np.diff(there.astype(np.int8), prepend=0) > 0)
    ends = np.flatnonzero(np.diff(there.astype(np.int8), append=0) < 0)
    whole = (track.stamp_ns[begins] > from_ns) & (ends < len(there) - 1)
    return np.asarray(track.stamp_ns[ends[whole]], np.int64)


def _classes(layers: Layers, cells: Network) -> Ints:
    return resistance_class(layers["resistance"][cells.row, cells.column])


def false_alarms(run: LiveRun, drive: SharedDrive, last: Layers, seconds: float) -> tuple[int, float]:
    """Changes that the server lists where the ground did not change, and the known area times the time [km2 days]."""
    newest = {event["body"]["id"]: event["body"] for event in run.events if event["kind"] == CHANGE}
    centres = [((b[0] + b[2]) / 2, (b[1] + b[3]) / 2) for b in (body["bounds"] for body in newest.values())]
    true = [any(inside(each, np.array([at]), NEAR_M)[0] for each in outlines(drive).values()) for at in centres]
    known = int((resistance_class(last["resistance"]) != UNKNOWN).sum())
    return len(true) - sum(true), known * 1e-6 * seconds / 86400


# --- one machine that is not as the others ---------------------------------------------------------------------------


def spoiled_costs(run: LiveRun, line: Timeline, last: Layers, true: Scene, names: Sequence[str], arm: Arm) -> Row:
    """What the last machine costs the map of the others, in points of wrong cells where these drove.

    cost_pct: with true values, in the map as the server has it in the end; let_in_pct: had it not been excluded.
    estimated_cost_pct: with estimated values. excluded_min: when it was excluded.
    """
    *good, bad = names
    rows = line.by_machine(names)
    exact = {name: with_true_values(table, true, name) for name, table in rows.items()}
    if arm.spoiled == BAD:
        exact[bad]["applied_zero"] = exact[bad]["applied_scale"] = 0.0  # nothing was taken off true values
        exact |= gain({name: exact[name] for name in (good[0], bad)}, true, GAIN).rows
    window = window_of(true.truth)

    def wrong_pct(samples: Rows) -> float:
        return driven_score(folded(samples.items(), window), true, good).wrong_resistance_pct

    excluded = line.facts[-1][1].excluded
    alone = wrong_pct({name: exact[name] for name in good})
    shown = wrong_pct({name: exact[name] for name in names if name not in excluded})
    estimated = driven_score(last, true, good).wrong_resistance_pct
    estimated_alone = wrong_pct(served({name: rows[name] for name in good}))
    at_ns = [e["stamp_ns"] for e in run.events if e["kind"] == TRUST and e["body"]["machine"] == bad]
    return {
        "cost_pct": shown - alone,
        "let_in_pct": wrong_pct(exact) - alone,
        "estimated_cost_pct": estimated - estimated_alone,
        "excluded_min": (at_ns[0] - START_NS) / 60e9 if at_ns else None,
        "excluded": sorted(excluded),
    }


SOURCES = (
    *("agents", "mapserver", "protocol", "evaluation/fleet"),
    *(
        f"evaluation/cooperation/{part}.py"
        for part in ("arms", "central", "drives", "live", "maps", "network", "scores")
    ),
    *(f"evaluation/{part}.py" for part in ("ground/truth", "maps/methods", "maps/score", "paper/maps")),
)
EXPERIMENT = Experiment("cooperation-scores", Scored, SOURCES, _solve)
