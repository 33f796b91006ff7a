"""Configuration of the inverse sensor model and of the map."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, cast

from octoreplay.config.fields import check_ranges, parameter
from octoreplay.errors import ConfigError


@dataclass(frozen=True)
class SensorConfig:
    """Configuration of the inverse sensor model: log-odds increments, clamping and ranges."""

    hit: float = parameter(1.0, "log-odds added to the observed class of the cell where a ray ends (psi)", above=0.0)
    miss: float = parameter(-0.3, "log-odds added to all classes of a cell that a ray crosses (phi)", maximum=0.0)
    hit_other: float | None = parameter(
        None, "log-odds added to the other classes of the cell where a ray ends (default: miss)"
    )
    confidence_model: str = parameter(
        "tempered",
        "what the confidence of a label changes: nothing (none), hit (hit), hit and hit_other by the same factor"
        " (tempered), or the class alone (mixture)",
        choices=("none", "hit", "tempered", "mixture"),
    )
    clamp_min: float = parameter(-5.0, "lower limit of a class's log-odds", maximum=0.0)
    clamp_max: float = parameter(5.0, "upper limit of a class's log-odds", minimum=0.0)
    min_range: float = parameter(0.0, "minimum range of a measured point; nearer points are ignored [m]", minimum=0.0)
    max_range: float = parameter(
        10.0, "maximum length of a ray; farther points only mark free space [m]", above=0.0, is_common=True
    )
    rays: str = parameter(
        "cells", "one ray for each end cell (cells) or for each measured point (all)", choices=("cells", "all")
    )
    hide_robots: bool = parameter(False, "treat points inside another robot's body_box as free space")
    invalid_depth: tuple[float, ...] = parameter((), "raw depth values to ignore")
    no_return_depth: tuple[float, ...] = parameter(
        (), "raw depth values that mean 'no return': free space up to max_range"
    )

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.clamp_min >= self.clamp_max:
            raise ConfigError("clamp_min: must be below clamp_max")
        if self.min_range >= self.max_range:
            raise ConfigError("min_range: must be below max_range")

    @property
    def clamp(self) -> tuple[float, float]:
        """Smallest and largest log-odds of a class."""
        return self.clamp_min, self.clamp_max


def rounded_sensor(sensor: SensorConfig, quantum: float) -> SensorConfig:
    """Return the sensor model with increments and clamps rounded to multiples of ``quantum``; unchanged for 0.

    Ties go to the even multiple. Raises ConfigError where a number other than 0 becomes 0, or the clamps become equal.
    """
    if quantum == 0.0:
        return sensor
    rounded: dict[str, Any] = {}
    for name in ("hit", "miss", "hit_other", "clamp_min", "clamp_max"):
        value = getattr(sensor, name)
        rounded[name] = None if value is None else round(value / quantum) * quantum
        if value and rounded[name] == 0.0:
            raise ConfigError(f"quantum: {quantum:g} rounds {name} {value:g} to 0; choose a smaller quantum, or 0")
    return dataclasses.replace(sensor, **rounded)


Region: TypeAlias = tuple[float, float, float, float, float, float]
"""Region (xmin, ymin, zmin, xmax, ymax, zmax) [m]."""


def region_of(bounds: Sequence[float]) -> Region:
    """Return the region of ``bounds``: zmin and zmax, all six numbers, or none for a region without limits [m].

    Raises ConfigError for other numbers, and where a minimum is not below its maximum.
    """
    if not all(math.isfinite(number) for number in bounds):
        raise ConfigError("bounds: expects finite numbers")
    if len(bounds) not in (0, 2, 6):
        raise ConfigError(f"bounds: expects 2 or 6 numbers, got {len(bounds)}")
    half = len(bounds) // 2
    if any(bounds[i] >= bounds[half + i] for i in range(half)):
        raise ConfigError("bounds: every minimum must be below its maximum")
    limits = [-math.inf] * 3 + [math.inf] * 3
    for axis in range(half):
        limits[3 - half + axis], limits[6 - half + axis] = bounds[axis], bounds[half + axis]
    return cast("Region", tuple(limits))


@dataclass(frozen=True)
class MapConfig:
    """Configuration of the map: geometry, prior and pruning."""

    resolution: float = parameter(0.2, "edge length of the finest cell [m]", above=0.0, is_common=True)
    bounds: tuple[float, ...] = parameter(
        (), "mapped region, ZMIN,ZMAX or XMIN,YMIN,ZMIN,XMAX,YMAX,ZMAX in the team's frame [m] (default: no limit)"
    )
    prob_free: float | None = parameter(
        None, "prior probability of free space (default: the same as of every class)", above=0.0, maximum=0.999999
    )
    prune_tolerance: float = parameter(
        0.0,
        "largest log-odds difference between siblings that published maps merge into one leaf (0: lossless)",
        minimum=0.0,
    )

    def __post_init__(self) -> None:
        check_ranges(self)
        region_of(self.bounds)

    @property
    def box(self) -> Region:
        """Mapped region (xmin, ymin, zmin, xmax, ymax, zmax) in metres in the team's frame; infinite without bounds."""
        return region_of(self.bounds)

    def prior(self, num_classes: int) -> float:
        """h_0, the log-odds of each occupied class in an unobserved cell."""
        if self.prob_free is None:
            return 0.0
        return math.log((1.0 - self.prob_free) / num_classes / self.prob_free)
