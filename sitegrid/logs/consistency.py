"""Whether errors fit their covariances: NEES, NIS, 95 % ellipse, whiteness of innovations.

NEES is e' P^-1 e of an estimate's error; NIS the same of an innovation with covariance S. For a consistent filter both
are chi-square, with the vector's dimension as degrees of freedom (Bar-Shalom, Li, Kirubarajan, "Estimation with
Applications to Tracking and Navigation", 5.4).
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
    """Summary of a NEES or NIS series.

    mean: [-], near `dof` if consistent, above it if the covariance is too small. low, high: 95 % interval of a
    consistent filter's mean. coverage: share inside the 95 % ellipse. independent: effective sample size.
    """

    dof: int
    mean: float
    low: float
    high: float
    coverage: float
    independent: float


def normalised_square(vectors: Floats, covariances: Floats) -> Floats:
    """NEES or NIS of vectors (n, k) with covariances (n, k, k) -> (n,)."""
    solved = np.linalg.solve(covariances, vectors[:, :, None])[:, :, 0]
    squares: Floats = np.einsum("nk,nk->n", vectors, solved)
    return squares


def summarise(squares: Floats, dof: int, independent: float | None = None) -> ConsistencySummary:
    """Summarise a NEES or NIS series (n,), in time order.

    independent: effective sample size, by default from the autocorrelation. The interval takes the sum as chi-square.
    """
    if not len(squares):
        return ConsistencySummary(dof, math.nan, math.nan, math.nan, math.nan, 0.0)
    worth = independent or independent_values(squares)
    low, high = mean_interval(dof, worth)
    inside = squares <= ellipse_limit(dof)
    return ConsistencySummary(dof, float(squares.mean()), low, high, float(inside.mean()), worth)


def mean_interval(dof: int, independent: float) -> tuple[float, float]:
    """95 % interval of the mean of `independent` chi-square values."""
    tail = (1 - CONFIDENCE) / 2
    low, high = stats.chi2.ppf([tail, 1 - tail], dof * independent) / independent
    return float(low), float(high)


def ellipse_limit(dof: int) -> float:
    """Squared Mahalanobis radius of a Gaussian's 95 % ellipse."""
    return float(stats.chi2.ppf(CONFIDENCE, dof))


def independent_values(series: Floats) -> float:
    """Effective sample size of a stationary series (n,), at least 1: n over its autocorrelation time.

    Position errors last for minutes; ignoring that makes the interval of a 10 Hz NEES absurdly narrow. The
    autocorrelation is summed until its pairs reach zero (Geyer 1992, initial positive sequence).
    """
    correlation = autocorrelation(series)
    if correlation is None:
        return 1.0
    pairs = correlation[: len(correlation) // 2 * 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0)
    time = max(1.0, 2 * float(pairs[: ends[0] if len(ends) else None].sum()) - 1)
    return max(1.0, len(series) / time)


def autocorrelation(series: Floats) -> Floats | None:
    """Autocorrelation (n,) at lags 0 to n - 1; None for a constant series."""
    n = len(series)
    centred = series - series.mean()
    power = np.abs(np.fft.rfft(centred, 2 * n)) ** 2
    products = np.fft.irfft(power)[:n]
    if n < 2 or products[0] <= 1e-12 * n:
        return None
    correlation: Floats = products / products[0]
    return correlation
