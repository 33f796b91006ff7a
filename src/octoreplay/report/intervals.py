"""Means over teams with bootstrap intervals, and paired differences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

CONFIDENCE = 0.95
"""Confidence level of every interval."""
NUM_RESAMPLES = 10_000
MIN_TEAMS = 5
"""Least number of teams with an interval; fewer say too little about others."""
_SEED = 0
_ROUNDING = 1e-12
"""Relative differences up to which values are equal."""


class Interval(NamedTuple):
    """Mean of a number over teams, with the ends of its confidence interval; the ends are NaN for too few teams."""

    mean: float
    low: float
    high: float

    def excludes(self, value: float) -> bool:
        """Return True where ``value`` lies outside of the interval; False without an interval."""
        return value < self.low or value > self.high


def interval(values: Sequence[float]) -> Interval:
    """Return the mean of ``values``, one number of each team, with its bias-corrected and accelerated interval.

    Values that are NaN are left out; fewer than ``MIN_TEAMS`` have no interval. The interval is that of Efron, "Better
    bootstrap confidence intervals", Journal of the American Statistical Association 82, 1987.
    """
    from scipy.stats import bootstrap

    known = np.array([value for value in values if not math.isnan(value)])
    if not known.size:
        return Interval(math.nan, math.nan, math.nan)
    mean = float(known.mean())
    if known.size < MIN_TEAMS:
        return Interval(mean, math.nan, math.nan)
    spread = float(np.ptp(known))
    if spread <= _ROUNDING * float(np.abs(known).max()):
        return Interval(mean, mean, mean)
    # Powers of small differences underflow; a power of two scales without rounding.
    unit = 2.0 ** math.floor(math.log2(spread))
    found = bootstrap(
        (known / unit,), np.mean, n_resamples=NUM_RESAMPLES, confidence_level=CONFIDENCE, method="BCa",
        rng=np.random.default_rng(_SEED), vectorized=True,
    ).confidence_interval  # fmt: skip
    return Interval(mean, float(found.low) * unit, float(found.high) * unit)
