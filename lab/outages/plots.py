"""Pictures of positions without GPS: errors over the time since it was lost."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lab.campaign import pictures
from lab.campaign.experiment import Runner
from lab.campaign.pictures import head
from lab.outages.blackouts import Outcome
from lab.outages.replays import GAP_S, JUMPS, SENSORS
from lab.positions.plots import COLOUR, RADIUS_95
from protocol.arrays import Floats
from sitegrid.proof.figures import Report

NAMES = {"reference": "with the attitude reference", "gyro": "one gyro and wheels alone"}


def draw(report: Report, outcomes: Sequence[Outcome], runner: Runner, folder: Path) -> list[Path]:  # noqa: ARG001
    """Draw a picture per case into a folder; returns their paths."""
    cases = dict.fromkeys(outcome.variant.case for outcome in outcomes)
    return pictures.draw_all({case: partial(draw_case, report, outcomes, case) for case in cases}, folder)


def draw_case(report: Report, outcomes: Sequence[Outcome], case: str) -> Figure:
    """Mean error of each profile with each set of sensors, and what `default` states; thin lines are its courses."""
    figure, panels = plt.subplots(1, len(SENSORS), figsize=(pictures.WIDTH_IN, 4.0), sharex=True)
    for axes, sensors in zip(panels, SENSORS, strict=True):
        for profile, colour in COLOUR.items():
            of_row = [o.courses for o in outcomes if vars(o.variant) == _row(case, sensors, profile)]
            distance = np.concatenate([courses.distance_m for courses in of_row])
            covariance = np.concatenate([courses.covariance_m2 for courses in of_row])
            _draw_errors(axes, distance, covariance, profile, colour)
        if case in JUMPS:
            axes.axvline(GAP_S, color="black", lw=0.8, ls=":")
        head(axes, NAMES[sensors], 9)
        axes.set_xlabel("time since GPS was lost [s]")
        axes.set_ylim(bottom=0)
        axes.margins(x=0.01)
    panels[0].set_ylabel("error [m]")
    panels[0].legend(loc="upper left")
    head(figure, f"{case}: {len(report['seeds'])} seeds of {report['seconds']:g} s, {report['scenario']}", 9, "normal")
    return figure


def _row(case: str, sensors: str, profile: str) -> dict[str, str]:
    return {"case": case, "sensors": sensors, "profile": profile}


def _draw_errors(axes: Axes, distance: Floats, covariance: Floats, profile: str, colour: str) -> None:
    time_s = np.arange(distance.shape[1])
    if profile == "default":
        axes.plot(time_s, distance.T, color=colour, lw=0.4, alpha=0.35)
        stated = RADIUS_95 * np.nanmean(np.sqrt(np.linalg.eigvalsh(covariance)[..., -1]), axis=0)
        axes.plot(time_s, stated, color=colour, lw=1.0, ls="--", label="95 % radius that default states")
    axes.plot(time_s, np.nanmean(distance, axis=0), color=colour, lw=1.8, label=f"{profile}, mean")
