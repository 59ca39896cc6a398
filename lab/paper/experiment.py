"""The paper's tables: positions by sensors, and wrong map cells, beside the published figures.

Maps are cached, their comparison is not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from lab.calibration import drives
from lab.calibration.drives import scene
from lab.campaign.experiment import Runner
from lab.campaign.figures import judge
from lab.campaign.goals import goals
from lab.campaign.recordings import PAPER, PlannedDrive
from lab.campaign.true_maps import pooled_by_border, region_of, true_layers
from lab.maps.uncertainty import Believed, coverage_pct, forecast_row, layers_forecast, pooled
from lab.paper import maps
from lab.paper.drives import QUICK, RECOMMENDED, MapSource, Plan
from lab.paper.maps import AS_TRUE, FORECASTS, KINDS, PAPERS, SERVED, MadeMaps, MapKind
from lab.paper.tensor import write_tensor
from lab.positions import experiment as positions
from lab.positions.configurations import Configuration
from lab.positions.experiment import Scores
from lab.positions.published import PLOTTING, POSITIONS, Published
from protocol.arrays import AnyArray, Bools, Floats, Floats32, Ints
from protocol.errors import SitegridError
from protocol.site.ground_classes import resistance_class
from sitegrid.logs.replay import Score
from sitegrid.proof.figures import Report, Row, half_width, rounded
from sitegrid.proof.map_score import driven_cells, score, score_driven

LEAST_S = 60.0  # of a recording: heading needs seconds, calibration needs repeated ground
PLACES = ("rmse_x_m", "rmse_y_m", "net_m")
# Of truly driven cells, and of all plotted ones, the paper's count.
DRIVEN = ("wrong_resistance_pct", "wrong_grade_pct", "known_pct", "cells")
PLOTTED = ("plotted_wrong_resistance_pct", "plotted_wrong_grade_pct", "plotted_cells")
WITH_INTERVAL = ("net_m", *DRIVEN[:2], *PLOTTED[:2])
DIGITS = 4

DEVIATIONS = {"resistance_std": ("resistance",), "grade_std": ("grade_east", "grade_north")}  # their layers


@dataclass(frozen=True)
class MapOutcome:
    """Maps of one source and seed."""

    source: MapSource
    drive: PlannedDrive
    made: MadeMaps


@dataclass(frozen=True)
class Outcomes:
    """Input of pictures and files."""

    plan: Plan
    positions: Scores
    maps: Sequence[MapOutcome]

    def all_of(self, source: MapSource) -> list[MapOutcome]:
        """Maps of a source by seed."""
        return [each for each in self.maps if each.source == source]


def run(runner: Runner, plan: Plan) -> tuple[Report, Outcomes]:
    """Record, replay, plot and judge; a row per configuration of either table. SitegridError for short drives."""
    if plan.seconds < LEAST_S:
        raise SitegridError(f"seconds: {plan.seconds:g} is too short; maps need drives of {LEAST_S:g} s or more")
    outcomes = Outcomes(plan, _positions(runner, plan), _maps(runner, plan))
    rows = [position_row(plan, each, runs) for each, runs in outcomes.positions.items()]
    for source in plan.sources:
        figures = {kind: [_figures(each, kind, runner) for each in outcomes.all_of(source)] for kind in KINDS}
        rows += [map_row(source, kind, of_kind, figures[AS_TRUE]) for kind, of_kind in figures.items()]
    fleets = [source for source in plan.sources if source.machines > 1]
    forecasts = [row for source in fleets for row in forecast_rows(source, outcomes, runner)]
    coverage = [row for source in fleets for row in coverage_rows(source, outcomes, runner)]
    lists = {"paper": rows, "paper_forecasts": forecasts, "paper_coverage": coverage}
    report: Report = {
        "seeds": list(plan.seeds),
        "seconds": plan.seconds,
        "gps_error": positions.gps_error(PlannedDrive(plan.seeds[0], plan.seconds, PAPER.preset, plan.setup)),
        "rows": rows,
        "forecasts": forecasts,
        "coverage": coverage,
        "goals": [] if plan == QUICK else [row for name, those in lists.items() for row in judge(goals(name), those)],
        "contradictions": contradictions(),
    }
    return report, outcomes


def write_map(outcomes: Outcomes, runner: Runner, path: Path) -> None:
    """Write the paper's map by its own method with its recommended sensors, first seed."""
    theirs = replace(RECOMMENDED, profile="paper")
    outcome = next(each for each in outcomes.maps if each.source.machines == 1 and each.source.configuration == theirs)
    write_tensor(path, outcome.made.layers_of(PAPERS), scene(outcome.drive, runner.cache).truth)


def _positions(runner: Runner, plan: Plan) -> Scores:
    """Tables 1 and 2, replayed as in `lab positions`."""
    planned = [PlannedDrive(seed, plan.seconds, PAPER.preset, plan.setup) for seed in plan.seeds]
    rows = [positions.as_recorded(row, planned[0]) for row in plan.positions]
    return positions.scored(runner, planned, rows)


def _maps(runner: Runner, plan: Plan) -> list[MapOutcome]:
    """Maps of Table 3 and of fleets."""
    pairs = [(source, seed) for seed in plan.seeds for source in plan.sources]
    runner.run(drives.EXPERIMENT, [task for source, seed in pairs for task in source.runs(seed, plan)])
    made = runner.run(maps.EXPERIMENT, [source.maps(seed, plan) for source, seed in pairs])
    return [
        MapOutcome(source, source.drive(seed, plan), each) for (source, seed), each in zip(pairs, made, strict=True)
    ]


# --- rows ------------------------------------------------------------------------------------------------------------


def position_row(plan: Plan, row: Configuration, runs: Sequence[Score]) -> Row:
    """Row of Tables 1 and 2: means over seeds."""
    figures = [{name: getattr(run, name) for name in (*PLACES, "us_per_second")} for run in runs]
    named = {"table": "positions", "scenario": plan.setup.scenario, "preset": PAPER.preset, **_sensors(row)}
    nothing = dict.fromkeys(("values", "calibration", "merge"))
    return _row({**named, **nothing, "machines": 1}, figures, POSITIONS.get(row.group))


def map_row(source: MapSource, kind: MapKind, figures: Sequence[Row], true_figures: Sequence[Row]) -> Row:
    """Row of Table 3: means over seeds. true_figures: the same samples with true bias and scale."""
    named = {"table": "maps", "scenario": source.scenario, "preset": source.preset, **_sensors(source.configuration)}
    published = PLOTTING.get(source.configuration.group) if source.machines == 1 else None
    row = _row({**named, **vars(kind), "machines": source.machines}, figures, published)
    if kind == SERVED:
        pairs = zip(figures, true_figures, strict=True)
        above = [ours[DRIVEN[0]] - true[DRIVEN[0]] for ours, true in pairs]
        row["above_true_pct"] = round(max(0.0, float(np.mean(above))), DIGITS)
    row["by_border"] = rounded(pooled_by_border([each["by_border"] for each in figures]), DIGITS)
    return row


def _sensors(row: Configuration) -> Row:
    return {"filter": row.filter, "gps": row.gps, "imu": row.imu, "profile": row.profile}


def _row(named: Row, figures: Sequence[Row], published: Published | None) -> Row:
    """Means over seeds, interval half-widths, published figures; None if missing."""
    by_seed: dict[str, Floats] = {
        name: np.array([each[name] for each in figures], float)
        for name in (*PLACES, *DRIVEN, *PLOTTED, "us_per_second")
        if name in figures[0]
    }
    means = {name: float(by_seed[name].mean()) if name in by_seed else None for name in (*PLACES, *DRIVEN, *PLOTTED)}
    cost = round(float(by_seed["us_per_second"].mean())) if "us_per_second" in by_seed else None
    row = {
        **named,
        **means,
        "us_per_second": cost,
        "above_true_pct": None,
        "ci95": {name: half_width(by_seed[name]) for name in WITH_INTERVAL if name in by_seed},
        "paper": asdict(published) if published else None,
        "by_border": [],
        "by_seed": {name: by_seed[name].tolist() for name in WITH_INTERVAL if name in by_seed},
    }
    return rounded(row, DIGITS)


def _figures(outcome: MapOutcome, kind: MapKind, runner: Runner) -> Row:
    """Figures of one map and seed, with its samples' position errors."""
    true = scene(outcome.drive, runner.cache)
    region, truth = region_of(true.truth, outcome.made.layers_of(kind)), true_layers(true.truth)
    driven = score_driven(region, truth, [track.place_m for track in true.tracks.values()])
    everywhere = score(region, truth)
    east, north = outcome.made.errors_m(kind)
    return {
        **dict(zip(PLACES, (east, north, float(np.hypot(east, north))), strict=True)),
        **asdict(driven),
        **{f"plotted_{name}": value for name, value in asdict(everywhere).items()},
    }


# --- how far maps are believed ---------------------------------------------------------------------------------------


def forecast_rows(source: MapSource, outcomes: Outcomes, runner: Runner) -> list[Row]:
    """Class probabilities of the server and of others on the same samples, over truly driven cells."""
    believed: dict[str, list[Believed]] = {name: [] for name in (SERVED.merge, *FORECASTS)}
    for outcome in outcomes.all_of(source):
        true, made = _driven(outcome, runner), outcome.made
        said = {
            SERVED.merge: layers_forecast(made.layers_of(SERVED)),
            **{name: made.forecast(name) for name in FORECASTS},
        }
        for name, forecast in said.items():
            believed[name].append(forecast.judged(true.kind, true.driven))
    return [forecast_row({**_of(source), "method": name}, pooled(parts)) for name, parts in believed.items()]


def coverage_rows(source: MapSource, outcomes: Outcomes, runner: Runner) -> list[Row]:
    """Share of errors in the 95 % interval stated by the server, over driven cells."""
    errors: dict[str, list[AnyArray]] = {name: [] for name in DEVIATIONS}
    stated: dict[str, list[AnyArray]] = {name: [] for name in DEVIATIONS}
    for outcome in outcomes.all_of(source):
        true, layers = _driven(outcome, runner), outcome.made.layers_of(SERVED)
        for deviation, of_layers in DEVIATIONS.items():
            for name in of_layers:
                errors[deviation].append((layers[name] - true.layers[name])[true.driven])
                stated[deviation].append(layers[deviation][true.driven])
    return [
        {**_of(source), "layer": name, "coverage_pct": round(coverage_pct(*map(np.concatenate, pair)), DIGITS)}
        for name, pair in {name: (errors[name], stated[name]) for name in DEVIATIONS}.items()
    ]


@dataclass(frozen=True)
class TrueCells:
    """Truth by cell (rows, columns): layers, class, whether a load centre passed."""

    layers: Mapping[str, Floats32]
    kind: Ints
    driven: Bools


def _driven(outcome: MapOutcome, runner: Runner) -> TrueCells:
    true = scene(outcome.drive, runner.cache)
    layers = true_layers(true.truth)
    passed = driven_cells(region_of(true.truth, {}), [track.place_m for track in true.tracks.values()])
    return TrueCells(layers, resistance_class(layers["resistance"]), passed)


def _of(source: MapSource) -> Row:
    return {"scenario": source.scenario, "preset": source.preset, "machines": source.machines}


# --- where the paper does not fit together ---------------------------------------------------------------------------


def contradictions() -> list[Row]:
    """Rows of the paper whose net error contradicts x and y."""
    tables = (("Tables 1 and 2", POSITIONS), ("Table 3", PLOTTING))
    return [
        {
            "where": where,
            "group": f"{group[0].upper()} {group[1]} GPS {group[2]} IMU",
            "net_m": published.net_m,
            "net_of_parts_m": round(published.net_of_parts_m, DIGITS),
        }
        for where, groups in tables
        for group, published in groups.items()
        if not published.is_consistent
    ]
