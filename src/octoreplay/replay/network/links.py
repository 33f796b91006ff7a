"""The radio links: when a packet arrives, in what state, or that it never does.

Every direction of a link has a generator of its own, seeded by the run's seed and the two robots, and takes the same
number of draws from it for every packet: what happens on one link does not depend on the others.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from typing import Generic, Protocol, Self, TypeVar

import numpy as np

from octoreplay.config.network import LinkConfig
from octoreplay.config.run import RunConfig


class Transmission(Protocol):
    """What a link carries."""

    @property
    def num_bytes(self) -> int:
        """Its length [bytes]."""
        ...

    @property
    def waits(self) -> bool:
        """True for what takes its turn in the queue of a busy link; false for what is sent beside it."""
        ...

    def damaged(self, share: float) -> Self:
        """The same with one bit flipped, ``share`` in [0, 1) of the way through."""
        ...


T = TypeVar("T", bound=Transmission)


@dataclass(frozen=True)
class Delivery(Generic[T]):
    """What arrived from a robot at another."""

    sender: int
    receiver: int
    sent_ns: int
    arrival_ns: int
    content: T


@dataclass
class LinkCounts:
    """What happened on one direction of a link since it was last asked. Packets are those that wait their turn."""

    num_sent: int = 0
    sent_bytes: int = 0
    num_delivered: int = 0
    delivered_bytes: int = 0
    num_lost: int = 0
    num_dropped: int = 0
    num_late: int = 0


@dataclass
class _Link(Generic[T]):
    """One direction of a link."""

    config: LinkConfig
    random: np.random.Generator
    in_burst: bool = False
    busy_until_ns: int = 0
    waiting: deque[tuple[int, T]] = field(default_factory=deque)
    counts: LinkCounts = field(default_factory=LinkCounts)


class Links(Generic[T]):
    """All links of a team, between robots given by their indices. Times are of the shared clock [ns].

    ``longest_transmission`` is the longest time [s] that a packet kept a link with a rate busy.
    """

    def __init__(self, config: RunConfig) -> None:
        self._config = config
        self._ids = [robot.robot_id for robot in config.robots]
        self._links: dict[tuple[int, int], _Link[T]] = {}
        self._on_air: list[tuple[int, int, int, int, Delivery[T]]] = []
        self._num_started = 0
        self.longest_transmission = 0.0

    def send(self, sender: int, receiver: int, content: T, now_ns: int) -> None:
        """Hand something to a link. It is on its way, in the link's queue, or gone."""
        link = self._link(sender, receiver)
        link.counts.num_sent += content.waits
        link.counts.sent_bytes += content.num_bytes
        self._start_waiting(sender, receiver, link, now_ns)
        if not content.waits or (link.busy_until_ns <= now_ns and not link.waiting):
            self._start(sender, receiver, link, now_ns, now_ns, content)
            return
        if link.config.queue == "newest":
            link.counts.num_dropped += len(link.waiting)
            link.waiting.clear()
        elif sum(other.num_bytes for _, other in link.waiting) + content.num_bytes > link.config.queue_bytes:
            link.counts.num_dropped += 1
            return
        link.waiting.append((now_ns, content))

    def deliver(self, now_ns: int, listening: Collection[int]) -> list[Delivery[T]]:
        """What has arrived by now at the robots that are ``listening``, in the order of (arrival, sender, receiver).

        What arrives at others is lost.
        """
        for (sender, receiver), link in self._links.items():
            self._start_waiting(sender, receiver, link, now_ns)
        arrived = []
        while self._on_air and self._on_air[0][0] <= now_ns:
            delivery = heapq.heappop(self._on_air)[-1]
            counts = self._link(delivery.sender, delivery.receiver).counts
            if delivery.receiver not in listening:
                counts.num_lost += delivery.content.waits
                continue
            counts.delivered_bytes += delivery.content.num_bytes
            if delivery.content.waits:
                counts.num_delivered += 1
                counts.num_late += delivery.sent_ns < now_ns
            arrived.append(delivery)
        return arrived

    def cut(self, links: Iterable[tuple[int, int]]) -> None:
        """Empty the queues of all links (sender, receiver) but these: the others do not exist now."""
        standing = set(links)
        for ends, link in self._links.items():
            if ends not in standing:
                link.counts.num_dropped += len(link.waiting)
                link.waiting.clear()

    def take_counts(self) -> dict[tuple[int, int], LinkCounts]:
        """What happened on each direction of each link since the last call."""
        counts = {ends: link.counts for ends, link in self._links.items()}
        for link in self._links.values():
            link.counts = LinkCounts()
        return counts

    def _link(self, sender: int, receiver: int) -> _Link[T]:
        """One direction of a link; made at its first use."""
        if (sender, receiver) not in self._links:
            config = self._config.link_config(self._ids[sender], self._ids[receiver])
            random = np.random.default_rng([self._config.network.network_seed, sender, receiver])
            self._links[sender, receiver] = _Link(config, random)
        return self._links[sender, receiver]

    def _start_waiting(self, sender: int, receiver: int, link: _Link[T], now_ns: int) -> None:
        """Start what waited for the link to become free, as far as that happened by now."""
        while link.waiting and link.busy_until_ns <= now_ns:
            sent_ns, content = link.waiting.popleft()
            self._start(sender, receiver, link, sent_ns, max(link.busy_until_ns, sent_ns), content)

    def _start(self, sender: int, receiver: int, link: _Link[T], sent_ns: int, start_ns: int, content: T) -> None:
        """Put something on the air; decides whether, when and how it arrives."""
        config = link.config
        turn, loss, delay, corruption, place = link.random.random(5)
        if config.rate is not None and content.waits:
            seconds = content.num_bytes / config.rate
            self.longest_transmission = max(self.longest_transmission, seconds)
            link.busy_until_ns = start_ns + round(seconds * 1e9)
            start_ns = link.busy_until_ns
        link.in_burst = turn >= config.burst_end if link.in_burst else turn < config.burst_start
        if loss < (config.burst_loss if link.in_burst else config.loss):
            link.counts.num_lost += content.waits
            return
        arrival_ns = start_ns + round((config.latency + config.jitter * (2.0 * delay - 1.0)) * 1e9)
        if corruption < config.corruption:
            content = content.damaged(place)
        delivery = Delivery(sender, receiver, sent_ns, arrival_ns, content)
        self._num_started += 1
        heapq.heappush(self._on_air, (arrival_ns, sender, receiver, self._num_started, delivery))
