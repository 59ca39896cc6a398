"""Maps of one recording: the paper's plotter and our merge, with true and estimated values.

Samples come from whole pipelines. A plotter draws at once, so `last_write` uses real-time positions; a map server uses
smoothed ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lab.calibration import drives
from lab.calibration.cases import Rows, Tampered, cells, truth_places
from lab.calibration.drives import Agent, AgentSamples, Scene, scene
from lab.calibration.solving import as_correction, served, true_errors
from lab.campaign.experiment import Experiment, Task, read_result, replay_task
from lab.campaign.recordings import PlannedDrive
from lab.campaign.true_maps import window_of
from lab.maps.methods import SERVER_LAYERS, Layers, folded, hits_of, in_order, last_write, merge_hard
from lab.maps.uncertainty import Forecast, by_frequency, by_mean
from mapserver.calibration.correction import corrected
from protocol.arrays import Bools, Floats, Floats32, Table
from sim.truth import TruthMap
from sitegrid.proof.figures import root_mean_square

PLOTTED = ("resistance", "grade_east", "grade_north")  # layers of `last_write`
LAYERS = (*SERVER_LAYERS, "resistance_class", "resistance_std", "grade_std")
TRUE_STD = 1e-4  # stated for true values
FORECASTS = {"last_write": by_frequency, "mean": by_mean}  # besides the server's


@dataclass(frozen=True)
class MapKind:
    """How a map is made of samples.

    values: "oracle": true ones at the true place, or "estimated". calibration: of estimated values, "none": as sent,
    "server": as corrected by the map server, "truth": true errors removed. merge: "last_write" or "soft_votes".
    """

    values: str
    calibration: str | None
    merge: str

    @property
    def is_live(self) -> bool:
        """Whether real-time positions are used instead of smoothed ones."""
        return self.merge == "last_write"


PAPERS = MapKind("oracle", None, "last_write")  # the paper's plotter
PLOTTED_ESTIMATES = MapKind("estimated", "none", "last_write")
OURS = MapKind("oracle", None, "soft_votes")
SERVED = MapKind("estimated", "server", "soft_votes")  # the map server's
AS_SENT, AS_TRUE = (MapKind("estimated", calibration, "soft_votes") for calibration in ("none", "truth"))
KINDS = (PAPERS, PLOTTED_ESTIMATES, OURS, AS_SENT, SERVED, AS_TRUE)


@dataclass(frozen=True)
class Fleet:
    """Agents of one recording whose samples make a map."""

    agents: tuple[Agent, ...]

    @property
    def name(self) -> str:
        """Short unique name."""
        return "+".join(agent.name for agent in self.agents)


@dataclass(frozen=True)
class MadeMaps:
    """Maps of one recording. layers: (KINDS, LAYERS, rows, columns), NaN unknown.

    forecasts: (FORECASTS, 2, rows, columns), class and confidence of others on the server's samples. rmse_m: (2, 2),
    position RMSE east and north, real-time and smoothed. samples: number.
    """

    layers: Floats32
    forecasts: Floats32
    rmse_m: Floats
    samples: int

    def layers_of(self, kind: MapKind) -> dict[str, Floats32]:
        """Layers of one map."""
        return dict(zip(LAYERS, self.layers[KINDS.index(kind)], strict=True))

    def forecast(self, method: str) -> Forecast:
        """A method's class and confidence by cell."""
        kind, confidence = self.forecasts[list(FORECASTS).index(method)].astype(np.float64)
        return Forecast(kind.astype(np.int64), confidence)

    def errors_m(self, kind: MapKind) -> tuple[float, float]:
        """Position RMSE of its samples, east and north."""
        east, north = self.rmse_m[0 if kind.is_live else 1].tolist()
        return east, north


def with_true_values(rows: Table, true: Scene, name: str) -> Table:
    """Samples with the true map's values at the true place; unplaced ones are dropped."""
    known: Bools = np.isfinite(true.tracks[name].at(rows["stamp_ns"]).place_m[:, 0])
    rows = rows[known].copy()
    at, truth = cells(truth_places(rows, true, name), true), true.truth
    rows["c_rr"], rows["grade_e"], rows["grade_n"] = truth.c_rr[at], truth.grade_east[at], truth.grade_north[at]
    rows["c_rr_var"] = rows["grade_var"] = TRUE_STD**2
    return rows


def plotted(rows: Mapping[str, Table], truth: TruthMap) -> Layers:
    """The paper's plotter: the last value per cell."""
    return merge_hard(last_write, in_order(rows.values()), PLOTTED, window_of(truth))


def make_maps(live: Rows, final: Rows, true: Scene) -> MadeMaps:
    """All maps of some machines' samples, real-time and final."""
    truth, corrected_by_server = true.truth, served(final)
    data = Tampered(final, truth.c_rr)
    samples: dict[MapKind, Rows] = {
        PAPERS: {name: with_true_values(rows, true, name) for name, rows in live.items()},
        PLOTTED_ESTIMATES: live,
        OURS: {name: with_true_values(rows, true, name) for name, rows in final.items()},
        AS_SENT: {name: final[name] for name in corrected_by_server},
        SERVED: corrected_by_server,
        AS_TRUE: {name: _by_truth(final[name], name, data, true) for name in corrected_by_server},
    }
    out: Floats32 = np.full((len(KINDS), len(LAYERS), *truth.c_rr.shape), np.nan, np.float32)
    for kind, rows in samples.items():
        made = plotted(rows, truth) if kind.is_live else folded(rows.items(), window_of(truth), LAYERS)
        for layer, values in made.items():
            out[KINDS.index(kind), LAYERS.index(layer)] = values
    hits = hits_of(in_order(samples[SERVED].values()), "resistance", window_of(truth))
    said = [method(hits) for method in FORECASTS.values()]
    forecasts = np.array([[each.kind, each.confidence] for each in said], np.float32)
    errors_m = np.array([rmse_m(rows, true) for rows in (live, final)])
    return MadeMaps(out, forecasts.reshape(-1, 2, *truth.c_rr.shape), errors_m, sum(map(len, final.values())))


def _by_truth(rows: Table, name: str, data: Tampered, true: Scene) -> Table:
    """Samples with the true errors removed."""
    return corrected(rows, [as_correction(name, error) for error in true_errors(data, name, true, 1)])


def rmse_m(rows: Rows, true: Scene) -> tuple[float, float]:
    """Position RMSE, east and north, where the truth is known."""
    off_m = np.concatenate([_off_m(table, true, name) for name, table in rows.items()])
    known = off_m[np.isfinite(off_m).all(axis=1)]
    return root_mean_square(known[:, 0]), root_mean_square(known[:, 1])


def _off_m(rows: Table, true: Scene, name: str) -> Floats:
    """Position errors (n, 2), east and north."""
    return np.asarray(np.stack([rows["x_m"], rows["y_m"]], axis=1) - true.tracks[name].at(rows["stamp_ns"]).place_m)


# --- in the worker processes -----------------------------------------------------------------------------------------


def _solve(task: Task[Fleet], cache: Path) -> MadeMaps:
    """Maps of one recording whose agents have run."""
    assert task.drive
    true = scene(task.drive, cache)
    names = sorted(true.tracks)
    made = {names[agent.index]: samples_of(agent, task.drive, cache) for agent in task.variant.agents}
    return make_maps(
        {name: each.live for name, each in made.items()}, {name: each.samples for name, each in made.items()}, true
    )


def samples_of(agent: Agent, drive: PlannedDrive, cache: Path) -> AgentSamples:
    """Cached samples of an agent."""
    return read_result(AgentSamples, drives.EXPERIMENT.file(replay_task(agent, drive), cache))


EXPERIMENT = Experiment("paper", MadeMaps, _solve)
