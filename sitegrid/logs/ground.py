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
from sitegrid.proof.figures import Row, root_mean_square, rounded

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

    mean: weighted by metres driven; off: mean minus known; rms: of the samples' errors; std: rms of the standard
    deviations that they state. Samples count that lie inside by more than the standard deviation of their position.
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
    mean = float(np.average(values, weights=metres)) if metres.sum() else None
    figures = {
        "mean": mean,
        "off": mean - known if mean is not None else None,
        "rms": root_mean_square(values - known),
        "std": root_mean_square(np.sqrt(measured[variance].astype(float))),
    }
    counted = {"samples": len(measured), "metres": round(float(metres.sum()), 1)}
    return {"area": area, "figure": figure, "known": known, **rounded(figures, 4), **counted}
