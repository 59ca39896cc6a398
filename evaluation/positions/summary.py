"""From scores per seed to the rows of the table: means with intervals, the paper's figures, paired ratios."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from evaluation.campaign.figures import half_width, rounded
from evaluation.positions.configurations import Configuration
from evaluation.positions.replay import Score
from protocol.arrays import Floats

MEANS = ("rmse_x_m", "rmse_y_m", "net_m", "nees", "coverage95", "covered")


@dataclass(frozen=True)
class TableRow(Configuration):
    """One row of the table: means over the seeds.

    ci95_m: half-width of the interval of the mean net error over seeds, None of a single one. max_m: the largest error
    of all seeds. nees_95: interval of the mean NEES if the covariance is right. paper_net_m: the paper's figure, None
    where it has no such row; difference_m: ours minus that.
    """

    rmse_x_m: float
    rmse_y_m: float
    net_m: float
    ci95_m: float | None
    max_m: float
    nees: float
    nees_95: list[float]
    coverage95: float
    covered: float
    us_per_second: int
    paper_net_m: float | None
    difference_m: float | None
    net_by_seed_m: list[float]


@dataclass(frozen=True)
class RatioRow(Configuration):
    """A configuration's net error over that of another on the same recordings, with the half-width of its interval."""

    ratio: str
    net: float
    ci95: float | None


def summarise(row: Configuration, scores: Sequence[Score]) -> TableRow:
    """One row of the table."""
    net, paper = values(scores, "net_m"), row.published_net_m
    means: dict[str, Any] = {name: float(values(scores, name).mean()) for name in MEANS}
    summary = TableRow(
        **vars(row),
        **means,
        ci95_m=half_width(net),
        max_m=float(values(scores, "max_m").max()),
        nees_95=nees_interval(scores),
        us_per_second=round(float(values(scores, "us_per_second").mean())),
        paper_net_m=paper,
        difference_m=None if paper is None else means["net_m"] - paper,
        net_by_seed_m=net.tolist(),
    )
    return rounded(summary, 4, max_m=3, nees=3, nees_95=3)


def ratios(scores: Mapping[Configuration, Sequence[Score]]) -> list[RatioRow]:
    """Net errors of `default` over `paper`, and of EKF over UKF, where both were run on the same recordings."""
    rows = []
    for row in scores:
        others = {"default/paper": replace(row, profile="paper"), "ekf/ukf": replace(row, filter="ukf")}
        for name, other in others.items():
            if other != row and other in scores:
                ratio, half = paired_ratio(values(scores[row], "net_m"), values(scores[other], "net_m"))
                rows.append(rounded(RatioRow(**vars(row), ratio=name, net=ratio, ci95=half), 4))
    return rows


def paired_ratio(a: Floats, b: Floats) -> tuple[float, float | None]:
    """Ratio of the means of paired values (n,), and the half-width of its 95 % interval (None of one pair)."""
    ratio = float(a.mean() / b.mean())
    half = half_width((a - ratio * b) / b.mean())
    return ratio, half


def nees_interval(scores: Sequence[Score]) -> list[float]:
    """Interval of the mean NEES over independent runs: the half-widths of their intervals add as squares."""
    low, high = values(scores, "nees_low"), values(scores, "nees_high")
    middle, half = (low + high) / 2, (high - low) / 2
    width = float(np.sqrt((half**2).sum())) / len(scores)
    return [float(middle.mean()) - width, float(middle.mean()) + width]


def values(scores: Sequence[Score], name: str) -> Floats:
    """One field of scores (n,)."""
    return np.array([getattr(score, name) for score in scores], float)
