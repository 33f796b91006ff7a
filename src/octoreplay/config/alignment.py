"""Configuration of the alignment of robots during a run."""

from __future__ import annotations

from dataclasses import dataclass

from octoreplay.config.fields import check_ranges, parameter

ON_AIR = "on-air"


@dataclass(frozen=True)
class AlignmentConfig:
    """Alignment of robots from the evidence that they send each other (docs/on-air.md)."""

    align: str = parameter(
        "off",
        "robots begin in the team's frame (off), or in their own frames and find each other's frames from the evidence"
        " that they receive (on-air)",
        choices=("off", ON_AIR),
    )
    align_every: float = parameter(
        5.0, "align on-air: period in which a robot sends its evidence to robots in other frames [s]", above=0.0
    )
    align_growth: float = parameter(
        0.25,
        "align on-air: share by which one of two maps grows before their alignment is tried again",
        minimum=0.0,
    )

    def __post_init__(self) -> None:
        check_ranges(self)

    @property
    def is_on_air(self) -> bool:
        """True where robots find each other's frames during the run."""
        return self.align == ON_AIR
