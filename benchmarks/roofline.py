"""Roofline: what a frame and a tick cost at the least on this machine, and how far we are from it.

The floors come from two measured rates, copying memory and bare stepping of a grid ray, on one core.
"""

from __future__ import annotations

import argparse
import statistics
import time
from typing import Any

import numba
import numpy as np
import scenes
from consensus import NUM_ROBOTS, WARM_TICKS, Team, complete_graph, never_hit_share, robot_evidence
from rounds import Report, Row, arguments, pinned
from scenes import NUM_CLASSES

from octoreplay.config.sensor import MapConfig
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.sensor import ScanCaster, add_scan, clamped_increments

FLOAT = 4


def main() -> None:
    """Rates, then the camera's frame at two resolutions, then the tick."""
    options = arguments(__doc__ or "", rounds=5, add=_add_options)
    report = Report("roofline", vars(options))
    with pinned():
        bandwidth = max(_copy_rate() for _ in range(options.rounds))
        step_ns = min(_step_ns() for _ in range(options.rounds))
        report.add(Row("copying memory (bytes read + written)", bandwidth, "GB/s"))
        report.add(Row("bare step of a grid ray, nothing marked", step_ns, "ns"))
        for resolution in (0.2, 0.1):
            _add_frame(report, resolution, options.frames, bandwidth, step_ns)
        _add_tick(report, options.rounds, options.resolution, bandwidth)
    report.save(options.json)


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--frames", type=int, default=100, help="camera frames (default: %(default)s)")
    parser.add_argument("--resolution", type=float, default=0.1, help="of the tick's maps (default: %(default)s)")


def _add_frame(report: Report, resolution: float, num_frames: int, bandwidth: float, step_ns: float) -> None:
    """A camera frame: the images are read once and every marked cell's values are read and written once."""
    scene = scenes.camera_scene(num_frames)
    load = scenes.workload(scene, resolution)
    image_bytes = 640 * 480 * 3
    # Passed cells have one value for all classes, or are counted as if: the least that any storage can do.
    map_bytes = 2 * FLOAT * (load.marked_cells + (NUM_CLASSES - 1) * load.end_cells)
    moving = (image_bytes + map_bytes) / bandwidth / 1e6
    stepping = load.ray_steps * step_ns / 1e6
    octree = SemanticOctree(resolution, NUM_CLASSES)
    caster = ScanCaster(scene.sensor(), MapConfig(resolution=resolution), NUM_CLASSES)
    times = []
    for index, frame in enumerate(scene.frames):
        started = time.perf_counter()
        add_scan(octree, caster.cast(frame), clamped_increments(scene.sensor()), index)
        times.append((time.perf_counter() - started) * 1e3)
    ours = statistics.median(times)
    title = f"camera frame, {resolution:g} m"
    report.add(Row(f"{title}: bytes that must move", (image_bytes + map_bytes) / 1e6, "MB"))
    report.add(Row(f"{title}: moving them", moving, "ms"))
    report.add(Row(f"{title}: stepping every ray", stepping, "ms", note=f"{load.ray_steps:,.0f} steps"))
    report.add(Row(f"{title}: one bare step for each marked cell", load.marked_cells * step_ns / 1e6, "ms"))
    report.add(Row(f"{title}: ours", ours, "ms"))
    report.add(Row(f"{title}: ours over moving and stepping", ours / (moving + stepping), "times"))


def _add_tick(report: Report, rounds: int, resolution: float, bandwidth: float) -> None:
    """A tick on a complete graph: robot by robot every map is read for every robot; brick by brick once."""
    team = Team([robot_evidence(robot, resolution) for robot in range(NUM_ROBOTS)], "gradient", complete_graph)
    for _ in range(WARM_TICKS):
        team.tick()
    union = max(octree.num_cells for octree in team.maps)
    share = never_hit_share(team.maps[0])
    values = share + (1.0 - share) * NUM_CLASSES
    ours = statistics.median(team.tick()[1] for _ in range(rounds)) * 1e6 / (union * NUM_ROBOTS)
    # Own map and evidence are read and the map is written; neighbours' maps are read on top, or shared.
    alone = FLOAT * values * (3 + NUM_ROBOTS - 1)
    together = FLOAT * values * 3
    report.add(Row("tick: values of a cell, mean", values, "", note=f"{100 * share:.0f} % never hit, one value there"))
    report.add(Row("tick: bytes per cell and robot-update, robot by robot", alone, "B"))
    report.add(Row("tick: the same brick by brick for all robots", together, "B"))
    report.add(Row("tick: moving them, robot by robot", alone / bandwidth, "ns"))
    report.add(Row("tick: moving them, brick by brick", together / bandwidth, "ns"))
    report.add(Row("tick: ours per cell and robot-update", ours, "ns"))


def _copy_rate() -> float:
    """Bytes read and written per nanosecond (GB/s) by copying an array much larger than the caches."""
    source = np.ones(1 << 25, np.float64)
    target = np.zeros_like(source)
    started = time.perf_counter()
    np.copyto(target, source)
    return 2 * source.nbytes / (time.perf_counter() - started) / 1e9


def _step_ns() -> float:
    """Nanoseconds of one step along a ray that only advances: Amanatides and Woo's loop without any memory."""
    directions = np.random.default_rng(0).normal(size=(20_000, 3))
    directions = np.abs(directions) / np.linalg.norm(directions, axis=1, keepdims=True)
    _walk(directions[:10], 100)
    started = time.perf_counter()
    _walk(directions, 100)
    return (time.perf_counter() - started) / (len(directions) * 100) * 1e9


@numba.njit(error_model="numpy")
def _walk(directions: Any, num_steps: int) -> int:
    """Steps of each ray from a cell's centre; the sum keeps the compiler from leaving them out."""
    total = 0
    for i in range(directions.shape[0]):
        delta_x, delta_y, delta_z = 1.0 / directions[i, 0], 1.0 / directions[i, 1], 1.0 / directions[i, 2]
        next_x, next_y, next_z = 0.5 * delta_x, 0.5 * delta_y, 0.5 * delta_z
        x = y = z = 0
        for _ in range(num_steps):
            if next_x < next_y and next_x < next_z:
                x += 1
                next_x += delta_x
            elif next_y < next_z:
                y += 1
                next_y += delta_y
            else:
                z += 1
                next_z += delta_z
        total += x + 3 * y + 5 * z
    return total


if __name__ == "__main__":
    main()
