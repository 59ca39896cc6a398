"""A recording's ground against areas of known ground.

The site's known ground is hidden here, else the machine would calibrate on its own reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from agents.localisation.localiser import LocalisationConfig
from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from protocol.arrays import Table
from protocol.machine.log_folder import LogFolder
from protocol.machine.readings import Reading
from protocol.machine.samples import joined
from sitegrid.logs.log_truth import KnownArea
from sitegrid.logs.replay import spans
from sitegrid.proof.figures import Row, half_width, root_mean_square, rounded

AWAY_NS = 5 * 10**9  # without samples inside, the next one starts a new pass
# Compared sample columns, and their variances.
FIGURES = {
    "c_rr": ("c_rr", "c_rr_var"),
    "grade_east": ("grade_e", "grade_var"),
    "grade_north": ("grade_n", "grade_var"),
}


def samples_of(log: LogFolder, options: LocalisationConfig, readings: Sequence[Reading]) -> Table:
    """Samples as the machine's agent would send them, at smoothed places."""
    config = PipelineConfig(localisation=options)
    pipeline = Pipeline(replace(log.site, known_ground=()), log.machine, config)
    return joined([*(pipeline.step(span).final for span in spans(readings)), pipeline.finish().final])


def compare(samples: Table, areas: Sequence[KnownArea]) -> list[Row]:
    """One row per area and known figure.

    mean: weighted by distance. off: mean minus known. spread: samples' standard deviation. mean_95: half the mean's 95
    % interval from the scatter of passes, None for one pass. rms: of sample errors. std: rms of stated standard
    deviations. Samples count if inside by more than their position's standard deviation.
    """
    rows = []
    for area in areas:
        inside = samples[[_is_inside(area, sample) for sample in samples]]
        known = {name: getattr(area, name) for name in FIGURES}
        rows += [_row(area.name, name, value, inside) for name, value in known.items() if value is not None]
    return rows


def _is_inside(area: KnownArea, sample: Table) -> bool:
    std_m = float(np.sqrt(max(sample["cov_xx_m2"], sample["cov_yy_m2"])))
    return area.inside_m(float(sample["x_m"]), float(sample["y_m"])) > std_m


def _row(area: str, figure: str, known: float, inside: Table) -> Row:
    column, variance = FIGURES[figure]
    measured = inside[np.isfinite(inside[column])]
    values, metres = measured[column].astype(float), measured["distance_m"].astype(float)
    passes = np.split(np.arange(len(measured)), np.flatnonzero(np.diff(measured["stamp_ns"]) > AWAY_NS) + 1)
    passes = [one for one in passes if metres[one].sum()]
    mean = float(np.average(values, weights=metres)) if metres.sum() else None
    figures = {
        "mean": mean,
        "off": mean - known if mean is not None else None,
        "spread": float(values.std()) if len(values) else None,
        "mean_95": half_width(np.array([np.average(values[one], weights=metres[one]) for one in passes])),
        "rms": root_mean_square(values - known),
        "std": root_mean_square(np.sqrt(measured[variance].astype(float))),
    }
    counted = {"samples": len(measured), "passes": len(passes), "metres": round(float(metres.sum()), 1)}
    return {"area": area, "figure": figure, "known": known, **rounded(figures, 4), **counted}
