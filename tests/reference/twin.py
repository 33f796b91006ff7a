"""Reference twin: replay of a whole team in plain float64 numpy on the uniform grid.

    recording = record(config, frames)          # ray casting, once for each team and sensor model
    for tick in Twin(config, recording).ticks():
        tick.log_odds(robot)                    # (M, C), including the prior, for recording.keys (M, 3)
        tick.known[robot]                       # (M,)
        tick.metrics                            # TwinMetrics

The grid holds the cells that any scan of any robot touches. All other cells have the prior in every map at every tick
under every rule, so omitting them does not change the results.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from octoreplay.config.run import RunConfig
from octoreplay.errors import ConfigError, InputError
from octoreplay.records import BoolArray, Float64Array, Frame, Int64Array
from reference import graph, rules
from reference.evidence import Evidence, IndexedScan
from reference.graph import TeamGraph
from reference.metrics import TwinMetrics, team_metrics
from reference.sensor import ScanUpdate, scan_update

STOPPED_OFF = "no settling"
STOPPED_CONVERGED = "converged"
STOPPED_MAX = "settle_max"


@dataclass(frozen=True, eq=False)
class Recording:
    """Scans of a team after ray casting, in order of (stamp, robot).

    ``keys`` is (M, 3) int64: all cells that any scan touches, sorted by (x, y, z).
    """

    keys: Int64Array
    scans: tuple[IndexedScan, ...]
    num_classes: int


@dataclass(frozen=True, eq=False)
class TwinTick:
    """State of the team after one tick. Arrays are copies; maps, evidence and oracle are deviations with column 0 zero.

    - ``maps`` (N, M, K): h_i - h_0.
    - ``evidence`` (N, M, K): log q_i (s_i for evidence 'sum').
    - ``known`` (N, M): cells in each robot's map.
    - ``oracle`` (M, K): sum of log q_i.
    """

    tick: int
    stamp_ns: int
    settling: bool
    active: tuple[bool, ...]
    links: tuple[tuple[int, int], ...]
    num_scans: tuple[int, ...]
    num_iterations: tuple[int, ...]
    prior: float
    maps: Float64Array
    known: BoolArray
    evidence: Float64Array
    oracle: Float64Array
    metrics: TwinMetrics | None

    def log_odds(self, robot: int) -> Float64Array:
        """Return one robot's log-odds (M, C) of the classes 1..C, including the prior."""
        absolute: Float64Array = self.maps[robot][:, 1:] + self.prior
        return absolute


def record(config: RunConfig, frames: Sequence[Frame]) -> Recording:
    """Return the freed and hit cells of all scans, by the configuration's sensor model and mapped region.

    Raises InputError without frames and for a frame of a robot that is not in the team, ConfigError without classes.
    """
    if config.classes is None:
        raise ConfigError("classes: the reference needs a class table")
    index = {robot.robot_id: i for i, robot in enumerate(config.robots)}
    for frame in frames:
        if frame.robot_id not in index:
            raise InputError(f"robot '{frame.robot_id}' is not in the team")
    ordered = sorted(frames, key=lambda frame: (frame.stamp_ns, index[frame.robot_id]))
    if not ordered:
        raise InputError("no frames")
    updates = [scan_update(frame, config.sensor, config.map) for frame in ordered]
    keys = _distinct_keys(updates)
    codes = _codes(keys)
    scans = tuple(
        IndexedScan(
            robot=index[frame.robot_id],
            stamp_ns=frame.stamp_ns,
            freed=np.searchsorted(codes, _codes(update.freed)),
            hit=np.searchsorted(codes, _codes(update.hit)),
            hit_classes=update.hit_classes,
            hit_strengths=update.hit_strengths,
        )
        for frame, update in zip(ordered, updates, strict=True)
    )
    return Recording(keys, scans, config.classes.num_classes)


def _distinct_keys(updates: Sequence[ScanUpdate]) -> Int64Array:
    """Return the distinct cells (M, 3) of all updates, sorted."""
    every = np.concatenate([part for update in updates for part in (update.freed, update.hit)])
    _, first = np.unique(_codes(every), return_index=True)
    return every[first]


def _codes(keys: Int64Array) -> Int64Array:
    """Return one integer for each key, in the order of (x, y, z)."""
    limit = 1 << 20
    if len(keys) and np.abs(keys).max() >= limit:
        raise InputError("a cell lies more than 2^20 cells from the origin")
    return ((keys[:, 0] + limit) << 42) | ((keys[:, 1] + limit) << 21) | (keys[:, 2] + limit)


class Twin:
    """Run of a recording with the consensus and network sections of a configuration."""

    def __init__(self, config: RunConfig, recording: Recording, *, with_metrics: bool = True) -> None:
        """Raise ConfigError where epsilon is above the bound of the graph of the whole team."""
        if config.map.prune_tolerance != 0.0:
            raise ConfigError("prune_tolerance: the reference is lossless")
        self.config = config
        self.recording = recording
        self.with_metrics = with_metrics
        self.stop_reason = ""
        self.period_ns = round(config.network.publish_period * 1e9)
        self.robot_ids = [robot.robot_id for robot in config.robots]
        self.num_robots = len(self.robot_ids)
        self.prior = config.map.prior(recording.num_classes)
        self._graph_of(tuple([True] * self.num_robots))

        num_cells, num_columns = len(recording.keys), recording.num_classes + 1
        self.sums = [Evidence(num_cells, recording.num_classes) for _ in self.robot_ids]
        self.log_q: Float64Array = np.zeros((self.num_robots, num_cells, num_columns))
        self.log_q_used = self.log_q.copy()
        self.touched: BoolArray = np.zeros((self.num_robots, num_cells), dtype=bool)
        self.maps = self.log_q.copy()
        self.known = self.touched.copy()
        self.num_iterations = [0] * self.num_robots
        self.num_integrated = 0

    # --- time --------------------------------------------------------------------------------------------------------

    @property
    def start_ns(self) -> int:
        """First stamp t_0 of the team."""
        return self.recording.scans[0].stamp_ns

    @property
    def num_log_ticks(self) -> int:
        """Number of ticks before settling, up to the first tick after the last scan."""
        return (self.recording.scans[-1].stamp_ns - self.start_ns) // self.period_ns + 2

    def ticks(self) -> Iterator[TwinTick]:
        """Yield the team after every tick, including settling; ``stop_reason`` is set at the end."""
        for tick in range(self.num_log_ticks):
            stamp_ns = self.start_ns + tick * self.period_ns
            self._integrate_before(stamp_ns)
            active = self._active_at(stamp_ns)
            team = self._graph_of(active)
            yield self._tick(tick, active, team, gamma_factor=1.0, settling=False)
        yield from self._settle(active, team)

    def _settle(self, active: tuple[bool, ...], team: TeamGraph) -> Iterator[TwinTick]:
        """Yield ticks on the last graph with decreasing gamma until nothing changes."""
        consensus = self.config.consensus
        if consensus.settle == 0:
            self.stop_reason = STOPPED_OFF
            return
        most = consensus.settle_max
        if most is None:
            most = graph.default_settle_max(consensus.settle, graph.second_eigenvalue(team))
        for settling_tick in range(1, most + 1):
            tick = self.num_log_ticks - 1 + settling_tick
            before = self.maps.copy()
            factor = rules.settling_ramp(settling_tick, consensus.settle)
            yield self._tick(tick, active, team, gamma_factor=factor, settling=True)
            if np.abs(self.maps - before).max(initial=0.0) < consensus.settle_tolerance:
                self.stop_reason = STOPPED_CONVERGED
                return
        self.stop_reason = STOPPED_MAX

    # --- one tick ----------------------------------------------------------------------------------------------------

    def _tick(
        self, tick: int, active: tuple[bool, ...], team: TeamGraph, *, gamma_factor: float, settling: bool
    ) -> TwinTick:
        """Publish, deliver, iterate and measure; scans before the tick are already integrated."""
        before = self.maps.copy()
        published, published_known = before, self.known.copy()
        for robot in range(self.num_robots):
            if active[robot]:
                self._iterate_robot(robot, team, published, published_known, gamma_factor)
        change = float(np.abs(self.maps - before).max(initial=0.0))
        oracle = self.log_q.sum(axis=0)
        metrics = None
        if self.with_metrics:
            metrics = team_metrics(
                self._with_prior(self.maps), self.known, self._with_prior(oracle), team.links, change
            )
        return TwinTick(
            tick=tick,
            stamp_ns=self.start_ns + tick * self.period_ns,
            settling=settling,
            active=active,
            links=team.links,
            num_scans=tuple(sums.num_scans for sums in self.sums),
            num_iterations=tuple(self.num_iterations),
            prior=self.prior,
            maps=self.maps.copy(),
            known=self.known.copy(),
            evidence=self.log_q.copy(),
            oracle=oracle,
            metrics=metrics,
        )

    def _integrate_before(self, stamp_ns: int) -> None:
        """Integrate the remaining scans with stamps before ``stamp_ns``, in order of (stamp, robot)."""
        changed = set()
        scans = self.recording.scans
        while self.num_integrated < len(scans) and scans[self.num_integrated].stamp_ns < stamp_ns:
            scan = scans[self.num_integrated]
            self.sums[scan.robot].integrate(scan, self.config.sensor)
            self.touched[scan.robot, scan.freed] = True
            self.touched[scan.robot, scan.hit] = True
            changed.add(scan.robot)
            self.num_integrated += 1
        for robot in changed:
            self.log_q[robot] = self.sums[robot].log_likelihood(self.config.consensus.evidence)

    def _active_at(self, stamp_ns: int) -> tuple[bool, ...]:
        """Return which robots are active: from the first tick after their first scan.

        With after_end 'leave', they are active up to and including the first tick after their last scan.
        """
        active = []
        for robot in range(self.num_robots):
            stamps = [scan.stamp_ns for scan in self.recording.scans if scan.robot == robot]
            begun = bool(stamps) and stamps[0] < stamp_ns
            left = self.config.network.after_end == "leave" and begun and stamps[-1] < stamp_ns - self.period_ns
            active.append(begun and not left)
        return tuple(active)

    def _graph_of(self, active: tuple[bool, ...]) -> TeamGraph:
        """Return the weighted graph of the active robots."""
        return graph.team_graph(self.config.network, self.config.consensus, self.robot_ids, active)

    def _iterate_robot(
        self,
        robot: int,
        team: TeamGraph,
        published: Float64Array,
        published_known: BoolArray,
        gamma_factor: float,
    ) -> None:
        """Run all iterations of one robot in a tick, with the maps that its neighbours published in the tick."""
        consensus = self.config.consensus
        senders = [] if consensus.rule == "local" else team.neighbours(robot)
        if consensus.mode == "sync" or not senders:
            base = self._base(published[robot])
            differences = [(team.weights[robot, j], published[j] - base) for j in senders]
            self._iterate(robot, differences, team.epsilon, gamma_factor)
        else:
            per_arrival = gamma_factor / len(senders) if consensus.gamma_per_arrival == "divided" else gamma_factor
            for j in senders:
                # 'bayes' conserves the sum over robots only if both ends of a link use the same difference.
                own = self._base(published[robot] if consensus.rule == "bayes" else self.maps[robot])
                self._iterate(robot, [(team.weights[robot, j], published[j] - own)], team.epsilon, per_arrival)
        self.known[robot] |= self.touched[robot]
        for j in senders:
            self.known[robot] |= published_known[j]

    def _base(self, own: Float64Array) -> Float64Array:
        """Return the map that is subtracted from a neighbour's: the robot's own, or 0 for 'merge'."""
        return np.zeros_like(own) if self.config.consensus.rule == "merge" else own

    def _iterate(
        self, robot: int, differences: list[tuple[float, Float64Array]], epsilon: float, gamma_factor: float
    ) -> None:
        """Run one iteration of the rule at one robot."""
        consensus = self.config.consensus
        k = self.num_iterations[robot]
        gamma = gamma_factor * rules.gamma_at(consensus.gamma, k, consensus.gamma_power, consensus.gamma_decay)
        mixed = rules.mix(self.maps[robot], differences, epsilon)
        log_q = self.log_q[robot]
        if consensus.rule == "gradient":
            self.maps[robot] = rules.gradient_step(mixed, log_q, gamma)
        elif consensus.rule == "natural":
            self.maps[robot] = rules.natural_step(mixed, log_q, gamma)
        elif consensus.rule == "bayes":
            self.maps[robot] = rules.bayes_step(mixed, log_q, self.log_q_used[robot])
        elif consensus.rule == "merge":
            sensor = self.config.sensor
            self.maps[robot] = rules.merge_step(
                mixed, log_q, self.log_q_used[robot], sensor.clamp_min, sensor.clamp_max
            )
        else:
            self.maps[robot] = log_q
        self.log_q_used[robot] = log_q
        self.num_iterations[robot] += 1

    def _with_prior(self, deviation: Float64Array) -> Float64Array:
        """Return absolute log-odds: the prior is added to the classes 1..C."""
        absolute = deviation.copy()
        absolute[..., 1:] += self.prior
        return absolute
