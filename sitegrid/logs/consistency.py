"""Whether errors are as large as their covariances say: NEES, NIS, the 95 % ellipse, whiteness of innovations.

NEES is e' P^-1 e of an estimate's error, NIS the same of an innovation with its covariance S. Of a consistent filter
both are chi-square distributed with as many degrees of freedom as the vector has components (Bar-Shalom, Li,
Kirubarajan, "Estimation with Applications to Tracking and Navigation", 5.4).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import stats

from protocol.arrays import Floats
from sitegrid.proof.figures import CONFIDENCE


@dataclass(frozen=True)
class ConsistencySummary:
    """Figures of a series of NEES or NIS.

    mean: [-], of a consistent filter close to `dof`, above it where the covariance is too small. low, high: interval
    that holds the mean of a consistent filter in 95 of 100 cases. coverage: share inside of the 95 % ellipse.
    independent: how many independent values the series is worth.
    """

    dof: int
    mean: float
    low: float
    high: float
    coverage: float
    independent: float


def normalised_square(vectors: Floats, covariances: Floats) -> Floats:
    """NEES of errors, or NIS of innovations: vectors (n, k), covariances (n, k, k) -> (n,)."""
    solved = np.linalg.solve(covariances, vectors[:, :, None])[:, :, 0]
    squares: Floats = np.einsum("nk,nk->n", vectors, solved)
    return squares


def summarise(squares: Floats, dof: int, independent: float | None = None) -> ConsistencySummary:
    """Summarise a series (n,) of NEES or NIS in the order of time.

    independent: how many independent values it is worth; by default its autocorrelation says so. The interval takes
    their sum as chi-square distributed.
    """
    if not len(squares):
        return ConsistencySummary(dof, math.nan, math.nan, math.nan, math.nan, 0.0)
    worth = independent or independent_values(squares)
    low, high = mean_interval(dof, worth)
    inside = squares <= ellipse_limit(dof)
    return ConsistencySummary(dof, float(squares.mean()), low, high, float(inside.mean()), worth)


def mean_interval(dof: int, independent: float) -> tuple[float, float]:
    """Interval that holds the mean of so many independent chi-square values in 95 of 100 cases."""
    tail = (1 - CONFIDENCE) / 2
    low, high = stats.chi2.ppf([tail, 1 - tail], dof * independent) / independent
    return float(low), float(high)


def ellipse_limit(dof: int) -> float:
    """Squared Mahalanobis radius of the ellipse that holds 95 % of a Gaussian distribution."""
    return float(stats.chi2.ppf(CONFIDENCE, dof))


def independent_values(series: Floats) -> float:
    """How many independent values a stationary series (n,) is worth, at least 1: n over its autocorrelation time.

    Errors of a position last for minutes; without this the interval of a NEES at 10 Hz would be absurdly narrow. The
    autocorrelation is summed up to where its pairs fall to zero (Geyer 1992, initial positive sequence).
    """
    correlation = autocorrelation(series)
    if correlation is None:
        return 1.0
    pairs = correlation[: len(correlation) // 2 * 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0)
    time = max(1.0, 2 * float(pairs[: ends[0] if len(ends) else None].sum()) - 1)
    return max(1.0, len(series) / time)


def autocorrelation(series: Floats) -> Floats | None:
    """Autocorrelation (n,) of a series at lags 0 to n - 1, None of a constant one."""
    n = len(series)
    centred = series - series.mean()
    power = np.abs(np.fft.rfft(centred, 2 * n)) ** 2
    products = np.fft.irfft(power)[:n]
    if n < 2 or products[0] <= 1e-12 * n:
        return None
    correlation: Floats = products / products[0]
    return correlation
