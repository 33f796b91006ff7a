"""Configuration of the result's contents."""

from __future__ import annotations

from dataclasses import dataclass

from octoreplay.config.fields import check_ranges, parameter
from octoreplay.errors import ConfigError


@dataclass(frozen=True)
class OutputConfig:
    """Configuration of the result's contents."""

    state_every: float = parameter(
        5.0, "period between stored maps of each robot; the last map is stored too [s]", above=0.0
    )
    view_every: float = parameter(
        10.0, "period between stored fused maps for viewers; the last one is stored too [s]", above=0.0
    )
    markers_every: float | None = parameter(
        None, "period between stored maps as cubes for RViz; the last one is stored too [s] (default: none)", above=0.0
    )
    evidence_every: float | None = parameter(
        None, "period between stored evidence of each robot [s] (default: stored at the end of the run only)", above=0.0
    )
    grid_every: float | None = parameter(
        None, "period between stored occupancy grids of each robot; the last one is stored too [s] (default: none)",
        above=0.0,
    )  # fmt: skip
    grid_low: float | None = parameter(None, "lowest height of the occupancy grids [m] (default: all)")
    grid_high: float | None = parameter(None, "highest height of the occupancy grids [m] (default: all)")
    octomap_every: float | None = parameter(
        None, "period between stored OctoMap trees of each robot; the last one is stored too [s] (default: none)",
        above=0.0,
    )  # fmt: skip
    keep_packets: bool = parameter(False, "store the exchanged packets")
    hash: bool = parameter(False, "identify input files by the SHA-256 of the whole file instead of samples")

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.grid_low is not None and self.grid_high is not None and not self.grid_low < self.grid_high:
            raise ConfigError(f"grid_low: {self.grid_low:g} must be below grid_high, {self.grid_high:g}")
