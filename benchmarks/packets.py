"""Packets and links: what maps cost on the air, and what a team still agrees on when links fail.

Six robots explore the simulated village of docs/simulation.md with its default label noise. Compression, deltas,
losses, delays, a partition, a robot that dies, newcomers; with ``--table`` all rules x topologies x faults.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import itertools
import math
import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import scenes
import zstandard
from rounds import Report, Row, arguments, measured

from octoreplay.config.network import ScheduleEntry
from octoreplay.config.run import RunConfig
from octoreplay.config.sensor import MapConfig
from octoreplay.config.team_file import load_team_file
from octoreplay.io.robots.discover import resolve
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.mapping import codec
from octoreplay.mapping.codec import PacketFormat
from octoreplay.mapping.consensus import Evidence, sum_of_evidence
from octoreplay.mapping.octree import KEY_BITS, SemanticOctree
from octoreplay.mapping.sensor import ScanCaster, add_scan, clamped_increments
from octoreplay.mapping.streams import leaf_list, leaf_values
from octoreplay.records import DepthFrame, Float64Array, Frame, Int64Array, TickMetrics
from octoreplay.replay.exchange.messages import Source
from octoreplay.replay.session import Session
from octoreplay.replay.tick import Tick
from octoreplay.simulate.team import SimulationConfig, simulate_team

NUM_ROBOTS = 6
PACKET_RESOLUTION = 0.3
FAULT_RESOLUTION = 0.4
"""Edges of the finest cells [m] where packets and where faults are measured; the former is the demo's."""
AGREED = 0.999
AGREED_TICKS = 20
"""Settling at 99 % loss is over when the team agreed in so many ticks in a row."""
MOST_LOSSY_TICKS = 800
"""Settling at 99 % loss is given up after so many ticks."""
TABLE_TICKS = 60
"""The most settling ticks of the table: enough on the ring and the complete graph, too few on the line."""

RULES = ("gradient", "natural", "bayes", "ratio", "flood", "merge")
TOPOLOGIES = ("complete", "ring", "line", "range")
FAULTS: dict[str, dict[str, Any]] = {
    "none": {},
    "30 % loss": {"loss": 0.3},
    "bursts": {"burst_start": 0.05, "burst_end": 0.25},
    "latency 1.5 s": {"latency": 1.5},
    "one-way link": {},
}


# --- a run ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Watched:
    """The metrics of a run's ticks, and why it stopped."""

    ticks: tuple[TickMetrics, ...]
    stop_reason: str

    @property
    def log_ticks(self) -> tuple[TickMetrics, ...]:
        """The ticks while the logs last."""
        return tuple(tick for tick in self.ticks if not tick.settling)

    @property
    def num_settling(self) -> int:
        """How many ticks it settled for."""
        return len(self.ticks) - len(self.log_ticks)

    @property
    def peak(self) -> float:
        """The largest Phi_all."""
        return max(tick.total_distance_all for tick in self.ticks)

    @property
    def end(self) -> float:
        """The last Phi_all."""
        return self.ticks[-1].total_distance_all

    @property
    def sent_megabytes(self) -> float:
        """All that was sent."""
        return sum(robot.sent_bytes for tick in self.ticks for robot in tick.robots) / 1e6


class _Stored:
    """Frames that are in memory."""

    def __init__(self, frames: Sequence[Frame]) -> None:
        self._frames = frames

    def frames(self) -> Iterator[Frame]:
        """The frames from the beginning."""
        return iter(self._frames)


Watcher = Callable[[Session, Tick], bool]
"""Is shown every tick; True ends the run."""


def _play(config: RunConfig, duration: float, watch: Watcher | None = None, blank_after: float = math.inf) -> Watched:
    """Run a team; its sensors see nothing from ``blank_after`` [s] on."""
    frames = _frames(duration)
    start_ns = min(of_robot[0].stamp_ns for of_robot in frames)
    if blank_after < math.inf:
        frames = tuple(tuple(_blanked(f, start_ns + round(blank_after * 1e9)) for f in part) for part in frames)
    session = Session(config, [_Stored(part) for part in frames], ThreadPoolExecutor(2))
    ticks = []
    for tick in session.ticks():
        ticks.append(tick.metrics)
        if watch is not None and watch(session, tick):
            break
    return Watched(tuple(ticks), session.stop_reason)


def _blanked(frame: Frame, since_ns: int) -> Frame:
    """The frame without anything measured, if it is that late."""
    if frame.stamp_ns < since_ns or not isinstance(frame, DepthFrame):
        return frame
    return dataclasses.replace(frame, depth_image=np.zeros_like(frame.depth_image))


@functools.cache
def _team(duration: float) -> RunConfig:
    """The team with logs of a length, simulated when they are first asked for."""
    folder = scenes.cache_folder() / f"village-{NUM_ROBOTS}-{duration:g}s"
    if not (folder / "team.yaml").exists():
        simulate_team(folder, SimulationConfig(num_robots=NUM_ROBOTS, duration=duration))
    return resolve(load_team_file(folder / "team.yaml"))


@functools.lru_cache(maxsize=1)
def _frames(duration: float) -> tuple[tuple[Frame, ...], ...]:
    """Every robot's frames, decoded once for many runs."""
    config = _team(duration)
    with ExitStack() as stack:
        logs = [stack.enter_context(RobotLog(robot, config.time, config.classes)) for robot in config.robots]
        return tuple(tuple(log.frames()) for log in logs)


def _config(
    duration: float,
    *,
    schedule: Iterable[ScheduleEntry] = (),
    one_way: Iterable[tuple[str, str]] = (),
    **parameters: Any,
) -> RunConfig:
    """The team's configuration with a schedule and flat parameters."""
    config = _team(duration).with_parameters(parameters)
    network = dataclasses.replace(config.network, schedule=tuple(schedule), one_way=tuple(one_way))
    return dataclasses.replace(config, network=network)


@functools.cache
def _clean_run(rule: str, resolution: float, duration: float, packets: str, content: str) -> Watched:
    """A run on the complete graph without faults."""
    config = _config(duration, rule=rule, resolution=resolution, packets=packets, content=content)
    return _play(config, duration)


def _ids(config: RunConfig) -> tuple[str, ...]:
    return tuple(robot.robot_id for robot in config.robots)


def _worst(tick: TickMetrics) -> tuple[float, float]:
    """The worst robot's agreement: all cells, occupied cells."""
    return min(robot.agreement for robot in tick.robots), min(robot.agreement_occupied for robot in tick.robots)


def _add_agreement(report: Report, title: str, tick: TickMetrics, must: float | None = None, note: str = "") -> None:
    """Both numbers of the worst robot."""
    for cells, value in zip(("all cells", "occupied"), _worst(tick), strict=True):
        report.add(Row(f"{title}, {cells}", value, "", must=must, more_is_better=True, note=note))


# --- cells ------------------------------------------------------------------------------------------------------------


def _cells(octree: SemanticOctree) -> tuple[Int64Array, Float64Array]:
    """Every known finest cell, one by one: Morton codes (n,), ascending, and deviations (n, C)."""
    streams = octree.streams()
    codes, depths, is_vector = leaf_list(streams)
    spans = np.int64(1) << (3 * (KEY_BITS - depths.astype(np.int64)))
    starts = np.concatenate([np.zeros(1, np.int64), np.cumsum(spans)[:-1]])
    cells = np.repeat(codes - starts, spans) + np.arange(spans.sum())
    values = np.repeat(leaf_values(streams, is_vector, octree.num_classes), spans, axis=0)
    return cells, values.astype(np.float64)


def _sum(octrees: Sequence[SemanticOctree]) -> tuple[Int64Array, Float64Array]:
    """The sum over octrees, cell by cell, as ``_cells``."""
    parts = [_cells(octree) for octree in octrees]
    codes = np.unique(np.concatenate([cells for cells, _ in parts]))
    total = np.zeros((codes.size, octrees[0].num_classes))
    for cells, values in parts:
        total[np.searchsorted(codes, cells)] += values
    return codes, total


def _deviation(
    one: tuple[Int64Array, Float64Array], other: tuple[Int64Array, Float64Array], scale: float = 1.0
) -> Float64Array:
    """|scale x one - other| over the cells that either knows, (n, C); what one does not know counts as 0."""
    codes = np.union1d(one[0], other[0])
    difference = np.zeros((codes.size, other[1].shape[1]))
    difference[np.searchsorted(codes, one[0])] += scale * one[1]
    difference[np.searchsorted(codes, other[0])] -= other[1]
    return np.abs(difference)


# --- packets ----------------------------------------------------------------------------------------------------------


def _lossless(report: Report, options: argparse.Namespace) -> None:
    """Whole exact maps against the uniform grid, with and without compression."""
    for rule, resolution in itertools.product(("gradient", "bayes"), (0.3, 0.2)):
        run = _clean_run(rule, resolution, options.duration, "full", "float32")
        title = f"{rule} {resolution:g} m, whole exact maps"
        for when, ticks in (("mean over the logs", run.log_ticks), ("settled", run.ticks[-1:])):
            is_target = when != "settled"
            grid, octree, packet = _map_bytes(ticks)
            report.add(Row(f"{title}: grid / octree, {when}", grid / octree, "", must=6.0 if is_target else None,
                           more_is_better=True))  # fmt: skip
            report.add(Row(f"{title}: grid / packet, {when}", grid / packet, "", must=25.0, more_is_better=True))
        report.add(Row(f"{title}: known cells, settled", float(run.ticks[-1].num_known_cells), ""))


def _map_bytes(ticks: Iterable[TickMetrics]) -> tuple[float, float, float]:
    """Bytes as grid, as octree and as sent, summed over what every robot published."""
    published = [robot for tick in ticks for robot in tick.robots if robot.grid_bytes and robot.active]
    return (
        float(sum(robot.grid_bytes for robot in published)),
        float(sum(robot.octree_bytes for robot in published)),
        float(sum(robot.packet_bytes for robot in published)),
    )


def _delta(report: Report, options: argparse.Namespace) -> None:
    """What changed since the receiver's version, in steps of 0.05 log-odds."""
    for rule in ("bayes", "gradient", "flood"):
        exact = _clean_run(rule, PACKET_RESOLUTION, options.duration, "full", "float32")
        run = _clean_run(rule, PACKET_RESOLUTION, options.duration, "delta", "int8")
        title = f"{rule}, delta + int8 + zstd"
        grid, _, packet = _map_bytes(run.log_ticks)
        # In the first seconds most of a map is new, so short logs have no target.
        report.add(Row(f"{title}: grid / packet, mean over the logs", grid / packet, "",
                       must=200.0 if options.duration >= 60.0 else None, more_is_better=True,
                       note="settling excluded"))  # fmt: skip
        grid, _, packet = _map_bytes(run.ticks)
        report.add(Row(f"{title}: grid / packet, with settling", grid / max(packet, 1.0), "",
                       note=f"{run.num_settling} settling ticks"))  # fmt: skip
        receivers = NUM_ROBOTS - 1
        sent = sum(robot.sent_bytes for tick in run.log_ticks for robot in tick.robots)
        grid = _map_bytes(run.log_ticks)[0]
        report.add(Row(f"{title}: grid / all bytes on the air, over the logs", receivers * grid / sent, "",
                       note="acknowledgements included"))  # fmt: skip
        for when, one, other in (
            ("logs' end", run.log_ticks[-1], exact.log_ticks[-1]), ("settled", run.ticks[-1], exact.ticks[-1]),
        ):  # fmt: skip
            for cells, mine, theirs in zip(("all cells", "occupied"), _worst(one), _worst(other), strict=True):
                report.add(Row(f"{title}: agreement, {when}, {cells}: off the exact run's", abs(mine - theirs), "",
                               must=0.002, note=f"{mine:.5f} against {theirs:.5f}"))  # fmt: skip


def _codec(report: Report, options: argparse.Namespace) -> None:
    """Encoding and decoding a map of a million cells, and the delta of one second."""
    for title, octree, changed in (_lidar_map(), _village_map(60.0)):
        report.add(Row(f"{title}: known cells", float(octree.num_cells), "", note=f"{octree.num_bricks:,} bricks"))
        packet_format = PacketFormat()
        data = codec.encode_packet(octree, packet_format=packet_format)
        encode = [_milliseconds(functools.partial(codec.encode_packet, octree)) for _ in range(options.rounds)]
        decode = [_milliseconds(functools.partial(codec.decode_packet, data)) for _ in range(options.rounds)]
        both = [(a + b) * 1e6 / octree.num_cells for a, b in zip(encode, decode, strict=True)]
        smaller = codec.grid_bytes(octree.num_cells, octree.num_classes) / len(data)
        report.add(Row(f"{title}: grid / packet", smaller, ""))
        report.add(measured(f"{title}: encoding", encode, "ms"))
        report.add(measured(f"{title}: decoding", decode, "ms"))
        report.add(measured(f"{title}: encoding + decoding, for 1 M cells", both, "ms", must=20.0))
        _delta_speed(report, title, octree, changed, options.rounds)


def _delta_speed(report: Report, title: str, octree: SemanticOctree, changed: Int64Array, rounds: int) -> None:
    """The time of a delta next to zstd alone."""
    plain = codec.encode_delta(octree, changed, packet_format=PacketFormat(zstd_level=None))[codec.HEADER_BYTES :]
    data = codec.encode_delta(octree, changed)
    coded = zstandard.ZstdDecompressor().decompress(data[codec.HEADER_BYTES :])
    title = f"{title}: delta of 1 s"
    report.add(Row(f"{title}: bricks", float(changed.size), "", note=f"{len(plain):,} bytes, packed {len(data):,}"))
    ours, raw, inner = [], [], []
    for _ in range(max(rounds, 20)):
        ours.append(_milliseconds(lambda: codec.encode_delta(octree, changed)))
        raw.append(_milliseconds(lambda: zstandard.ZstdCompressor(level=1).compress(plain)))
        inner.append(_milliseconds(lambda: zstandard.ZstdCompressor(level=1).compress(coded)))
    report.add(measured(f"{title}: encoding", ours, "ms"))
    for name, alone, must in (("the octree's bytes", raw, 2.0), ("the coded bytes that it gets", inner, None)):
        ratios = [a / b for a, b in zip(ours, alone, strict=True)]
        report.add(measured(f"{title}: encoding / zstd alone on {name}", ratios, "", must=must))


def _milliseconds(action: Callable[[], object]) -> float:
    """Of this thread's processor time: nothing here uses another thread."""
    started = time.thread_time()
    action()
    return 1e3 * (time.thread_time() - started)


def _lidar_map() -> tuple[str, SemanticOctree, Int64Array]:
    """A map of a LiDAR of at least a million cells, and the bricks that its last second (10 scans) changed."""
    resolution = 0.15
    scene = scenes.load("lidar", 100)
    octree = SemanticOctree(resolution, scenes.NUM_CLASSES)
    caster = ScanCaster(scene.sensor(), MapConfig(resolution=resolution), scenes.NUM_CLASSES)
    increments = clamped_increments(scene.sensor())
    number = 0
    for number, frame in enumerate(scene.frames):
        add_scan(octree, caster.cast(frame), increments, number)
        if octree.num_cells >= 1_000_000:
            break
    return f"lidar {resolution:g} m", octree, np.flatnonzero(octree.revisions > number - 10)


def _village_map(duration: float) -> tuple[str, SemanticOctree, Int64Array]:
    """What six noisy robots agree on, and the bricks that one robot's last second changed."""
    config = _team(duration)
    assert config.classes is not None
    num_classes, resolution = config.classes.num_classes, 0.2
    map_config = dataclasses.replace(config.map, resolution=resolution)
    caster = ScanCaster(config.sensor, map_config, num_classes)
    evidence = []
    for frames in _frames(duration):
        octree = SemanticOctree(resolution, num_classes)
        for frame in frames:
            is_last = frame.stamp_ns >= frames[-1].stamp_ns - 10**9
            add_scan(octree, caster.cast(frame), clamped_increments(config.sensor), int(is_last))
        evidence.append(octree)
    agreed = SemanticOctree(resolution, num_classes)
    codes = np.unique(np.concatenate([octree.codes for octree in evidence]))
    sum_of_evidence(agreed, [Evidence(octree, scale=1.0 / len(evidence)) for octree in evidence], codes, 0)
    return f"village {resolution:g} m", agreed, agreed.find(evidence[0].codes[evidence[0].revisions == 1])


# --- faults -----------------------------------------------------------------------------------------------------------


def _ring(report: Report, options: argparse.Namespace) -> None:
    """A ring with losses and delays. Losses also raise the peak, so Phi_all is next to the peak without any."""
    common: dict[str, Any] = {"resolution": FAULT_RESOLUTION, "topology": "ring", "rule": "ratio"}
    whole = _play(_config(options.duration, **common), options.duration)
    run = _play(_config(options.duration, **common, loss=0.3, latency=0.2, jitter=0.1), options.duration)
    title = "ratio, ring, 30 % loss, 0.2 +- 0.1 s late"
    left = run.end / whole.peak
    report.add(Row(f"{title}: Phi_all, settled / peak without faults", left, "", must=1e-6,
                   note=f"{left:.2g}; {run.num_settling} settling ticks, {run.stop_reason}"))  # fmt: skip
    report.add(Row(f"{title}: peak of Phi_all / peak without faults", run.peak / whole.peak, ""))
    _add_agreement(report, f"{title}: agreement, logs' end", run.log_ticks[-1])
    _add_agreement(report, f"{title}: agreement, settled", run.ticks[-1], must=AGREED)
    report.add(Row(f"{title}: sent", run.sent_megabytes, "MB", note=f"{whole.sent_megabytes:.0f} without faults"))


def _loss(report: Report, options: argparse.Namespace) -> None:
    """A team that loses 99 of 100 packets; settling is watched until everybody agrees, or given up."""
    del options
    duration = 300.0
    results: list[tuple[float, float, str]] = []
    variants = [("flood", "delta"), *((rule, "full") for rule in ("flood", "ratio", "bayes", "gradient"))]
    for rule, packets in variants:
        config = _config(
            duration, resolution=FAULT_RESOLUTION, rule=rule, packets=packets, loss=0.99, settle_max=MOST_LOSSY_TICKS
        )
        in_row = [0]

        def has_settled(_: Session, tick: Tick, in_row: list[int] = in_row) -> bool:
            in_row[0] = in_row[0] + 1 if tick.settling and min(_worst(tick.metrics)) >= AGREED else 0
            return in_row[0] == AGREED_TICKS

        run = _play(config, duration, has_settled)
        title = f"{rule}, {packets}, 99 % loss"
        _add_agreement(report, f"{title}: agreement, logs' end", run.log_ticks[-1])
        how = run.stop_reason or f"agreed for {AGREED_TICKS}, stopped"
        _add_agreement(report, f"{title}: agreement, settled", run.ticks[-1], note=f"{run.num_settling} ticks: {how}")
        log_run = Watched(run.log_ticks, "")
        report.add(Row(f"{title}: sent over the logs", log_run.sent_megabytes, "MB"))
        report.add(Row(f"{title}: sent in all", run.sent_megabytes, "MB"))
        results.append((min(_worst(run.log_ticks[-1])), min(_worst(run.ticks[-1])), f"{rule}, {packets}"))
    at_end, settled, name = max(results)
    title = "99 % loss, the best rule: agreement, the lesser of both"
    report.add(Row(f"{title}, logs' end", at_end, "", must=0.8, more_is_better=True, note=name))
    report.add(Row(f"{title}, settled", settled, "", must=AGREED, more_is_better=True, note=name))


def _partition(report: Report, options: argparse.Namespace) -> None:
    """Three and three robots for a minute, then all together."""
    del options
    duration, start, end = 180.0, 60.0, 120.0
    ids = _ids(_team(duration))
    schedule = (ScheduleEntry(start, end, groups=(ids[:3], ids[3:])),)
    for rule, blank_after in itertools.product(("bayes", "ratio"), (math.inf, end)):
        config = _config(duration, schedule=schedule, resolution=FAULT_RESOLUTION, rule=rule)
        run = _play(config, duration, lambda _, tick: tick.number >= end + 10, blank_after)
        title = f"{rule}, 3 + 3 robots from {start:g} to {end:g} s"
        title += ", mapping goes on" if blank_after == math.inf else ", nothing new is seen afterwards"
        apart = max(tick.total_distance_all for tick in run.ticks if start <= tick.tick < end)
        after = [tick.total_distance_all for tick in run.ticks if end <= tick.tick < end + 10]
        report.add(Row(f"{title}: least Phi_all in the 10 ticks after / peak", min(after) / apart, "", must=0.01,
                       note=f"tick by tick {', '.join(f'{value / apart:.2g}' for value in after)}"))  # fmt: skip
        _add_agreement(report, f"{title}: agreement, 10 ticks after", run.ticks[int(end) + 9])
        if blank_after == math.inf:
            before = [tick.total_distance_all for tick in run.ticks if start - 10 <= tick.tick < start]
            note = "what one second's scans do"
            report.add(Row(f"{title}: Phi_all, median of the 10 ticks before / peak", statistics.median(before) / apart,
                           "", note=note))  # fmt: skip
            _add_agreement(report, f"{title}: agreement, last tick apart", run.ticks[int(end) - 1])


def _killed(report: Report, options: argparse.Namespace) -> None:
    """A robot that stops for good at half time."""
    duration = options.duration
    killed = NUM_ROBOTS - 1
    schedule = (ScheduleEntry(duration / 2, math.inf, robots_off=(_ids(_team(duration))[killed],)),)
    for rule in ("flood", "ratio", "bayes", "gradient"):
        config = _config(duration, schedule=schedule, resolution=FAULT_RESOLUTION, rule=rule)
        sessions: list[Session] = []

        def keep(session: Session, _: Tick, sessions: list[Session] = sessions) -> bool:
            sessions[:] = [session]
            return False

        run = _play(config, duration, keep)
        robots = sessions[0].team.robots
        alive = [index for index in range(NUM_ROBOTS) if index != killed]
        maps = {index: _cells(robots[index].map) for index in alive}
        title = f"{rule}, a robot killed at {duration / 2:g} s"
        everything = _sum([robot.evidence.octree for robot in robots])
        if rule == "flood":
            given = [robot.exchange.held[robots[killed].source].octree for robot in (robots[i] for i in alive)]
            living = [robots[index].evidence.octree for index in alive]
            off = [
                _deviation(maps[index], _sum([*living, octree]), NUM_ROBOTS).max()
                for index, octree in zip(alive, given, strict=True)
            ]
            report.add(Row(f"{title}: N h off what was delivered, worst cell and robot", max(off), "log-odds",
                           must=1e-4))  # fmt: skip
        deviations = [_deviation(maps[index], everything, NUM_ROBOTS) for index in alive]
        report.add(Row(f"{title}: N h off all evidence, worst cell and robot", max(d.max() for d in deviations),
                       "log-odds"))  # fmt: skip
        report.add(Row(f"{title}: N h off all evidence, mean", statistics.mean(float(d.mean()) for d in deviations),
                       "log-odds", note="all cells and classes"))  # fmt: skip
        living_metrics = [run.ticks[-1].robots[index] for index in alive]
        for cells, value in (
            ("all cells", min(robot.agreement for robot in living_metrics)),
            ("occupied", min(robot.agreement_occupied for robot in living_metrics)),
        ):
            report.add(Row(f"{title}: agreement of the others, settled, {cells}", value, ""))


# --- newcomers --------------------------------------------------------------------------------------------------------


NEWCOMERS = (("off from 0 to 30 s", 0.0, 30.0, False), ("off from 20 to 40 s, forgets", 20.0, 40.0, True))


def _newcomer(report: Report, options: argparse.Namespace) -> None:
    """A robot that comes late, and one that comes back knowing nothing, in a ring; nothing new is seen meanwhile."""
    del options
    duration = 60.0
    ids = _ids(_team(duration))
    for name, start, end, forget in NEWCOMERS:
        schedule = (ScheduleEntry(start, end, robots_off=(ids[0],), forget=forget),)
        for packets in ("full", "delta"):
            config = _config(
                duration, schedule=schedule, resolution=FAULT_RESOLUTION, topology="ring", rule="flood", packets=packets
            )
            _flood_newcomer(report, f"flood, ring, {packets}, a robot {name}", config, duration, end)
        config = _config(duration, schedule=schedule, resolution=FAULT_RESOLUTION, topology="ring", rule="ratio")
        _ratio_newcomer(report, f"ratio, ring, a robot {name}", config, duration, end)


def _flood_newcomer(report: Report, title: str, config: RunConfig, duration: float, back: float) -> None:
    """Ticks, its first one included, until robot 0 has what everybody had published when it came back."""
    wanted: dict[Source, int] = {}
    missing: dict[int, list[Source]] = {}
    graphs: list[nx.Graph] = []

    def watch(session: Session, tick: Tick) -> bool:
        robots = session.team.robots
        if tick.number < back:
            return False
        if tick.number == back:
            # Every source's newest version anywhere; the others' versions of this very tick are part of it.
            for source, state in itertools.chain(*(robot.exchange.held.items() for robot in robots[1:])):
                wanted[source] = max(wanted.get(source, 0), state.version)
            graphs.append(nx.Graph(tick.graph.pairs))
        held = robots[0].exchange.held
        own = robots[0].source
        missing[tick.number] = [
            source for source, version in wanted.items()
            if source != own and (source not in held or held[source].version < version)
        ]  # fmt: skip
        return not missing[tick.number]

    run = _play(config, duration, watch, blank_after=back)
    left = missing[max(missing)]
    diameter = nx.diameter(graphs[0])
    note = f"diameter {diameter}"
    if left:
        names = ", ".join(f"{config.robots[source.origin].robot_id} (life {source.epoch})" for source in left)
        note = f"not even then: {names}; {note}"
    report.add(Row(f"{title}: ticks until it has everything", len(missing), "", must=diameter, note=note))
    _add_agreement(report, f"{title}: agreement then", run.ticks[-1])


def _ratio_newcomer(report: Report, title: str, config: RunConfig, duration: float, back: float) -> None:
    """Ticks, its first one included, until robot 0's map is within 1 % of where it is to go, next to lambda_2's."""
    to_mean: list[float] = []
    to_others: list[float] = []
    rates: list[float] = []

    def watch(session: Session, tick: Tick) -> bool:
        del session
        if tick.number < back:
            return False
        mine, others = _cells(tick.maps[0]), _sum(tick.maps[1:])
        oracle = _cells(tick.oracle)
        if tick.number == back:
            # Before it came back it knew nothing.
            to_mean.append(float(np.linalg.norm(oracle[1] / NUM_ROBOTS)))
            to_others.append(float(np.linalg.norm(others[1] / (NUM_ROBOTS - 1))))
            rates.append(_share_lambda_2(tick.graph.links))
        to_mean.append(float(np.linalg.norm(_deviation(mine, oracle, NUM_ROBOTS)) / NUM_ROBOTS))
        to_others.append(float(np.linalg.norm(_deviation(mine, others, NUM_ROBOTS - 1)) / (NUM_ROBOTS - 1)))
        return False

    run = _play(config, duration, watch, blank_after=back)
    predicted = math.log(0.01) / math.log(rates[0])
    for name, errors in (("the mean of all evidence", to_mean), ("the mean of the others' maps", to_others)):
        within = [number for number, error in enumerate(errors) if error < 0.01 * errors[0]]
        ticks = within[0] if within else len(errors) - 1
        note = f"log 0.01 / log lambda_2 = {predicted:.1f}; at the end {errors[-1] / errors[0]:.2g} of its start"
        note = note if within else f"not even then; {note}"
        report.add(Row(f"{title}: ticks until within 1 % of {name}", ticks, "", note=note))
    _add_agreement(report, f"{title}: agreement, settled", run.ticks[-1])


def _share_lambda_2(links: Iterable[tuple[int, int]]) -> float:
    """The second largest |eigenvalue| of the column-stochastic share matrix: 1 / (1 + D) kept and for each receiver."""
    adjacency = np.zeros((NUM_ROBOTS, NUM_ROBOTS))
    for sender, receiver in links:
        adjacency[receiver, sender] = 1.0
    shares = (np.eye(NUM_ROBOTS) + adjacency) / (1.0 + adjacency.sum(axis=0))
    return float(np.sort(np.abs(np.linalg.eigvals(shares)))[-2])


# --- the table --------------------------------------------------------------------------------------------------------

TABLE_HEAD = (
    "rule", "topology", "fault", "agreement, logs' end", "settled", "Phi_all, peak", "end", "settling ticks",
    "sent [MB]",
)  # fmt: skip


def _table(report: Report, options: argparse.Namespace) -> None:
    """Every rule on every topology with every fault, as Markdown."""
    duration, resolution = options.table_duration, options.table_resolution
    ids = _ids(_team(duration))
    started = time.perf_counter()
    lines = [f"| {' | '.join(TABLE_HEAD)} |", "|" + "---|" * len(TABLE_HEAD)]
    for topology, (fault, link), rule in itertools.product(TOPOLOGIES, FAULTS.items(), RULES):
        one_way = ((ids[0], ids[1]),) if fault == "one-way link" else ()
        network = {"topology": topology, "rule": rule, "resolution": resolution, "settle_max": TABLE_TICKS, **link}
        config = _config(duration, one_way=one_way, **network)
        run = _play(config, duration)
        ends = [" / ".join(f"{value:.4f}" for value in _worst(tick)) for tick in (run.log_ticks[-1], run.ticks[-1])]
        lines.append(
            f"| {rule} | {topology} | {fault} | {ends[0]} | {ends[1]} | {run.peak:.1e} | {run.end:.1e} |"
            f" {run.num_settling} | {run.sent_megabytes:.0f} |"
        )
        print(lines[-1], flush=True)
    Path(options.table).write_text("\n".join(lines) + "\n", encoding="utf-8")
    report.add(Row("table", time.perf_counter() - started, "s", note=f"{len(lines) - 2} runs"))


# --- command line -----------------------------------------------------------------------------------------------------

SECTIONS: dict[str, Callable[[Report, argparse.Namespace], None]] = {
    "lossless": _lossless, "delta": _delta, "ring": _ring, "loss": _loss, "partition": _partition, "killed": _killed,
    "newcomer": _newcomer, "codec": _codec,
}  # fmt: skip


def main() -> None:
    """The sections that were asked for, then the table."""
    options = arguments(__doc__ or "", rounds=10, add=_add_options)
    report = Report("packets", vars(options))
    for name in options.only or ([] if options.table else SECTIONS):
        SECTIONS[name](report, options)
    if options.table:
        _table(report, options)
    report.save(options.json)


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--only", action="append", choices=tuple(SECTIONS), help="run only these sections")
    parser.add_argument(
        "--duration", type=float, default=60.0,
        help="of the logs in seconds, but for loss, partition and newcomer (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--table", metavar="FILE", help="all rules x topologies x faults, written as Markdown")
    parser.add_argument("--table-duration", type=float, default=60.0, help="default: %(default)s")
    parser.add_argument("--table-resolution", type=float, default=0.5, help="default: %(default)s")


if __name__ == "__main__":
    main()
