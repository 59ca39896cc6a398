"""From scores per seed to the rows of the table: means with intervals, the paper's figures, paired ratios."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from scipy import stats

from evaluation.positions.configurations import Configuration
from evaluation.positions.consistency import CONFIDENCE
from evaluation.positions.replay import Score
from protocol.arrays import Floats

Row = dict[str, Any]
MEANS = ("rmse_x_m", "rmse_y_m", "net_m", "nees", "coverage95", "covered", "us_per_second")


def summarise(row: Configuration, scores: Sequence[Score]) -> Row:
    """One row of the table: means over the seeds, the largest error of all, the paper's figure and the difference.

    ci95_m: half-width of the interval of the mean net error over seeds, None of a single one. nees_95: where the mean
    NEES of a right covariance would lie.
    """
    found = {name: mean(scores, name) for name in MEANS}
    net = values(scores, "net_m")
    paper = row.paper_net_m
    return {
        **asdict(row),
        "rmse_x_m": round(found["rmse_x_m"], 4),
        "rmse_y_m": round(found["rmse_y_m"], 4),
        "net_m": round(found["net_m"], 4),
        "ci95_m": rounded(half_width(net), 4),
        "max_m": round(float(values(scores, "max_m").max()), 3),
        "nees": round(found["nees"], 3),
        "nees_95": nees_interval(scores),
        "coverage95": round(found["coverage95"], 4),
        "covered": round(found["covered"], 4),
        "us_per_second": round(found["us_per_second"]),
        "paper_net_m": paper,
        "difference_m": rounded(found["net_m"] - paper if paper is not None else None, 4),
        "net_by_seed_m": [round(float(v), 4) for v in net],
    }


def ratios(scores: Mapping[Configuration, Sequence[Score]]) -> list[Row]:
    """Net errors of `default` over `paper`, and of EKF over UKF, where both were run on the same recordings."""
    found = []
    for row in scores:
        others = {"default/paper": replace(row, profile="paper"), "ekf/ukf": replace(row, filter="ukf")}
        for name, other in others.items():
            if other != row and other in scores:
                ratio, half = paired_ratio(values(scores[row], "net_m"), values(scores[other], "net_m"))
                pair = {**asdict(row), "ratio": name, "net": round(ratio, 4), "ci95": rounded(half, 4)}
                found.append(pair)
    return found


def paired_ratio(a: Floats, b: Floats) -> tuple[float, float | None]:
    """Ratio of the means of paired values (n,), and the half-width of its 95 % interval (None of one pair)."""
    ratio = float(a.mean() / b.mean())
    half = half_width((a - ratio * b) / b.mean())
    return ratio, half


def half_width(sample: Floats) -> float | None:
    """Half-width of the 95 % interval of a mean, by Student's t; None of a single value."""
    n = len(sample)
    if n < 2:
        return None
    quantile = float(stats.t.ppf(0.5 + CONFIDENCE / 2, n - 1))
    return quantile * float(sample.std(ddof=1)) / math.sqrt(n)


def nees_interval(scores: Sequence[Score]) -> list[float]:
    """Where the mean NEES over independent runs would lie: their intervals' half-widths add as squares."""
    low, high = values(scores, "nees_low"), values(scores, "nees_high")
    middle, half = (low + high) / 2, (high - low) / 2
    width = float(np.sqrt((half**2).sum())) / len(scores)
    return [round(float(middle.mean()) - width, 3), round(float(middle.mean()) + width, 3)]


def values(scores: Sequence[Score], name: str) -> Floats:
    """One field of scores (n,)."""
    return np.array([getattr(score, name) for score in scores], float)


def mean(scores: Sequence[Score], name: str) -> float:
    """Mean of one field over the runs."""
    return float(values(scores, name).mean())


def rounded(value: float | None, digits: int) -> float | None:
    """Round, where there is a value."""
    return None if value is None else round(value, digits)
