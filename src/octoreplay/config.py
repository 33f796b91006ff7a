"""What a run can be told: frozen dataclasses with range checks.

Every parameter has one name: in the team file (a flat key), on the command line (``--name-with-dashes``) and here.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

from octoreplay.class_tables.edits import Merges
from octoreplay.errors import ConfigError, suggestion
from octoreplay.records import ClassTable

RULES = ("gradient", "bayes", "natural", "ratio", "flood", "merge", "local")
EVIDENCES = ("sum", "time-average", "cell-average")
MODES = ("sync", "on-arrival")
TOPOLOGIES = ("complete", "ring", "line", "star", "grid", "nearest", "range", "random", "edges")
WEIGHTS = ("metropolis", "degree", "max-degree", "given")

CENTRAL = "central"
"""The name under which a result holds the centralised map, the sum of all robots' evidence."""

PALETTE: tuple[tuple[int, int, int], ...] = (
    (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (0, 114, 178), (213, 94, 0), (204, 121, 167),
    (120, 120, 120), (127, 60, 141), (17, 165, 121), (57, 105, 172), (242, 183, 1), (231, 63, 116), (128, 186, 90),
)  # fmt: skip
"""Colours for classes that come without one (the first seven: Okabe and Ito's colour-blind safe set)."""


_LARGEST, _SMALLEST = 1e12, 1e-15
"""No number of a configuration is larger, nor smaller where it must be above 0: what times become still has room."""


def _parameter(
    default: Any,
    help_text: str,
    *,
    minimum: float | None = None,
    maximum: float | None = None,
    above: float | None = None,
    choices: tuple[str, ...] | None = None,
) -> Any:
    """A dataclass field that carries its help text and the range that it is checked against."""
    return field(
        default=default,
        metadata={"help": help_text, "minimum": minimum, "maximum": maximum, "above": above, "choices": choices},
    )


def _help(text: str) -> Mapping[str, str]:
    """What a key of a robot is for, as a team file's comments say it."""
    return {"help": text}


def _check_ranges(config: Any) -> None:
    """Check every parameter of one section against its type and range."""
    for item in dataclasses.fields(config):
        value, meta = getattr(config, item.name), item.metadata
        if value is None or not meta:
            continue
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{item.name}: {value} is not a finite number")
        if isinstance(value, float) and abs(value) > _LARGEST:
            raise ConfigError(f"{item.name}: {value:g} is above the largest value {_LARGEST:g}")
        if meta["choices"] is not None and value not in meta["choices"]:
            raise ConfigError(f"{item.name}: '{value}' is not one of {', '.join(meta['choices'])}")
        if meta["minimum"] is not None and value < meta["minimum"]:
            raise ConfigError(f"{item.name}: {value} is below the least value {meta['minimum']:g}")
        if meta["maximum"] is not None and value > meta["maximum"]:
            raise ConfigError(f"{item.name}: {value} is above the largest value {meta['maximum']:g}")
        if meta["above"] is not None and value <= meta["above"]:
            raise ConfigError(f"{item.name}: {value} must be greater than {meta['above']:g}")
        if isinstance(value, float) and meta["above"] == 0.0 and value < _SMALLEST:
            raise ConfigError(f"{item.name}: {value:g} is below the least value {_SMALLEST:g}")


@dataclass(frozen=True)
class SensorConfig:
    """The inverse sensor model: log-odds increments, clamping and ranges."""

    hit: float = _parameter(1.0, "log-odds added to a hit cell's class (psi)", above=0.0)
    miss: float = _parameter(-0.3, "log-odds added to all classes of a cell that a ray passes (phi)", maximum=0.0)
    hit_other: float | None = _parameter(None, "log-odds added to a hit cell's other classes (default: miss)")
    clamp_min: float = _parameter(-5.0, "least log-odds of a class", maximum=0.0)
    clamp_max: float = _parameter(5.0, "largest log-odds of a class", minimum=0.0)
    min_range: float = _parameter(0.0, "points nearer than this carry no information [m]", minimum=0.0)
    max_range: float = _parameter(10.0, "rays are cut here [m]", above=0.0)
    rays: str = _parameter("cells", "one ray per distinct end cell, or per measured point", choices=("cells", "all"))
    hide_robots: bool = _parameter(False, "points in another robot's body_box free their ray and hit nothing")
    invalid_depth: tuple[float, ...] = _parameter((), "raw depth values that carry no information")
    no_return_depth: tuple[float, ...] = _parameter(
        (), "raw depth values that mean 'no return' and free their ray up to max_range"
    )

    def __post_init__(self) -> None:
        _check_ranges(self)
        if self.clamp_min >= self.clamp_max:
            raise ConfigError("clamp_min: must be below clamp_max")
        if self.min_range >= self.max_range:
            raise ConfigError("min_range: must be below max_range")

    @property
    def clamp(self) -> tuple[float, float]:
        """The least and the largest log-odds of a class."""
        return self.clamp_min, self.clamp_max


@dataclass(frozen=True)
class MapConfig:
    """The map's geometry and prior."""

    resolution: float = _parameter(0.2, "edge of the finest leaf [m]", above=0.0)
    bounds: tuple[float, ...] = _parameter(
        (), "mapped region: ZMIN,ZMAX or XMIN,YMIN,ZMIN,XMAX,YMAX,ZMAX in the team's frame [m]"
    )
    prob_free: float | None = _parameter(
        None, "prior probability of free space (default: uniform over all classes)", above=0.0, maximum=0.999999
    )
    prune_tolerance: float = _parameter(
        0.0, "siblings whose log-odds differ by at most this are one leaf when published (0: lossless)", minimum=0.0
    )

    def __post_init__(self) -> None:
        _check_ranges(self)
        if not all(math.isfinite(number) for number in self.bounds):
            raise ConfigError("bounds: expects finite numbers")
        if len(self.bounds) not in (0, 2, 6):
            raise ConfigError(f"bounds: expects 2 or 6 numbers, got {len(self.bounds)}")
        half = len(self.bounds) // 2
        if any(self.bounds[i] >= self.bounds[half + i] for i in range(half)):
            raise ConfigError("bounds: every minimum must be below its maximum")

    @property
    def box(self) -> tuple[float, float, float, float, float, float]:
        """The mapped region (xmin, ymin, zmin, xmax, ymax, zmax) in metres; infinite where it is not limited."""
        infinity = math.inf
        if len(self.bounds) == 2:
            return (-infinity, -infinity, self.bounds[0], infinity, infinity, self.bounds[1])
        if len(self.bounds) == 6:
            return self.bounds
        return (-infinity, -infinity, -infinity, infinity, infinity, infinity)

    def prior(self, num_classes: int) -> float:
        """h_0: the log-odds of each occupied class in an unobserved cell."""
        if self.prob_free is None:
            return 0.0
        return math.log((1.0 - self.prob_free) / num_classes / self.prob_free)


@dataclass(frozen=True)
class ConsensusConfig:
    """The consensus rule and its steps (docs/algorithm.md)."""

    rule: str = _parameter("gradient", "consensus rule", choices=RULES)
    evidence: str = _parameter("sum", "reading of log q_i", choices=EVIDENCES)
    mode: str = _parameter("sync", "one iteration per tick, or one per arriving map", choices=MODES)
    epsilon: float | None = _parameter(
        None, "consensus step size (default: 0.5, or 0.9 of the bound where that is less)", above=0.0
    )
    gamma: float = _parameter(0.5, "gradient step size", minimum=0.0)
    gamma_power: float = _parameter(0.0, "gamma_k = gamma / (1 + k / gamma_decay)^gamma_power", minimum=0.0)
    gamma_decay: float = _parameter(1.0, "iterations after which gamma starts to fall", above=0.0)
    gamma_per_arrival: str = _parameter(
        "divided", "on-arrival: gamma divided by the robot's degree, or full", choices=("divided", "full")
    )
    settle: int = _parameter(20, "ticks over which gamma ramps to 0 after the last log; 0: no settling", minimum=0)
    settle_tolerance: float = _parameter(
        1e-6, "settling stops when no log-odds changes by more than this in a tick", above=0.0
    )
    settle_max: int | None = _parameter(None, "most settling ticks (default: 20 + 12 / -log10 lambda_2)", minimum=1)

    def __post_init__(self) -> None:
        _check_ranges(self)


@dataclass(frozen=True)
class ScheduleEntry:
    """What is up or down from ``start`` up to, but not with, ``end`` [s since the run's start].

    ``groups`` cut all links between robots of different groups; ``links_down`` and ``links_up`` are links, both
    directions; ``robots_off`` neither map nor talk, and ``forget`` what they knew when they come back;
    ``robots_silent`` hear and do not talk.
    """

    start: float
    end: float = math.inf
    groups: tuple[tuple[str, ...], ...] = ()
    links_down: tuple[tuple[str, str], ...] = ()
    links_up: tuple[tuple[str, str], ...] = ()
    robots_off: tuple[str, ...] = ()
    robots_silent: tuple[str, ...] = ()
    forget: bool = False

    def __post_init__(self) -> None:
        if not self.start >= 0:
            raise ConfigError(f"schedule: from: {self.start:g} s is before the run's start; it must be at least 0")
        if not self.start < self.end:
            raise ConfigError(f"schedule: an entry lasts from {self.start:g} s to {self.end:g} s; 'from' must be first")
        if self.forget and not self.robots_off:
            raise ConfigError("schedule: 'forget' goes with robots_off")


@dataclass(frozen=True)
class NetworkConfig:
    """The simulated communication graph: who can hear whom, and when."""

    topology: str = _parameter("complete", "communication graph", choices=TOPOLOGIES)
    edges: tuple[tuple[str, str, float | None], ...] = field(default=())
    one_way: tuple[tuple[str, str], ...] = field(default=())
    schedule: tuple[ScheduleEntry, ...] = field(default=())
    num_nearest: int = _parameter(2, "topology nearest: links to so many nearest robots", minimum=1)
    radio_range: float = _parameter(30.0, "topology range: robots nearer than this get a link [m]", above=0.0)
    range_hysteresis: float = _parameter(
        3.0, "topology range: a link breaks this much beyond radio_range [m]", minimum=0.0
    )
    prob_link: float = _parameter(
        0.5, "topology random: probability of each link (Erdos-Renyi)", minimum=0.0, maximum=1.0
    )
    network_seed: int = _parameter(0, "seed of the random graph, losses and jitter", minimum=0)
    weights: str = _parameter("metropolis", "weights A_ij of the links", choices=WEIGHTS)
    publish_period: float = _parameter(
        1.0, "every robot publishes its map every so often [s]", above=0.0, maximum=86_400.0
    )
    after_end: str = _parameter(
        "stay", "after a robot's last scan it stays in the team or leaves", choices=("stay", "leave")
    )

    def __post_init__(self) -> None:
        _check_ranges(self)
        if (self.topology == "edges") != bool(self.edges):
            raise ConfigError("edges: an edge list goes with topology 'edges', and topology 'edges' needs one")
        if (self.weights == "given") != any(weight is not None for *_, weight in self.edges):
            raise ConfigError("weights: 'given' goes with an edge list that carries a weight for every edge")
        if self.weights == "given" and any(weight is None for *_, weight in self.edges):
            raise ConfigError("edges: with weights 'given' every edge needs a weight")
        for sender, receiver in self.one_way:
            if sender == receiver:
                raise ConfigError(f"one_way: '{sender}' cannot have a link to itself")
            if (receiver, sender) in self.one_way:
                raise ConfigError(
                    f"one_way: {sender} -> {receiver} and {receiver} -> {sender} are both listed; keep the one that"
                    " carries"
                )


@dataclass(frozen=True)
class LinkConfig:
    """What happens to a packet on a link (one direction): delay, loss, rate and queue.

    Losses follow Gilbert and Elliott's two states: a packet is lost with ``loss`` in the good state and ``burst_loss``
    in the bad one; before every packet the good state turns bad with ``burst_start`` and the bad one good with
    ``burst_end``. Without ``burst_start`` they are independent (Bernoulli).
    """

    latency: float = _parameter(0.0, "mean delay of a packet [s]", minimum=0.0)
    jitter: float = _parameter(0.0, "the delay varies evenly by up to this much both ways [s]", minimum=0.0)
    loss: float = _parameter(0.0, "probability that a packet is lost (in the good state)", minimum=0.0, maximum=1.0)
    burst_start: float = _parameter(
        0.0, "probability that a burst of losses starts with a packet (Gilbert-Elliott)", minimum=0.0, maximum=1.0
    )
    burst_end: float = _parameter(0.5, "probability that a burst ends with a packet", above=0.0, maximum=1.0)
    burst_loss: float = _parameter(1.0, "probability that a packet is lost in a burst", minimum=0.0, maximum=1.0)
    corruption: float = _parameter(0.0, "probability that a packet arrives damaged", minimum=0.0, maximum=1.0)
    rate: float | None = _parameter(None, "what a link carries [bytes/s] (default: no limit)", above=0.0)
    queue: str = _parameter(
        "newest", "a busy link keeps the newest packet waiting, or all that fit", choices=("newest", "drop-tail")
    )
    queue_bytes: int = _parameter(1_000_000, "what fits in the queue of a link, for drop-tail [bytes]", minimum=1)

    def __post_init__(self) -> None:
        _check_ranges(self)
        if self.jitter > self.latency:
            raise ConfigError(f"jitter: {self.jitter:g} is above latency {self.latency:g}; a delay cannot be negative")

    @property
    def is_random(self) -> bool:
        """True where chance decides what becomes of a packet."""
        return any((self.jitter, self.loss, self.burst_start, self.corruption))

    @property
    def mean_loss(self) -> float:
        """Share of the packets that do not arrive whole, over a long time and without rate limit."""
        in_burst = self.burst_start / (self.burst_start + self.burst_end)
        return (1.0 - in_burst) * self._missing(self.loss) + in_burst * self._missing(self.burst_loss)

    @property
    def repeated_loss(self) -> float:
        """The factor by which one more packet lost in a row is rarer than one less, in long rows.

        The largest eigenvalue of the two states' transitions, each times the loss in the state that it leads to.
        """
        good, bad = self._missing(self.loss), self._missing(self.burst_loss)
        if self.burst_start == 0.0:
            return good
        stay_good, stay_bad = (1.0 - self.burst_start) * good, (1.0 - self.burst_end) * bad
        change = self.burst_start * bad * self.burst_end * good
        return (stay_good + stay_bad + math.sqrt((stay_good - stay_bad) ** 2 + 4.0 * change)) / 2.0

    def _missing(self, loss: float) -> float:
        """Share of the packets that are lost or damaged."""
        return 1.0 - (1.0 - loss) * (1.0 - self.corruption)


@dataclass(frozen=True)
class PacketConfig:
    """What robots send: whole maps or changes, how exactly, and how much of it."""

    packets: str = _parameter("full", "whole maps, or what the receiver does not have yet", choices=("full", "delta"))
    acknowledge: bool = _parameter(True, "receivers of deltas acknowledge what they have")
    key_frame_every: int = _parameter(
        10, "deltas without acknowledgement: every so many packets a whole map", minimum=1
    )
    content: str = _parameter("float32", "numbers in packets", choices=("float32", "float16", "int8"))
    int8_step: float = _parameter(0.05, "log-odds of one step of int8", minimum=1e-6, maximum=1e6)
    top_classes: int | None = _parameter(
        None, "only so many of a cell's classes are sent, one value for the others (default: all)", minimum=1
    )
    packet_compression: str = _parameter("zstd", "compression of the packets", choices=("zstd", "none"))
    zstd_level: int = _parameter(1, "zstd's level: higher is smaller and slower", minimum=1, maximum=22)
    budget: int | None = _parameter(
        None, "most bytes of a packet to one receiver; what changes most goes first (default: no limit)", minimum=256
    )
    cast: str = _parameter(
        "unicast", "one packet for each receiver, or one for all of them", choices=("unicast", "broadcast")
    )

    def __post_init__(self) -> None:
        _check_ranges(self)
        if self.budget is not None and self.packets != "delta":
            raise ConfigError("budget: goes with packets 'delta'; a whole map cannot be sent in parts")
        if self.budget is not None and not self.acknowledge:
            raise ConfigError("budget: goes with acknowledge; what waits is sent from what the receiver has")

    @property
    def is_exact(self) -> bool:
        """True when receivers have just what was published."""
        return self.content == "float32" and self.top_classes is None and self.budget is None


@dataclass(frozen=True)
class TimeConfig:
    """How stamps are read and streams are paired."""

    clock: str = _parameter("header", "stamps: the messages' headers or the log's", choices=("header", "log"))
    reorder_window: float = _parameter(1.0, "messages may be this much out of order [s]", minimum=0.0, maximum=1e6)
    pair_tolerance: float = _parameter(0.02, "depth and label may be this far apart [s]", minimum=0.0, maximum=1e6)
    pose_gap: float = _parameter(
        0.5, "poses further apart than this are not interpolated between [s]", above=0.0, maximum=1e6
    )
    strict_labels: bool = _parameter(False, "refuse raw labels that the class table does not know")
    start: float = _parameter(
        0.0, "frames before this much after the team's first are left out [s]", minimum=0.0, maximum=1e9
    )
    duration: float | None = _parameter(
        None, "frames later than this after start are left out [s]", above=0.0, maximum=1e9
    )
    every: int = _parameter(1, "take one image or cloud of so many of each robot", minimum=1)
    rate_limit: float | None = _parameter(
        None, "take at most so many images or clouds a second of each robot [Hz]", minimum=1e-6
    )

    def __post_init__(self) -> None:
        _check_ranges(self)


@dataclass(frozen=True)
class OutputConfig:
    """What the result holds."""

    state_every: float = _parameter(5.0, "each robot's map is stored every so often and at the end [s]", above=0.0)
    view_every: float = _parameter(10.0, "fused maps for viewing, every so often and at the end [s]", above=0.0)
    keep_packets: bool = _parameter(False, "store the radio packets themselves")
    hash: bool = _parameter(False, "fingerprint inputs by a SHA-256 of the whole file")

    def __post_init__(self) -> None:
        _check_ranges(self)


@dataclass(frozen=True)
class RobotConfig:
    """One robot: its log files, topics, clock and frames. Topics and frames that are None are found in the log.

    ``depth_topic``, ``label_topic`` and ``confidence_topic`` are images; ``cloud_topic`` is a point cloud or a laser
    scan, with its labels in ``label_field`` and how sure they are in ``confidence_field``. ``pose_file`` takes the
    place of a pose topic: a trajectory in TUM's or KITTI's format, the latter with ``pose_times``, a time in each line,
    or else with a pose for every message of the sensor.
    ``intrinsics`` is (fx, fy, cx, cy) in pixels in place of CameraInfo; ``rectified`` says whether CameraInfo's P
    holds (None: where the topic's name says 'rect') or K and the distortion. Transforms are (x, y, z, qx, qy, qz, qw):
    ``T_team_map`` from the robot's map frame to the team's, ``T_body_sensor`` from the sensor's frame to the frame
    whose pose the pose topic gives, in place of TF. ``body_box`` is (xmin, ymin, zmin, xmax, ymax, zmax) of the robot
    itself [m] in ``body_frame``, the frame whose pose the pose topic gives unless named: what the sensor sees in it is
    left out. ``clock_offset`` [s] is added to the robot's stamps. The robot publishes every ``publish_period`` [s], the
    team's unless given, ``publish_phase`` [s] after the ticks that are multiples of it.
    """

    robot_id: str
    logs: tuple[Path, ...]
    depth_topic: str | None = field(default=None, metadata=_help("depth images, raw or compressed"))
    label_topic: str | None = field(
        default=None, metadata=_help("label images, ids or colours; '' to map without labels")
    )
    confidence_topic: str | None = field(default=None, metadata=_help("images that say how sure the labels are"))
    camera_info_topic: str | None = field(default=None, metadata=_help("CameraInfo of the depth images"))
    cloud_topic: str | None = field(
        default=None, metadata=_help("point clouds or laser scans, in place of depth_topic")
    )
    label_field: str | None = field(
        default=None, metadata=_help("field of the points that holds their labels, such as rgb")
    )
    confidence_field: str | None = field(
        default=None, metadata=_help("field of the points that says how sure the labels are")
    )
    pose_topic: str | None = field(default=None, metadata=_help("odometry, stamped poses, a path or TF"))
    pose_file: Path | None = field(
        default=None, metadata=_help("a trajectory in place of pose_topic: TUM or KITTI format")
    )
    pose_times: Path | None = field(default=None, metadata=_help("times of a KITTI trajectory, one in each line [s]"))
    label_info_topic: str | None = field(default=None, metadata=_help("LabelInfo that names the labels"))
    map_frame: str | None = field(default=None, metadata=_help("the frame that the poses are in"))
    sensor_frame: str | None = field(
        default=None, metadata=_help("the sensor's frame, if not the one that its messages name")
    )
    intrinsics: tuple[float, ...] | None = field(
        default=None, metadata=_help("[fx, fy, cx, cy] in place of CameraInfo [pixels]")
    )
    rectified: bool | None = field(
        default=None, metadata=_help("true: CameraInfo's P holds; false: K and the distortion")
    )
    depth_unit: float | None = field(default=None, metadata=_help("metres per depth value, in place of the encoding's"))
    clock_offset: float = field(default=0.0, metadata=_help("added to this robot's stamps [s]"))
    T_team_map: tuple[float, ...] = field(
        default=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        metadata=_help("its map frame in the team's: x y z [m], quaternion x y z w"),
    )
    T_body_sensor: tuple[float, ...] | None = field(
        default=None, metadata=_help("the sensor in the frame that the poses are of, in place of TF")
    )
    body_frame: str | None = field(
        default=None, metadata=_help("the frame of body_box, if not the one that the poses are of")
    )
    body_box: tuple[float, ...] | None = field(
        default=None, metadata=_help("the robot itself: XMIN, YMIN, ZMIN, XMAX, YMAX, ZMAX [m]")
    )
    publish_period: float | None = field(
        default=None, metadata=_help("publishes its map every so often, in place of the team's [s]")
    )
    publish_phase: float = field(
        default=0.0, metadata=_help("and so much after the ticks that are multiples of it [s]")
    )

    def __post_init__(self) -> None:
        if not self.robot_id or "/" in self.robot_id:
            raise ConfigError(f"robot id '{self.robot_id}': every robot needs an id, without '/' in it")
        if self.robot_id == CENTRAL:
            raise ConfigError(f"robot id '{CENTRAL}': is the name of the centralised map; give the robot another")
        for problem in (*self._wrong_sources(), *self._wrong_geometry(), *self._wrong_numbers()):
            raise ConfigError(f"robot '{self.robot_id}': {problem}")

    def _wrong_sources(self) -> Iterator[str]:
        """What does not go together in the files and topics."""
        if not self.logs:
            yield "needs a log"
        if self.depth_topic and self.cloud_topic:
            yield "give depth_topic or cloud_topic, not both"
        if self.pose_topic and self.pose_file:
            yield "give pose_topic or pose_file, not both"
        if self.pose_times and not self.pose_file:
            yield "pose_times goes with pose_file"

    def _wrong_geometry(self) -> Iterator[str]:
        """What is no transform, no camera or no box."""
        for name in ("T_team_map", "T_body_sensor"):
            value = getattr(self, name)
            if value is not None and len(value) != 7:
                yield f"{name} expects 7 numbers x, y, z, qx, qy, qz, qw"
            elif value is not None and abs(math.hypot(*value[3:]) - 1.0) > 1e-3:
                yield f"{name}'s quaternion must have length 1"
        if self.intrinsics is not None and (len(self.intrinsics) != 4 or min(self.intrinsics[:2]) <= 0):
            yield "intrinsics expects 4 numbers fx, fy, cx, cy"
        box = self.body_box
        if box is not None and (len(box) != 6 or not all(low < high for low, high in zip(box, box[3:], strict=False))):
            yield "body_box expects 6 numbers XMIN, YMIN, ZMIN, XMAX, YMAX, ZMAX, every minimum below its maximum"

    def _wrong_numbers(self) -> Iterator[str]:
        """What is out of range."""
        if self.depth_unit is not None and self.depth_unit <= 0:
            yield "depth_unit must be greater than 0"
        if self.publish_period is not None and not 0 < self.publish_period < math.inf:
            yield "publish_period must be greater than 0"
        if not 0 <= self.publish_phase < math.inf:
            yield "publish_phase must not be negative"
        for item in dataclasses.fields(self):
            value = getattr(self, item.name)
            numbers = [n for n in (value if isinstance(value, tuple) else (value,)) if isinstance(n, float)]
            if not all(math.isfinite(number) for number in numbers):
                yield f"{item.name} must be finite, not {value}"
            if any(abs(number) > _LARGEST for number in numbers):
                yield f"{item.name} must not hold numbers above {_LARGEST:g}"

    @property
    def files(self) -> tuple[Path, ...]:
        """All files and folders that the robot's data come from."""
        return (*self.logs, *(path for path in (self.pose_file, self.pose_times) if path is not None))

    def with_absolute_paths(self) -> RobotConfig:
        """This robot with paths that hold from everywhere."""
        logs = tuple(log.resolve() for log in self.logs)
        pose_file, pose_times = (None if path is None else path.resolve() for path in (self.pose_file, self.pose_times))
        return dataclasses.replace(self, logs=logs, pose_file=pose_file, pose_times=pose_times)


@dataclass(frozen=True)
class RunConfig:
    """Everything that a run depends on.

    ``classes`` is None where the logs bring their own class table; ``merge_classes`` and ``ignore_hits`` are what to
    make of that (``edited``). ``link_overrides`` are (sender, receiver, values): what differs from ``link`` in one
    direction of a link.
    """

    robots: tuple[RobotConfig, ...]
    classes: ClassTable | None = None
    merge_classes: Merges = ()
    ignore_hits: tuple[str, ...] = ()
    sensor: SensorConfig = SensorConfig()
    map: MapConfig = MapConfig()
    consensus: ConsensusConfig = ConsensusConfig()
    network: NetworkConfig = NetworkConfig()
    link: LinkConfig = LinkConfig()
    packet: PacketConfig = PacketConfig()
    link_overrides: tuple[tuple[str, str, tuple[tuple[str, Any], ...]], ...] = ()
    time: TimeConfig = TimeConfig()
    output: OutputConfig = OutputConfig()

    def __post_init__(self) -> None:
        if not self.robots:
            raise ConfigError("robots: a team needs at least one robot")
        seen: set[str] = set()
        for robot in self.robots:
            if robot.robot_id in seen:
                raise ConfigError(f"robots: '{robot.robot_id}' is listed twice")
            seen.add(robot.robot_id)
        for sender, receiver, weight in self.network.edges:
            for robot_id in (sender, receiver):
                if robot_id not in seen:
                    raise ConfigError(f"edges: robot '{robot_id}' is not in the team: {', '.join(sorted(seen))}")
            if sender == receiver:
                raise ConfigError(f"edges: '{sender}' cannot have a link to itself")
            if weight is not None and not 0 <= weight < math.inf:
                raise ConfigError(f"edges: the weight of {sender} - {receiver} must be a finite number from 0 on")
        for key, robot_id in _named_robots(self):
            if robot_id not in seen:
                raise ConfigError(f"{key}: robot '{robot_id}' is not in the team: {', '.join(sorted(seen))}")
        for sender, receiver, _ in self.link_overrides:
            if sender == receiver:
                raise ConfigError(f"links: '{sender}' cannot have a link to itself")
            try:
                self.link_config(sender, receiver)
            except ConfigError as error:
                raise ConfigError(f"links: {sender} -> {receiver}: {error}") from error
        for robot in self.robots:
            for name, value in (("publish_period", robot.publish_period), ("publish_phase", robot.publish_phase)):
                ticks = (value or 0.0) / self.network.publish_period
                if abs(ticks - round(ticks)) > 1e-6 or (value and round(ticks) == 0):
                    raise ConfigError(
                        f"robot '{robot.robot_id}': {name} {value:g} s is not a multiple of the team's publish_period"
                        f" {self.network.publish_period:g} s, the length of a tick"
                    )
        if self.sensor.hide_robots and all(robot.body_box is None for robot in self.robots):
            raise ConfigError("hide_robots: no robot has a body_box; give it in the team file")
        _check_rule(self)

    def link_config(self, sender: str, receiver: str) -> LinkConfig:
        """What happens to a packet from one robot to another."""
        values = [changes for a, b, changes in self.link_overrides if (a, b) == (sender, receiver)]
        return dataclasses.replace(self.link, **{name: value for changes in values for name, value in changes})

    def with_parameters(self, values: Mapping[str, Any]) -> RunConfig:
        """This configuration with flat parameters replaced.

        Raises ConfigError for a name that is no parameter, a value of the wrong type or one out of range.
        """
        changes = coerced(values)
        sections = {name: dataclasses.replace(getattr(self, name), **fields) for name, fields in changes.items()}
        return dataclasses.replace(self, **sections)


def coerced(values: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Flat parameters in their types, by section. Raises ConfigError for an unknown name and a wrong type."""
    changes: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        parameter = PARAMETERS.get(name)
        if parameter is None:
            raise ConfigError(f"{name}: unknown parameter{suggestion(name, PARAMETERS)}")
        changes.setdefault(parameter.section, {})[name] = parameter.coerce(value)
    return changes


def _named_robots(config: RunConfig) -> Iterator[tuple[str, str]]:
    """Every robot that the network's parameters name, with the parameter; edges are checked with their weights."""
    for pair in config.network.one_way:
        yield from (("one_way", robot_id) for robot_id in pair)
    for entry in config.network.schedule:
        for group in (*entry.groups, *entry.links_down, *entry.links_up, entry.robots_off, entry.robots_silent):
            yield from (("schedule", robot_id) for robot_id in group)
    for sender, receiver, _ in config.link_overrides:
        yield from (("links", robot_id) for robot_id in (sender, receiver))


def _check_rule(config: RunConfig) -> None:
    """Refuse what a rule cannot do."""
    rule, packet = config.consensus.rule, config.packet
    if rule in ("ratio", "flood") and config.consensus.mode != "sync":
        raise ConfigError(f"mode: rule '{rule}' adds up what arrived once in a tick; use mode 'sync'")
    if rule == "ratio":
        is_exact = packet.is_exact and config.map.prune_tolerance == 0
        if not is_exact or packet.packets != "full":
            raise ConfigError(
                "rule: 'ratio' sends running sums, all of which change in every tick and must be exact; use packets"
                " 'full', content 'float32' and prune_tolerance 0, without budget and top_classes"
            )


@dataclass(frozen=True)
class Parameter:
    """One flat parameter: its name, section, type and what its help says."""

    name: str
    section: str
    kind: str
    default: Any
    help: str
    choices: tuple[str, ...] | None

    def coerce(self, value: Any) -> Any:
        """The value in the parameter's type. Raises ConfigError where it has another."""
        try:
            return self._coerce(value)
        except (TypeError, ValueError):
            expected = {"float": "a number", "int": "a whole number", "bool": "true or false", "str": "a word",
                        "floats": "numbers"}[self.kind]  # fmt: skip
            raise ConfigError(f"{self.name}: expects {expected}, got {value!r}") from None

    def _coerce(self, value: Any) -> Any:
        if value is None and self.default is None:
            return None
        if self.kind == "floats":
            numbers = value.split(",") if isinstance(value, str) else value
            return tuple(as_number(number) for number in ([numbers] if is_number(numbers) else numbers))
        if self.kind == "bool":
            if not isinstance(value, bool):
                raise TypeError
            return value
        if self.kind == "int":
            if not is_number(value) or int(value) != value:
                raise TypeError
            return int(value)
        if self.kind == "float":
            return as_number(value)
        if not isinstance(value, str):
            raise TypeError
        return value


def is_number(value: Any) -> bool:
    """True for int and float, not for bool."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def as_number(value: Any) -> float:
    """A float from a number or its text."""
    if isinstance(value, str):
        return float(value)
    if not is_number(value):
        raise TypeError
    return float(value)


def _parameters() -> Iterator[Parameter]:
    """All flat parameters, in the order of the sections' fields."""
    kinds = {"float": "float", "float | None": "float", "int": "int", "int | None": "int", "bool": "bool",
             "str": "str", "tuple[float, ...]": "floats"}  # fmt: skip
    for section in dataclasses.fields(RunConfig):
        if section.name in ("robots", "classes", "merge_classes", "ignore_hits", "link_overrides"):
            continue
        for item in dataclasses.fields(cast("Any", section.default)):
            if item.metadata:
                yield Parameter(
                    item.name, section.name, kinds[str(item.type)], item.default, item.metadata["help"],
                    item.metadata["choices"],
                )  # fmt: skip


PARAMETERS: Mapping[str, Parameter] = MappingProxyType({parameter.name: parameter for parameter in _parameters()})
"""Every flat parameter by name."""

SECTIONS: Mapping[str, str] = MappingProxyType(
    {
        "sensor": "Inverse sensor model", "map": "Map", "consensus": "Consensus", "network": "Communication graph",
        "link": "Links", "packet": "Packets", "time": "Time and pairing", "output": "What the result holds",
    }
)  # fmt: skip
"""What the sections of parameters are about."""

PRESETS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "paper": MappingProxyType(
            {
                "rule": "gradient", "evidence": "time-average", "mode": "on-arrival", "gamma_per_arrival": "full",
                "topology": "complete", "publish_period": 1.0, "weights": "degree", "settle": 0, "gamma": 1.0,
            }
        )
    }
)  # fmt: skip
"""Named sets of parameters. 'paper' is the literal reading of the paper."""
