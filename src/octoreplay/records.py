"""The values that cross folders: frames, class tables, leaf tables and metrics.

Times are integer nanoseconds and end in ``_ns``; lengths are metres. ``T_a_b`` maps coordinates of frame b to frame a.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import astuple, dataclass, field, fields
from typing import Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.floating[Any]]
UInt8Array: TypeAlias = npt.NDArray[np.uint8]
UInt64Array: TypeAlias = npt.NDArray[np.uint64]
Int32Array: TypeAlias = npt.NDArray[np.int32]
Int64Array: TypeAlias = npt.NDArray[np.int64]
Float32Array: TypeAlias = npt.NDArray[np.float32]
Float64Array: TypeAlias = npt.NDArray[np.float64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]
Color: TypeAlias = tuple[int, int, int]

CENTRAL = "central"
"""The name under which a result holds the centralised map, the sum of all robots' evidence."""

NO_CLASS = 0
"""The class_id of a measured point that carries no usable label: it frees its ray and hits nothing."""

CONVERGED = "converged"
"""The ``stop_reason`` of a run whose maps came to rest."""


@dataclass(frozen=True)
class CameraModel:
    """Pinhole intrinsics in pixels; z looks forward, x right, y down (REP 103 optical).

    ``slopes`` is (2, height, width) float32 where the lens distorts: x / z and y / z of every pixel's ray, in place of
    (u - cx) / fx and (v - cy) / fy, NaN where no ray of the lens model hits a pixel.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    slopes: Float32Array | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, eq=False)
class BodyBox:
    """A box in which a scan's points belong to a robot: its own body, or another robot's.

    ``low`` and ``high`` are (3,) in metres in the box's frame, and ``T_box_team`` (4, 4) float64 maps the team's frame
    to it. Points in an own box carry no information; points in another's free their ray and hit nothing.
    """

    low: Float64Array
    high: Float64Array
    T_box_team: Float64Array
    is_own: bool


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """One depth image with its labels and the camera's pose at its stamp.

    ``depth_image`` is (H, W), uint16 or float32; metres along z = value x ``depth_unit``.
    ``class_image`` is (H, W) uint8: class_id 1..C, or NO_CLASS; None where the log has no labels (all points class 1).
    ``confidence_image`` is (H, W) uint8: how sure each label is, in 255ths; None where all are sure.
    ``T_team_sensor`` is (4, 4) float64; points in ``boxes`` are a robot's.
    """

    robot_id: str
    stamp_ns: int
    depth_image: npt.NDArray[Any]
    depth_unit: float
    class_image: UInt8Array | None
    camera: CameraModel
    T_team_sensor: Float64Array
    confidence_image: UInt8Array | None = None
    boxes: tuple[BodyBox, ...] = ()


@dataclass(frozen=True, eq=False)
class CloudFrame:
    """One point cloud with its labels and the sensor's pose at its stamp.

    ``points`` is (P, 3) float32 or float64 in the sensor's frame; NaN rows carry no information.
    ``class_ids`` is (P,) uint8: class_id 1..C, or NO_CLASS; None where the log has no labels.
    ``confidences`` is (P,) uint8: how sure each label is, in 255ths; None where all are sure.
    ``T_team_sensor`` is (4, 4) float64; points in ``boxes`` are a robot's.
    """

    robot_id: str
    stamp_ns: int
    points: npt.NDArray[Any]
    class_ids: UInt8Array | None
    T_team_sensor: Float64Array
    confidences: UInt8Array | None = None
    boxes: tuple[BodyBox, ...] = ()


Frame: TypeAlias = DepthFrame | CloudFrame


@dataclass(frozen=True)
class SemanticClass:
    """One occupied class: its id 1..C, name, colour (r, g, b in 0..255) and the raw labels that mean it.

    ``raw_colors`` are the colours that mean it in colour-coded label images: its own colour unless given.
    """

    class_id: int
    name: str
    color: Color
    raw_labels: tuple[int, ...]
    raw_colors: tuple[Color, ...] = field(default=cast("tuple[Color, ...]", None))

    def __post_init__(self) -> None:
        if self.raw_colors is None:
            object.__setattr__(self, "raw_colors", (self.color,))


@dataclass(frozen=True)
class ClassTable:
    """The occupied classes of a team, in order of class_id, and the raw labels and colours of images to ignore."""

    classes: tuple[SemanticClass, ...]
    ignored_raw_labels: tuple[int, ...] = ()
    ignored_raw_colors: tuple[Color, ...] = ()

    @property
    def num_classes(self) -> int:
        """C, the number of occupied classes (free space not counted)."""
        return len(self.classes)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the classes 1..C."""
        return tuple(c.name for c in self.classes)

    @property
    def colors(self) -> UInt8Array:
        """Colours of the classes 1..C: (C, 3) uint8."""
        return np.array([c.color for c in self.classes], dtype=np.uint8).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class LeafTable:
    """The leaves of one octree, in Morton order.

    ``centers`` (L, 3) float64, metres in the team's frame; ``sizes`` (L,) float64, edge lengths in metres;
    ``log_odds`` (L, C) float32, log p(c) / p(free) for the classes 1..C, the prior included.
    """

    centers: Float64Array
    sizes: Float64Array
    log_odds: Float32Array

    def __len__(self) -> int:
        return len(self.sizes)


@dataclass
class FrameCounts:
    """What became of one robot's sensor messages while reading; every message is counted once.

    ``first_missing`` says which message was the first that came too late, or had no label or pose, by the count's name;
    ``unknown_label_pixels`` are numbers of pixels or points by raw label, ``unknown_colors`` by colour, 0xRRGGBB;
    ``truncated_files`` has a sentence for each log that is cut or damaged, which says what was skipped.
    """

    used: int = 0
    no_label: int = 0
    no_pose: int = 0
    late: int = 0
    duplicate: int = 0
    undecodable: int = 0
    first_missing: dict[str, str] = field(default_factory=dict, compare=False)
    unknown_label_pixels: dict[int, int] = field(default_factory=dict)
    unknown_colors: dict[int, int] = field(default_factory=dict)
    truncated_files: list[str] = field(default_factory=list)

    @property
    def skipped(self) -> int:
        """Sensor messages that were read and not mapped."""
        return self.no_label + self.no_pose + self.late + self.undecodable

    @property
    def lost_data(self) -> bool:
        """True when something in the log could not be used; a duplicate is no loss."""
        return bool(self.skipped or self.truncated_files)


@dataclass(frozen=True)
class RobotMetrics:
    """One robot at one tick. Bytes of packets and maps are of what it published in this tick (0 while dormant)."""

    robot_id: str
    active: bool
    num_scans: int
    num_iterations: int
    agreement: float
    agreement_occupied: float
    num_leaves: int
    num_cells: int
    observed_volume: float
    entropy_bits: float
    memory_bytes: int
    sent_bytes: int
    packet_bytes: int
    octree_bytes: int
    grid_bytes: int
    unpruned_bytes: int
    unpruned_compressed_bytes: int


@dataclass(frozen=True)
class LinkMetrics:
    """One directed link in one tick: what became of its packets. Acknowledgements count in bytes only."""

    sender: str
    receiver: str
    num_sent: int
    sent_bytes: int
    num_delivered: int
    delivered_bytes: int
    num_lost: int
    num_dropped: int
    num_late: int
    num_stale: int
    num_gaps: int
    num_damaged: int
    bytes_per_second: float


@dataclass(frozen=True)
class TickMetrics:
    """The team after one tick; the definitions are in docs/metrics.md."""

    tick: int
    stamp_ns: int
    settling: bool
    total_distance: float
    total_distance_all: float
    distance_per_leaf: float
    distance_per_cell_and_link: float
    num_known_cells: int
    label_disagreement: float
    max_change: float
    robots: tuple[RobotMetrics, ...]
    links: tuple[LinkMetrics, ...]

    @property
    def counted_robots(self) -> tuple[RobotMetrics, ...]:
        """The active robots, of which the worst or the mean is taken; all where none is active."""
        return tuple(robot for robot in self.robots if robot.active) or self.robots


class LinkTotals:
    """Each directed link over many ticks: sums, and the mean of ``bytes_per_second``."""

    def __init__(self) -> None:
        self._sums: dict[tuple[str, str], list[float]] = {}
        self._num_ticks: dict[tuple[str, str], int] = {}

    def add(self, links: Iterable[LinkMetrics]) -> None:
        """Add the links of one tick."""
        for link in links:
            ends = (link.sender, link.receiver)
            values = astuple(link)[2:]
            sums = self._sums.get(ends, [0] * len(values))
            self._sums[ends] = [a + b for a, b in zip(sums, values, strict=True)]
            self._num_ticks[ends] = self._num_ticks.get(ends, 0) + 1

    def totals(self) -> tuple[LinkMetrics, ...]:
        """The links in the order in which they first occurred."""
        names = [item.name for item in fields(LinkMetrics)]

        def total(ends: tuple[str, str], sums: list[float]) -> LinkMetrics:
            values: list[Any] = [*ends, *map(int, sums[:-1]), sums[-1] / self._num_ticks[ends]]
            return LinkMetrics(**dict(zip(names, values, strict=True)))

        return tuple(total(ends, sums) for ends, sums in self._sums.items())


@dataclass(frozen=True)
class MapState:
    """One robot's map as stored in a result: a packet of the map codec, whole (key frame) or as a delta.

    A delta holds the bricks that changed since the state with ``base_sequence`` of the same robot.
    """

    robot_id: str
    stamp_ns: int
    tick: int
    sequence: int
    base_sequence: int
    is_key_frame: bool
    data: bytes


@dataclass(frozen=True, eq=False)
class RobotPose:
    """Where one robot's sensor is: (4, 4) float64 in the team's frame."""

    robot_id: str
    T_team_sensor: Float64Array


@dataclass(frozen=True)
class RunSummary:
    """What a whole run came to; the wall time is for the reader's eyes and never stored in the result.

    ``links`` are the directed links over all ticks.
    """

    num_ticks: int
    num_settling_ticks: int
    stop_reason: str
    log_seconds: float
    wall_seconds: float
    last: TickMetrics
    peak_total_distance: float
    peak_total_distance_all: float
    mean_packet_bytes: float
    mean_octree_bytes: float
    mean_grid_bytes: float
    total_sent_bytes: int
    links: tuple[LinkMetrics, ...]
    frame_counts: Mapping[str, FrameCounts]
    warnings: tuple[str, ...]

    @property
    def lost_data(self) -> bool:
        """True when any log was cut or any frame could not be used."""
        return any(counts.lost_data for counts in self.frame_counts.values())
