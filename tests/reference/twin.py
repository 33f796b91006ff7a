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
from reference import flows, graph, rules
from reference.anchors import Anchor
from reference.evidence import Evidence, IndexedScan
from reference.graph import Link, TeamGraph
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


@dataclass(frozen=True, eq=False)
class Exchange:
    """Maps of a tick: published maps (N, M, K) and their cells (N, M), and the arrivals as (sender, receiver)."""

    team: TeamGraph
    published: Float64Array
    known: BoolArray
    arrivals: frozenset[Link]
    tick: int

    def senders(self, receiver: int) -> list[int]:
        """Return the robots whose maps arrived, in the team's order."""
        return sorted(j for j, i in self.arrivals if i == receiver)

    def is_mutual(self, i: int, j: int) -> bool:
        """Return whether the maps of both robots arrived at the other one."""
        return {(i, j), (j, i)} <= self.arrivals


@dataclass(frozen=True)
class Stage:
    """Parameters of a tick that change while settling; ``flow_bits`` 0: no flows."""

    gamma_factor: float
    flow_bits: int
    settling: bool


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
        if any(entry.forget for entry in config.network.schedule):
            raise ConfigError("schedule: the reference has no robots that forget")
        self.config = config
        self.recording = recording
        self.with_metrics = with_metrics
        self.stop_reason = ""
        self.period_ns = round(config.network.publish_period * 1e9)
        self.robot_ids = [robot.robot_id for robot in config.robots]
        self.num_robots = len(self.robot_ids)
        self.prior = config.map.prior(recording.num_classes)
        self.sensor = config.effective_sensor
        self.quantum = config.consensus.effective_quantum
        self.flow_bits = config.effective_flow_bits
        self.num_averaged = [1] * self.num_robots
        self.blocks = _codes(recording.keys // flows.BLOCK_EDGE)
        self._graph_of(tuple([True] * self.num_robots), self.start_ns)
        self.scans = [scan for scan in recording.scans if not self._is_off(scan.robot, scan.stamp_ns)]
        self.stamps = [[scan.stamp_ns for scan in self.scans if scan.robot == i] for i in range(self.num_robots)]

        num_cells, num_columns = len(recording.keys), recording.num_classes + 1
        self.sums = [Evidence(num_cells, recording.num_classes, self.quantum) for _ in self.robot_ids]
        self.log_q: Float64Array = np.zeros((self.num_robots, num_cells, num_columns))
        self.log_q_used = self.log_q.copy()
        self.touched: BoolArray = np.zeros((self.num_robots, num_cells), dtype=bool)
        self.maps = self.log_q.copy()
        self.known = self.touched.copy()
        anchor_after = config.consensus.anchor_after if config.consensus.rule in ("gradient", "natural") else 0
        self.anchors = [Anchor((num_cells, num_columns), anchor_after) for _ in self.robot_ids]
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
        stage = Stage(gamma_factor=1.0, flow_bits=self.flow_bits, settling=False)
        for tick in range(self.num_log_ticks):
            stamp_ns = self.start_ns + tick * self.period_ns
            self._integrate_before(stamp_ns)
            active = self._active_at(stamp_ns)
            team = self._graph_of(active, stamp_ns)
            yield self._tick(tick, active, team, stage)
        yield from self._settle(active, team)

    def _settle(self, active: tuple[bool, ...], team: TeamGraph) -> Iterator[TwinTick]:
        """Yield ticks on the last graph with decreasing gamma and growing flow_bits until nothing changes."""
        consensus = self.config.consensus
        if consensus.settle == 0:
            self.stop_reason = STOPPED_OFF
            return
        num_finer = flows.num_finer_ticks(self.maps, self.flow_bits, self.quantum)
        most = consensus.settle_max
        if most is None:
            # Maps that agree have equal certainties, so that 'weighted' mixes them with half the step size.
            share = 0.5 if consensus.rule == "weighted" else 1.0
            most = graph.default_settle_max(consensus.settle, graph.second_eigenvalue(team, share))
            most += max(flows.EXTRA_SETTLING_TICKS, num_finer) if self.flow_bits else 0
        # Every flow is at least the quantum, so that no flow is below this tolerance.
        tolerance = min(consensus.settle_tolerance, self.quantum) if self.flow_bits else consensus.settle_tolerance
        for settling_tick in range(1, most + 1):
            tick = self.num_log_ticks - 1 + settling_tick
            before = self.maps.copy()
            stage = Stage(
                gamma_factor=rules.settling_ramp(settling_tick, consensus.settle),
                flow_bits=self.flow_bits
                and self.flow_bits + flows.BITS_PER_SETTLING_TICK * min(settling_tick, num_finer),
                settling=True,
            )
            yield self._tick(tick, active, team, stage)
            is_at_rest = np.abs(self.maps - before).max(initial=0.0) < tolerance
            if is_at_rest and settling_tick >= num_finer:
                self.stop_reason = STOPPED_CONVERGED
                return
        self.stop_reason = STOPPED_MAX

    # --- one tick ----------------------------------------------------------------------------------------------------

    def _tick(self, tick: int, active: tuple[bool, ...], team: TeamGraph, stage: Stage) -> TwinTick:
        """Publish, deliver, iterate and measure; scans before the tick are already integrated."""
        exchange = self._exchange(tick, active, team)
        for robot in range(self.num_robots):
            arrived = frozenset(exchange.senders(robot))
            self.anchors[robot].update(self._due(tick), arrived, self.maps[robot], self.log_q_used[robot])
            if active[robot]:
                self._iterate_robot(robot, exchange, stage)
        oracle = self.log_q.sum(axis=0)
        self._count_averaged(team, active)
        return TwinTick(
            tick=tick,
            stamp_ns=self.start_ns + tick * self.period_ns,
            settling=stage.settling,
            active=active,
            links=team.links,
            num_scans=tuple(sums.num_scans for sums in self.sums),
            num_iterations=tuple(self.num_iterations),
            prior=self.prior,
            maps=self.maps.copy(),
            known=self.known.copy(),
            evidence=self.log_q.copy(),
            oracle=oracle,
            metrics=self._metrics(exchange, oracle) if self.with_metrics else None,
        )

    def _metrics(self, exchange: Exchange, oracle: Float64Array) -> TwinMetrics:
        """Return the metrics of the maps after the iterations."""
        team = exchange.team
        least_tolerance = 0.0
        if self.flow_bits:
            least_tolerance = self.num_robots * self.quantum / (2.0 * team.epsilon * team.least_weight)
        return team_metrics(
            self._with_prior(self.maps),
            self.known,
            self._with_prior(oracle),
            team.links,
            float(np.abs(self.maps - exchange.published).max(initial=0.0)),
            published=self._with_prior(exchange.published),
            least_tolerance=least_tolerance,
            labelled=np.array(
                [self._with_prior(own, count) for own, count in zip(self.maps, self.num_averaged, strict=True)]
            ),
        )

    def _exchange(self, tick: int, active: tuple[bool, ...], team: TeamGraph) -> Exchange:
        """Return the published maps, and the arrivals from active robots that are due."""
        due = self._due(tick)
        exchanges = self.config.consensus.rule != "local"
        arrivals = frozenset((j, i) for j, i in team.directed if exchanges and j in due and active[j] and active[i])
        return Exchange(team, self.maps.copy(), self.known.copy(), arrivals, tick)

    def _due(self, tick: int) -> frozenset[int]:
        """Return the robots that publish in a tick by their own periods and phases."""
        due = []
        for index, robot in enumerate(self.config.robots):
            period = round((robot.publish_period or self.period_ns * 1e-9) * 1e9 / self.period_ns)
            phase = round(robot.publish_phase * 1e9 / self.period_ns)
            if (tick - phase) % period == 0:
                due.append(index)
        return frozenset(due)

    def _integrate_before(self, stamp_ns: int) -> None:
        """Integrate the remaining scans with stamps before ``stamp_ns``, in order of (stamp, robot).

        With rules 'bayes' and 'weighted' every robot's new evidence enters its map, active or not.
        """
        changed = set()
        while self.num_integrated < len(self.scans) and self.scans[self.num_integrated].stamp_ns < stamp_ns:
            scan = self.scans[self.num_integrated]
            self.sums[scan.robot].integrate(scan, self.sensor)
            self.touched[scan.robot, scan.freed] = True
            self.touched[scan.robot, scan.hit] = True
            changed.add(scan.robot)
            self.num_integrated += 1
        for robot in changed:
            self.log_q[robot] = self.sums[robot].log_likelihood(self.config.consensus.evidence)
            if self.config.consensus.rule in ("bayes", "weighted"):
                self._add_evidence(robot)

    def _add_evidence(self, robot: int) -> None:
        """Add the change of a robot's evidence to its map, and its cells."""
        self.maps[robot] = rules.with_evidence(self.maps[robot], self.log_q[robot], self.log_q_used[robot])
        self.known[robot] |= self.touched[robot]
        self.log_q_used[robot] = self.log_q[robot]

    def _active_at(self, stamp_ns: int) -> tuple[bool, ...]:
        """Return which robots are active: from the first tick after their first scan, while the schedule has them on.

        With after_end 'leave', they are active up to and including the first tick after their last scan.
        """
        active = []
        for robot, stamps in enumerate(self.stamps):
            begun = bool(stamps) and stamps[0] < stamp_ns
            left = self.config.network.after_end == "leave" and begun and stamps[-1] < stamp_ns - self.period_ns
            active.append(begun and not left and not self._is_off(robot, stamp_ns))
        return tuple(active)

    def _is_off(self, robot: int, stamp_ns: int) -> bool:
        """Return whether the schedule turns a robot off at a time."""
        elapsed_s = (stamp_ns - self.start_ns) * 1e-9
        return any(
            self.robot_ids[robot] in entry.robots_off and entry.start <= elapsed_s < entry.end
            for entry in self.config.network.schedule
        )

    def _graph_of(self, active: tuple[bool, ...], stamp_ns: int) -> TeamGraph:
        """Return the weighted graph of the active robots at a time of the schedule."""
        elapsed_s = (stamp_ns - self.start_ns) * 1e-9
        return graph.team_graph(self.config.network, self.config.consensus, self.robot_ids, active, elapsed_s)

    def _iterate_robot(self, robot: int, exchange: Exchange, stage: Stage) -> None:
        """Run all iterations of one robot in a tick: one with all maps that arrived, or one for each."""
        consensus = self.config.consensus
        senders = exchange.senders(robot)
        if consensus.rule == "merge" and consensus.merge_maps is not None:
            senders = rules.in_turn(senders, consensus.merge_maps, exchange.tick)
        gamma_factor = stage.gamma_factor
        if consensus.mode == "sync" or not senders:
            self._iterate(robot, senders, exchange, stage, gamma_factor)
        else:
            if consensus.gamma_per_arrival == "divided":
                gamma_factor /= len(senders)
            for j in senders:
                self._iterate(robot, [j], exchange, stage, gamma_factor)
        self.known[robot] |= self.touched[robot]
        for j in senders:
            self.known[robot] |= exchange.known[j]

    def _mixed(self, robot: int, senders: Sequence[int], exchange: Exchange, stage: Stage) -> Float64Array:
        """Return the robot's map h~ after mixing with some of the maps that arrived."""
        team, current = exchange.team, self.maps[robot]
        differences, amounts = [], np.zeros_like(current)
        for j in senders:
            other, weight = exchange.published[j], team.weights[robot, j]
            if self.config.consensus.rule == "merge" and self.config.consensus.merge_weight is not None:
                weight = self.config.consensus.merge_weight / (2.0 * team.epsilon)
            is_mutual = self.config.consensus.rule == "bayes" and exchange.is_mutual(robot, j)
            # 'bayes' conserves the sum over robots only if both ends of a link use the same difference.
            own = exchange.published[robot] if is_mutual else self._base(current)
            if is_mutual and stage.flow_bits:
                amounts += self._flow(own, other, 2.0 * team.epsilon * weight, stage)
            elif self.config.consensus.rule == "weighted":
                differences.append((weight, rules.weighted_difference(own, other)))
            else:
                differences.append((weight, other - own))
        return rules.mix(current, differences, team.epsilon) + amounts

    def _flow(self, own: Float64Array, other: Float64Array, weight: float, stage: Stage) -> Float64Array:
        """Return the flow from a neighbour."""
        steps = flows.flow_steps(own, other, stage.flow_bits + flows.link_bits(weight), self.quantum)
        amounts = flows.flow(own, other, weight, steps)
        gate = self.config.consensus.flow_gate
        if stage.settling or gate == 0.0:
            return amounts
        return np.where(flows.is_held_back(own, other, self.blocks, gate), 0.0, amounts)

    def _base(self, own: Float64Array) -> Float64Array:
        """Return the map that is subtracted from a neighbour's: the robot's own, or 0 for 'merge'."""
        return np.zeros_like(own) if self.config.consensus.rule == "merge" else own

    def _iterate(
        self, robot: int, senders: Sequence[int], exchange: Exchange, stage: Stage, gamma_factor: float
    ) -> None:
        """Run one iteration of the rule at one robot."""
        consensus = self.config.consensus
        k = self.num_iterations[robot]
        gamma = gamma_factor * rules.gamma_at(consensus.gamma, k, consensus.gamma_power, consensus.gamma_decay)
        mixed = self._mixed(robot, senders, exchange, stage)
        log_q = self.log_q[robot]
        if consensus.rule in ("gradient", "natural"):
            step = rules.gradient_step if consensus.rule == "gradient" else rules.natural_step
            result = step(mixed, log_q + self.anchors[robot].offset, gamma)
            self.maps[robot] = result if stage.settling else rules.rounded(result, self.quantum)
        elif consensus.rule == "bayes":
            self.maps[robot] = rules.free_is_zero(mixed)
        elif consensus.rule == "weighted":
            result = rules.free_is_zero(mixed)
            self.maps[robot] = result if stage.settling else rules.rounded(result, self.quantum)
        elif consensus.rule == "merge":
            self.maps[robot] = rules.merge_step(
                mixed, log_q, self.log_q_used[robot], self.sensor.clamp_min, self.sensor.clamp_max
            )
        else:
            self.maps[robot] = log_q
        self.log_q_used[robot] = log_q
        self.num_iterations[robot] += 1

    def _count_averaged(self, team: TeamGraph, active: tuple[bool, ...]) -> None:
        """Update the number of robots that each active robot's map is the mean of: those that reach it, and itself."""
        if not self.config.consensus.map_is_mean:
            return
        for robot in np.flatnonzero(active).tolist():
            reaching = {robot}
            while more := {sender for sender, receiver in team.directed if receiver in reaching} - reaching:
                reaching |= more
            self.num_averaged[robot] = len(reaching)

    def _with_prior(self, deviation: Float64Array, num_averaged: int = 1) -> Float64Array:
        """Return absolute log-odds: the prior, divided by ``num_averaged``, is added to the classes 1..C."""
        absolute = deviation.copy()
        absolute[..., 1:] += self.prior / num_averaged
        return absolute
