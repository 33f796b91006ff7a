"""Configuration of the communication graph, its schedule and its links."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from octoreplay.config.fields import check_ranges, parameter
from octoreplay.errors import ConfigError

TOPOLOGIES = ("complete", "ring", "line", "star", "grid", "nearest", "range", "random", "edges")
POSITION_TOPOLOGIES = ("nearest", "range")
"""Topologies whose links depend on the robots' positions; the others are fixed over a run."""

WEIGHTS = ("metropolis", "degree", "max-degree", "given")


@dataclass(frozen=True)
class ScheduleEntry:
    """Entry of a schedule: robots and links that are down or up in [start, end) [s since the run's start].

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
    """Configuration of the simulated communication graph."""

    topology: str = parameter(
        "complete",
        "communication graph: complete, ring, line, star, grid, nearest (neighbours), range (radio range), random"
        " (Erdos-Renyi) or edges (edge list)",
        choices=TOPOLOGIES,
        is_common=True,
    )
    edges: tuple[tuple[str, str, float | None], ...] = field(default=())
    one_way: tuple[tuple[str, str], ...] = field(default=())
    schedule: tuple[ScheduleEntry, ...] = field(default=())
    num_nearest: int = parameter(2, "topology nearest: number of nearest robots that a robot has links to", minimum=1)
    radio_range: float = parameter(30.0, "topology range: distance below which two robots get a link [m]", above=0.0)
    range_hysteresis: float = parameter(
        3.0, "topology range: additional distance at which a link breaks [m]", minimum=0.0
    )
    prob_link: float = parameter(0.5, "topology random: probability of each link", minimum=0.0, maximum=1.0)
    network_seed: int = parameter(0, "seed of the random graph, packet losses, corruption and jitter", minimum=0)
    weights: str = parameter(
        "metropolis",
        "link weights: metropolis, degree (1 / degree), max-degree, or given in the edge list",
        choices=WEIGHTS,
    )
    publish_period: float = parameter(
        1.0,
        "period between a robot's published maps, the length of a tick [s]",
        above=0.0,
        maximum=86_400.0,
        is_common=True,
    )
    after_end: str = parameter(
        "stay", "after its last scan a robot keeps exchanging maps (stay) or not (leave)", choices=("stay", "leave")
    )

    def __post_init__(self) -> None:
        check_ranges(self)
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
    """Configuration of one direction of a link: delay, loss, rate and queue.

    Losses follow Gilbert and Elliott's two states: a packet is lost with ``loss`` in the good state and ``burst_loss``
    in the bad one; before every packet the good state turns bad with ``burst_start`` and the bad one good with
    ``burst_end``. Without ``burst_start`` they are independent (Bernoulli).
    """

    latency: float = parameter(0.0, "mean packet delay [s]", minimum=0.0)
    jitter: float = parameter(
        0.0, "largest deviation from the mean packet delay, uniformly distributed [s]", minimum=0.0
    )
    loss: float = parameter(
        0.0, "probability that a packet is lost, outside bursts", minimum=0.0, maximum=1.0, is_common=True
    )
    burst_start: float = parameter(
        0.0, "probability per packet that a burst of losses starts (Gilbert-Elliott model)", minimum=0.0, maximum=1.0
    )
    burst_end: float = parameter(0.5, "probability per packet that a burst ends", above=0.0, maximum=1.0)
    burst_loss: float = parameter(1.0, "probability that a packet is lost within a burst", minimum=0.0, maximum=1.0)
    corruption: float = parameter(
        0.0, "probability that a packet arrives damaged and is dropped", minimum=0.0, maximum=1.0
    )
    rate: float | None = parameter(None, "link capacity [bytes/s] (default: no limit)", above=0.0)
    queue: str = parameter(
        "newest",
        "packets waiting for a busy link: the newest, or all that fit into queue_bytes (drop-tail)",
        choices=("newest", "drop-tail"),
    )
    queue_bytes: int = parameter(1_000_000, "queue drop-tail: capacity of a link's queue [bytes]", minimum=1)

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.jitter > self.latency:
            raise ConfigError(f"jitter: {self.jitter:g} is above latency {self.latency:g}; a delay cannot be negative")

    @property
    def is_random(self) -> bool:
        """True where delay, loss or damage is random."""
        return any((self.jitter, self.loss, self.burst_start, self.corruption))

    @property
    def mean_loss(self) -> float:
        """Long-term share of the packets that are lost or damaged, without a rate limit."""
        in_burst = self.burst_start / (self.burst_start + self.burst_end)
        return (1.0 - in_burst) * self._missing(self.loss) + in_burst * self._missing(self.burst_loss)

    @property
    def repeated_loss(self) -> float:
        """Ratio of the probabilities of n + 1 and of n lost packets in a row, for large n.

        The largest eigenvalue of the two states' transitions, each times the loss in the state that it leads to.
        """
        good, bad = self._missing(self.loss), self._missing(self.burst_loss)
        if self.burst_start == 0.0:
            return good
        stay_good, stay_bad = (1.0 - self.burst_start) * good, (1.0 - self.burst_end) * bad
        change = self.burst_start * bad * self.burst_end * good
        return (stay_good + stay_bad + math.sqrt((stay_good - stay_bad) ** 2 + 4.0 * change)) / 2.0

    def _missing(self, loss: float) -> float:
        """Share of lost or damaged packets, with the loss of one state."""
        return 1.0 - (1.0 - loss) * (1.0 - self.corruption)
