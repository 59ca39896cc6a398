"""Figures of one arm and seed: map over time and by round, repaved ground, a spoiled machine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lab.calibration.cases import GAIN, Rows, gain
from lab.calibration.drives import Scene, scene
from lab.calibration.solving import served
from lab.campaign.experiment import Experiment, Task, read_result, replay_task
from lab.campaign.true_maps import region_of, true_layers, window_of
from lab.cooperation import live
from lab.cooperation.drives import BAD, Arm, SharedDrive, length_m
from lab.cooperation.live import LiveRun
from lab.cooperation.maps import Layers, Timeline, central_timeline
from lab.cooperation.network import LAYERS, Network, figures, network
from lab.cooperation.repaved import inside, outlines, repaved_rows
from lab.ground.truth import true_ground
from lab.maps.methods import folded
from lab.paper.maps import with_true_values
from mapserver.change.change_log import KIND as CHANGE
from mapserver.trust.decisions import KIND as TRUST
from protocol.arrays import AnyArray, Floats
from protocol.site.ground_classes import UNKNOWN, resistance_class
from sim.simulator import START_NS
from sitegrid.proof.figures import Row
from sitegrid.proof.map_score import DrivenScore, score_driven

STEP_S = 15.0  # between maps over time
AFTER_S = 30.0  # after a recording's end: all its samples are final and sent
ROUNDS = (1, 2, 3, 4, 5, 6)  # of tours, driven by every machine
NEAR_M = 6.0  # of repaved ground: changes listed within it are true
CENTRAL = "central"


@dataclass(frozen=True)
class Judging:
    """An arm to judge: as it ran, or as one process with a perfect link."""

    arm: Arm
    central: bool = False

    @property
    def name(self) -> str:
        """Short unique name."""
        return CENTRAL if self.central else self.arm.name


@dataclass(frozen=True)
class Scored:
    """Figures of one arm and seed.

    minutes (t,): times of the maps; by_stamp, by_arrival (t, FIGURES). rounds: a row per round that all machines drove;
    `decided`: with the final decisions. end: of the last map. repaved: a row per ground. spoiled: cost of the last
    machine to the others. alarms: false changes in km2_days. same_pct: central samples that live agents sent too, bit
    for bit.
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
    """First time at which a figure (t,) reached a limit, interpolated; NaN: never."""
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
    """Share of central samples that the live agents also sent, bit for bit."""
    own, theirs = ({row.tobytes() for row in table} for table in (central.samples, run.samples))
    return 100.0 * len(own & theirs) / max(1, len(own))


def _live(arm: Arm, drive: SharedDrive, cache: Path) -> LiveRun:
    return read_result(LiveRun, live.EXPERIMENT.file(replay_task(arm, drive), cache))


def rounds_ns(true: Scene, drive: SharedDrive, names: Sequence[str], rounds: int) -> int | None:
    """Time at which all machines had driven `rounds` of their tours; None if one did not."""
    stamps = []
    for name in names:
        track = true.tracks[name]
        if track.driven_m[-1] < (driven_m := rounds * length_m(drive.tours[name])):
            return None
        stamps.append(int(track.stamp_ns[np.searchsorted(track.driven_m, driven_m)]))
    return max(stamps)


def driven_figures(layers: Layers, true: Scene, names: Sequence[str]) -> Row:
    """J over the truly driven cells, and the share known."""
    score = driven_score(layers, true, names)
    figures_of = (score.wrong_resistance_pct, score.wrong_grade_pct, score.known_pct)
    return dict(zip(("driven_wrong_pct", "driven_slope_wrong_pct", "driven_known_pct"), figures_of, strict=True))


def places_c_rr_pct(line: Timeline, true: Scene, names: Sequence[str], cells: Network) -> float:
    """`c_rr_pct` of a map with true values at the samples' places: the effect of position alone."""
    exact = {name: with_true_values(rows, true, name) for name, rows in line.by_machine(names).items()}
    return figures(folded(exact.items(), window_of(true.truth), LAYERS), cells)["c_rr_pct"]


def driven_score(layers: Mapping[str, AnyArray], true: Scene, names: Sequence[str]) -> DrivenScore:
    """A map against the truth on truly driven cells."""
    tracks = [true.tracks[name].place_m for name in names]
    return score_driven(region_of(true.truth, layers), true_layers(true.truth), tracks)


# --- what was listed --------------------------------------------------------------------------------------------------


def false_alarms(run: LiveRun, drive: SharedDrive, last: Layers, seconds: float) -> tuple[int, float]:
    """Listed changes off repaved ground, and known area times time [km2 days]."""
    newest = {event["body"]["id"]: event["body"] for event in run.events if event["kind"] == CHANGE}
    centres = [((b[0] + b[2]) / 2, (b[1] + b[3]) / 2) for b in (body["bounds"] for body in newest.values())]
    true = [any(inside(each, np.array([at]), NEAR_M)[0] for each in outlines(drive).values()) for at in centres]
    known = int((resistance_class(last["resistance"]) != UNKNOWN).sum())
    return len(true) - sum(true), known * 1e-6 * seconds / 86400


# --- one machine that is not as the others ---------------------------------------------------------------------------


def spoiled_costs(run: LiveRun, line: Timeline, last: Layers, true: Scene, names: Sequence[str], arm: Arm) -> Row:
    """Cost of the last machine to the others' map, in points of wrong cells where they drove.

    cost_pct: true values, server's final decisions; let_in_pct: without exclusion. estimated_cost_pct: estimated
    values. excluded_min: time of exclusion.
    """
    *good, bad = names
    rows = line.by_machine(names)
    exact = {name: with_true_values(table, true, name) for name, table in rows.items()}
    if arm.spoiled == BAD:
        exact[bad]["applied_zero"] = exact[bad]["applied_scale"] = 0.0  # true values were not corrected
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


EXPERIMENT = Experiment("cooperation-scores", Scored, _solve)
