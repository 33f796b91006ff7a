"""Configuration of the result's contents."""

from __future__ import annotations

from dataclasses import dataclass

from octoreplay.config.fields import check_ranges, parameter


@dataclass(frozen=True)
class OutputConfig:
    """What the result holds."""

    state_every: float = parameter(5.0, "each robot's map is stored every so often and at the end [s]", above=0.0)
    view_every: float = parameter(10.0, "fused maps for viewing, every so often and at the end [s]", above=0.0)
    keep_packets: bool = parameter(False, "store the radio packets themselves")
    hash: bool = parameter(False, "fingerprint inputs by a SHA-256 of the whole file")

    def __post_init__(self) -> None:
        check_ranges(self)
