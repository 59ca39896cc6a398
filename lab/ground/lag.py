"""What the smoother's lag gives the map: four loaders at work, the same readings with and without it.

Every machine's whole pipeline runs in this process; its final samples go through the map server's own trust, fold and
read. So a map of minutes of real processes takes seconds, and all rows have the very same readings. In the last row the
samples lie where they truly were made: no lag can give more.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from agents.localisation.localiser import LocalisationConfig
from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from agents.sampling import Samples, joined
from lab.campaign.experiment import Experiment, Runner, Task, replay_task
from lab.campaign.recordings import PlannedDrive, Setup
from lab.maps.methods import soft_votes
from lab.maps.samples import Delivery
from protocol.arrays import Bools, Floats, Floats32, Table
from protocol.machine.log_folder import open_log
from protocol.machine.readings import Reading
from protocol.queries.answers import Region
from sim.recorder import TRACKS_FOLDER
from sim.truth import MAP_FILE, TruthMap
from sitegrid.proof.figures import Goal, Report, Row, half_width, judge, root_mean_square, rounded
from sitegrid.proof.map_score import pooled_by_border, region_of, score_driven, true_layers, window_of
from sitegrid.proof.tracks import LoadTrack, read_load_track

LOADERS = Setup("loading", ("west", "east", "middle", "yard"), gps=(1, 2), imu=(3,), preset="dgps")
LAGS_S = (0.0, LocalisationConfig().lag_s)
CHUNK = 5000  # readings that a pipeline gets at a time
BATCH_ROWS = 100  # samples that a machine sends at a time
SOURCES = (
    *("agents", "mapserver", "protocol"),
    *(f"lab/{part}.py" for part in ("ground/lag", "ground/truth", "maps/methods", "maps/score")),
)
TRUE_STD_M = 0.05  # stated of true places
GOALS = (Goal({"lag_s": LAGS_S[1]}, "fall_pct", ">=", 15.0),)
FIGURES = ("samples", "cells", "known_pct", "wrong_resistance_pct", "wrong_grade_pct", "place_off_m")
DIGITS = 3


@dataclass(frozen=True)
class FleetDrive(PlannedDrive):
    """All machines of a scenario on one ground, as its file has them."""

    @property
    def scenario_toml(self) -> str:
        """The scenario file of this drive."""
        world = f'\nworld = "{self.setup.world}"' if self.setup.world else ""
        return f'base = "{self.setup.scenario}"{world}\n'


@dataclass(frozen=True)
class LagConfiguration:
    """What one row compares. lag_s: None for true places."""

    lag_s: float | None

    @property
    def name(self) -> str:
        """Short and unique."""
        return "true-places" if self.lag_s is None else f"lag{self.lag_s:g}"

    @property
    def options(self) -> PipelineConfig:
        """The agent's."""
        return PipelineConfig(LocalisationConfig(lag_s=self.lag_s or 0.0))


@dataclass(frozen=True)
class LagResult:
    """A map of one drive. cells: that load centres passed; known, wrong: percent of them, of those that are known.

    place_off_m: root mean square distance of samples from where the load centre was at their stamps. by_border: as
    `sitegrid.proof.map_score.by_border_distance`.
    """

    samples: int
    cells: int
    known_pct: float
    wrong_resistance_pct: float
    wrong_grade_pct: float
    place_off_m: float
    by_border: list[Row]


def run(
    runner: Runner, seeds: Sequence[int], seconds: float, setup: Setup = LOADERS, lags_s: Sequence[float] = LAGS_S
) -> tuple[Report, list[LagResult]]:
    """Record, smooth and merge with all seeds; a row per lag, the first one being what the others are compared with."""
    rows = [LagConfiguration(lag_s) for lag_s in (*lags_s, None)]
    pairs = [(FleetDrive(seed, seconds, setup.preset, setup), row) for seed in seeds for row in rows]
    results = runner.run(EXPERIMENT, [replay_task(row, drive) for drive, row in pairs])
    by_row = {row: [r for (_, other), r in zip(pairs, results, strict=True) if other == row] for row in rows}
    table = [summarise(row, of_row, by_row[rows[0]]) for row, of_row in by_row.items()]
    drives = {"scenario": setup.scenario, "seeds": list(seeds), "seconds": seconds}
    return {**drives, "rows": table, "goals": judge(GOALS, table)}, results


def summarise(row: LagConfiguration, results: Sequence[LagResult], first: Sequence[LagResult]) -> Row:
    """Means over the seeds. fall_pct: of wrong cells, against the first row on the same readings, seed by seed."""
    wrong, before = (np.array([r.wrong_resistance_pct for r in each]) for each in (results, first))
    fall = 100.0 * (1.0 - wrong / np.where(before > 0, before, np.nan))
    known = fall[np.isfinite(fall)]
    return rounded(
        {
            "lag_s": row.lag_s,
            **{name: float(np.mean([getattr(r, name) for r in results])) for name in FIGURES},
            "wrong_ci95": half_width(wrong),
            "fall_pct": float(known.mean()) if len(known) else math.nan,
            "fall_ci95": half_width(known),
            "wrong_by_seed_pct": wrong.tolist(),
            "fall_by_seed_pct": fall.tolist(),
            "by_border": pooled_by_border([r.by_border for r in results]),
        },
        DIGITS,
    )


# --- in the worker processes -----------------------------------------------------------------------------------------


def _solve(task: Task[LagConfiguration], cache: Path) -> LagResult:
    """Run the pipelines of all machines, and merge their samples."""
    assert task.drive
    folder = task.drive.folder(cache)
    tracks: list[LoadTrack] = []
    deliveries: list[Delivery] = []
    off_m: list[Floats] = []
    for logs in sorted(path for path in (folder / "logs").iterdir() if path.is_dir()):
        log = open_log(logs)
        rows = all_samples(Pipeline(log.site, log.machine, task.variant.options), tuple(log.readings())).final
        track = read_load_track(folder / "truth" / TRACKS_FOLDER / f"{logs.name}.csv", log.machine.load_centre_m)
        if task.variant.lag_s is None:
            rows = at_places(rows, track.at(rows["stamp_ns"]).place_m)
        off_m.append(distance_m(rows, track))
        tracks.append(track)
        deliveries += batches(logs.name, rows)
    region, truth = merged(deliveries, TruthMap.load(folder / "truth" / MAP_FILE))
    score = asdict(score_driven(region, truth, [track.place_m for track in tracks]))
    off = np.concatenate(off_m)
    return LagResult(samples=len(off), place_off_m=root_mean_square(off[np.isfinite(off)]), **score)


def all_samples(pipeline: Pipeline, readings: Sequence[Reading]) -> Samples:
    """All samples that a pipeline makes of readings, as they were known at once, and the same ones final."""
    made = [pipeline.step(readings[i : i + CHUNK]) for i in range(0, len(readings), CHUNK)]
    return joined([*made, pipeline.finish()])


def distance_m(rows: Table, track: LoadTrack) -> Floats:
    """How far samples (n,) are from where the load centre was, NaN where that is not known."""
    off_m: Floats = np.hypot(*(track.at(rows["stamp_ns"]).place_m - np.stack([rows["x_m"], rows["y_m"]], axis=-1)).T)
    return off_m


def at_places(rows: Table, place_m: Floats) -> Table:
    """The samples at other places (n, 2), of which they are sure; those whose place is not known are left away."""
    known: Bools = np.isfinite(place_m[:, 0])
    rows = rows.copy()
    rows["x_m"], rows["y_m"] = np.where(known[:, None], place_m, 0.0).T
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = TRUE_STD_M**2
    rows["cov_xy_m2"] = 0.0
    return rows[known]


def batches(machine: str, rows: Table) -> Iterator[Delivery]:
    """What a machine sends at a time."""
    for first in range(0, len(rows), BATCH_ROWS):
        batch = rows[first : first + BATCH_ROWS]
        yield Delivery(machine, batch, int(batch["stamp_ns"].max()))


def merged(deliveries: Sequence[Delivery], truth: TruthMap) -> tuple[Region, dict[str, Floats32]]:
    """The server's map of samples on the cells of a true map, and the true layers."""
    layers, _ = soft_votes(sorted(deliveries, key=lambda delivery: delivery.received_ns), window_of(truth))
    return region_of(truth, layers), true_layers(truth)


EXPERIMENT = Experiment("lag", LagResult, SOURCES, _solve)
