"""Values that several packages share: frames, class tables, leaf tables and metrics.

Times are integer nanoseconds and end in ``_ns``; lengths are metres. ``T_a_b`` maps coordinates of frame b to frame a.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import astuple, dataclass, field, fields
from typing import Any, TypeAlias, TypeVar, cast

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
ArrayT = TypeVar("ArrayT", bound=npt.NDArray[Any])

TEAM = "team"
"""Frame of all maps and poses in a result, except of robots that begin a run in their own frames."""

CENTRAL = "central"
"""Name of the centralised map in a result: the sum of all robots' evidence."""

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
    ``T_team_sensor`` is (4, 4) float64; ``boxes`` are the bodies of robots.
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
    ``confidences`` is (P,) uint8: label confidences in 1 / 255; None for full confidence.
    ``T_team_sensor`` is (4, 4) float64; ``boxes`` are the bodies of robots.
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


@dataclass
class FrameCounts:
    """Numbers of one robot's sensor messages by outcome of reading; every message is counted once.

    - ``first_missing``: description of the first late message and of the first without label or pose, by the name of
      the count.
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
    first_missing: dict[str, str] = field(default_factory=dict, compare=False)
    unknown_label_pixels: dict[int, int] = field(default_factory=dict)
    unknown_colors: dict[int, int] = field(default_factory=dict)
    truncated_files: list[str] = field(default_factory=list)

    @property
    def skipped(self) -> int:
        """Number of sensor messages that were read but not mapped."""
        return self.no_label + self.no_pose + self.late + self.undecodable

    @property
    def lost_data(self) -> bool:
        """True where part of the log could not be used; duplicates do not count."""
        return bool(self.skipped or self.truncated_files)


@dataclass(frozen=True)
class RobotMetrics:
    """Metrics of one robot at one tick. Bytes are those of the map published in this tick (0 while dormant)."""

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
    """Packets of one directed link in one tick, by outcome. Acknowledgements count in bytes only."""

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


MIN_COMPARED_CELLS = 500
"""Number of compared cells from which the contradiction of a pair of robots counts as the team's."""


@dataclass(frozen=True)
class PairMetrics:
    """Contradiction of the evidence of two robots that share known cells; docs/metrics.md defines it.

    Attributes
    ----------
    first, second : str
        The robots, in the team's order.
    overlap_cells : int
        Cells that both know.
    occupied_cells : int
        Of these, cells that one calls occupied and the other occupied or free.
    contradiction : float
        Share of the occupied cells that the other robot calls free; NaN without occupied cells.
    clear_contradiction : float
        Share of the occupied cells that the other robot calls firmly free, and has no occupied cell beside (26
        neighbours); NaN without occupied cells.
    contradiction_of_first, contradiction_of_second : float
        The same over the cells that this robot calls occupied and the other one occupied or free.
    both_occupied_cells : int
        Cells that both call occupied.
    label_contradiction : float
        Share of these with different labels; NaN without such cells.
    """

    first: str
    second: str
    overlap_cells: int
    occupied_cells: int
    contradiction: float
    clear_contradiction: float
    contradiction_of_first: float
    contradiction_of_second: float
    both_occupied_cells: int
    label_contradiction: float


PAIR_SHARES = {
    "contradiction": "occupied_cells",
    "clear_contradiction": "occupied_cells",
    "label_contradiction": "both_occupied_cells",
}
"""Shares of a pair that have a number for the team, and the number of cells that each is a share of."""


def ranked_pairs(pairs: Iterable[PairMetrics], name: str) -> list[PairMetrics]:
    """Return the pairs with at least MIN_COMPARED_CELLS cells for the share ``name``, the largest share first."""
    counted = [pair for pair in pairs if getattr(pair, PAIR_SHARES[name]) >= MIN_COMPARED_CELLS]
    return sorted(counted, key=lambda pair: -float(getattr(pair, name)))


class PairTotals:
    """Team numbers of the pairs of robots: properties of every record with a field ``pairs``."""

    pairs: tuple[PairMetrics, ...]

    @property
    def contradiction(self) -> float:
        """Largest contradiction of a pair; NaN where no pair has enough cells."""
        return self._largest("contradiction")

    @property
    def clear_contradiction(self) -> float:
        """Largest clear contradiction of a pair; NaN where no pair has enough cells."""
        return self._largest("clear_contradiction")

    @property
    def label_contradiction(self) -> float:
        """Largest label contradiction of a pair; NaN where no pair has enough cells."""
        return self._largest("label_contradiction")

    def _largest(self, name: str) -> float:
        """Largest value of a share over the pairs with enough cells."""
        return max((getattr(pair, name) for pair in ranked_pairs(self.pairs, name)), default=math.nan)


@dataclass(frozen=True)
class FramePlace:
    """Frame of one robot's map and poses.

    ``frame_id`` is the name of the frame: 'team', or '<robot>/map' for the map frame of a robot. ``T_frame_map`` maps
    the robot's own map frame to it: x, y, z [m], qx, qy, qz, qw.
    """

    robot_id: str
    frame_id: str
    T_frame_map: tuple[float, ...]


@dataclass(frozen=True)
class TickMetrics(PairTotals):
    """Metrics of the team after one tick; docs/metrics.md defines them.

    ``pairs`` are the pairs of robots that share known cells, in the robots' order. They are empty in results that were
    written before the contradiction of evidence was measured. ``places`` are the frames of all robots where they find
    them during the run, else empty.
    """

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
    pairs: tuple[PairMetrics, ...] = ()
    places: tuple[FramePlace, ...] = ()

    @property
    def components(self) -> tuple[tuple[str, ...], ...]:
        """Robots with a common frame, the largest group first, then in the robots' order."""
        groups: dict[str, list[str]] = {}
        for robot in self.robots:
            groups.setdefault(self.frame_of(robot.robot_id), []).append(robot.robot_id)
        return tuple(tuple(group) for group in sorted(groups.values(), key=lambda group: -len(group)))

    @property
    def num_components(self) -> int:
        """Number of groups of robots with a common frame."""
        return len(self.components)

    def frame_of(self, robot_id: str) -> str:
        """Return the name of the frame of a robot's map, or of the centralised map."""
        frames = {place.robot_id: place.frame_id for place in self.places}
        if robot_id == CENTRAL and frames:
            robot_id = self.components[0][0]
        return frames.get(robot_id, TEAM)

    @property
    def counted_robots(self) -> tuple[RobotMetrics, ...]:
        """Robots over which team figures are computed: the active ones, or all where none is active."""
        return tuple(robot for robot in self.robots if robot.active) or self.robots


class LinkTotals:
    """Totals of each directed link over many ticks: sums, and the mean of ``bytes_per_second``."""

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
        """Return the totals of the links in the order in which they first occurred."""
        names = [item.name for item in fields(LinkMetrics)]

        def total(ends: tuple[str, str], sums: list[float]) -> LinkMetrics:
            values: list[Any] = [*ends, *map(int, sums[:-1]), sums[-1] / self._num_ticks[ends]]
            return LinkMetrics(**dict(zip(names, values, strict=True)))

        return tuple(total(ends, sums) for ends, sums in self._sums.items())


@dataclass(frozen=True)
class MapState:
    """Map or evidence of one robot as stored in a result: a packet of the map codec, a key frame or a delta.

    A delta holds the bricks that changed since the state ``base_sequence`` of the same robot.
    """

    robot_id: str
    stamp_ns: int
    tick: int
    sequence: int
    base_sequence: int
    is_key_frame: bool
    data: bytes
    frame_id: str = TEAM


@dataclass(frozen=True, eq=False)
class RobotPose:
    """Pose of one robot's sensor in the team's frame, or in the robot's present frame ``frame_id``: (4, 4) float64."""

    robot_id: str
    T_team_sensor: Float64Array
    frame_id: str = TEAM


@dataclass(frozen=True)
class Join:
    """Event of a run in which two groups of robots got one frame.

    Attributes
    ----------
    tick : int
        First tick in the common frame.
    seconds : float
        Its log time since the run's start [s].
    first, second : str
        Robots between whose maps the pose was found; ``second`` is among those whose frame changed.
    moved : tuple of str
        Robots whose frame changed.
    frame_id : str
        The common frame.
    score : float
        Log-likelihood ratio L of the pose.
    """

    tick: int
    seconds: float
    first: str
    second: str
    moved: tuple[str, ...]
    frame_id: str
    score: float


@dataclass(frozen=True)
class RunSummary:
    """Summary of a run.

    ``links`` are the directed links over all ticks. ``frame_origins`` are phrases on the origin of each robot's place
    in the team's frame, by robot_id; empty in results without them. ``joins`` are the events in which robots found a
    common frame during the run. The wall time is not stored in the result.
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
    frame_origins: Mapping[str, str] = field(default_factory=dict)
    joins: tuple[Join, ...] = ()

    @property
    def lost_data(self) -> bool:
        """True where any log was cut or any frame could not be used."""
        return any(counts.lost_data for counts in self.frame_counts.values())
