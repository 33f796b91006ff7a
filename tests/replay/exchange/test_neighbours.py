"""Exchange of maps over links that drop, repeat, reorder and damage packets: received maps are published versions."""

from __future__ import annotations

import dataclasses
from collections import defaultdict

import numpy as np
import pytest

from octoreplay.config.packets import PacketConfig
from octoreplay.errors import ConfigError
from octoreplay.mapping import codec
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.replay.exchange.acknowledgement import Possession, encode_acknowledgement
from octoreplay.replay.exchange.messages import Acknowledgement, HeldMap, MapMessage, Receipt, Source
from octoreplay.replay.exchange.neighbours import Exchange
from octoreplay.replay.exchange.packet_codec import PacketCodec
from support.long_suite import one_in
from support.octree_factory import octree_of

NUM_BRICKS = 6

DELTA = PacketConfig(packets="delta")
CONFIGS = {
    "full": PacketConfig(packets="full"),
    "delta": DELTA,
    "key frames": PacketConfig(packets="delta", acknowledge=False, key_frame_every=4),
    "broadcast": PacketConfig(packets="delta", cast="broadcast"),
    "broadcast, key frames": PacketConfig(packets="delta", cast="broadcast", acknowledge=False, key_frame_every=3),
    "not compressed": PacketConfig(packets="delta", packet_compression="none"),
}


def _content(octree):
    """Equal for equal maps, however they are stored: packets are canonical."""
    return codec.encode_packet(octree)


class Author:
    """A robot whose own map changes in every tick; remembers every version."""

    def __init__(self, index, config, random):
        self.source = Source(index, 0)
        self.exchange = Exchange(config, PacketCodec(config))
        self.versions = {}
        self._random = random
        self._cells = {}
        self._octree = SemanticOctree(0.25, 2)

    def publish(self, tick):
        """Change some bricks, and hold the new version."""
        bricks = self._random.integers(NUM_BRICKS, size=self._random.integers(0, 3))
        changes = {(4 * int(b), int(self._random.integers(4)), 0): self._random.integers(-5, 6, 2) for b in bricks}
        self._cells.update(changes)
        changed = octree_of({key: v for key, v in self._cells.items() if key[0] // 4 in bricks})
        self._octree.overwrite(changed, np.arange(changed.num_bricks), tick - 1)
        self.exchange.hold(self.source, HeldMap(self._octree.copy(), tick))
        self.versions[tick] = _content(self._octree)


def _decoding(message):
    """A message whose receivers decode the packets themselves."""
    return MapMessage(tuple(dataclasses.replace(part, held=None) for part in message.parts))


def _check_held(robots):
    """Everything that anybody has is what its author had in that version."""
    for robot in robots:
        for source, held in robot.exchange.held.items():
            assert _content(held.octree) == robots[source.origin].versions[held.version]
            assert (held.octree.revisions < held.version).all()


def _run(config, *, seed, num_robots, links, decodes, forwards, num_ticks=40, num_good_ticks=12):
    """Robots exchange maps over links with faults, then without; returns them and what was counted."""
    random = np.random.default_rng(seed)
    robots = [Author(index, config, random) for index in range(num_robots)]
    on_air = []
    receipts = defaultdict(Receipt)
    for tick in range(1, num_ticks + num_good_ticks + 1):
        is_good = tick > num_ticks
        for index, robot in enumerate(robots):
            if not is_good:
                robot.publish(tick)
            elif not forwards:
                robot.exchange.hold(robot.source, dataclasses.replace(robot.exchange.held[robot.source], version=tick))
                robot.versions[tick] = robot.versions[tick - 1]
            sources = sorted(robot.exchange.held) if forwards else [robot.source]
            receivers = [b for a, b in links if a == index]
            for group, message in robot.exchange.outbox(receivers, sources, keep_alive=not forwards):
                on_air += [(index, receiver, _decoding(message) if decodes else message) for receiver in group]
        if is_good:
            pending, on_air = on_air, []
        else:
            # Dropped, delivered in any order, or delivered and still on its way: repeated later.
            random.shuffle(on_air)
            count = random.integers(0, len(on_air) + 1)
            pending, on_air = on_air[:count], on_air[count:]
            on_air += [entry for entry in pending if random.random() < 0.2]
            pending = [entry for entry in pending if random.random() > 0.3]
        while pending:
            sender, receiver, content = pending.pop(0)
            if not is_good and random.random() < 0.1:
                content = content.damaged(random.random())
            robot = robots[receiver]
            if isinstance(content, Acknowledgement):
                robot.exchange.acknowledged(sender, content)
                continue
            receipt, answer = robot.exchange.receive(sender, content)
            receipts[sender, receiver].add(receipt)
            if answer is not None and (receiver, sender) in links:
                (pending if is_good else on_air).append((receiver, sender, answer))
        _check_held(robots)
    return robots, receipts


def _acknowledgement(source, version):
    return Acknowledgement(encode_acknowledgement((Possession(*source, version),)))


TRIANGLE = [(0, 1), (1, 0), (1, 2), (2, 1), (0, 2), (2, 0)]
CHAIN = [(0, 1), (1, 0), (1, 2), (2, 1)]


@pytest.mark.parametrize(("name", "decodes", "seed"), one_in(5, CONFIGS, [True, False], range(4)))
def test_every_received_map_is_a_published_version(name, decodes, seed):
    robots, receipts = _run(CONFIGS[name], seed=seed, num_robots=3, links=TRIANGLE, decodes=decodes, forwards=False)
    newest = {robot.source: robot.exchange.held[robot.source].version for robot in robots}
    for robot in robots:
        assert {source: held.version for source, held in robot.exchange.held.items()} == newest
    assert sum(receipt.num_stale for receipt in receipts.values()) > 0
    assert sum(receipt.num_damaged for receipt in receipts.values()) > 0


@pytest.mark.parametrize(("name", "decodes", "seed"), one_in(5, CONFIGS, [True, False], range(4)))
def test_forwarded_maps_arrive_complete(name, decodes, seed):
    robots, _ = _run(CONFIGS[name], seed=seed, num_robots=3, links=CHAIN, decodes=decodes, forwards=True)
    for robot in robots:
        for other in robots:
            assert _content(robot.exchange.held[other.source].octree) == other.versions[40]


def test_without_acknowledgement_a_loss_is_a_gap_until_the_next_whole_map():
    config = PacketConfig(packets="delta", acknowledge=False, key_frame_every=4)
    author = Author(0, config, np.random.default_rng(0))
    receiver = Exchange(config, PacketCodec(config))
    fates = []
    for tick in range(1, 10):
        author.publish(tick)
        ((_, message),) = author.exchange.outbox([1], [author.source], keep_alive=True)
        if tick == 3:
            continue
        receipt, answer = receiver.receive(0, message)
        assert answer is None
        fates.append((len(receipt.fresh), receipt.num_gaps))
    assert fates == [(1, 0), (1, 0), (0, 1), (1, 0), (1, 0), (1, 0), (1, 0), (1, 0)]


def test_a_receiver_that_forgot_everything_gets_a_whole_map():
    author, receiver = Author(0, DELTA, np.random.default_rng(0)), Exchange(DELTA, PacketCodec(DELTA))
    kinds, gaps = [], []
    for tick in range(1, 8):
        author.publish(tick)
        if tick == 4:
            receiver = Exchange(DELTA, PacketCodec(DELTA))
        ((_, message),) = author.exchange.outbox([1], [author.source], keep_alive=True)
        receipt, answer = receiver.receive(0, message)
        author.exchange.acknowledged(1, answer)
        kinds.append(codec.read_header(message.parts[0].data).kind)
        gaps.append(receipt.num_gaps)
    assert kinds == [codec.FULL, codec.DELTA, codec.DELTA, codec.DELTA, codec.FULL, codec.DELTA, codec.DELTA]
    assert gaps == [0, 0, 0, 1, 0, 0, 0]


def test_a_delta_holds_the_changes_since_the_acknowledged_version():
    octree = octree_of({(0, 0, 0): [1.0, 2.0], (4, 0, 0): [3.0, 4.0], (8, 0, 0): [5.0, 6.0]})
    octree.revisions[octree.find(octree_of({(4, 0, 0): 0.0}).codes)] = 5
    author, source = Exchange(DELTA, PacketCodec(DELTA)), Source(0, 0)
    author.hold(source, HeldMap(octree, 6))
    for base, expected in ((None, 3), (1, 3), (2, 1), (5, 1), (6, 0)):
        if base is not None:
            author.acknowledged(1, _acknowledgement(source, base))
        ((_, message),) = author.outbox([1], [source], keep_alive=True)
        header = codec.read_header(message.parts[0].data)
        assert (header.map_version.version, header.num_leaves) == (6, expected)


def test_a_map_is_not_sent_back_to_its_sender():
    exchanges = [Exchange(PacketConfig(packets="full"), PacketCodec(PacketConfig(packets="full"))) for _ in range(2)]
    source = Source(7, 0)
    exchanges[0].hold(source, HeldMap(octree_of({(0, 0, 0): [1.0, 2.0]}), 3))
    ((_, message),) = exchanges[0].outbox([1], [source], keep_alive=False)
    exchanges[1].receive(0, message)
    assert exchanges[1].outbox([0], [source], keep_alive=False) == []
    assert len(exchanges[1].outbox([2], [source], keep_alive=False)) == 1


def test_a_damaged_acknowledgement_is_dropped():
    exchange = Exchange(DELTA, PacketCodec(DELTA))
    source = Source(0, 0)
    exchange.hold(source, HeldMap(octree_of({(0, 0, 0): [1.0, 2.0]}), 3))
    exchange.acknowledged(1, _acknowledgement(source, 3).damaged(0.5))
    assert len(exchange.outbox([1], [source], keep_alive=False)) == 1
    exchange.acknowledged(1, _acknowledgement(source, 3))
    assert exchange.outbox([1], [source], keep_alive=False) == []


# --- the budget -------------------------------------------------------------------------------------------------------

BUDGET = dataclasses.replace(DELTA, budget=512)


@pytest.mark.parametrize(("seed", "cast"), one_in(3, range(4), ["unicast", "broadcast"]))
def test_within_a_budget_all_changes_arrive_eventually(seed, cast):
    """A receiver that comes late to a map of many versions gets it version by version, in packets that fit."""
    random = np.random.default_rng(seed)
    config = dataclasses.replace(BUDGET, cast=cast)
    octree = SemanticOctree(0.25, 2)
    exchange = Exchange(config, PacketCodec(config))
    receivers = {receiver: Exchange(config, PacketCodec(config)) for receiver in (1, 2)}
    source = Source(0, 0)
    for tick in range(1, 200):
        if tick <= 60:
            brick = int(random.integers(40))
            keys = [(4 * brick + x, y, z) for x in range(4) for y in range(2) for z in range(2)]
            changed = octree_of({key: random.normal(size=2) for key in keys})
            octree.overwrite(changed, np.arange(1), tick - 1)
        exchange.hold(source, HeldMap(octree.copy(), tick))
        reached = [receiver for receiver in receivers if tick > 60 and random.random() < 0.7]
        for group, message in exchange.outbox(list(receivers), [source], keep_alive=True):
            assert message.num_bytes <= 512
            for receiver in set(group).intersection(reached):
                receipt, answer = receivers[receiver].receive(0, message)
                assert receipt.num_gaps == 0
                if random.random() < 0.7:
                    exchange.acknowledged(receiver, answer)
        for receiver in receivers.values():
            if source in receiver.held:
                held = receiver.held[source]
                # Every brick that did not change after the version that a receiver has is as it should be.
                old = octree.copy()
                settled = np.flatnonzero(octree.revisions < held.version)
                expected, actual = SemanticOctree(0.25, 2), SemanticOctree(0.25, 2)
                expected.overwrite(old, settled)
                there = held.octree.find(octree.codes[settled])
                assert (there >= 0).all()
                actual.overwrite(held.octree, there)
                assert _content(actual) == _content(expected)
    for receiver in receivers.values():
        assert _content(receiver.held[source].octree) == _content(octree)


def test_a_map_forwarded_in_parts_is_complete_after_a_late_acknowledgement():
    """A delta that overlaps what is there must not make a brick look newer than one that changed after it."""
    rng = np.random.default_rng(0)
    source, octree = Source(0, 0), SemanticOctree(0.25, 2)
    author, forwarder, last = (Exchange(BUDGET, PacketCodec(BUDGET)) for _ in range(3))

    def publish(brick, version):
        keys = [(4 * brick + x, y, z) for x in range(4) for y in range(2) for z in range(2)]
        octree.overwrite(octree_of({key: rng.normal(size=2) for key in keys}), np.arange(1), version - 1)
        author.hold(source, HeldMap(octree.copy(), version))

    def send(sender, number, receiver, to):
        for _, message in sender.outbox([to], [source], keep_alive=False):
            receiver.receive(number, message)

    publish(brick=0, version=5)
    send(author, 0, forwarder, 1)
    publish(brick=1, version=7)
    send(author, 0, forwarder, 1)
    # Only now does the answer to version 5 arrive: the next packet holds brick 1 again, and brick 0 no more.
    author.acknowledged(1, _acknowledgement(source, 5))
    publish(brick=2, version=10)
    send(author, 0, forwarder, 1)
    assert forwarder.held[source].version == 10
    send(forwarder, 1, last, 2)
    assert last.held[source].version < 10
    for _ in range(3):
        author.acknowledged(2, _acknowledgement(source, last.held[source].version))
        send(author, 0, last, 2)
    assert last.held[source].version == 10
    assert _content(last.held[source].octree) == _content(octree)


def test_a_budget_needs_acknowledged_deltas():
    with pytest.raises(ConfigError, match="budget: goes with packets 'delta'"):
        PacketConfig(packets="full", budget=1000)
    with pytest.raises(ConfigError, match="budget: goes with acknowledge"):
        PacketConfig(packets="delta", acknowledge=False, budget=1000)
