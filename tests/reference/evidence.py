"""Evidence of one robot: sums of its scans' log-odds increments, and the three definitions of log q."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from octoreplay.config.sensor import SensorConfig
from octoreplay.records import Float64Array, Int64Array
from reference.rules import rounded


@dataclass(frozen=True, eq=False)
class IndexedScan:
    """One scan as indices into the team's list of cells; ``hit_classes`` are 1..C, ``hit_strengths`` in 1 / 255."""

    robot: int
    stamp_ns: int
    freed: Int64Array
    hit: Int64Array
    hit_classes: Int64Array
    hit_strengths: Int64Array


class Evidence:
    """Clamped and unclamped sums of one robot's increments, (M, K) with column 0 zero, and numbers of scans.

    With a ``quantum`` above 0 the sums are multiples of it, if the sensor model's numbers are.
    """

    def __init__(self, num_cells: int, num_classes: int, quantum: float = 0.0) -> None:
        self.quantum = quantum
        self.clamped: Float64Array = np.zeros((num_cells, num_classes + 1))
        self.total: Float64Array = np.zeros((num_cells, num_classes + 1))
        self.num_touching_scans: Int64Array = np.zeros(num_cells, dtype=np.int64)
        self.num_scans = 0

    def integrate(self, scan: IndexedScan, sensor: SensorConfig) -> None:
        """Add one scan: ``miss`` to freed cells, ``hit`` and ``hit_other`` to hit ones; clamp the touched cells.

        The increments of a hit depend on its strength and on the confidence model, and are rounded to the quantum.
        """
        for cells, increments in self._increments(scan, sensor):
            self.total[cells] += increments
            self.clamped[cells] = np.clip(self.clamped[cells] + increments, sensor.clamp_min, sensor.clamp_max)
            self.num_touching_scans[cells] += 1
        self.num_scans += 1

    def _increments(self, scan: IndexedScan, sensor: SensorConfig) -> Iterator[tuple[Int64Array, Float64Array]]:
        """Yield (cells, increments (., K)) of the freed and of the hit cells; each cell occurs once in one of them."""
        num_columns = self.clamped.shape[1]
        freed = np.full((len(scan.freed), num_columns), sensor.miss)
        hit = np.zeros((len(scan.hit), num_columns))
        for row, class_id, strength in zip(hit, scan.hit_classes.tolist(), scan.hit_strengths.tolist(), strict=True):
            row[1:] = rounded(_hit_increments(sensor, num_columns - 1, class_id, strength / 255), self.quantum)
        for cells, increments in ((scan.freed, freed), (scan.hit, hit)):
            increments[:, 0] = 0.0
            yield cells, increments

    def log_likelihood(self, reading: str) -> Float64Array:
        """Return log q (M, K) as a deviation from the prior; ``reading`` is 'sum', 'time-average' or 'cell-average'."""
        if reading == "sum":
            return self.clamped.copy()
        if reading == "time-average":
            return self.total / max(self.num_scans, 1)
        return self.total / np.maximum(self.num_touching_scans, 1)[:, None]


def _hit_increments(sensor: SensorConfig, num_classes: int, class_id: int, strength: float) -> Float64Array:
    """Return the increments (C,) of a cell that is hit with a label whose confidence is ``strength``."""
    hit_other = sensor.miss if sensor.hit_other is None else sensor.hit_other

    def certain(label: int) -> Float64Array:
        return np.where(np.arange(1, num_classes + 1) == label, sensor.hit, hit_other)

    model = "none" if strength == 1.0 else sensor.confidence_model
    if model == "hit":
        return np.where(np.arange(1, num_classes + 1) == class_id, strength * sensor.hit, hit_other)
    if model == "tempered":
        return strength * certain(class_id)
    if model == "mixture" and num_classes > 1:
        others = [label for label in range(1, num_classes + 1) if label != class_id]
        wrong = sum(np.exp(certain(label)) for label in others) / len(others)
        return np.log(strength * np.exp(certain(class_id)) + (1.0 - strength) * wrong)
    return certain(class_id)
