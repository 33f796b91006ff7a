"""What a run can be told: frozen dataclasses with range checks, and the team file that holds them.

Every parameter has one name: in the team file (a flat key), on the command line (``--name-with-dashes``) and here.
This is the only module that reads or writes configuration files.
"""

from __future__ import annotations

import dataclasses
import difflib
import io
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

from octoreplay.errors import ConfigError
from octoreplay.records import ClassTable, SemanticClass

RULES = ("gradient", "bayes", "natural", "ratio", "flood", "merge", "local")
EVIDENCES = ("sum", "time-average", "cell-average")
MODES = ("sync", "on-arrival")
TOPOLOGIES = ("complete", "ring", "line", "star", "grid", "nearest", "range", "random", "edges")
WEIGHTS = ("metropolis", "degree", "max-degree", "given")

PALETTE: tuple[tuple[int, int, int], ...] = (
    (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (0, 114, 178), (213, 94, 0), (204, 121, 167),
    (120, 120, 120), (127, 60, 141), (17, 165, 121), (57, 105, 172), (242, 183, 1), (231, 63, 116), (128, 186, 90),
)  # fmt: skip
"""Colours for classes that come without one (the first seven: Okabe and Ito's colour-blind safe set)."""


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


def _check_ranges(config: Any) -> None:
    """Check every parameter of one section against its type and range."""
    for item in dataclasses.fields(config):
        value, meta = getattr(config, item.name), item.metadata
        if value is None or not meta:
            continue
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{item.name}: {value} is not a finite number")
        if meta["choices"] is not None and value not in meta["choices"]:
            raise ConfigError(f"{item.name}: '{value}' is not one of {', '.join(meta['choices'])}")
        if meta["minimum"] is not None and value < meta["minimum"]:
            raise ConfigError(f"{item.name}: {value} is below the least value {meta['minimum']:g}")
        if meta["maximum"] is not None and value > meta["maximum"]:
            raise ConfigError(f"{item.name}: {value} is above the largest value {meta['maximum']:g}")
        if meta["above"] is not None and value <= meta["above"]:
            raise ConfigError(f"{item.name}: {value} must be greater than {meta['above']:g}")


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
    publish_period: float = _parameter(1.0, "every robot publishes its map every so often [s]", above=0.0)
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
    reorder_window: float = _parameter(1.0, "messages may be this much out of order [s]", minimum=0.0)
    pair_tolerance: float = _parameter(0.02, "depth and label may be this far apart [s]", minimum=0.0)
    pose_gap: float = _parameter(0.5, "poses further apart than this are not interpolated between [s]", above=0.0)
    strict_labels: bool = _parameter(False, "refuse raw labels that the class table does not know")

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

    ``intrinsics`` is (fx, fy, cx, cy) in pixels in place of CameraInfo. Transforms are (x, y, z, qx, qy, qz, qw):
    ``T_team_map`` from the robot's map frame to the team's, ``T_body_sensor`` from the sensor's frame to the frame
    whose pose the pose topic gives, in place of TF. ``clock_offset`` [s] is added to the robot's stamps. The robot
    publishes every ``publish_period`` [s], the team's unless given, ``publish_phase`` [s] after the ticks that are
    multiples of it.
    """

    robot_id: str
    logs: tuple[Path, ...]
    depth_topic: str | None = None
    label_topic: str | None = None
    camera_info_topic: str | None = None
    cloud_topic: str | None = None
    pose_topic: str | None = None
    label_info_topic: str | None = None
    map_frame: str | None = None
    sensor_frame: str | None = None
    intrinsics: tuple[float, ...] | None = None
    depth_unit: float | None = None
    clock_offset: float = 0.0
    T_team_map: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    T_body_sensor: tuple[float, ...] | None = None
    publish_period: float | None = None
    publish_phase: float = 0.0

    def __post_init__(self) -> None:
        if not self.robot_id or "/" in self.robot_id:
            raise ConfigError(f"robot id '{self.robot_id}': must not be empty or contain '/'")
        if not self.logs:
            raise ConfigError(f"robot '{self.robot_id}': needs a log")
        for name in ("T_team_map", "T_body_sensor"):
            value = getattr(self, name)
            if value is None:
                continue
            if len(value) != 7:
                raise ConfigError(f"robot '{self.robot_id}': {name} expects 7 numbers x, y, z, qx, qy, qz, qw")
            if abs(math.hypot(*value[3:]) - 1.0) > 1e-3:
                raise ConfigError(f"robot '{self.robot_id}': {name}'s quaternion must have length 1")
        if self.intrinsics is not None and (len(self.intrinsics) != 4 or min(self.intrinsics[:2]) <= 0):
            raise ConfigError(f"robot '{self.robot_id}': intrinsics expects 4 numbers fx, fy, cx, cy")
        if self.depth_unit is not None and self.depth_unit <= 0:
            raise ConfigError(f"robot '{self.robot_id}': depth_unit must be greater than 0")
        if self.publish_period is not None and not 0 < self.publish_period < math.inf:
            raise ConfigError(f"robot '{self.robot_id}': publish_period must be greater than 0")
        if not 0 <= self.publish_phase < math.inf:
            raise ConfigError(f"robot '{self.robot_id}': publish_phase must not be negative")
        if self.depth_topic and self.cloud_topic:
            raise ConfigError(f"robot '{self.robot_id}': give depth_topic or cloud_topic, not both")


@dataclass(frozen=True)
class RunConfig:
    """Everything that a run depends on.

    ``classes`` is None where the logs bring their own class table. ``link_overrides`` are (sender, receiver, values):
    what differs from ``link`` in one direction of a link.
    """

    robots: tuple[RobotConfig, ...]
    classes: ClassTable | None = None
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
        _check_rule(self)

    def link_config(self, sender: str, receiver: str) -> LinkConfig:
        """What happens to a packet from one robot to another."""
        values = [changes for a, b, changes in self.link_overrides if (a, b) == (sender, receiver)]
        return dataclasses.replace(self.link, **{name: value for changes in values for name, value in changes})

    def with_parameters(self, values: Mapping[str, Any]) -> RunConfig:
        """This configuration with flat parameters replaced.

        Raises ConfigError for a name that is no parameter, a value of the wrong type or one out of range.
        """
        changes = _coerced(values)
        sections = {name: dataclasses.replace(getattr(self, name), **fields) for name, fields in changes.items()}
        return dataclasses.replace(self, **sections)


def _coerced(values: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Flat parameters in their types, by section. Raises ConfigError for an unknown name and a wrong type."""
    changes: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        parameter = PARAMETERS.get(name)
        if parameter is None:
            raise ConfigError(f"{name}: unknown parameter{_suggestion(name, PARAMETERS)}")
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
            return tuple(_number(number) for number in ([numbers] if _is_number(numbers) else numbers))
        if self.kind == "bool":
            if not isinstance(value, bool):
                raise TypeError
            return value
        if self.kind == "int":
            if not _is_number(value) or int(value) != value:
                raise TypeError
            return int(value)
        if self.kind == "float":
            return _number(value)
        if not isinstance(value, str):
            raise TypeError
        return value


def _is_number(value: Any) -> bool:
    """True for int and float, not for bool."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def _number(value: Any) -> float:
    """A float from a number or its text."""
    if isinstance(value, str):
        return float(value)
    if not _is_number(value):
        raise TypeError
    return float(value)


def _parameters() -> Iterator[Parameter]:
    """All flat parameters, in the order of the sections' fields."""
    kinds = {"float": "float", "float | None": "float", "int": "int", "int | None": "int", "bool": "bool",
             "str": "str", "tuple[float, ...]": "floats"}  # fmt: skip
    for section in dataclasses.fields(RunConfig):
        if section.name in ("robots", "classes", "link_overrides"):
            continue
        for item in dataclasses.fields(cast("Any", section.default)):
            if item.metadata:
                yield Parameter(
                    item.name, section.name, kinds[str(item.type)], item.default, item.metadata["help"],
                    item.metadata["choices"],
                )  # fmt: skip


PARAMETERS: Mapping[str, Parameter] = MappingProxyType({parameter.name: parameter for parameter in _parameters()})
"""Every flat parameter by name."""

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


def _suggestion(name: str, known: Any) -> str:
    """'; did you mean ...' for the nearest known name, or nothing."""
    near = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean '{near[0]}'?" if near else ""


# --- team files ------------------------------------------------------------------------------------------------------

_ROBOT_KEYS = ("id", "log", *(f.name for f in dataclasses.fields(RobotConfig) if f.name not in ("robot_id", "logs")))
_CLASS_KEYS = ("name", "color", "raw_labels")
_SCHEDULE_KEYS = {"from": "start", "to": "end", **{f.name: f.name for f in dataclasses.fields(ScheduleEntry)[2:]}}
_LINK_KEYS = tuple(f.name for f in dataclasses.fields(LinkConfig))
_TEAM_KEYS = ("robots", "classes", "ignored_raw_labels", "edges", "one_way", "schedule", "links")


def load_team_file(path: str | Path) -> RunConfig:
    """Read a team file. Log paths in it are relative to its folder.

    Raises ConfigError with the file and the key for anything that is not understood.
    """
    path = Path(path)
    return parse_team(_read_text(path, "team"), source=str(path), folder=path.parent)


def _read_text(path: Path, kind: str) -> str:
    """A configuration file's text."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a {kind} file (no UTF-8 text)") from error


def parse_team(text: str, *, source: str, folder: Path) -> RunConfig:
    """A configuration from a team file's text; ``source`` names it in errors. Raises ConfigError."""
    content = _load_yaml(text, source)
    try:
        return _team_from_mapping(content, folder)
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from error


def _load_yaml(text: str, source: str) -> Any:
    """What a YAML text holds."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        return YAML(typ="safe", pure=True).load(text)
    except YAMLError as error:
        line = getattr(getattr(error, "problem_mark", None), "line", None)
        where = "" if line is None else f" (line {line + 1})"
        raise ConfigError(f"{source}: not valid YAML{where}: {getattr(error, 'problem', None) or error}") from error


def _team_from_mapping(content: Any, folder: Path) -> RunConfig:
    if not isinstance(content, Mapping):
        raise ConfigError("a team file is a YAML mapping with the key 'robots'")
    if "robots" not in content or not isinstance(content["robots"], list):
        raise ConfigError("robots: expects a list of robots, each with 'id' and 'log'")
    for key in content:
        if key not in _TEAM_KEYS and key not in PARAMETERS:
            raise ConfigError(f"{key}: unknown key{_suggestion(str(key), (*_TEAM_KEYS, *PARAMETERS))}")
    robots = tuple(_robot_from_mapping(entry, folder) for entry in content["robots"])
    classes = None
    if content.get("classes") is not None:
        classes = class_table(content["classes"], content.get("ignored_raw_labels") or ())
    changes = _coerced({key: value for key, value in content.items() if key in PARAMETERS})
    changes.setdefault("network", {}).update(
        edges=_edges(content.get("edges") or ()),
        one_way=_pairs("one_way", content.get("one_way") or ()),
        schedule=schedule(content.get("schedule") or ()),
    )
    # All at once: what one parameter may be depends on others.
    defaults = {item.name: item.default for item in dataclasses.fields(RunConfig)}
    return RunConfig(
        robots=robots,
        classes=classes,
        link_overrides=_link_overrides(content.get("links") or ()),
        **{name: dataclasses.replace(cast("Any", defaults[name]), **fields) for name, fields in changes.items()},
    )


def _robot_from_mapping(entry: Any, folder: Path) -> RobotConfig:
    if not isinstance(entry, Mapping):
        raise ConfigError("robots: every robot is a mapping with 'id' and 'log'")
    robot_id = str(entry.get("id", ""))
    for key in entry:
        if key not in _ROBOT_KEYS:
            raise ConfigError(f"robot '{robot_id}': {key}: unknown key{_suggestion(str(key), _ROBOT_KEYS)}")
    logs = entry.get("log") or ()
    logs = (logs,) if isinstance(logs, str) else logs
    if not isinstance(logs, list | tuple) or not all(isinstance(log, str) for log in logs):
        raise ConfigError(f"robot '{robot_id}': log: expects a path or a list of paths")
    fields: dict[str, Any] = {}
    for key, value in entry.items():
        if key in ("id", "log") or value is None:
            continue
        try:
            if key in ("intrinsics", "T_team_map", "T_body_sensor"):
                fields[key] = tuple(_number(number) for number in value)
            elif key in ("clock_offset", "depth_unit", "publish_period", "publish_phase"):
                fields[key] = _number(value)
            else:
                if not isinstance(value, str):
                    raise TypeError
                fields[key] = value
        except (TypeError, ValueError):
            raise ConfigError(f"robot '{robot_id}': {key}: {value!r} has the wrong type") from None
    return RobotConfig(robot_id=robot_id, logs=tuple(folder / log for log in logs), **fields)


def _edges(entries: Any) -> tuple[tuple[str, str, float | None], ...]:
    """Edges from lists [a, b] or [a, b, weight]."""
    edges = []
    for entry in entries:
        if not isinstance(entry, list | tuple) or len(entry) not in (2, 3):
            raise ConfigError("edges: every edge is a list [robot, robot] or [robot, robot, weight]")
        if len(entry) == 3 and not _is_number(entry[2]):
            raise ConfigError(f"edges: the weight of {entry[0]} - {entry[1]} is not a number")
        edges.append((str(entry[0]), str(entry[1]), float(entry[2]) if len(entry) == 3 else None))
    return tuple(edges)


def _pairs(key: str, entries: Any) -> tuple[tuple[str, str], ...]:
    """Pairs of robots from lists [a, b]."""
    if not isinstance(entries, list | tuple) or not all(isinstance(e, list | tuple) and len(e) == 2 for e in entries):
        raise ConfigError(f"{key}: expects a list of pairs [robot, robot]")
    return tuple((str(a), str(b)) for a, b in entries)


def load_schedule(path: str | Path) -> tuple[ScheduleEntry, ...]:
    """Read a schedule file: a YAML list of entries. Raises ConfigError with the file and the entry."""
    path = Path(path)
    content = _load_yaml(_read_text(path, "schedule"), str(path))
    try:
        return schedule(content)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def schedule(entries: Any) -> tuple[ScheduleEntry, ...]:
    """A schedule from the list that a file holds: mappings with from, to and what is up or down.

    Raises ConfigError for an unknown key or a wrong type.
    """
    if not isinstance(entries, list | tuple):
        raise ConfigError("schedule: expects a list of entries, each with 'from' and what is up or down")
    found = []
    for entry in entries:
        if not isinstance(entry, Mapping) or "from" not in entry:
            raise ConfigError("schedule: every entry is a mapping with 'from' [s] and what is up or down")
        values: dict[str, Any] = {}
        for key, value in entry.items():
            if key not in _SCHEDULE_KEYS:
                raise ConfigError(f"schedule: {key}: unknown key{_suggestion(str(key), _SCHEDULE_KEYS)}")
            if key in ("from", "to"):
                if not _is_number(value):
                    raise ConfigError(f"schedule: {key}: {value!r} is not a number of seconds")
                value = float(value)
            elif key == "forget":
                if not isinstance(value, bool):
                    raise ConfigError(f"schedule: {key}: expects true or false, got {value!r}")
            elif key in ("links_down", "links_up"):
                value = _pairs(f"schedule: {key}", value)
            elif key == "groups":
                if not isinstance(value, list | tuple) or not all(isinstance(group, list | tuple) for group in value):
                    raise ConfigError("schedule: groups: expects a list of lists of robots")
                value = tuple(tuple(str(robot_id) for robot_id in group) for group in value)
            else:
                names = [value] if isinstance(value, str) else value
                if not isinstance(names, list | tuple):
                    raise ConfigError(f"schedule: {key}: expects a list of robots")
                value = tuple(str(robot_id) for robot_id in names)
            values[_SCHEDULE_KEYS[key]] = value
        found.append(ScheduleEntry(**values))
    return tuple(found)


def _link_overrides(entries: Any) -> tuple[tuple[str, str, tuple[tuple[str, Any], ...]], ...]:
    """Links that differ, from mappings with 'from' and 'to', or 'between' for both directions, and link parameters."""
    if not isinstance(entries, list | tuple):
        raise ConfigError("links: expects a list of links, each with 'from' and 'to' or 'between', and what differs")
    found = []
    for entry in entries:
        named = {"between", "from", "to"}.intersection(entry) if isinstance(entry, Mapping) else set()
        if named not in ({"between"}, {"from", "to"}):
            raise ConfigError("links: every link names 'from' and 'to', or 'between' two robots for both directions")
        changes = {key: value for key, value in entry.items() if key not in ("between", "from", "to")}
        for key in changes:
            if key not in _LINK_KEYS:
                raise ConfigError(f"links: {key}: unknown key{_suggestion(str(key), _LINK_KEYS)}")
        try:
            values = tuple((key, PARAMETERS[key].coerce(value)) for key, value in changes.items())
        except ConfigError as error:
            raise ConfigError(f"links: {error}") from error
        if "between" in entry:
            pair = entry["between"]
            if not isinstance(pair, list | tuple) or len(pair) != 2:
                raise ConfigError(f"links: between: expects [robot, robot], got {pair!r}")
            a, b = (str(robot_id) for robot_id in pair)
            found += [(a, b, values), (b, a, values)]
        else:
            found.append((str(entry["from"]), str(entry["to"]), values))
    return tuple(found)


def class_table(entries: Any, ignored: Any = ()) -> ClassTable:
    """A class table from the list that a team file holds: mappings with name, color [r, g, b] and raw_labels.

    Raises ConfigError for an unknown key, a wrong type, or a raw label that has two meanings.
    """
    if not isinstance(entries, list | tuple) or not entries:
        raise ConfigError("classes: expects a list of classes, each with 'name' and 'raw_labels'")
    if len(entries) > 254:
        raise ConfigError(f"classes: at most 254 classes, got {len(entries)}")
    classes = []
    meaning: dict[int, str] = {}
    for index, entry in enumerate(entries):
        if not isinstance(entry, Mapping) or "name" not in entry:
            raise ConfigError("classes: every class is a mapping with 'name', 'color' and 'raw_labels'")
        for key in entry:
            if key not in _CLASS_KEYS:
                raise ConfigError(f"classes: {key}: unknown key{_suggestion(str(key), _CLASS_KEYS)}")
        name = str(entry["name"])
        raw_labels = _raw_labels(entry.get("raw_labels", [index + 1]), name)
        for raw in raw_labels:
            if raw in meaning:
                raise ConfigError(f"classes: raw label {raw} means both '{meaning[raw]}' and '{name}'")
            meaning[raw] = name
        color = entry.get("color") or PALETTE[index % len(PALETTE)]
        if len(color) != 3 or not all(isinstance(c, int) and 0 <= c <= 255 for c in color):
            raise ConfigError(f"classes: the color of '{name}' must be three whole numbers from 0 to 255")
        classes.append(SemanticClass(index + 1, name, (color[0], color[1], color[2]), raw_labels))
    ignored_labels = _raw_labels(ignored, "ignored_raw_labels")
    for raw in ignored_labels:
        if raw in meaning:
            raise ConfigError(f"classes: raw label {raw} means '{meaning[raw]}' and is in ignored_raw_labels")
    return ClassTable(tuple(classes), ignored_labels)


def _raw_labels(value: Any, name: str) -> tuple[int, ...]:
    """Raw labels as whole numbers."""
    values = [value] if _is_number(value) else value
    if not isinstance(values, list | tuple) or not all(isinstance(v, int) and not isinstance(v, bool) for v in values):
        raise ConfigError(f"classes: the raw labels of '{name}' must be whole numbers")
    return tuple(values)


def dump_team(config: RunConfig, folder: Path | None = None) -> str:
    """The team file's text of a configuration: everything that differs from the defaults, and every robot.

    Log paths are written relative to ``folder`` where they lie below it. ``parse_team`` gives the same configuration.
    """
    from ruamel.yaml import YAML

    content: dict[str, Any] = {"robots": [_robot_to_mapping(robot, folder) for robot in config.robots]}
    if config.classes is not None:
        content["classes"] = [
            {"name": c.name, "color": list(c.color), "raw_labels": list(c.raw_labels)} for c in config.classes.classes
        ]
        if config.classes.ignored_raw_labels:
            content["ignored_raw_labels"] = list(config.classes.ignored_raw_labels)
    if config.network.edges:
        content["edges"] = [[e for e in edge if e is not None] for edge in config.network.edges]
    if config.network.one_way:
        content["one_way"] = [list(pair) for pair in config.network.one_way]
    if config.network.schedule:
        content["schedule"] = [_entry_to_mapping(entry) for entry in config.network.schedule]
    if config.link_overrides:
        content["links"] = [{"from": a, "to": b, **dict(values)} for a, b, values in config.link_overrides]
    for name, parameter in PARAMETERS.items():
        value = getattr(getattr(config, parameter.section), name)
        if value != parameter.default:
            content[name] = list(value) if isinstance(value, tuple) else value
    buffer = io.StringIO()
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    yaml.width = 110
    yaml.dump(content, buffer)
    return buffer.getvalue()


def _entry_to_mapping(entry: ScheduleEntry) -> dict[str, Any]:
    """One entry of a schedule as a file holds it."""

    def plain(value: Any) -> Any:
        return [plain(part) for part in value] if isinstance(value, tuple) else value

    defaults = ScheduleEntry(start=0.0)
    values = {key: getattr(entry, name) for key, name in _SCHEDULE_KEYS.items()}
    return {
        key: plain(value)
        for key, value in values.items()
        if key == "from" or value != getattr(defaults, _SCHEDULE_KEYS[key])
    }


def _robot_to_mapping(robot: RobotConfig, folder: Path | None) -> dict[str, Any]:
    """One robot as a team file holds it."""

    def text(path: Path) -> str:
        return str(path.relative_to(folder) if folder is not None and path.is_relative_to(folder) else path)

    logs = [text(path) for path in robot.logs]
    entry: dict[str, Any] = {"id": robot.robot_id, "log": logs[0] if len(logs) == 1 else logs}
    for item in dataclasses.fields(RobotConfig):
        if item.name in ("robot_id", "logs"):
            continue
        value = getattr(robot, item.name)
        if value != item.default:
            entry[item.name] = list(value) if isinstance(value, tuple) else value
    return entry
