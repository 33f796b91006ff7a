"""Test of corrected poses on scans that were held back: contradiction of evidence and entropy, before and after."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from octoreplay.config.resolved import ResolvedRun
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.mapping.contradiction import EvidenceComparer, state_limits
from octoreplay.mapping.metrics import MapComparer
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.sensor import ScanCaster, add_scan, clamped_increments
from octoreplay.records import BoolArray, Float64Array, Int64Array
from octoreplay.registration.drift import Correction, Track

# Shortest part of a log that is compared with the others, and the largest number of parts of one log.
_PART_NS, _MAX_PARTS = 15_000_000_000, 8
# Least number of shared occupied cells of a comparison, and the number of cells that count as one measurement.
MIN_CELLS, _CELLS_PER_SAMPLE = 500, 20
# Corrected poses are accepted where the contradiction is less than this share of that before, by so many deviations,
MAX_RATIO, MIN_DEVIATIONS = 0.95, 2.0
# and the entropy is not larger than this share of that before.
MAX_ENTROPY_RATIO = 1.01


def is_held_back(number: int, hold_back: int) -> bool:
    """Return True for the scans of a log that are held back for the test, by their number from 0."""
    return number % hold_back == hold_back - 1


@dataclass(frozen=True, eq=False)
class HeldBack:
    """Comparison of the scans that were held back, with the recorded (0) and with the corrected (1) poses.

    - ``robots`` (p,) int64: robot of each part of a log.
    - ``cells``, ``contradicting`` (2, p, 2, p) float64, symmetric: cells that one part calls occupied and the other one
      occupied or free, and those that the other one calls free.
    - ``entropy_bits`` (2, N) float64: mean entropy of the known cells of each robot's map.
    """

    robots: Int64Array
    cells: Float64Array
    contradicting: Float64Array
    entropy_bits: Float64Array

    def contradiction(self, is_corrected: BoolArray, members: Sequence[int], robot: int | None = None) -> Contradiction:
        """Return the contradiction among some robots, or of one of them with all.

        ``is_corrected`` (N,) chooses the poses of each robot.
        """
        of_members = np.flatnonzero(np.isin(self.robots, members))
        of_robot = of_members if robot is None else np.flatnonzero(self.robots == robot)
        rows, columns = np.meshgrid(of_robot, of_members, indexing="ij")
        # Every pair once: all pairs of the robot with others, and half of the others.
        is_counted = (rows < columns) | ((robot is not None) & (self.robots[rows] != self.robots[columns]))
        rows, columns = rows[is_counted], columns[is_counted]
        chosen = is_corrected[self.robots].astype(np.int64)
        where = (chosen[rows], rows, chosen[columns], columns)
        return Contradiction(int(self.cells[where].sum()), int(self.contradicting[where].sum()))


@dataclass(frozen=True)
class Contradiction:
    """Number of shared occupied cells, and of those that contradict."""

    num_cells: int
    num_contradicting: int

    @property
    def share(self) -> float:
        """Contradicting share of the cells; NaN without cells."""
        return self.num_contradicting / self.num_cells if self.num_cells else math.nan

    def is_clearly_less_than(self, other: Contradiction) -> bool:
        """True where the share is smaller by more than chance."""
        if min(self.num_cells, other.num_cells) < MIN_CELLS:
            return False
        variance = sum(c.share * (1.0 - c.share) * _CELLS_PER_SAMPLE / c.num_cells for c in (self, other))
        difference = other.share - self.share
        return self.share <= MAX_RATIO * other.share and difference > MIN_DEVIATIONS * math.sqrt(variance)


@dataclass(frozen=True)
class RobotScore:
    """Test of one robot's corrected poses.

    ``before`` and ``after`` are the contradiction with its group, itself at other times included. ``reason`` is the
    reason for keeping the recorded poses, empty where the corrected ones are accepted.
    """

    before: Contradiction
    after: Contradiction
    entropy_before: float
    entropy_after: float
    reason: str

    @property
    def is_accepted(self) -> bool:
        """True where the corrected poses are used."""
        return not self.reason


def judge(held_back: HeldBack, groups: Sequence[Sequence[int]]) -> tuple[RobotScore, ...]:
    """Return the test of each robot. ``groups`` are the robots that were corrected together.

    A group's corrected poses are accepted where its contradiction is clearly less than with the recorded ones. Within
    it, robots whose own contradiction or entropy does not fall keep the recorded poses, the worst one first.
    """
    num_robots = held_back.entropy_bits.shape[1]
    reasons = ["no other submap overlaps its own" for _ in range(num_robots)]
    is_corrected = np.zeros(num_robots, np.bool_)
    for group in groups:
        for robot in group:
            reasons[robot] = ""
        is_corrected[list(group)] = True
        _drop_worse(held_back, group, is_corrected, reasons)
        before = held_back.contradiction(np.zeros(num_robots, np.bool_), group)
        if is_corrected[list(group)].any() and not held_back.contradiction(is_corrected, group).is_clearly_less_than(
            before
        ):
            for robot in group:
                reasons[robot] = reasons[robot] or _NOT_CLEAR
            is_corrected[list(group)] = False
    return tuple(_score(held_back, groups, robot, is_corrected, reasons[robot]) for robot in range(num_robots))


_NOT_CLEAR = "the contradiction on held-back scans is not clearly less"


def _drop_worse(held_back: HeldBack, group: Sequence[int], is_corrected: BoolArray, reasons: list[str]) -> None:
    """Take the corrections back, one by one, of the robots of a group that they do not improve."""
    recorded = np.zeros_like(is_corrected)
    while True:
        worst, worst_gain = -1, 0.0
        for robot in group:
            if not is_corrected[robot]:
                continue
            alone = is_corrected.copy()
            alone[robot] = False
            before = held_back.contradiction(recorded, group, robot)
            after = held_back.contradiction(is_corrected, group, robot)
            gain = min(before.share, held_back.contradiction(alone, group, robot).share) - after.share
            entropy = held_back.entropy_bits[:, robot]
            if entropy[1] > MAX_ENTROPY_RATIO * entropy[0]:
                gain = -math.inf
            if not gain > 0.0 and (worst < 0 or gain < worst_gain):
                worst, worst_gain = robot, gain
        if worst < 0:
            return
        is_corrected[worst] = False
        reasons[worst] = "its entropy grows" if worst_gain == -math.inf else "its own contradiction does not fall"


def _score(
    held_back: HeldBack, groups: Sequence[Sequence[int]], robot: int, is_corrected: BoolArray, reason: str
) -> RobotScore:
    """Test of one robot against its group, which has the poses that were chosen."""
    group = next((group for group in groups if robot in group), (robot,))
    tried = is_corrected.copy()
    tried[robot] = True
    return RobotScore(
        held_back.contradiction(np.zeros_like(is_corrected), group, robot),
        held_back.contradiction(tried, group, robot),
        float(held_back.entropy_bits[0, robot]),
        float(held_back.entropy_bits[1, robot]),
        reason,
    )


def compare_held_back(
    config: ResolvedRun,
    logs: Sequence[RobotLog],
    start_ns: int,
    hold_back: int,
    tracks: Sequence[Track],
    corrections: Sequence[Correction | None],
    threads: Executor,
) -> HeldBack:
    """Return the comparison of the evidence of every ``hold_back``-th scan of each log, read again."""

    def read(index: int) -> _Evidence:
        return _evidence(config, logs[index], start_ns, hold_back, tracks[index], corrections[index])

    found = list(threads.map(read, range(len(logs))))
    num_classes, num_robots = config.classes.num_classes, len(logs)
    robots = np.repeat(np.arange(num_robots), [len(evidence.parts[0]) for evidence in found])
    octrees = [octree for variant in (0, 1) for evidence in found for octree in evidence.parts[variant]]
    names = [str(number) for number in range(len(octrees))]
    cells, contradicting = np.zeros((2, len(octrees), len(octrees)))
    comparer = EvidenceComparer(names, num_classes, state_limits(config.effective_sensor))
    for pair in comparer.compare(octrees, 0, threads):
        if pair.occupied_cells:
            places = [int(pair.first), int(pair.second)], [int(pair.second), int(pair.first)]
            cells[places] = pair.occupied_cells
            contradicting[places] = pair.contradiction * pair.occupied_cells
    entropy = np.zeros((2, num_robots))
    for variant in (0, 1):
        maps = [evidence.wholes[variant] for evidence in found]
        comparison = MapComparer(num_robots, config.map.prior(num_classes)).compare(maps, maps[0], [], 0, threads)
        entropy[variant] = comparison.entropy_bits
    shape = (2, robots.size, 2, robots.size)
    return HeldBack(robots, cells.reshape(shape), np.rint(contradicting).reshape(shape), entropy)


@dataclass(frozen=True, eq=False)
class _Evidence:
    """Evidence of one robot's scans that were held back: of parts of the log and of the whole, by the poses used."""

    parts: tuple[list[SemanticOctree], list[SemanticOctree]]
    wholes: tuple[SemanticOctree, SemanticOctree]


def _evidence(
    config: ResolvedRun, log: RobotLog, start_ns: int, hold_back: int, track: Track, correction: Correction | None
) -> _Evidence:
    """Read one log and integrate the scans that are held back, with the recorded and with the corrected poses."""
    num_classes, resolution = config.classes.num_classes, config.map.resolution
    caster = ScanCaster(config.effective_sensor, config.map, num_classes)
    increments = clamped_increments(config.effective_sensor)
    parts: tuple[dict[int, SemanticOctree], dict[int, SemanticOctree]] = ({}, {})
    wholes = (SemanticOctree(resolution, num_classes), SemanticOctree(resolution, num_classes))
    if track.stamps_ns.size == 0:
        return _Evidence(([], []), wholes)
    first_ns = int(track.stamps_ns[0])
    part_ns = max(_PART_NS, (int(track.stamps_ns[-1]) - first_ns) // _MAX_PARTS + 1)
    for number, frame in enumerate(log.frames(start_ns)):
        if not is_held_back(number, hold_back):
            continue
        pose = frame.T_team_sensor
        corrected = correction.corrected(np.array([frame.stamp_ns]), pose[None])[0] if correction else pose
        part = (frame.stamp_ns - first_ns) // part_ns
        for variant, T_team_sensor in enumerate((pose, corrected)):
            cells = caster.cast(dataclasses.replace(frame, T_team_sensor=T_team_sensor))
            octree = parts[variant].setdefault(part, SemanticOctree(resolution, num_classes))
            add_scan(octree, cells, increments, 0)
            add_scan(wholes[variant], cells, increments, 0)
    return _Evidence((list(parts[0].values()), list(parts[1].values())), wholes)
