"""Configuration of the packets that robots exchange."""

from __future__ import annotations

from dataclasses import dataclass

from octoreplay.config.fields import check_ranges, parameter
from octoreplay.errors import ConfigError


@dataclass(frozen=True)
class PacketConfig:
    """Configuration of packets: full maps or deltas, number format and budget."""

    packets: str | None = parameter(
        None,
        "packets hold the full map, or the delta to what the receiver has (default: delta; full for rule ratio, which"
        " sends nothing else)",
        choices=("full", "delta"),
    )
    acknowledge: bool = parameter(True, "packets delta: receivers acknowledge packets")
    key_frame_every: int = parameter(
        10, "packets delta without acknowledgements: every n-th packet holds the full map", minimum=1
    )
    content: str = parameter(
        "float32",
        "number format in packets: float32 (lossless), float16 or int8",
        choices=("float32", "float16", "int8"),
    )
    int8_step: float = parameter(0.05, "content int8: quantisation step [log-odds]", minimum=1e-6, maximum=1e6)
    top_classes: int | None = parameter(
        None,
        "number of most probable classes sent per cell; the others share one value (default: all classes)",
        minimum=1,
    )
    packet_compression: str = parameter("zstd", "packet compression: zstd or none", choices=("zstd", "none"))
    zstd_level: int = parameter(1, "zstd compression level; higher is smaller and slower", minimum=1, maximum=22)
    budget: int | None = parameter(
        None,
        "packets delta: maximum packet size; the largest changes are sent first [bytes] (default: no limit)",
        minimum=256,
    )
    cast: str = parameter(
        "unicast",
        "one packet for each receiver (unicast), or one for all (broadcast)",
        choices=("unicast", "broadcast"),
    )

    decode_packets: bool = parameter(
        False, "receivers decode every packet instead of sharing the sender's map: slower, with the same maps"
    )

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.budget is not None and self.packets == "full":
            raise ConfigError("budget: goes with packets 'delta'; a whole map cannot be sent in parts")
        if self.budget is not None and not self.acknowledge:
            raise ConfigError("budget: goes with acknowledge; what waits is sent from what the receiver has")

    @property
    def is_exact(self) -> bool:
        """True when packets hold the map's values unchanged."""
        return self.content == "float32" and self.top_classes is None and self.budget is None
