"""The ground that a recording shows, against areas where it is known.

The machine is not told the site's known ground here: it would calibrate itself on what it is compared with.
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

AWAY_NS = 5 * 10**9  # without a sample inside: the next one begins another pass
# What is compared: the columns of a sample, and of its variance.
FIGURES = {
    "c_rr": ("c_rr", "c_rr_var"),
    "grade_east": ("grade_e", "grade_var"),
    "grade_north": ("grade_n", "grade_var"),
}


def samples_of(log: LogFolder, options: LocalisationConfig, readings: Sequence[Reading]) -> Table:
    """The samples that the machine's agent would have sent, at their smoothed places."""
    config = PipelineConfig(localisation=options)
    pipeline = Pipeline(replace(log.site, known_ground=()), log.machine, config)
    return joined([*(pipeline.step(span).final for span in spans(readings)), pipeline.finish().final])


def compare(samples: Table, areas: Sequence[KnownArea]) -> list[Row]:
    """A row per area and figure that is known of it.

    mean: weighted by metres driven; off: mean minus known; spread: standard deviation of the samples; mean_95: half
    the 95 % interval of the mean, by how far single passes are apart, None of one pass; rms: of the samples' errors;
    std: rms of the standard deviations that they state. Samples count that lie inside by more than the standard
    deviation of their position.
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
