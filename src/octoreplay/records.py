"""Values that several packages share: frames, class tables, leaf tables, stored maps and poses.

Times are integer nanoseconds and end in ``_ns``; lengths are metres. ``T_a_b`` maps coordinates of frame b to frame a.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias, TypeVar, cast

import numpy as np
import numpy.typing as npt

from octoreplay.data_table import Table

FloatArray: TypeAlias = npt.NDArray[np.floating[Any]]
UInt8Array: TypeAlias = npt.NDArray[np.uint8]
UInt32Array: TypeAlias = npt.NDArray[np.uint32]
UInt64Array: TypeAlias = npt.NDArray[np.uint64]
Int32Array: TypeAlias = npt.NDArray[np.int32]
Int64Array: TypeAlias = npt.NDArray[np.int64]
Float32Array: TypeAlias = npt.NDArray[np.float32]
Float64Array: TypeAlias = npt.NDArray[np.float64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]
Color: TypeAlias = tuple[int, int, int]
FilePath: TypeAlias = str | os.PathLike[str]
"""Path of a file or folder, as text or as an object such as ``pathlib.Path``."""
ArrayT = TypeVar("ArrayT", bound=npt.NDArray[Any])

TEAM = "team"
"""Frame of all maps and poses in a result, except of robots that begin a run in their own frames."""

TEAM_ORIGIN = "frame of the team"
"""Phrase on the origin of the place of the robot whose map frame is the team's frame."""

CENTRAL = "central"
"""Name of the centralised map in a result: the sum of all robots' evidence."""

POSTERIOR, MEAN = "posterior", "mean"
MAP_KINDS = (POSTERIOR, MEAN)
"""Forms in which a stored map is shown: the posterior of the robots that it is the mean of, or this mean."""

NO_CLASS = 0
"""The class_id of a measured point without a usable label: it frees its ray and hits nothing."""

CONVERGED = "converged"
"""The ``stop_reason`` of a run in which the maps converged."""


def read_only(array: ArrayT) -> ArrayT:
    """Return a read-only view of an array."""
    view = array.view()
    view.flags.writeable = False
    return view


@dataclass(frozen=True)
class CameraModel:
    """Pinhole intrinsics [pixel]; z points forward, x right, y down (REP 103 optical frame).

    ``slopes`` (2, height, width) float32, for lenses with distortion, are x / z and y / z of each pixel's ray. They
    replace (u - cx) / fx and (v - cy) / fy, and are NaN where the lens model has no ray for the pixel.
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
    """Box around a robot's body, for points of a scan that belong to the scanning robot or to another robot.

    ``low`` and ``high`` (3,) are its corners in the box's frame [m]; ``T_box_team`` (4, 4) float64 maps the team's
    frame to the box's frame. Points in the robot's own box carry no information; points in another robot's box free
    their ray and hit nothing.
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
    ``confidence_image`` is (H, W) uint8: label confidences in 1 / 255; None for full confidence.
    ``T_team_sensor`` is (4, 4) float64; ``boxes`` are the bodies of robots. ``min_range`` and ``max_range`` [m] take
    the place of the sensor model's; None for those. ``sensor_index`` numbers the sensors of the robot.
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
    min_range: float | None = None
    max_range: float | None = None
    sensor_index: int = 0


@dataclass(frozen=True, eq=False)
class CloudFrame:
    """One point cloud with its labels and the sensor's pose at its stamp.

    ``points`` is (P, 3) float32 or float64 in the sensor's frame; NaN rows carry no information.
    ``class_ids`` is (P,) uint8: class_id 1..C, or NO_CLASS; None where the log has no labels.
    ``confidences`` is (P,) uint8: label confidences in 1 / 255; None for full confidence.
    ``T_team_sensor`` is (4, 4) float64; ``boxes`` are the bodies of robots. ``min_range`` and ``max_range`` [m] take
    the place of the sensor model's; None for those. ``sensor_index`` numbers the sensors of the robot.
    """

    robot_id: str
    stamp_ns: int
    points: npt.NDArray[Any]
    class_ids: UInt8Array | None
    T_team_sensor: Float64Array
    confidences: UInt8Array | None = None
    boxes: tuple[BodyBox, ...] = ()
    min_range: float | None = None
    max_range: float | None = None
    sensor_index: int = 0


Frame: TypeAlias = DepthFrame | CloudFrame


@dataclass(frozen=True)
class SemanticClass:
    """Occupied class: id 1..C, name, colour (r, g, b in 0..255), and the raw labels that map to it.

    ``raw_colors`` are the colours that map to it in colour-coded label images; by default its own colour.
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
    """Occupied classes of a team in the order of class_id, and the raw labels and colours to ignore."""

    classes: tuple[SemanticClass, ...]
    ignored_raw_labels: tuple[int, ...] = ()
    ignored_raw_colors: tuple[Color, ...] = ()

    @property
    def num_classes(self) -> int:
        """Number C of occupied classes, without free space."""
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
    """Leaves of one octree in Morton order.

    - ``centers`` (L, 3) float64: in the team's frame [m].
    - ``sizes`` (L,) float64: edge lengths [m].
    - ``log_odds`` (L, C) float32: log p(c) / p(free) for the classes 1..C, including the prior.
    """

    centers: Float64Array
    sizes: Float64Array
    log_odds: Float32Array

    def __len__(self) -> int:
        return len(self.sizes)

    @classmethod
    def joined(cls, tables: Sequence[LeafTable]) -> LeafTable:
        """Return the leaves of one table after the other, of at least one."""
        if len(tables) == 1:
            return tables[0]
        columns = ([getattr(table, name) for table in tables] for name in ("centers", "sizes", "log_odds"))
        return cls(*map(np.concatenate, columns))

    def as_table(self) -> Table:
        """Return the columns x, y, z, size [m] and log_odds_1 to log_odds_C, one row per leaf."""
        columns = dict(zip("xyz", self.centers.T, strict=True)) | {"size": self.sizes}
        return Table(columns | {f"log_odds_{c}": values for c, values in enumerate(self.log_odds.T, start=1)})

    def taken(self, chosen: BoolArray | Int64Array) -> LeafTable:
        """Return the leaves where ``chosen`` (L,) is True, or those at positions ``chosen`` (n,)."""
        return LeafTable(self.centers[chosen], self.sizes[chosen], self.log_odds[chosen])

    def between(self, low: float, high: float) -> BoolArray:
        """Return True (L,) for leaves that overlap the heights from ``low`` to ``high`` [m]."""
        half, z = self.sizes / 2, self.centers[:, 2]
        return np.asarray((z + half > low) & (z - half < high))


def public_names(value: object) -> list[str]:
    """Return the attributes of an object for ``dir``, without private ones."""
    return sorted(name for name in object.__dir__(value) if not name.startswith("_"))


MIN_GAP_NS = 10_000_000_000
"""Least distance of two used sensor messages of a robot that is noted as a gap."""


@dataclass
class FrameCounts:
    """Numbers of one robot's messages by outcome of reading; every message is counted once.

    - ``used`` to ``off``: numbers of sensor messages; ``off`` are those at times when the schedule has the robot off.
    - ``sensor_topic``: topic of the sensor messages; '' where several sensors have one each.
    - ``messages``: numbers of messages by topic and outcome. 'in_log' is the number in the logs, 'read' the number that
      was read; all others are the outcomes, which add up to 'read' (docs/logs.md).
    - ``spans``: first and last stamp [ns, team's clock] of the unused messages, by topic and outcome; log times where a
      message has no usable stamp.
    - ``used_span``: first and last stamp [ns, team's clock] of the used sensor messages; None without any.
    - ``gaps``: the stamps on both sides of each gap of at least MIN_GAP_NS between used sensor messages.
    - ``first_missing``: description of the first late message and of the first without label or pose, by the name of
      the count; 'late_pose' of the first pose that came after a frame without one, 'leading' of the frames before the
      first used one.
    - ``unknown_label_pixels``, ``unknown_colors``: numbers of pixels or points with an unknown label, by raw label and
      by colour 0xRRGGBB.
    - ``truncated_files``: one sentence for each cut or damaged log, with the part that was skipped.
    """

    used: int = 0
    no_label: int = 0
    no_pose: int = 0
    late: int = 0
    duplicate: int = 0
    undecodable: int = 0
    off: int = 0
    sensor_topic: str = field(default="", compare=False)
    messages: dict[str, dict[str, int]] = field(default_factory=dict, compare=False)
    spans: dict[str, dict[str, tuple[int, int]]] = field(default_factory=dict, compare=False)
    used_span: tuple[int, int] | None = field(default=None, compare=False)
    gaps: list[tuple[int, int]] = field(default_factory=list, compare=False)
    first_missing: dict[str, str] = field(default_factory=dict, compare=False)
    unknown_label_pixels: dict[int, int] = field(default_factory=dict)
    unknown_colors: dict[int, int] = field(default_factory=dict)
    truncated_files: list[str] = field(default_factory=list)

    def settle(self, topic: str, outcome: str, stamp_ns: int | None = None, count: int = 1) -> None:
        """Count messages of a topic by outcome; ``stamp_ns`` widens the span of the outcome."""
        outcomes = self.messages[topic]
        outcomes[outcome] = outcomes.get(outcome, 0) + count
        if stamp_ns is not None:
            spans = self.spans.setdefault(topic, {})
            first, last = spans.get(outcome, (stamp_ns, stamp_ns))
            spans[outcome] = min(first, stamp_ns), max(last, stamp_ns)

    def use(self, stamp_ns: int) -> None:
        """Count a used sensor message, which comes in stamp order, and note a gap before it."""
        self.used += 1
        first, last = self.used_span or (stamp_ns, stamp_ns)
        if stamp_ns - last >= MIN_GAP_NS:
            self.gaps.append((last, stamp_ns))
        self.used_span = first, stamp_ns

    @property
    def outcomes(self) -> dict[str, dict[str, int]]:
        """Numbers of messages by topic and outcome, which add up to those in the logs.

        'not_read' are the messages outside the replayed part, in damaged parts of the logs, and of topics of which the
        first message is enough. In results without ``messages`` the sensor messages are the only topic.
        """
        if not self.messages:
            causes = {name: getattr(self, name) for name in ("used", "no_label", "no_pose", "late", "undecodable")}
            return {"images or clouds": {name: number for name, number in causes.items() if number}}
        found = {}
        for topic, numbers in self.messages.items():
            outcomes = {name: number for name, number in numbers.items() if number and name not in ("in_log", "read")}
            not_read = numbers["in_log"] - numbers["read"]
            found[topic] = {**outcomes, **({"not_read": not_read} if not_read > 0 else {})}
        return found

    def leave_out(self, num_off: int) -> None:
        """Count sensor messages as left out because the robot was off, which were counted as used."""
        if num_off:
            self.used, self.off = self.used - num_off, self.off + num_off
            self.settle(self.sensor_topic, "used", count=-num_off)
            self.settle(self.sensor_topic, "off", count=num_off)

    @property
    def unaccounted(self) -> dict[str, int]:
        """Number of messages that were read less those with an outcome, by topic; empty where the sums agree."""
        differences = {
            topic: 2 * numbers["read"] - sum(number for name, number in numbers.items() if name != "in_log")
            for topic, numbers in self.messages.items()
        }
        return {topic: difference for topic, difference in differences.items() if difference}

    @property
    def skipped(self) -> int:
        """Number of sensor messages that were read but not mapped."""
        return self.no_label + self.no_pose + self.late + self.undecodable

    @property
    def lost_data(self) -> bool:
        """True where part of the log could not be used or is not accounted for; duplicates do not count."""
        return bool(self.skipped or self.truncated_files or self.unaccounted)


@dataclass(frozen=True)
class MapState:
    """Map or evidence of one robot as stored in a result: a packet of the map codec, a key frame or a delta.

    A delta holds the bricks that changed since the state ``base_sequence`` of the same robot. ``num_robots`` is N, the
    number of robots of whose evidence the map is the mean, 1 where it is no mean; None in results without it.
    """

    robot_id: str
    stamp_ns: int
    tick: int
    sequence: int
    base_sequence: int
    is_key_frame: bool
    data: bytes
    frame_id: str = TEAM
    num_robots: int | None = 1


@dataclass(frozen=True, eq=False)
class RobotPose:
    """Pose of one robot's sensor in the team's frame, or in the robot's present frame ``frame_id``: (4, 4) float64."""

    robot_id: str
    T_team_sensor: Float64Array
    frame_id: str = TEAM
