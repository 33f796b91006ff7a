"""A day of log time in fast motion: exact sums in every tick, and no growth beyond what is mapped."""

from __future__ import annotations

import dataclasses
import gc
import resource
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import cycle, islice

import numpy as np
import pytest

from octoreplay.records import Frame
from octoreplay.replay.session import Session
from support.faulty_team import configured, dense, scenario
from support.long_suite import long

MINUTE_NS = 60 * 10**9
FRAME_EVERY = 2
"""Ticks, which are minutes, from one frame of a robot to the next."""


class RepeatedFrames:
    """Source that gives the frames of a robot again and again, one every two minutes."""

    def __init__(self, frames: list[Frame], num_minutes: int) -> None:
        self._frames = frames
        self._num_frames = num_minutes // FRAME_EVERY

    def frames(self) -> Iterator[Frame]:
        for number, frame in enumerate(islice(cycle(self._frames), self._num_frames)):
            yield dataclasses.replace(frame, stamp_ns=frame.stamp_ns % MINUTE_NS + number * FRAME_EVERY * MINUTE_NS)


def memory_of(session: Session) -> tuple[int, int]:
    """Number of live objects and the largest resident memory [kB] so far."""
    gc.collect()
    return len(gc.get_objects()), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


@long
@pytest.mark.parametrize("hours", [2, 24])
def test_sums_stay_exact_and_memory_does_not_grow(hours: int) -> None:
    config = configured(rule="bayes", topology="ring", packets="delta", publish_period=60.0, settle=0)
    by_robot = [[f for f in scenario().frames if f.robot_id == robot.robot_id] for robot in config.robots]
    num_minutes = 60 * hours
    session = Session(config, [RepeatedFrames(frames, num_minutes) for frames in by_robot], ThreadPoolExecutor(1))
    # After all frames were seen the maps have their size.
    settled = FRAME_EVERY * (1 + max(map(len, by_robot)))
    memory = []
    for tick in session.ticks():
        if tick.number % 10 == 0:
            total = np.sum([dense(octree) for octree in tick.evidence], axis=0)
            np.testing.assert_array_equal(np.sum([dense(octree) for octree in tick.maps], axis=0), total)
        if tick.number in (settled, num_minutes - FRAME_EVERY):
            memory.append(memory_of(session))
    assert (tick.number, tick.stamp_ns // MINUTE_NS) == (num_minutes - 1, num_minutes - 1)
    (first_objects, first_peak), (last_objects, last_peak) = memory
    assert last_objects < first_objects + 500
    assert last_peak < first_peak + 20_000
