"""Parts of sessions that replay frames from memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from octoreplay.records import Frame


@dataclass(frozen=True)
class FrameList:
    """Source of frames from memory."""

    content: tuple[Frame, ...]

    def frames(self) -> Iterator[Frame]:
        return iter(self.content)


def frame_lists(robot_ids: Iterable[str], frames: Iterable[Frame]) -> list[FrameList]:
    """Return one source for each robot, with the robot's frames in their order."""
    return [FrameList(tuple(frame for frame in frames if frame.robot_id == robot_id)) for robot_id in robot_ids]


def sent_packets(tick: Any) -> list[bytes]:
    """Return every packet that was sent in a tick."""
    messages = [message for published in tick.published if published for _, message in published.outbox]
    return [part.data for message in messages for part in message.parts]
