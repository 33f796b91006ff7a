"""Messages between robots: packets of maps, and acknowledgements."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeAlias

from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.snapshot import Snapshot


class Source(NamedTuple):
    """Origin of a map: a robot's index and its restart epoch."""

    origin: int
    epoch: int


@dataclass(frozen=True, eq=False)
class HeldMap:
    """Immutable state of a robot's map, at the robot itself or at another.

    All revisions of its bricks are below ``version``. ``weight`` is the running sum of weights of rule 'ratio'.
    ``content`` is None where the robot needs the version alone.
    """

    content: SemanticOctree | Snapshot | None
    version: int
    weight: int = 0

    @property
    def octree(self) -> SemanticOctree:
        """The map. Do not call it without content."""
        assert self.content is not None
        return self.content.octree if isinstance(self.content, Snapshot) else self.content


def _with_flipped_bit(data: bytes, place: int) -> bytes:
    """Copy with the lowest bit of the byte at ``place`` flipped."""
    return data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]


@dataclass(frozen=True, eq=False)
class MapPart:
    """One packet of a message.

    ``held`` is the state of the map after the packet, shared by the sender; None: receivers decode the packet.
    """

    data: bytes
    source: Source
    base: int | None
    held: HeldMap | None


@dataclass(frozen=True, eq=False)
class MapMessage:
    """Packets of the maps of one or more robots in one message. It waits while its link is busy."""

    parts: tuple[MapPart, ...]

    waits = True

    @cached_property
    def num_bytes(self) -> int:
        """Length of the packets [bytes]."""
        return sum(len(part.data) for part in self.parts)

    def damaged(self, share: float) -> MapMessage:
        """Copy with one bit flipped, at the fraction ``share`` in [0, 1) of the message."""
        place = int(share * self.num_bytes)
        parts = list(self.parts)
        for index, part in enumerate(parts):
            if place < len(part.data):
                parts[index] = dataclasses.replace(part, data=_with_flipped_bit(part.data, place), held=None)
                break
            place -= len(part.data)
        return MapMessage(tuple(parts))


@dataclass(frozen=True)
class Acknowledgement:
    """Versions of maps that a robot holds after a message. It is sent beside the queue of its link."""

    data: bytes

    waits = False

    @property
    def num_bytes(self) -> int:
        """Length of the packet [bytes]."""
        return len(self.data)

    def damaged(self, share: float) -> Acknowledgement:
        """Copy with one bit flipped, at the fraction ``share`` in [0, 1) of the packet."""
        return Acknowledgement(_with_flipped_bit(self.data, int(share * len(self.data))))


Content: TypeAlias = MapMessage | Acknowledgement


@dataclass
class Receipt:
    """Result of receiving messages: maps with a new version, and numbers of packets that were not used."""

    fresh: list[Source] = dataclasses.field(default_factory=list)
    num_stale: int = 0
    num_gaps: int = 0
    num_damaged: int = 0

    def add(self, other: Receipt) -> None:
        """Add the receipt of another message."""
        self.fresh += other.fresh
        self.num_stale += other.num_stale
        self.num_gaps += other.num_gaps
        self.num_damaged += other.num_damaged
