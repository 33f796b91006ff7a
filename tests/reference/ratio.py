"""Ratio consensus with running sums on dense arrays: integers that never wrap around, one line for each equation.

Source: Hadjicostis, Vaidya and Dominguez-Garcia, IEEE TAC 2016. Masses are int64 of any shape in units of UNIT; the
range of int64 holds 10^7 ticks. Weights are Python integers.
"""

from __future__ import annotations

import numpy as np

from octoreplay.records import Float64Array, Int64Array

UNIT = 2.0**-17
WHOLE_WEIGHT = 2**40


def quantised(log_odds: Float64Array) -> Int64Array:
    """Log-odds in units, rounded to nearest, ties to even."""
    return np.rint(np.asarray(log_odds, np.float64) / UNIT).astype(np.int64)


def share_of(mass: Int64Array, num_receivers: int) -> Int64Array:
    """What each of so many receivers gets of a mass, rounded to nearest, ties to even."""
    return np.rint(mass / (1 + num_receivers)).astype(np.int64)


class RatioRobot:
    """One robot: mass y, weight z, their running sums sigma and eta, and what it last heard of each sender's."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.mass = np.zeros(shape, np.int64)
        self.weight = WHOLE_WEIGHT
        self.total = np.zeros(shape, np.int64)
        self.total_weight = 0
        self.evidence = np.zeros(shape, np.int64)
        self.heard: dict[int, tuple[Int64Array, int]] = {}

    def observe(self, log_odds: Float64Array) -> None:
        """y += q(s now) - q(s before)."""
        now = quantised(log_odds)
        self.mass = self.mass + now - self.evidence
        self.evidence = now

    def share_out(self, num_receivers: int) -> None:
        """Sigma += y / (1 + D), y -= D y / (1 + D), and the same of the weight; nothing where nobody listens."""
        if num_receivers == 0:
            return
        share, weight = share_of(self.mass, num_receivers), self.weight // (1 + num_receivers)
        self.total, self.total_weight = self.total + share, self.total_weight + weight
        self.mass, self.weight = self.mass - num_receivers * share, self.weight - num_receivers * weight

    def receive(self, sender: int, total: Int64Array, total_weight: int) -> None:
        """Y += sigma - sigma heard before, and the same of the weight."""
        heard, heard_weight = self.heard.get(sender, (np.zeros_like(total), 0))
        self.mass, self.weight = self.mass + total - heard, self.weight + total_weight - heard_weight
        self.heard[sender] = total, total_weight

    @property
    def log_odds(self) -> Float64Array:
        """The robot's map y / z."""
        log_odds: Float64Array = self.mass * UNIT / (self.weight / WHOLE_WEIGHT)
        return log_odds
