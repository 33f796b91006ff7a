"""Configuration of the result's contents."""

from __future__ import annotations

from dataclasses import dataclass

from octoreplay.config.fields import check_ranges, parameter


@dataclass(frozen=True)
class OutputConfig:
    """Configuration of the result's contents."""

    state_every: float = parameter(
        5.0, "period between stored maps of each robot; the last map is stored too [s]", above=0.0
    )
    view_every: float = parameter(
        10.0, "period between stored fused maps for viewers; the last one is stored too [s]", above=0.0
    )
    evidence_every: float | None = parameter(
        None, "period between stored evidence of each robot [s] (default: stored at the end of the run only)", above=0.0
    )
    keep_packets: bool = parameter(False, "store the exchanged packets")
    hash: bool = parameter(False, "identify input files by the SHA-256 of the whole file instead of samples")

    def __post_init__(self) -> None:
        check_ranges(self)
