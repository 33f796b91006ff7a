"""Radio links: delay, loss, rate and queue; losses are drawn independently per direction."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from octoreplay.config.network import LinkConfig
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.errors import ConfigError
from octoreplay.replay.network.links import LinkCounts, Links

SECOND = 1_000_000_000
EVERYBODY = range(3)


@dataclass(frozen=True)
class Content:
    """A packet with a number."""

    number: int
    num_bytes: int = 100
    waits: bool = True
    is_damaged: bool = False

    def damaged(self, share):
        assert 0 <= share < 1
        return Content(self.number, self.num_bytes, self.waits, is_damaged=True)


def _links(overrides=(), seed=0, **parameters):
    robots = tuple(RobotConfig(name, (Path(f"{name}.mcap"),)) for name in "abc")
    config = RunConfig(robots=robots, link=LinkConfig(**parameters), link_overrides=overrides)
    return Links(config.with_parameters({"network_seed": seed}))


def _numbers(deliveries):
    return [delivery.content.number for delivery in deliveries]


def test_without_delay_a_packet_arrives_at_once():
    links = _links()
    links.send(1, 0, Content(1), 5)
    links.send(0, 1, Content(2), 5)
    assert [(d.sender, d.receiver, d.sent_ns, d.arrival_ns) for d in links.deliver(5, EVERYBODY)] == [
        (0, 1, 5, 5), (1, 0, 5, 5),
    ]  # fmt: skip
    assert links.deliver(10 * SECOND, EVERYBODY) == []


def test_packets_are_ordered_by_arrival_and_sender():
    links = _links((("b", "a", (("latency", 0.5),)),), latency=1.0)
    links.send(2, 0, Content(1), 0)
    links.send(1, 0, Content(2), 0)
    links.send(0, 1, Content(3), 0)
    links.send(1, 0, Content(4), SECOND // 2)
    assert _numbers(links.deliver(SECOND // 2 - 1, EVERYBODY)) == []
    assert _numbers(links.deliver(SECOND, EVERYBODY)) == [2, 3, 4, 1]


def test_jitter_spreads_delays_evenly_around_the_latency():
    links = _links(latency=1.0, jitter=0.4)
    for number in range(2000):
        links.send(0, 1, Content(number), 0)
    delays = np.array([d.arrival_ns for d in links.deliver(2 * SECOND, EVERYBODY)]) / 1e9
    assert 0.6 <= delays.min() < 0.61
    assert 1.39 < delays.max() <= 1.4
    assert abs(delays.mean() - 1.0) < 0.03
    assert sorted(_numbers(links.deliver(2 * SECOND, EVERYBODY))) == []


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        ({"loss": 0.3}, 0.3),
        ({"loss": 1.0}, 1.0),
        ({"burst_start": 0.1, "burst_end": 0.3}, 0.25),
        ({"loss": 0.1, "burst_start": 0.2, "burst_end": 0.2, "burst_loss": 0.5}, 0.3),
    ],
)
def test_losses_have_the_given_frequency(parameters, expected):
    links = _links(**parameters)
    for number in range(20_000):
        links.send(0, 1, Content(number), 0)
    num_arrived = len(links.deliver(0, EVERYBODY))
    assert links.take_counts()[0, 1] == LinkCounts(
        num_sent=20_000, sent_bytes=2_000_000, num_delivered=num_arrived, delivered_bytes=100 * num_arrived,
        num_lost=20_000 - num_arrived,
    )  # fmt: skip
    assert LinkConfig(**parameters).mean_loss == pytest.approx(expected)
    assert 1 - num_arrived / 20_000 == pytest.approx(expected, abs=0.02)


def test_bursts_have_the_given_mean_length():
    links = _links(burst_start=0.02, burst_end=0.25)
    for number in range(40_000):
        links.send(0, 1, Content(number), 0)
    arrived = np.zeros(40_000, bool)
    arrived[_numbers(links.deliver(0, EVERYBODY))] = True
    starts = np.flatnonzero(arrived[:-1] & ~arrived[1:]).size
    assert (~arrived).sum() / starts == pytest.approx(4.0, rel=0.1)


def test_losses_are_drawn_independently_per_direction_from_the_seed():
    def fates(seed, *, with_other):
        links = _links(loss=0.5, latency=0.1, jitter=0.1, seed=seed)
        for number in range(64):
            if with_other:
                links.send(2, 1, Content(1000 + number), 0)
            links.send(0, 1, Content(number), 0)
        return [(d.content.number, d.arrival_ns) for d in links.deliver(SECOND, EVERYBODY) if d.sender == 0]

    assert fates(0, with_other=False) == fates(0, with_other=True) != fates(1, with_other=False)


def test_a_rate_delays_packets_by_their_size():
    links = _links(rate=1000.0, queue="drop-tail", latency=0.5)
    for number in range(3):
        links.send(0, 1, Content(number, num_bytes=250), 0)
    assert [d.arrival_ns for d in links.deliver(2 * SECOND, EVERYBODY)] == [SECOND * 3 // 4, SECOND, SECOND * 5 // 4]


def test_the_newest_packet_replaces_the_waiting_one():
    links = _links(rate=100.0)
    for number in range(4):
        links.send(0, 1, Content(number), number * SECOND // 10)
    assert _numbers(links.deliver(SECOND, EVERYBODY)) == [0]
    assert _numbers(links.deliver(2 * SECOND, EVERYBODY)) == [3]
    counts = links.take_counts()[0, 1]
    assert (counts.num_sent, counts.num_dropped, counts.num_delivered, counts.num_late) == (4, 2, 2, 2)


def test_a_full_queue_drops_new_packets():
    links = _links(rate=100.0, queue="drop-tail", queue_bytes=250)
    for number in range(5):
        links.send(0, 1, Content(number), 0)
    assert _numbers(links.deliver(10 * SECOND, EVERYBODY)) == [0, 1, 2]
    assert links.take_counts()[0, 1].num_dropped == 2


def test_acknowledgements_bypass_the_queue_and_count_in_bytes_only():
    links = _links(rate=1.0)
    links.send(0, 1, Content(1), 0)
    links.send(0, 1, Content(2, num_bytes=12, waits=False), 0)
    assert _numbers(links.deliver(0, EVERYBODY)) == [2]
    assert links.take_counts()[0, 1] == LinkCounts(num_sent=1, sent_bytes=112, delivered_bytes=12)


def test_the_queue_of_a_removed_link_is_empty():
    links = _links(rate=100.0)
    links.send(0, 1, Content(1), 0)
    links.send(0, 1, Content(2), 0)
    links.send(0, 2, Content(3), 0)
    links.send(0, 2, Content(4), 0)
    links.cut([(0, 2)])
    assert _numbers(links.deliver(9 * SECOND, EVERYBODY)) == [1, 3, 4]
    assert links.take_counts()[0, 1].num_dropped == 1


def test_packets_to_a_robot_that_is_off_are_lost():
    links = _links()
    links.send(0, 1, Content(1), 0)
    links.send(0, 2, Content(2), 0)
    assert _numbers(links.deliver(0, [0, 2])) == [2]
    assert links.take_counts()[0, 1] == LinkCounts(num_sent=1, sent_bytes=100, num_lost=1)


def test_damage_has_the_given_frequency():
    links = _links(corruption=0.25)
    for number in range(4000):
        links.send(0, 1, Content(number), 0)
    assert np.mean([d.content.is_damaged for d in links.deliver(0, EVERYBODY)]) == pytest.approx(0.25, abs=0.03)


def test_counts_are_reset():
    links = _links()
    links.send(0, 1, Content(1), 0)
    assert links.take_counts()[0, 1].num_sent == 1
    assert links.take_counts() == {}


@settings(max_examples=60)
@given(
    sends=st.lists(st.tuples(st.integers(0, 20), st.integers(1, 300), st.booleans()), max_size=40),
    rate=st.sampled_from([None, 50.0, 500.0]),
    queue=st.sampled_from(["newest", "drop-tail"]),
    loss=st.sampled_from([0.0, 0.4]),
    seed=st.integers(0, 5),
)
def test_every_packet_is_delivered_lost_or_dropped_once(sends, rate, queue, loss, seed):
    links = _links(rate=rate, queue=queue, queue_bytes=400, loss=loss, latency=1.0, jitter=1.0, seed=seed)
    arrived = []
    now = 0
    for number, (wait, size, asks) in enumerate(sends):
        now += wait * SECOND // 10
        links.send(0, 1, Content(number, num_bytes=size), now)
        if asks:
            arrived += links.deliver(now, EVERYBODY)
    assert all(d.arrival_ns <= now for d in arrived)
    arrived += links.deliver(now + 1000 * SECOND, EVERYBODY)
    counts = links.take_counts()
    assert len(set(_numbers(arrived))) == len(arrived)
    if sends:
        count = counts[0, 1]
        assert count.num_sent == len(sends) == count.num_delivered + count.num_lost + count.num_dropped
        assert count.num_delivered == len(arrived)


def test_jitter_above_the_latency_is_refused():
    with pytest.raises(ConfigError, match=r"jitter: 0.2 is above latency 0.1; a delay cannot be negative"):
        _links(latency=0.1, jitter=0.2)


def test_content_from_and_to_some_robots_is_lost():
    links = _links(latency=1.0, rate=100.0)
    for number, (sender, receiver) in enumerate([(0, 1), (1, 0), (2, 0), (0, 2), (0, 2)]):
        links.send(sender, receiver, Content(number), 0)
    links.lose({1})
    assert sorted(_numbers(links.deliver(10 * SECOND, EVERYBODY))) == [2, 3, 4]
    counts = links.take_counts()
    assert (counts[0, 1].num_lost, counts[1, 0].num_lost) == (1, 1)
    assert (counts[0, 2].num_delivered, counts[2, 0].num_delivered) == (2, 1)
