"""Rule latest on dense arrays: the map of one robot that keeps, in each cell, the evidence that changed last."""

from __future__ import annotations

from collections.abc import Hashable, Mapping

import numpy as np

from octoreplay.records import BoolArray, Float64Array

State = tuple[Float64Array, BoolArray]
"""One robot's evidence (M, C) in M cells, and where it is known (M,)."""


class LatestMap:
    """Map (M, C) of one robot, where it is known (M,), and the last state of each robot's evidence that it has."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.values = np.zeros(shape)
        self.known = np.zeros(shape[0], dtype=bool)
        self.states: dict[Hashable, State] = {}

    def take(self, states: Mapping[Hashable, State]) -> None:
        """Take the states of one tick, in the order of their keys: each overwrites the cells that it changes."""
        for source in sorted(states):
            values, known = states[source]
            old, was_known = self.states.get(source, (np.zeros_like(values), np.zeros_like(known)))
            changed = known & (~was_known | (values != old).any(axis=1))
            self.values[changed] = values[changed]
            self.known |= changed
            self.states[source] = values, known
