"""Configuration of stamps, of the pairing of streams, and of the replayed part of the logs."""

from __future__ import annotations

from dataclasses import dataclass

from octoreplay.config.fields import check_ranges, parameter


@dataclass(frozen=True)
class TimeConfig:
    """How stamps are read and streams are paired."""

    clock: str = parameter("header", "stamps: the messages' headers or the log's", choices=("header", "log"))
    reorder_window: float = parameter(1.0, "messages may be this much out of order [s]", minimum=0.0, maximum=1e6)
    pair_tolerance: float = parameter(0.02, "depth and label may be this far apart [s]", minimum=0.0, maximum=1e6)
    pose_gap: float = parameter(
        0.5, "poses further apart than this are not interpolated between [s]", above=0.0, maximum=1e6
    )
    strict_labels: bool = parameter(False, "refuse raw labels that the class table does not know")
    start: float = parameter(
        0.0, "frames before this much after the team's first are left out [s]", minimum=0.0, maximum=1e9
    )
    duration: float | None = parameter(
        None, "frames later than this after start are left out [s]", above=0.0, maximum=1e9
    )
    every: int = parameter(1, "take one image or cloud of so many of each robot", minimum=1)
    rate_limit: float | None = parameter(
        None, "take at most so many images or clouds a second of each robot [Hz]", minimum=1e-6
    )

    def __post_init__(self) -> None:
        check_ranges(self)
