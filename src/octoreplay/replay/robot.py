"""One robot of the team: what its own scans say, and the map that it agrees on with the others."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from octoreplay.config import RunConfig
from octoreplay.mapping import codec
from octoreplay.mapping.consensus import Evidence, Step, gamma_at, sum_of_evidence, team_step
from octoreplay.mapping.octree import SemanticOctree, TreeStreams, octree_from_streams
from octoreplay.mapping.sensor import (
    COUNT_SCANS,
    ScanCaster,
    add_scan,
    clamped_increments,
    unclamped_increments,
)
from octoreplay.records import Float64Array, Frame, Int64Array


@dataclass(frozen=True, eq=False)
class PublishedMap:
    """A map as it went over the air in one tick: the packet, and what every receiver decodes from it."""

    packet: bytes
    octree: SemanticOctree
    octree_bytes: int
    grid_bytes: int
    unpruned_bytes: int
    unpruned_compressed_bytes: int


class Arrival(NamedTuple):
    """A neighbour's map as it arrived, with the step weight 2 epsilon A_ij of its link."""

    sender: int
    octree: SemanticOctree
    weight: float


class Robot:
    """A robot's evidence s_i, its map h_i and the iterations that bring them together.

    ``tick`` numbers, which grow, mark what changed when. Methods of different robots may run in parallel threads.
    """

    def __init__(self, robot_id: str, config: RunConfig, num_classes: int) -> None:
        self.robot_id = robot_id
        self.num_scans = 0
        self.num_iterations = 0
        self.T_team_sensor: Float64Array | None = None
        self._config = config
        self._caster = ScanCaster(config.sensor, config.map, num_classes)
        self._increments = clamped_increments(config.sensor)
        self._is_average = config.consensus.evidence != "sum"
        if self._is_average:
            self._increments = unclamped_increments(config.sensor)

        def octree(classes: int = num_classes) -> SemanticOctree:
            return SemanticOctree(config.map.resolution, classes)

        self._own_sum = octree()
        self._scan_counts = octree(1) if config.consensus.evidence == "cell-average" else None
        self._log_likelihood = octree() if self._is_average else self._own_sum
        self._last_log_likelihood = octree()
        self._scan_tick = -1
        self._likelihood_tick = -1
        self._last_step_tick = -1
        self._last_conditions: tuple[object, ...] = ()
        self.map = octree()
        self.streams: TreeStreams = self.map.streams()

    @property
    def evidence(self) -> Evidence:
        """How log q_i follows from the robot's own sums."""
        if self._config.consensus.evidence == "time-average":
            return Evidence(self._own_sum, scale=1.0 / max(self.num_scans, 1))
        return Evidence(self._own_sum, scan_counts=self._scan_counts)

    @property
    def memory_bytes(self) -> int:
        """Bytes of the robot's own octrees: evidence, map and what the rule keeps beside them."""
        octrees = {id(o): o for o in (self._own_sum, self._log_likelihood, self._last_log_likelihood, self.map)}
        if self._scan_counts is not None:
            octrees[id(self._scan_counts)] = self._scan_counts
        return sum(o.memory_bytes for o in octrees.values())

    def integrate(self, frames: Iterable[Frame], tick: int) -> None:
        """Add the robot's scans of one tick to its evidence."""
        for frame in frames:
            cells = self._caster.cast(frame)
            add_scan(self._own_sum, cells, self._increments, tick)
            if self._scan_counts is not None:
                add_scan(self._scan_counts, cells, COUNT_SCANS, tick)
            self.num_scans += 1
            self._scan_tick = tick
            self.T_team_sensor = frame.T_team_sensor

    def changed_evidence(self, tick: int) -> Int64Array:
        """Codes of the bricks whose log q_i changed in this tick; all of them when every scan rescales all cells."""
        changed = self._own_sum.revisions >= tick
        if self._config.consensus.evidence == "time-average" and self._scan_tick >= tick:
            return self._own_sum.codes.copy()
        return self._own_sum.codes[changed]

    def publish(self, *, with_unpruned: bool) -> PublishedMap:
        """The robot's map as a packet, with the sizes it would have in other encodings.

        The sizes without pruning are 0 unless ``with_unpruned``: they take as long as the packet itself.
        """
        compress = self._config.packet.packet_compression == "zstd"
        packet = codec.pack(self.map, self.streams, codec.FULL, compress=compress)
        # What decoding the packet gives; a lossless one gives the map as it is.
        received = self.map.copy()
        if self._config.map.prune_tolerance > 0:
            received = octree_from_streams(self.streams, self.map.resolution, self.map.num_classes)
            received.revisions[:] = self.map.revisions[self.map.find(received.codes)]
        unpruned = self.map.streams(prune=False) if with_unpruned else None
        return PublishedMap(
            packet=packet,
            octree=received,
            octree_bytes=codec.HEADER_BYTES + self.streams.num_bytes,
            grid_bytes=codec.grid_bytes(self.map.num_cells, self.map.num_classes),
            unpruned_bytes=codec.HEADER_BYTES + unpruned.num_bytes if unpruned else 0,
            unpruned_compressed_bytes=len(codec.pack(self.map, unpruned, codec.FULL, compress=True)) if unpruned else 0,
        )

    def iterate_on_arrival(
        self, own: PublishedMap | None, arrived: Sequence[Arrival], factor: float, tick: int
    ) -> float:
        """One iteration for each of the neighbours' maps that ``arrived``, in their order.

        ``factor`` scales gamma (settling ramps it to 0). Returns the largest change of a log-odds.
        """
        consensus = self._config.consensus
        self._update_log_likelihood(tick)
        # bayes keeps the sum over robots only when both ends of a link exchange the same difference.
        base = own.octree if own is not None and consensus.rule == "bayes" else None
        share = factor / len(arrived) if consensus.gamma_per_arrival == "divided" else factor
        before = self.map.copy()
        for arrival in arrived:
            step = self._step([arrival], share * gamma_at(consensus, self.num_iterations), base)
            team_step([step], rule=consensus.rule, revision=tick)
            self._finish_step(tick)
        self._prune()
        # What one arrival changes another may undo; what counts is the change over the tick.
        return team_step([Step(before, (), (), self.map, 0.0)], rule="local", revision=tick)[0]

    def next_step(self, own: PublishedMap | None, arrived: Sequence[Arrival], factor: float, tick: int) -> Step:
        """The one iteration of a tick with all the maps that ``arrived``; ``end_step`` must follow."""
        consensus = self._config.consensus
        self._update_log_likelihood(tick)
        lossy = self._config.map.prune_tolerance > 0
        gamma = factor * gamma_at(consensus, self.num_iterations)
        conditions = (gamma, *((sender, weight) for sender, _, weight in arrived))
        since = self._last_step_tick if conditions == self._last_conditions and not lossy else None
        self._last_conditions, self._last_step_tick = conditions, tick
        return self._step(arrived, gamma, own.octree if own and lossy else None, since)

    def end_step(self, tick: int) -> None:
        """Take note of the iteration that ``next_step`` described."""
        self._finish_step(tick)
        self._prune()

    def _step(
        self, arrived: Sequence[Arrival], gamma: float, base: SemanticOctree | None, since: int | None = None
    ) -> Step:
        """An iteration with some neighbours' maps; bricks at rest ``since`` the last one are skipped."""
        return Step(
            self.map, [arrival.octree for arrival in arrived], [arrival.weight for arrival in arrived],
            self._log_likelihood, gamma, base, self._last_log_likelihood, since,
        )  # fmt: skip

    def _finish_step(self, tick: int) -> None:
        """Count an iteration, and keep the evidence that it used."""
        self.num_iterations += 1
        if self._config.consensus.rule == "bayes":
            changed = np.flatnonzero(self._log_likelihood.revisions > self._likelihood_tick)
            self._last_log_likelihood.overwrite(self._log_likelihood, changed, tick)
            self._likelihood_tick = tick

    def _prune(self) -> None:
        """The map's streams, with its leaves merged."""
        self.streams = self.map.streams(tolerance=self._config.map.prune_tolerance)

    def _update_log_likelihood(self, tick: int) -> None:
        """Bring log q_i up to the scans of this tick; for ``sum`` it is the evidence itself."""
        if self._is_average:
            sum_of_evidence(self._log_likelihood, [self.evidence], self.changed_evidence(tick), tick)
