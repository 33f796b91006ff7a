"""Configuration of the packets that robots exchange."""

from __future__ import annotations

from dataclasses import dataclass

from octoreplay.config.fields import check_ranges, parameter
from octoreplay.errors import ConfigError


@dataclass(frozen=True)
class PacketConfig:
    """What robots send: whole maps or changes, how exactly, and how much of it."""

    packets: str = parameter("full", "whole maps, or what the receiver does not have yet", choices=("full", "delta"))
    acknowledge: bool = parameter(True, "receivers of deltas acknowledge what they have")
    key_frame_every: int = parameter(10, "deltas without acknowledgement: every so many packets a whole map", minimum=1)
    content: str = parameter("float32", "numbers in packets", choices=("float32", "float16", "int8"))
    int8_step: float = parameter(0.05, "log-odds of one step of int8", minimum=1e-6, maximum=1e6)
    top_classes: int | None = parameter(
        None, "only so many of a cell's classes are sent, one value for the others (default: all)", minimum=1
    )
    packet_compression: str = parameter("zstd", "compression of the packets", choices=("zstd", "none"))
    zstd_level: int = parameter(1, "zstd's level: higher is smaller and slower", minimum=1, maximum=22)
    budget: int | None = parameter(
        None, "most bytes of a packet to one receiver; what changes most goes first (default: no limit)", minimum=256
    )
    cast: str = parameter(
        "unicast", "one packet for each receiver, or one for all of them", choices=("unicast", "broadcast")
    )

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.budget is not None and self.packets != "delta":
            raise ConfigError("budget: goes with packets 'delta'; a whole map cannot be sent in parts")
        if self.budget is not None and not self.acknowledge:
            raise ConfigError("budget: goes with acknowledge; what waits is sent from what the receiver has")

    @property
    def is_exact(self) -> bool:
        """True when receivers have just what was published."""
        return self.content == "float32" and self.top_classes is None and self.budget is None
