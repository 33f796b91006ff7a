"""Exchange of maps by one robot: maps that it holds, and versions that its neighbours hold.

A published map has a linear history. Its *version* is the tick in which it was published. Each brick's *revision* is
the tick in which the brick got its value, so that the bricks with revisions from ``base`` on are those that changed
after version ``base``. A delta from ``base`` to ``version`` holds all of these bricks. Applied to any state from
``base`` on, it gives the map of ``version``, in spite of lost, repeated and reordered packets before. An older state
cannot use it: this is a *gap*, and the receiver needs a delta with an older base, or a full map. A robot that restarts
without memory begins a new ``epoch``, whose maps have a history of their own.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType

import numpy as np

from octoreplay.config.packets import PacketConfig
from octoreplay.errors import PacketError
from octoreplay.replay.exchange.acknowledgement import Possession, decode_acknowledgement, encode_acknowledgement
from octoreplay.replay.exchange.messages import Acknowledgement, HeldMap, MapMessage, MapPart, Receipt, Source
from octoreplay.replay.exchange.packet_codec import PacketCodec, PacketStamp

NOTHING = 0
"""Base of a delta that holds every brick; all versions are greater."""


class Exchange:
    """Maps that one robot holds, and versions that its neighbours are known to hold.

    A newer state replaces an older one. A delta is applied only if its base is held. Without acknowledgements the base
    of a delta is the version of the last packet to that neighbour, and every ``key_frame_every``-th packet is a full
    map.
    """

    def __init__(self, config: PacketConfig, packet_codec: PacketCodec) -> None:
        self._held: dict[Source, HeldMap] = {}
        self._config = config
        self._codec = packet_codec
        self._known: dict[tuple[int, Source], int] = {}
        self._num_sent: dict[int, int] = {}
        self._epochs: dict[int, int] = {}

    @property
    def held(self) -> Mapping[Source, HeldMap]:
        """Newest state of each map that is here, the robot's own published one included; read-only."""
        return MappingProxyType(self._held)

    def hold(self, source: Source, held: HeldMap) -> None:
        """Store a state of the robot's own map, to be sent by ``outbox``."""
        self._held[source] = held

    def release(self, source: Source) -> None:
        """Release the robot's own map before it changes; ``hold`` must follow."""
        self._held.pop(source, None)

    def forget_contents(self, own: Source) -> None:
        """Forget the maps of others, but not their versions, where packets bring the state of the whole map."""
        if self._codec.decodes or self._config.budget is not None:
            return
        for source, held in self._held.items():
            if source != own and held.content is not None:
                self._held[source] = HeldMap(None, held.version, held.weight)

    def outbox(
        self, receivers: Sequence[int], sources: Sequence[Source], *, keep_alive: bool
    ) -> list[tuple[tuple[int, ...], MapMessage]]:
        """Messages of this tick with the maps ``sources``; receivers with equal needs share a message.

        A neighbour that is known to hold a map's newest version gets no packet of it, or with ``keep_alive`` an empty
        delta.
        """
        if not receivers:
            return []
        for receiver in receivers:
            self._num_sent[receiver] = self._num_sent.get(receiver, -1) + 1
        groups: dict[tuple[tuple[Source, int | None], ...], list[int]] = {}
        if self._config.cast == "broadcast":
            bases = self._oldest([self._bases(receiver, sources, keep_alive) for receiver in receivers])
            groups[tuple(bases.items())] = list(receivers)
        else:
            for receiver in receivers:
                groups.setdefault(tuple(self._bases(receiver, sources, keep_alive).items()), []).append(receiver)
        outgoing = []
        for group_bases, group in groups.items():
            message = MapMessage(tuple(self._parts(group_bases, self._num_sent[group[0]])))
            if not message.parts:
                continue
            outgoing.append((tuple(group), message))
            if self._config.packets == "delta" and not self._config.acknowledge:
                for receiver in group:
                    self._known.update({(receiver, p.source): self._held[p.source].version for p in message.parts})
        return outgoing

    def receive(self, sender: int, message: MapMessage) -> tuple[Receipt, Acknowledgement | None]:
        """Store the maps of a message; its receipt, and the acknowledgement to send (None: none)."""
        receipt = Receipt()
        answers: dict[Source, Possession] = {}
        for part in message.parts:
            try:
                source, version, base = self._stamp(part)
                mine = self._held.get(source)
                if mine is not None and mine.version >= version:
                    receipt.num_stale += 1
                elif base is not None and (mine.version if mine else NOTHING) < base:
                    receipt.num_gaps += 1
                else:
                    self._held[source] = part.held or self._codec.state(part.data, mine)
                    receipt.fresh.append(source)
            except PacketError:
                receipt.num_damaged += 1
                continue
            if source.origin == sender and source.epoch > self.epoch_of(sender):
                # The sender restarted without memory.
                self._epochs[sender] = source.epoch
                self._known = {key: known for key, known in self._known.items() if key[0] != sender}
            if source.origin != sender or source.epoch == self.epoch_of(sender):
                # The sender of a version holds it.
                self._learn(sender, source, version)
            held = self._held.get(source)
            answers[source] = Possession(*source, held.version if held else None)
        if not answers or self._config.packets != "delta" or not self._config.acknowledge:
            return receipt, None
        return receipt, Acknowledgement(encode_acknowledgement(tuple(answers.values())))

    def epoch_of(self, robot: int) -> int:
        """Newest restart epoch that a robot has sent itself."""
        return self._epochs.get(robot, 0)

    def acknowledged(self, sender: int, answer: Acknowledgement) -> None:
        """Note the versions that a neighbour holds; a damaged acknowledgement is ignored."""
        with contextlib.suppress(PacketError):
            for origin, epoch, version in decode_acknowledgement(answer.data):
                if version is None:
                    self._known.pop((sender, Source(origin, epoch)), None)
                else:
                    self._learn(sender, Source(origin, epoch), version)

    def _learn(self, neighbour: int, source: Source, version: int) -> None:
        """Note that a neighbour holds at least this version of a map."""
        self._known[neighbour, source] = max(version, self._known.get((neighbour, source), version))

    def _bases(self, receiver: int, sources: Sequence[Source], keep_alive: bool) -> dict[Source, int | None]:
        """Maps to send to a neighbour, each with the base of its packet (None: a full map)."""
        is_delta = self._config.packets == "delta"
        is_key_frame = not self._config.acknowledge and self._num_sent[receiver] % self._config.key_frame_every == 0
        bases: dict[Source, int | None] = {}
        for source in sources:
            known = self._known.get((receiver, source))
            if known is None or not is_delta or is_key_frame:
                bases[source] = None
            else:
                bases[source] = min(known, self._held[source].version)
            is_there = known is not None and known >= self._held[source].version
            if is_there and not keep_alive and not (is_delta and is_key_frame):
                del bases[source]
        return bases

    def _oldest(self, bases: Iterable[Mapping[Source, int | None]]) -> dict[Source, int | None]:
        """Bases that every one of several neighbours can use."""
        merged: dict[Source, int | None] = {}
        for of_receiver in bases:
            for source, base in of_receiver.items():
                other = merged.get(source, base)
                merged[source] = None if base is None or other is None else min(base, other)
        return merged

    def _parts(self, bases: Sequence[tuple[Source, int | None]], turn: int) -> list[MapPart]:
        """Packets of a message; with a budget the sources take turns in being first."""
        if self._config.budget is None:
            return [self._whole_part(source, base) for source, base in bases]
        parts: list[MapPart] = []
        left = self._config.budget
        first = turn % max(len(bases), 1)
        for source, base in (*bases[first:], *bases[:first]):
            data = self._within(source, base or NOTHING, left)
            if data is not None:
                parts.append(MapPart(data, source, base or NOTHING, None))
                left -= len(data)
        return parts

    def _whole_part(self, source: Source, base: int | None) -> MapPart:
        """The packet from a base to the newest state of a map."""
        held = self._held[source]
        return MapPart(self._codec.packet(source, held, base), source, base, None if self._codec.decodes else held)

    def _within(self, source: Source, base: int, size: int) -> bytes | None:
        """Packet of at most ``size`` bytes: all changes after version ``base``, or else the oldest of them.

        Bricks of the same revision stay together; they fitted into one packet when they were published.
        """
        held = self._held[source]
        fitting = self._codec.packet(source, held, base)
        if len(fitting) <= size:
            return fitting
        revisions = held.octree.revisions
        steps = np.unique(revisions[revisions >= base])
        best = None
        fits, fails = 0, steps.size
        while fails - fits > 1:
            middle = (fits + fails) // 2
            version = int(steps[middle - 1]) + 1
            chosen = np.flatnonzero((revisions >= base) & (revisions < version))
            data = self._codec.encode(source, HeldMap(held.octree, version), base, chosen)
            if len(data) <= size:
                best, fits = data, middle
            else:
                fails = middle
        return best

    def _stamp(self, part: MapPart) -> PacketStamp:
        """Stamp of a packet. Raises PacketError for a damaged packet."""
        if part.held is None:
            return self._codec.stamp(part.data)
        return PacketStamp(part.source, part.held.version, part.base)
