"""Robust statistics of votes: centre, spread and count of histograms.

Votes (cells, bins); results (cells,) on the bin axis, NaN without votes.
"""

from __future__ import annotations

import numpy as np

from protocol.arrays import AnyArray, Floats


def robust_centre(votes: Floats, reach: float) -> Floats:
    """Centre of votes (cells, bins) on the bin axis.

    From the median bin and its larger neighbour, which ignores other ground 1.5 bins away, a local mean, twice: votes
    within one bin count fully, beyond `reach` bins not. Exact for equal votes, which are split linearly between bins;
    unbiased for symmetric noise.
    """
    summed = votes.cumsum(axis=-1)
    median = (2 * summed >= summed[..., -1:]).argmax(axis=-1)
    offsets = np.arange(-3, 4)  # the reach of the mean
    bins = median[..., None] + offsets
    inside = (bins >= 0) & (bins < votes.shape[-1])
    near = np.where(inside, np.take_along_axis(votes, np.where(inside, bins, 0), axis=-1), 0.0)
    below, middle, above = near[..., 2], near[..., 3], near[..., 4]
    other = np.maximum(below, above)
    centre = ratio(np.sign(above - below) * other, middle + other)
    for _ in range(2):
        share = np.clip((reach - np.abs(offsets - centre[..., None])) / (reach - 1), 0, 1)
        centre = ratio((near * share) @ offsets.astype(np.float64), (near * share).sum(axis=-1))
    centre += median
    return centre


def robust_spread(votes: Floats) -> Floats:
    """Standard deviation of votes (cells, bins), in bins, without outliers by quartiles.

    Splitting votes at fraction f between bins adds f (1 - f) to the variance of equal votes, on average 1/6 to that of
    wide ones; in between the difference decays as exp(-2 pi^2 variance), the first term of its Fourier series.
    Subtracted, so equal votes give 0, as does a spread below a third of a bin.
    """
    summed = votes.cumsum(axis=-1)
    first, median, third = ((4 * summed >= k * summed[..., -1:]).argmax(axis=-1) for k in (1, 2, 3))
    bins = np.arange(votes.shape[-1], dtype=np.float64)
    reach = 2 * (third - first + 1)  # at least 2.7 standard deviations of a normal distribution
    kept = np.where(np.abs(bins - median[..., None]) <= reach[..., None], votes, 0.0)
    count = kept.sum(axis=-1)
    mean = ratio(kept @ bins, count)
    variance = ratio(kept @ bins**2, count) - mean**2
    fraction = mean - np.floor(mean)
    split = fraction * (1 - fraction) - 1 / 6
    spread = np.zeros(mean.shape)
    for _ in range(8):  # fixed point, because the binning error depends on the spread
        spread = np.maximum(variance - 1 / 6 - split * np.exp(-2 * np.pi**2 * spread), 0)
    return np.sqrt(spread)


def linear_count(bitmaps: AnyArray) -> Floats:
    """Number of values hashed into 64-bit bitmaps, at most 266: linear counting (Whang et al. 1990)."""
    bits = np.bitwise_count(bitmaps).astype(np.float64)
    return np.where(bits > 0, np.rint(-64 * np.log(1 - np.minimum(bits, 63) / 64)), np.nan)


def ratio(numerator: Floats, denominator: Floats) -> Floats:
    """Quotient, NaN unless the denominator is positive."""
    out: Floats = np.full(denominator.shape, np.nan)
    np.divide(numerator, denominator, out=out, where=denominator > 0)
    return out
