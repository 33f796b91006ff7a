"""Anchored pull: absent robots of every robot, and the offset that keeps what a robot learned from others.

A robot is absent at another one that has received a map of it before, and at which its last ``anchor_after`` due
publications are missing, for any reason.
"""

from __future__ import annotations

from collections.abc import Set

import numpy as np

from octoreplay.records import Float64Array


class Anchor:
    """Absent robots of one robot, and its offset o (M, K); o is 0 while no robot is absent."""

    def __init__(self, shape: tuple[int, int], anchor_after: int) -> None:
        self.anchor_after = anchor_after
        self.num_missed: dict[int, int] = {}
        self.absent: frozenset[int] = frozenset()
        self.offset: Float64Array = np.zeros(shape)

    def update(self, due: Set[int], arrived: Set[int], log_odds: Float64Array, log_likelihood: Float64Array) -> None:
        """Count the maps of a tick. Where the absent robots change, take the offset anew.

        ``due`` are the robots that publish in the tick by their own periods, active or not; ``arrived`` those whose map
        arrived. ``log_odds`` is h_i, ``log_likelihood`` the log q_i of the robot's last iteration.
        """
        for robot in self.num_missed:
            self.num_missed[robot] += robot in due
        self.num_missed.update(dict.fromkeys(arrived, 0))
        absent = frozenset(j for j, missed in self.num_missed.items() if 0 < self.anchor_after <= missed)
        if absent != self.absent:
            self.absent = absent
            self.offset = self.offset_of(log_odds, log_likelihood)

    def offset_of(self, log_odds: Float64Array, log_likelihood: Float64Array) -> Float64Array:
        """Return o = h_i - log q_i while robots are absent, else 0."""
        return log_odds - log_likelihood if self.absent else np.zeros_like(log_odds)
