"""Configuration of stamps, of the pairing of streams, and of the replayed part of the logs."""

from __future__ import annotations

from dataclasses import dataclass

from octoreplay.config.fields import check_ranges, parameter


@dataclass(frozen=True)
class TimeConfig:
    """Configuration of the clock, of pairing, and of the part of the logs that is replayed."""

    clock: str = parameter("header", "source of stamps: message header, or log time", choices=("header", "log"))
    reorder_window: float = parameter(1.0, "largest delay of out-of-order messages [s]", minimum=0.0, maximum=1e6)
    pair_tolerance: float = parameter(
        0.02, "largest time difference between a depth image and its label image [s]", minimum=0.0, maximum=1e6
    )
    pose_gap: float = parameter(0.5, "largest gap between two poses that are interpolated [s]", above=0.0, maximum=1e6)
    strict_labels: bool = parameter(False, "stop at a raw label that the class table does not contain")
    strict_frames: bool = parameter(False, "stop where nothing relates the map frames of two robots")
    start: float = parameter(
        0.0, "start of the replayed span, after the team's first stamp [s]", minimum=0.0, maximum=1e9
    )
    duration: float | None = parameter(
        None, "length of the replayed span [s] (default: to the end)", above=0.0, maximum=1e9, is_common=True
    )
    every: int = parameter(1, "use every n-th image or cloud of each robot", minimum=1)
    rate_limit: float | None = parameter(
        None, "maximum rate of images or clouds used of each robot [Hz] (default: no limit)", minimum=1e-6
    )

    def __post_init__(self) -> None:
        check_ranges(self)
