"""Ratio consensus with running sums on dense arrays, in integers without wrap-around.

Source: Hadjicostis, Vaidya and Dominguez-Garcia, IEEE TAC 2016. Masses are int64 of any shape in units of UNIT; the
range of int64 holds 10^7 ticks. Weights are Python integers.
"""

from __future__ import annotations

import numpy as np

from octoreplay.records import Float64Array, Int64Array

UNIT = 2.0**-17
WHOLE_WEIGHT = 2**40


def quantised(log_odds: Float64Array) -> Int64Array:
    """Return log-odds in units, rounded to nearest, ties to even."""
    return np.rint(np.asarray(log_odds, np.float64) / UNIT).astype(np.int64)


def share_of(mass: Int64Array, num_receivers: int) -> Int64Array:
    """Return each receiver's share of a mass, rounded to nearest, ties to even."""
    return np.rint(mass / (1 + num_receivers)).astype(np.int64)


class RatioRobot:
    """One robot: mass y, weight z, their running sums sigma and eta, and the last sums received from each sender."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.mass = np.zeros(shape, np.int64)
        self.weight = WHOLE_WEIGHT
        self.total = np.zeros(shape, np.int64)
        self.total_weight = 0
        self.evidence = np.zeros(shape, np.int64)
        self.last_received: dict[int, tuple[Int64Array, int]] = {}

    def observe(self, log_odds: Float64Array) -> None:
        """Add new evidence: y += q(s now) - q(s before)."""
        now = quantised(log_odds)
        self.mass = self.mass + now - self.evidence
        self.evidence = now

    def share_out(self, num_receivers: int) -> None:
        """Share out: sigma += y / (1 + D), y -= D y / (1 + D), likewise the weight; no change without receivers."""
        if num_receivers == 0:
            return
        share, weight = share_of(self.mass, num_receivers), self.weight // (1 + num_receivers)
        self.total, self.total_weight = self.total + share, self.total_weight + weight
        self.mass, self.weight = self.mass - num_receivers * share, self.weight - num_receivers * weight

    def receive(self, sender: int, total: Int64Array, total_weight: int) -> None:
        """Receive sums: y += sigma - last sigma of the sender, likewise the weight."""
        last, last_weight = self.last_received.get(sender, (np.zeros_like(total), 0))
        self.mass, self.weight = self.mass + total - last, self.weight + total_weight - last_weight
        self.last_received[sender] = total, total_weight

    @property
    def log_odds(self) -> Float64Array:
        """Map y / z of the robot."""
        log_odds: Float64Array = self.mass * UNIT / (self.weight / WHOLE_WEIGHT)
        return log_odds
