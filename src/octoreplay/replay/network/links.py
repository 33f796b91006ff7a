"""Radio links: delay, loss, damage and queueing of packets.

Losses, delays and damage are drawn independently per direction: each direction of a link has its own random generator,
seeded by the run's seed and the two robots, and draws the same number of values for every packet. A change on one link
therefore leaves all others as they are. A link on which nothing is random draws nothing.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Collection, Iterable, Set
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, Protocol, Self, TypeVar

import numpy as np

from octoreplay.config.network import LinkConfig
from octoreplay.config.resolved import ResolvedRun


class Transmission(Protocol):
    """Content of a transmission over a link."""

    @property
    def num_bytes(self) -> int:
        """Length [bytes]."""
        ...

    @property
    def waits(self) -> bool:
        """True for content that queues while the link is busy, False for content that is sent beside the queue."""
        ...

    def damaged(self, share: float) -> Self:
        """Copy with one bit flipped, at the fraction ``share`` in [0, 1) of the content."""
        ...


T = TypeVar("T", bound=Transmission)


class Delivery(NamedTuple, Generic[T]):
    """Content that arrived from one robot at another."""

    sender: int
    receiver: int
    sent_ns: int
    arrival_ns: int
    content: T


@dataclass
class LinkCounts:
    """Counts of one direction of a link since the last call. Only content that queues counts as a packet."""

    num_sent: int = 0
    sent_bytes: int = 0
    num_delivered: int = 0
    delivered_bytes: int = 0
    num_lost: int = 0
    num_dropped: int = 0
    num_late: int = 0


_NO_COUNTS = LinkCounts()


@dataclass
class _Link(Generic[T]):
    """One direction of a link; ``random`` is None where nothing is drawn."""

    config: LinkConfig
    random: np.random.Generator | None
    in_burst: bool = False
    busy_until_ns: int = 0
    waiting: deque[tuple[int, T]] = field(default_factory=deque)
    counts: LinkCounts = field(default_factory=LinkCounts)


class Links(Generic[T]):
    """All links of a team, between robots given by their indices. Times are on the shared clock [ns].

    ``longest_transmission`` is the longest time that a packet kept a link busy [s].
    """

    def __init__(self, config: ResolvedRun) -> None:
        self._config = config
        self._ids = [robot.robot_id for robot in config.robots]
        self._links: dict[tuple[int, int], _Link[T]] = {}
        self._on_air: list[tuple[int, int, int, int, Delivery[T]]] = []
        self._num_started = 0
        self.longest_transmission = 0.0

    def send(self, sender: int, receiver: int, content: T, now_ns: int) -> None:
        """Send content over a link: it is transmitted, queued or dropped."""
        link = self._link(sender, receiver)
        link.counts.num_sent += content.waits
        link.counts.sent_bytes += content.num_bytes
        if link.waiting:
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
        """Deliveries up to now at the robots ``listening``, in the order of (arrival, sender, receiver).

        Content that arrives at other robots is lost.
        """
        for (sender, receiver), link in self._links.items():
            if link.waiting:
                self._start_waiting(sender, receiver, link, now_ns)
        arrived = []
        while self._on_air and self._on_air[0][0] <= now_ns:
            delivery = heapq.heappop(self._on_air)[-1]
            sender, receiver, sent_ns, _, content = delivery
            counts = self._links[sender, receiver].counts
            if receiver not in listening:
                counts.num_lost += content.waits
                continue
            counts.delivered_bytes += content.num_bytes
            if content.waits:
                counts.num_delivered += 1
                counts.num_late += sent_ns < now_ns
            arrived.append(delivery)
        return arrived

    def cut(self, links: Iterable[tuple[int, int]]) -> None:
        """Drop the queues of all links (sender, receiver) that are not in ``links``."""
        standing = set(links)
        for ends, link in self._links.items():
            if link.waiting and ends not in standing:
                link.counts.num_dropped += len(link.waiting)
                link.waiting.clear()

    def lose(self, robots: Set[int]) -> None:
        """Lose all content that is on the air or waits, from and to some robots."""
        kept = []
        for entry in self._on_air:
            delivery = entry[-1]
            if delivery.sender in robots or delivery.receiver in robots:
                self._link(delivery.sender, delivery.receiver).counts.num_lost += delivery.content.waits
            else:
                kept.append(entry)
        self._on_air = kept
        heapq.heapify(self._on_air)
        self.cut(ends for ends in self._links if not robots & set(ends))

    def take_counts(self) -> dict[tuple[int, int], LinkCounts]:
        """Counts since the last call of each direction of a link on which anything happened."""
        counts = {}
        for ends, link in self._links.items():
            if link.counts != _NO_COUNTS:
                counts[ends], link.counts = link.counts, LinkCounts()
        return counts

    def _link(self, sender: int, receiver: int) -> _Link[T]:
        """One direction of a link, made at its first use."""
        link = self._links.get((sender, receiver))
        if link is None:
            config = self._config.link_config(self._ids[sender], self._ids[receiver])
            seed = [self._config.network.network_seed, sender, receiver]
            link = _Link(config, np.random.default_rng(seed) if config.is_random else None)
            self._links[sender, receiver] = link
        return link

    def _start_waiting(self, sender: int, receiver: int, link: _Link[T], now_ns: int) -> None:
        """Transmit queued content for as long as the link has become free by now."""
        while link.waiting and link.busy_until_ns <= now_ns:
            sent_ns, content = link.waiting.popleft()
            self._start(sender, receiver, link, sent_ns, max(link.busy_until_ns, sent_ns), content)

    def _start(self, sender: int, receiver: int, link: _Link[T], sent_ns: int, start_ns: int, content: T) -> None:
        """Transmit content: draw its loss, delay and damage."""
        config, delay = link.config, link.config.latency
        if config.rate is not None and content.waits:
            seconds = content.num_bytes / config.rate
            self.longest_transmission = max(self.longest_transmission, seconds)
            link.busy_until_ns = start_ns + round(seconds * 1e9)
            start_ns = link.busy_until_ns
        if link.random is not None:
            turn, loss, deviation, corruption, place = link.random.random(5).tolist()
            link.in_burst = turn >= config.burst_end if link.in_burst else turn < config.burst_start
            if loss < (config.burst_loss if link.in_burst else config.loss):
                link.counts.num_lost += content.waits
                return
            delay += config.jitter * (2.0 * deviation - 1.0)
            if corruption < config.corruption:
                content = content.damaged(place)
        arrival_ns = start_ns + round(delay * 1e9)
        self._num_started += 1
        delivery = Delivery(sender, receiver, sent_ns, arrival_ns, content)
        heapq.heappush(self._on_air, (arrival_ns, sender, receiver, self._num_started, delivery))
