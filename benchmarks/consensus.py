"""Consensus: what one tick of a team costs, awake and nearly asleep, and how it grows with the robots on a ring.

Six robots map parts of the village that overlap; after a few ticks on a complete graph everybody's map covers the
union. One thread. A tick here is the robots' iterations; publishing (encoding every map once, and decoding it once for
all receivers) is reported apart.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence

import numpy as np
import scenes
from rounds import Report, Row, arguments, measured, pinned
from scenes import NUM_CLASSES

from octoreplay.config.consensus import FLOW_BITS
from octoreplay.config.rules import RULES
from octoreplay.config.sensor import MapConfig, SensorConfig, rounded_sensor
from octoreplay.mapping.codec import decode_packet, encode_packet
from octoreplay.mapping.consensus import Flows, Step, Update, team_step
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.sensor import ScanCaster, add_scan, clamped_increments
from octoreplay.mapping.snapshot import Snapshot
from octoreplay.records import Frame, Int64Array

NUM_ROBOTS = 6
SENSOR = rounded_sensor(SensorConfig(max_range=7.8), RULES["bayes"].default_quantum)
GAMMA = 0.5
BLOCK_EDGE = 8
"""Edge in cells of the blocks in which the share of never-hit space is counted."""
WARM_TICKS = 3
FRAMES_PER_ROBOT = 20
_UPDATES = {
    "gradient": Update.GRADIENT,
    "natural": Update.NATURAL,
    "bayes": Update.MIX,
    "local": Update.COPY,
}


_QUANTA = {rule: RULES[rule].default_quantum for rule in _UPDATES}


def main() -> None:
    """All parts of the benchmark for the asked rules."""
    options = arguments(__doc__ or "", rounds=5, add=_add_options)
    report = Report("consensus", vars(options))
    with pinned():
        evidence = [robot_evidence(robot, options.resolution) for robot in range(NUM_ROBOTS)]
        cells = [octree.num_cells for octree in evidence]
        report.add(Row("cells a robot", float(np.mean(cells)), "", min(cells), max(cells)))
        for rule in options.rule or _UPDATES:
            team = Team(evidence, rule, complete_graph)
            _add_full_tick(report, team, options.rounds)
            if rule != "local":
                _add_changed_tick(report, team, options.rounds, options.rest)
        if not options.no_ring:
            _add_rings(report, options.rounds, options.ring_resolution)
    report.save(options.json)


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rule", action="append", choices=tuple(_UPDATES))
    parser.add_argument("--resolution", type=float, default=0.1, help="of the robots' maps (default: %(default)s)")
    parser.add_argument("--rest", type=int, default=40, help="ticks before few bricks change (default: %(default)s)")
    parser.add_argument("--ring-resolution", type=float, default=0.25, help="of the rings' maps (default: %(default)s)")
    parser.add_argument("--no-ring", action="store_true", help="leave the rings out")


class Team:
    """Robots with their evidence and maps, which iterate in step."""

    def __init__(
        self, evidence: Sequence[SemanticOctree], rule: str, neighbours: Callable[[int, int], Sequence[int]]
    ) -> None:
        first = evidence[0]
        self.rule = rule
        self.evidence = [octree.copy() for octree in evidence]
        self.maps = [SemanticOctree(first.resolution, first.num_classes) for _ in evidence]
        self.max_change = 0.0
        self.tick_number = 0
        self.last_evidence = [Snapshot(octree) for octree in self.evidence]
        for octree, last in zip(self.evidence, self.last_evidence, strict=True):
            # Without known cells: all evidence is new.
            last.saved.find_or_add(octree.codes)
        self._last_tick = -1
        self._neighbours = [neighbours(robot, len(evidence)) for robot in range(len(evidence))]

    @property
    def num_links(self) -> int:
        """Directed links."""
        return sum(len(neighbours) for neighbours in self._neighbours)

    def tick(self, *, awake: bool = True) -> tuple[float, float]:
        """One tick; milliseconds of publishing and of iterating, all robots together.

        Bricks at rest since the last tick are worked on only if ``awake``.
        """
        added = self._add_evidence() if self.rule == "bayes" else 0.0
        started = time.perf_counter()
        published = [_received(octree) for octree in self.maps]
        decoded = time.perf_counter()
        since = None if awake else self._last_tick
        steps = [self._step(robot, published, since) for robot in range(len(self.maps))]
        self.max_change = max(
            team_step(steps, update=_UPDATES[self.rule], revision=self.tick_number, quantum=_QUANTA[self.rule])
        )
        self._last_tick = self.tick_number
        self.tick_number += 1
        return (decoded - started) * 1e3, (added + time.perf_counter() - decoded) * 1e3

    def _add_evidence(self) -> float:
        """Add new evidence to the maps, as ``bayes`` does before it publishes; seconds that it takes."""
        started = time.perf_counter()
        for octree, evidence, last in zip(self.maps, self.evidence, self.last_evidence, strict=True):
            step = Step(octree, (), (), evidence, 0.0, last_evidence=last.saved, since=self._last_tick + 1)
            team_step([step], update=Update.ADD, revision=self.tick_number)
        self.last_evidence = [Snapshot(octree) for octree in self.evidence]
        return time.perf_counter() - started

    def share_awake(self) -> float:
        """Share of the bricks of the robots' maps that the last tick changed."""
        awake = sum(np.count_nonzero(octree.revisions >= self._last_tick) for octree in self.maps)
        return float(awake / sum(octree.num_bricks for octree in self.maps))

    def _step(self, robot: int, published: Sequence[SemanticOctree], since: int | None) -> Step:
        """One robot's iteration with Metropolis weights and epsilon = 0.5."""
        others = self._neighbours[robot]
        weight = 1.0 / (1 + max(len(neighbours) for neighbours in self._neighbours))
        return Step(
            self.maps[robot], [published[other] for other in others], [weight] * len(others), self.evidence[robot],
            GAMMA, since=since, flows=Flows(FLOW_BITS, [True] * len(others)) if self.rule == "bayes" else None,
        )  # fmt: skip


def _received(octree: SemanticOctree) -> SemanticOctree:
    """A map as its receivers have it, with the revisions that its sender gave."""
    received = decode_packet(encode_packet(octree))
    received.revisions[:] = octree.revisions[octree.find(received.codes)]
    return received


def complete_graph(robot: int, num_robots: int) -> list[int]:
    """Everybody else."""
    return [other for other in range(num_robots) if other != robot]


def _ring(robot: int, num_robots: int) -> list[int]:
    """The one before and the one after."""
    return sorted({(robot - 1) % num_robots, (robot + 1) % num_robots} - {robot})


# --- the parts --------------------------------------------------------------------------------------------------------


def _add_full_tick(report: Report, team: Team, rounds: int) -> None:
    """Ticks in which every brick of every robot is awake."""
    for _ in range(WARM_TICKS):
        team.tick()
    union = max(octree.num_cells for octree in team.maps)
    share = never_hit_share(team.maps[0])
    ticks = [team.tick() for _ in range(rounds)]
    iterate = [iterating for _, iterating in ticks]
    name = f"{team.rule}, complete graph"
    targets = {} if team.rule == "local" else {"must": 6.0, "goal": 4.0}
    report.add(Row(f"{name}: cells of a robot's map", float(union), ""))
    report.add(
        Row(f"{name}: of it in 8^3 blocks never hit", 100 * share, "%", must=None if team.rule == "local" else 65.0)
    )
    report.add(measured(f"{name}: a tick's iterations", iterate, "ms"))
    report.add(measured(f"{name}: a tick's publishing", [publishing for publishing, _ in ticks], "ms"))
    updates = union * len(team.maps)
    report.add(measured(f"{name}: per cell and robot-update", [ms * 1e6 / updates for ms in iterate], "ns", **targets))


def _add_changed_tick(report: Report, team: Team, rounds: int, rest: int) -> None:
    """Ticks after new scans changed at least a tenth of the union's bricks, the others at rest; and full ticks."""
    full = [team.tick()[1] for _ in range(rest)]
    report.add(Row(f"{team.rule}: largest change after {rest} ticks", team.max_change, ""))
    report.add(Row(f"{team.rule}: bricks that still change then", 100 * team.share_awake(), "%"))
    fresh = _fresh_frames()
    ratios, shares = [], []
    for _ in range(rounds):
        shares.append(100 * _change_bricks(team, fresh))
        ratios.append(team.tick(awake=False)[1] / float(np.median(full[: max(rounds, 1)])))
        for _ in range(rest // 4):
            team.tick(awake=False)
    report.add(measured(f"{team.rule}: bricks changed", shares, "%"))
    must = None if team.rule == "gradient" else 0.15
    report.add(measured(f"{team.rule}: tick with few changes / full tick", ratios, "", must=must, goal=0.12))


def _add_rings(report: Report, rounds: int, resolution: float) -> None:
    """Rings of 2 to 32 robots that all hold the union's map."""
    evidence = [robot_evidence(robot, resolution) for robot in range(NUM_ROBOTS)]
    seed = Team(evidence, "gradient", complete_graph)
    for _ in range(WARM_TICKS):
        seed.tick()
    costs = []
    for size in (2, 4, 8, 16, 32):
        team = Team([evidence[robot % NUM_ROBOTS] for robot in range(size)], "gradient", _ring)
        team.maps = [seed.maps[robot % NUM_ROBOTS].copy() for robot in range(size)]
        team.tick()
        times = [team.tick()[1] for _ in range(rounds)]
        report.add(measured(f"ring of {size}: a tick's iterations", times, "ms"))
        # Two robots have one neighbour each, all others two.
        costs.append(float(np.median(times)) / team.num_links)
        report.add(Row(f"ring of {size}: per directed link", costs[-1], "ms"))
    report.add(
        Row("ring: cost per link, 32 robots over 4", costs[-1] / costs[1], "", must=1.2, note="1 is linear in links")
    )


# --- maps -------------------------------------------------------------------------------------------------------------


def robot_evidence(robot: int, resolution: float) -> SemanticOctree:
    """Evidence of one of the six robots: LiDAR scans along its part of the street."""
    octree = SemanticOctree(resolution, NUM_CLASSES)
    caster = ScanCaster(SENSOR, MapConfig(resolution=resolution), NUM_CLASSES)
    for frame in scenes.lidar_scene(FRAMES_PER_ROBOT, track=robot, tracks=NUM_ROBOTS).frames:
        add_scan(octree, caster.cast(frame), clamped_increments(SENSOR), 0)
    return octree


def _fresh_frames() -> list[Frame]:
    """Depth images along the street, for new evidence that touches few bricks."""
    return list(scenes.camera_scene(100).frames)


def _change_bricks(team: Team, fresh: list[Frame]) -> float:
    """Add scans until a tenth of the union's bricks have new evidence in some robot; the share that has."""
    caster = ScanCaster(SENSOR, MapConfig(resolution=team.evidence[0].resolution), NUM_CLASSES)
    changed: Int64Array = np.empty(0, np.int64)
    share = 0.0
    for robot in range(100):
        evidence, last = team.evidence[robot % NUM_ROBOTS], team.last_evidence[robot % NUM_ROBOTS]
        frame = fresh.pop(0)
        fresh.append(frame)
        add_scan(evidence, caster.cast(frame), clamped_increments(SENSOR), team.tick_number, last)
        changed = np.union1d(changed, evidence.codes[evidence.revisions >= team.tick_number])
        share = changed.size / team.maps[0].num_bricks
        if share >= 0.1:
            break
    return share


def never_hit_share(octree: SemanticOctree) -> float:
    """Share of the known cells that lie in blocks of 8^3 cells without a cell whose classes differ.

    A cell that was hit and is clamped at one end in all classes counts as never hit, so this is an upper bound.
    """
    leaves = octree.leaves()
    is_hit = np.ptp(leaves.log_odds, axis=1) > 0
    blocks = np.floor(leaves.centers / (BLOCK_EDGE * octree.resolution)).astype(np.int64) + (1 << 20)
    packed = (blocks[:, 0] << 42) | (blocks[:, 1] << 21) | blocks[:, 2]
    cells = np.rint((leaves.sizes / octree.resolution) ** 3)
    never = ~np.isin(packed, packed[is_hit])
    return float(cells[never].sum() / cells.sum())


if __name__ == "__main__":
    main()
