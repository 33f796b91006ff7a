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
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import scenes
import zstandard
from newcomers import add_newcomers
from rounds import Report, Row, arguments, measured
from watched_runs import (
    FAULT_RESOLUTION,
    NUM_ROBOTS,
    Watched,
    add_agreement,
    cells_of,
    clean_run,
    deviation_of_cells,
    play,
    recorded_frames,
    robot_ids,
    run_config,
    simulated_team,
    sum_of_cells,
    worst_agreement,
)

from octoreplay.config.network import ScheduleEntry
from octoreplay.config.sensor import MapConfig
from octoreplay.mapping import codec
from octoreplay.mapping.codec import PacketFormat
from octoreplay.mapping.consensus import Evidence, sum_of_evidence
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.sensor import ScanCaster, add_scan, clamped_increments
from octoreplay.records import Int64Array
from octoreplay.replay.session import Session
from octoreplay.replay.tick import Tick
from octoreplay.run_metrics import TickMetrics

PACKET_RESOLUTION = 0.3
"""Edge of the finest cells in the measurements of packets, as in the demo [m]."""
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


# --- packets ----------------------------------------------------------------------------------------------------------


def _lossless(report: Report, options: argparse.Namespace) -> None:
    """Whole exact maps against the uniform grid, with and without compression."""
    for rule, resolution in itertools.product(("gradient", "bayes"), (0.3, 0.2)):
        run = clean_run(rule, resolution, options.duration, "full", "float32")
        title = f"{rule} {resolution:g} m, whole exact maps"
        for when, ticks in (("mean over the logs", run.log_ticks), ("settled", run.ticks[-1:])):
            is_target = when != "settled"
            grid, octree, packet = _map_bytes(ticks)
            report.add(Row(f"{title}: grid / octree, {when}", grid / octree, "", must=6.0 if is_target else None,
                           more_is_better=True))  # fmt: skip
            must, goal = (50.0, 80.0) if rule == "bayes" else (25.0, 35.0)
            report.add(
                Row(f"{title}: grid / packet, {when}", grid / packet, "", must=must, goal=goal, more_is_better=True)
            )
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
    """Deltas since the receiver's version, in steps of 0.05 log-odds."""
    for rule in ("bayes", "gradient", "flood"):
        exact = clean_run(rule, PACKET_RESOLUTION, options.duration, "full", "float32")
        run = clean_run(rule, PACKET_RESOLUTION, options.duration, "delta", "int8")
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
            for cells, mine, theirs in zip(
                ("all cells", "occupied"), worst_agreement(one), worst_agreement(other), strict=True
            ):
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
        report.add(measured(f"{title}: encoding + decoding, for 1 M cells", both, "ms", must=18.0, goal=12.0))
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
    """Agreed map of six noisy robots, and the bricks that one robot's last second changed."""
    config = simulated_team(duration)
    assert config.classes is not None
    num_classes, resolution = config.classes.num_classes, 0.2
    map_config = dataclasses.replace(config.map, resolution=resolution)
    caster = ScanCaster(config.effective_sensor, map_config, num_classes)
    evidence = []
    for frames in recorded_frames(duration):
        octree = SemanticOctree(resolution, num_classes)
        for frame in frames:
            is_last = frame.stamp_ns >= frames[-1].stamp_ns - 10**9
            add_scan(octree, caster.cast(frame), clamped_increments(config.effective_sensor), int(is_last))
        evidence.append(octree)
    agreed = SemanticOctree(resolution, num_classes)
    codes = np.unique(np.concatenate([octree.codes for octree in evidence]))
    sum_of_evidence(agreed, [Evidence(octree, scale=1.0 / len(evidence)) for octree in evidence], codes, 0)
    return f"village {resolution:g} m", agreed, agreed.find(evidence[0].codes[evidence[0].revisions == 1])


# --- faults -----------------------------------------------------------------------------------------------------------


def _ring(report: Report, options: argparse.Namespace) -> None:
    """A ring with losses and delays. Losses also raise the peak, so Phi_all is next to the peak without any."""
    common: dict[str, Any] = {"resolution": FAULT_RESOLUTION, "topology": "ring", "rule": "ratio"}
    whole = play(run_config(options.duration, **common), options.duration)
    run = play(run_config(options.duration, **common, loss=0.3, latency=0.2, jitter=0.1), options.duration)
    title = "ratio, ring, 30 % loss, 0.2 +- 0.1 s late"
    left = run.end / whole.peak
    report.add(Row(f"{title}: Phi_all, settled / peak without faults", left, "", must=1e-6,
                   note=f"{left:.2g}; {run.num_settling} settling ticks, {run.stop_reason}"))  # fmt: skip
    report.add(Row(f"{title}: peak of Phi_all / peak without faults", run.peak / whole.peak, ""))
    add_agreement(report, f"{title}: agreement, logs' end", run.log_ticks[-1])
    add_agreement(report, f"{title}: agreement, settled", run.ticks[-1], must=AGREED)
    report.add(Row(f"{title}: sent", run.sent_megabytes, "MB", note=f"{whole.sent_megabytes:.0f} without faults"))


def _loss(report: Report, options: argparse.Namespace) -> None:
    """A team that loses 99 of 100 packets; settling is watched until everybody agrees, or given up."""
    del options
    duration = 300.0
    results: list[tuple[float, float, str]] = []
    variants = [("flood", "delta"), *((rule, "full") for rule in ("flood", "ratio", "bayes", "gradient"))]
    for rule, packets in variants:
        config = run_config(
            duration, resolution=FAULT_RESOLUTION, rule=rule, packets=packets, loss=0.99, settle_max=MOST_LOSSY_TICKS
        )
        in_row = [0]

        def has_settled(_: Session, tick: Tick, in_row: list[int] = in_row) -> bool:
            in_row[0] = in_row[0] + 1 if tick.settling and min(worst_agreement(tick.metrics)) >= AGREED else 0
            return in_row[0] == AGREED_TICKS

        run = play(config, duration, has_settled)
        title = f"{rule}, {packets}, 99 % loss"
        add_agreement(report, f"{title}: agreement, logs' end", run.log_ticks[-1])
        how = run.stop_reason or f"agreed for {AGREED_TICKS}, stopped"
        add_agreement(report, f"{title}: agreement, settled", run.ticks[-1], note=f"{run.num_settling} ticks: {how}")
        log_run = Watched(run.log_ticks, "")
        report.add(Row(f"{title}: sent over the logs", log_run.sent_megabytes, "MB"))
        report.add(Row(f"{title}: sent in all", run.sent_megabytes, "MB"))
        results.append(
            (min(worst_agreement(run.log_ticks[-1])), min(worst_agreement(run.ticks[-1])), f"{rule}, {packets}")
        )
    at_end, settled, name = max(results)
    title = "99 % loss, the best rule: agreement, the lesser of both"
    report.add(Row(f"{title}, logs' end", at_end, "", must=0.8, more_is_better=True, note=name))
    report.add(Row(f"{title}, settled", settled, "", must=AGREED, more_is_better=True, note=name))


def _partition(report: Report, options: argparse.Namespace) -> None:
    """Three and three robots for a minute, then all together."""
    del options
    duration, start, end = 180.0, 60.0, 120.0
    ids = robot_ids(simulated_team(duration))
    schedule = (ScheduleEntry(start, end, groups=(ids[:3], ids[3:])),)
    for rule, blank_after in itertools.product(("bayes", "ratio"), (math.inf, end)):
        config = run_config(duration, schedule=schedule, resolution=FAULT_RESOLUTION, rule=rule)
        run = play(config, duration, lambda _, tick: tick.number >= end + 10, blank_after)
        title = f"{rule}, 3 + 3 robots from {start:g} to {end:g} s"
        title += ", mapping goes on" if blank_after == math.inf else ", nothing new is seen afterwards"
        apart = max(tick.total_distance_all for tick in run.ticks if start <= tick.tick < end)
        after = [tick.total_distance_all for tick in run.ticks if end <= tick.tick < end + 10]
        report.add(Row(f"{title}: least Phi_all in the 10 ticks after / peak", min(after) / apart, "", must=0.01,
                       note=f"tick by tick {', '.join(f'{value / apart:.2g}' for value in after)}"))  # fmt: skip
        add_agreement(report, f"{title}: agreement, 10 ticks after", run.ticks[int(end) + 9])
        if blank_after == math.inf:
            before = [tick.total_distance_all for tick in run.ticks if start - 10 <= tick.tick < start]
            note = "what one second's scans do"
            report.add(Row(f"{title}: Phi_all, median of the 10 ticks before / peak", statistics.median(before) / apart,
                           "", note=note))  # fmt: skip
            add_agreement(report, f"{title}: agreement, last tick apart", run.ticks[int(end) - 1])


def _killed(report: Report, options: argparse.Namespace) -> None:
    """A robot that stops for good at half time."""
    duration = options.duration
    killed = NUM_ROBOTS - 1
    schedule = (ScheduleEntry(duration / 2, math.inf, robots_off=(robot_ids(simulated_team(duration))[killed],)),)
    for rule in ("flood", "ratio", "bayes", "gradient"):
        config = run_config(duration, schedule=schedule, resolution=FAULT_RESOLUTION, rule=rule)
        sessions: list[Session] = []

        def keep(session: Session, _: Tick, sessions: list[Session] = sessions) -> bool:
            sessions[:] = [session]
            return False

        run = play(config, duration, keep)
        robots = sessions[0].team.robots
        alive = [index for index in range(NUM_ROBOTS) if index != killed]
        maps = {index: cells_of(robots[index].map) for index in alive}
        title = f"{rule}, a robot killed at {duration / 2:g} s"
        everything = sum_of_cells([robot.evidence.octree for robot in robots])
        if rule == "flood":
            given = [robot.exchange.held[robots[killed].source].octree for robot in (robots[i] for i in alive)]
            living = [robots[index].evidence.octree for index in alive]
            off = [
                deviation_of_cells(maps[index], sum_of_cells([*living, octree]), NUM_ROBOTS).max()
                for index, octree in zip(alive, given, strict=True)
            ]
            report.add(Row(f"{title}: N h off what was delivered, worst cell and robot", max(off), "log-odds",
                           must=1e-4))  # fmt: skip
        deviations = [deviation_of_cells(maps[index], everything, NUM_ROBOTS) for index in alive]
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


# --- the table --------------------------------------------------------------------------------------------------------

TABLE_HEAD = (
    "rule", "topology", "fault", "agreement, logs' end", "settled", "Phi_all, peak", "end", "settling ticks",
    "sent [MB]",
)  # fmt: skip


def _table(report: Report, options: argparse.Namespace) -> None:
    """Every rule on every topology with every fault, as Markdown."""
    duration, resolution = options.table_duration, options.table_resolution
    ids = robot_ids(simulated_team(duration))
    started = time.perf_counter()
    lines = [f"| {' | '.join(TABLE_HEAD)} |", "|" + "---|" * len(TABLE_HEAD)]
    for topology, (fault, link), rule in itertools.product(TOPOLOGIES, FAULTS.items(), RULES):
        one_way = ((ids[0], ids[1]),) if fault == "one-way link" else ()
        network = {"topology": topology, "rule": rule, "resolution": resolution, "settle_max": TABLE_TICKS, **link}
        config = run_config(duration, one_way=one_way, packets="full", **network)
        run = play(config, duration)
        ends = [
            " / ".join(f"{value:.4f}" for value in worst_agreement(tick)) for tick in (run.log_ticks[-1], run.ticks[-1])
        ]
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
    "newcomer": add_newcomers, "codec": _codec,
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
