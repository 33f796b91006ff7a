"""Exchange of maps as a state machine: lost, repeated, reordered, damaged and foreign packets, and restarts.

The model is plain: each version of a robot's map is a dictionary of cells, and a robot holds a version or none.
"""

from __future__ import annotations

import dataclasses
import struct
import zlib

import numpy as np
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from octoreplay.config.packets import PacketConfig
from octoreplay.mapping import codec
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.replay.exchange.messages import Acknowledgement, Content, HeldMap, MapMessage, Source
from octoreplay.replay.exchange.neighbours import Exchange
from octoreplay.replay.exchange.packet_codec import PacketCodec
from support.long_suite import long
from support.machines import run_machine
from support.octree_factory import cells_of, octree_of
from support.trials import Trials

ROBOTS = range(3)
CONFIGS = (
    PacketConfig(packets="full"),
    PacketConfig(packets="delta"),
    PacketConfig(packets="delta", cast="broadcast"),
    PacketConfig(packets="delta", acknowledge=False, key_frame_every=3),
    PacketConfig(packets="delta", acknowledge=False, key_frame_every=3, cast="broadcast"),
)
OTHER_VERSIONS = {codec.VERSION - 1, codec.VERSION + 1, 0, 255}

robots = st.sampled_from(ROBOTS)
shares = st.floats(0, 0.999)


def of_other_version(content: Content, version: int) -> Content:
    """Copy of a message of another format version, with checksums that match."""
    if isinstance(content, Acknowledgement):
        body = bytearray(content.data[:-4])
        body[4] = version
        return Acknowledgement(bytes(body) + struct.pack("<I", zlib.crc32(body)))
    parts = []
    for part in content.parts:
        data = bytearray(part.data)
        data[4] = version
        data[codec.HEADER_BYTES - 4 : codec.HEADER_BYTES] = bytes(4)
        data[codec.HEADER_BYTES - 4 : codec.HEADER_BYTES] = struct.pack("<I", zlib.crc32(data))
        parts.append(dataclasses.replace(part, data=bytes(data), held=None))
    return MapMessage(tuple(parts))


class ExchangeMachine(RuleBasedStateMachine):
    """Three robots, the messages between them, and the model of what each robot holds."""

    @initialize(config=st.sampled_from(CONFIGS), decodes=st.booleans())
    def begin(self, config: PacketConfig, decodes: bool) -> None:
        self.config, self.decodes = config, decodes
        self.codec = PacketCodec(config)
        self.epochs = dict.fromkeys(ROBOTS, 0)
        self.on_air: list[tuple[int, int, Content]] = []
        # The model: cells of each version of each map, and the version of each map that a robot holds.
        self.cells: dict[Source, dict[int, dict]] = {}
        self.model: dict[int, dict[Source, int]] = {robot: {} for robot in ROBOTS}
        self.exchanges: dict[int, Exchange] = {}
        self.octrees: dict[int, SemanticOctree] = {}
        for robot in ROBOTS:
            self._start(robot)

    def _start(self, robot: int) -> None:
        """Begin a robot's exchange without memory and publish an empty map."""
        self.exchanges[robot] = Exchange(self.config, self.codec)
        self.octrees[robot] = SemanticOctree(0.25, 2)
        self.model[robot] = {}
        self.cells[self._own(robot)] = {}
        self._hold(robot, {}, version=1)

    def _own(self, robot: int) -> Source:
        return Source(robot, self.epochs[robot])

    def _version(self, robot: int) -> int:
        """Version of a robot's own map."""
        return self.model[robot][self._own(robot)]

    def _hold(self, robot: int, cells: dict, version: int) -> None:
        """Publish the present octree of a robot as a version, with the cells of the model."""
        self.exchanges[robot].hold(self._own(robot), HeldMap(self.octrees[robot].copy(), version))
        self.cells[self._own(robot)][version] = cells
        self.model[robot][self._own(robot)] = version

    # --- rules --------------------------------------------------------------------------------------------------------

    @rule(robot=robots, brick=st.integers(0, 5), value=st.integers(-5, 5), ticks=st.integers(1, 3))
    def publish(self, robot: int, brick: int, value: int, ticks: int) -> None:
        """A robot changes a brick of its map and publishes it some ticks after its last version."""
        version = self._version(robot) + ticks
        last = self.cells[self._own(robot)][self._version(robot)]
        kept = {key: values for key, values in last.items() if key[0] // 4 != brick}
        changed = {(4 * brick + x, 0, 0): np.array([value, -value], np.float32) for x in range(abs(value) % 4 + 1)}
        self.octrees[robot].overwrite(octree_of(changed), np.arange(1), version - 1)
        self._hold(robot, kept | {key: values.tobytes() for key, values in changed.items()}, version)

    @rule(robot=robots, receivers=st.sets(robots, min_size=1), forwards=st.booleans())
    def send(self, robot: int, receivers: set[int], forwards: bool) -> None:
        """A robot sends its map, or all maps that it holds."""
        held = self.exchanges[robot].held
        sources = sorted(held) if forwards else [self._own(robot)]
        others = sorted(receivers - {robot})
        for group, message in self.exchanges[robot].outbox(others, sources, keep_alive=not forwards):
            if self.decodes:
                message = MapMessage(tuple(dataclasses.replace(part, held=None) for part in message.parts))
            self.on_air += [(robot, receiver, message) for receiver in group]

    @rule(bricks=st.tuples(*[st.integers(0, 5)] * len(ROBOTS)), value=st.integers(-5, 5), forwards=st.booleans())
    def run_tick(self, bricks: tuple[int, ...], value: int, forwards: bool) -> None:
        """All robots change and publish their maps, and all messages on the air arrive."""
        for robot, brick in zip(ROBOTS, bricks, strict=True):
            self.publish(robot, brick, value + robot, ticks=1)
            self.send(robot, set(ROBOTS), forwards)
        self.deliver_all()

    @precondition(lambda self: self.on_air)
    @rule(data=st.data(), is_repeated=st.booleans())
    def deliver(self, data: st.DataObject, is_repeated: bool) -> None:
        """Any message on the air arrives; it may arrive again later."""
        index = data.draw(st.integers(0, len(self.on_air) - 1))
        sender, receiver, content = self.on_air[index] if is_repeated else self.on_air.pop(index)
        self._receive(sender, receiver, content, is_readable=[True] * len(getattr(content, "parts", ())))

    @rule()
    def deliver_all(self) -> None:
        """All messages on the air arrive in their order, and their answers after them."""
        while self.on_air:
            sender, receiver, content = self.on_air.pop(0)
            self._receive(sender, receiver, content, is_readable=[True] * len(getattr(content, "parts", ())))

    @precondition(lambda self: self.on_air)
    @rule(data=st.data(), share=shares)
    def deliver_damaged(self, data: st.DataObject, share: float) -> None:
        """A message arrives with a flipped bit."""
        sender, receiver, content = self.on_air.pop(data.draw(st.integers(0, len(self.on_air) - 1)))
        damaged = content.damaged(share)
        readable = []
        if isinstance(content, MapMessage) and isinstance(damaged, MapMessage):
            readable = [a.data == b.data for a, b in zip(content.parts, damaged.parts, strict=True)]
            assert readable.count(False) == 1
        self._receive_unreadable(sender, receiver, damaged, readable)

    @precondition(lambda self: self.on_air)
    @rule(data=st.data(), version=st.sampled_from(sorted(OTHER_VERSIONS)))
    def deliver_other_version(self, data: st.DataObject, version: int) -> None:
        """A message of an older or newer octoreplay arrives, whose format this one does not know."""
        sender, receiver, content = self.on_air.pop(data.draw(st.integers(0, len(self.on_air) - 1)))
        other = of_other_version(content, version)
        self._receive_unreadable(sender, receiver, other, [False] * len(getattr(content, "parts", ())))

    @precondition(lambda self: self.on_air)
    @rule(data=st.data())
    def lose(self, data: st.DataObject) -> None:
        """A message is lost."""
        self.on_air.pop(data.draw(st.integers(0, len(self.on_air) - 1)))

    @rule(robot=robots)
    def restart(self, robot: int) -> None:
        """A robot restarts without memory, in a new epoch; its messages stay on the air."""
        self.epochs[robot] += 1
        self._start(robot)

    @rule()
    def end_tick(self) -> None:
        """The codec forgets the packets of earlier ticks."""
        self.codec.end_tick()

    # --- the model ----------------------------------------------------------------------------------------------------

    def _receive(self, sender: int, receiver: int, content: Content, is_readable: list[bool]) -> None:
        """Pass a message on, and compare its receipt with that of the model."""
        exchange = self.exchanges[receiver]
        if isinstance(content, Acknowledgement):
            exchange.acknowledged(sender, content)
            return
        expected = {"fresh": [], "stale": 0, "gaps": 0, "damaged": 0}
        for part, is_good in zip(content.parts, is_readable, strict=True):
            if not is_good:
                expected["damaged"] += 1
                continue
            header = codec.read_header(part.data)
            stamp = header.map_version
            source, mine = Source(stamp.origin, stamp.epoch), self.model[receiver]
            if mine.get(source, 0) >= stamp.version:
                expected["stale"] += 1
            elif header.kind == codec.DELTA and mine.get(source, 0) < stamp.base:
                expected["gaps"] += 1
            else:
                expected["fresh"].append(source)
                mine[source] = stamp.version
        receipt, answer = exchange.receive(sender, content)
        found = {
            "fresh": receipt.fresh, "stale": receipt.num_stale, "gaps": receipt.num_gaps,
            "damaged": receipt.num_damaged,
        }  # fmt: skip
        assert found == expected
        if answer is not None:
            self.on_air.append((receiver, sender, answer))

    def _receive_unreadable(self, sender: int, receiver: int, content: Content, is_readable: list[bool]) -> None:
        """Pass a message on of which some packets, or the acknowledgement, cannot be read."""
        known = dict(self.exchanges[receiver]._known)
        self._receive(sender, receiver, content, is_readable)
        if not any(is_readable):
            # Nothing is learned from it.
            assert self.exchanges[receiver]._known == known

    @invariant()
    def held_maps_are_those_of_the_model(self) -> None:
        """Each robot holds the versions of the model, and each is the map that its author published."""
        for robot, exchange in getattr(self, "exchanges", {}).items():
            assert {source: held.version for source, held in exchange.held.items()} == self.model[robot]
            for source, held in exchange.held.items():
                assert cells_of(held.octree) == self.cells[source][held.version]
                assert (held.octree.revisions < held.version).all()

    def teardown(self) -> None:
        """Over links without faults every robot gets the newest version of every map soon."""
        if not hasattr(self, "exchanges"):
            return
        self.on_air.clear()
        for _ in range(4):
            for robot in ROBOTS:
                cells = self.cells[self._own(robot)][self._version(robot)]
                self._hold(robot, cells, self._version(robot) + 1)
                self.send(robot, set(ROBOTS), forwards=False)
            self.deliver_all()
        self.held_maps_are_those_of_the_model()
        for robot in ROBOTS:
            for other in ROBOTS:
                assert self.model[robot][self._own(other)] == self._version(other)


@long
def test_the_exchange_equals_its_model(trials: Trials) -> None:
    run_machine(ExchangeMachine, trials, num_examples=5, num_steps=50)
