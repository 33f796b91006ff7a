"""Insertion: how long one scan takes, next to native OctoMap, Bonxai and pyoctomap, and which cells differ.

All times are processor times of one thread. Our time includes unprojection from the depth image; the peers are given
ready-made points.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import scenes
from peers import Bonxai, MissingPeerError, NativeOctomap, PyOctomap, write_clouds
from rounds import Report, Row, arguments, interleave, measured, pinned, speedup
from scenes import NUM_CLASSES, PointCloud, Scene

from octoreplay.config.sensor import MapConfig
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.sensor import ScanCaster, add_scan, clamped_increments
from octoreplay.records import CloudFrame, Float32Array, Float64Array, Int32Array, Int64Array

FASTER_THAN_OCTOMAP = {
    ("camera", 0.2): (2.0, 4.0),
    ("camera", 0.1): (6.0, 11.0),
    ("lidar", 0.2): (10.0, 19.0),
    ("lidar", 0.1): (19.0, 36.0),
}
"""Speed relative to native OctoMap with discretize=true: target and goal."""
FASTER_THAN_BONXAI = {
    ("camera", 0.2): (1.8, 2.5),
    ("camera", 0.1): (2.0, 2.5),
    ("lidar", 0.2): (2.0, 2.5),
    ("lidar", 0.1): (1.8, 2.5),
}
"""Speed relative to Bonxai: target and goal."""
FASTER_THAN_PYOCTOMAP = (10.0, 20.0)
FASTER_THAN_SEMANTIC_TREE = (25.0, 50.0)
SEMANTIC_TREE_IN_OCTOMAPS = {
    ("camera", 0.2): 75.0 / 6.9,
    ("camera", 0.1): 490.0 / 41.0,
    ("lidar", 0.2): 1250.0 / 70.0,
    ("lidar", 0.1): 5990.0 / 533.0,
}
"""Time of the SSMI semantic octree over native OctoMap's with discretize=true, measured once on a like workload."""

DEFAULT_FRAMES = {"camera": 100, "lidar": 30, "seven-scenes": 100}
EXACTNESS_FRAMES = 5
MICROMETRE = 1e-6

_Peer = TypeVar("_Peer")


def main() -> None:
    """Measure every asked scene at every asked resolution."""
    options = arguments(__doc__ or "", rounds=3, add=_add_options)
    report = Report("insertion", vars(options))
    peers = _find_peers(report, options.bonxai)
    for name in options.scene or ["camera", "lidar"]:
        scene = scenes.load(name, options.frames or DEFAULT_FRAMES[name], options.folder)
        clouds = [scenes.point_cloud(frame) for frame in scene.frames]
        path = write_clouds(scenes.cache_folder() / f"{name}.clouds", clouds)
        for resolution in options.resolution or [0.2, 0.1]:
            title = f"{name} {resolution:g} m"
            _add_workload(report, title, scene, resolution)
            with pinned():
                _compare(report, title, scene, resolution, clouds, path, peers, options)
        for resolution in options.resolution or [0.2, 0.1]:
            if peers.octomap is not None:
                _add_exactness(report, f"{name} {resolution:g} m", scene, resolution, clouds, peers.octomap)
            if peers.bonxai is not None:
                _add_bonxai_cells(report, f"{name} {resolution:g} m", scene, resolution, clouds, peers.bonxai)
        path.unlink()
    report.save(options.json)


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scene", action="append", choices=tuple(DEFAULT_FRAMES), help="default: camera and lidar")
    parser.add_argument("--resolution", action="append", type=float, help="default: 0.2 and 0.1")
    parser.add_argument("--frames", type=int, help="default: 100, LiDAR 30")
    parser.add_argument("--folder", type=Path, help="a 7-Scenes sequence, for --scene seven-scenes")
    parser.add_argument(
        "--skip-all-rays",
        action="store_true",
        help="leave out OctoMap's discretize=false, which takes most of the time",
    )
    parser.add_argument(
        "--bonxai", type=Path, metavar="FOLDER", help="root of Bonxai's source; default: without Bonxai"
    )


@dataclass(frozen=True)
class _Peers:
    """The peers that this machine has."""

    octomap: NativeOctomap | None
    pyoctomap: PyOctomap | None
    bonxai: Bonxai | None


def _find_peers(report: Report, bonxai_folder: Path | None) -> _Peers:
    """The peers that this machine has; the report gets a sentence for each that is missing."""
    return _Peers(
        _found(report, NativeOctomap), _found(report, PyOctomap), _found(report, lambda: Bonxai(bonxai_folder))
    )


def _found(report: Report, make: Callable[[], _Peer]) -> _Peer | None:
    """The peer; None and a sentence in the report where this machine lacks it."""
    try:
        return make()
    except MissingPeerError as error:
        report.remark(str(error))
        return None


def _add_workload(report: Report, title: str, scene: Scene, resolution: float) -> None:
    """Add the workload of the scene; the camera's figures at 0.1 m have lower bounds, so that it is realistic."""
    load = scenes.workload(scene, resolution)
    bounded = scene.name == "camera" and resolution == 0.1
    valid = 100 * load.valid_share
    note = ("within" if 68.0 <= valid <= 74.0 else "OUTSIDE") + " 68 to 74" if bounded else ""
    report.add(Row(f"{title}: valid pixels or rays", valid, "%", note=note))
    report.add(Row(f"{title}: distinct end cells", load.end_cells, "a frame"))
    report.add(
        Row(f"{title}: ray steps", load.ray_steps, "a frame", must=1e6 if bounded else None, more_is_better=True)
    )
    report.add(
        Row(f"{title}: marked cells", load.marked_cells, "a frame", must=5e4 if bounded else None, more_is_better=True)
    )


# --- time -------------------------------------------------------------------------------------------------------------


class _Ours:
    """Our insertion of a scene, into a fresh map on every call; keeps the times of its two steps."""

    def __init__(self, scene: Scene, resolution: float) -> None:
        self._scene = scene
        self._resolution = resolution
        self._caster = ScanCaster(scene.sensor(), MapConfig(resolution=resolution), NUM_CLASSES)
        self.casting: list[float] = []
        self.applying: list[float] = []
        self._insert()

    def __call__(self) -> float:
        """Mean milliseconds of a frame."""
        casting, applying = self._insert()
        self.casting.append(casting)
        self.applying.append(applying)
        return casting + applying

    def _insert(self) -> tuple[float, float]:
        octree = SemanticOctree(self._resolution, NUM_CLASSES)
        increments = clamped_increments(self._scene.sensor())
        casting = applying = 0.0
        for index, frame in enumerate(self._scene.frames):
            started = time.thread_time()
            cells = self._caster.cast(frame)
            cast = time.thread_time()
            add_scan(octree, cells, increments, index)
            applying += time.thread_time() - cast
            casting += cast - started
        scale = 1e3 / len(self._scene.frames)
        return casting * scale, applying * scale


def _compare(
    report: Report, title: str, scene: Scene, resolution: float, clouds: Sequence[PointCloud], path: Path,
    peers: _Peers, options: argparse.Namespace,
) -> None:  # fmt: skip
    """Interleaved rounds of all programs over the same frames."""
    ours = _Ours(scene, resolution)
    octomap, pyoctomap, bonxai = peers.octomap, peers.pyoctomap, peers.bonxai
    contenders = {"octoreplay": ours.__call__}
    reach = scene.max_range
    if octomap is not None:
        contenders["OctoMap discretize=true"] = lambda: octomap.insert(path, resolution, reach, discretize=True)
    if octomap is not None and not options.skip_all_rays:
        contenders["OctoMap discretize=false"] = lambda: octomap.insert(path, resolution, reach, discretize=False)
    if bonxai is not None:
        contenders["Bonxai"] = lambda: bonxai.insert(path, resolution, reach)
    if pyoctomap is not None:
        contenders["pyoctomap discretize=True"] = lambda: pyoctomap.insert(clouds, resolution, reach)
    times = interleave(contenders, options.rounds)
    for name, values in times.items():
        report.add(measured(f"{title}: {name}", values, "ms"))
        if name == "octoreplay":
            report.add(measured(f"{title}: of it, unprojection and casting", ours.casting, "ms"))
            report.add(measured(f"{title}: of it, applying", ours.applying, "ms"))
    mine = times["octoreplay"]
    case = (scene.name, resolution)
    if octomap is not None:
        native = times["OctoMap discretize=true"]
        must, goal = FASTER_THAN_OCTOMAP.get(case, (None, None))
        report.add(speedup(f"{title}: against OctoMap discretize=true", mine, native, must=must, goal=goal))
        if case in SEMANTIC_TREE_IN_OCTOMAPS:
            must, goal = FASTER_THAN_SEMANTIC_TREE if scene.name == "camera" else (None, None)
            derived = [SEMANTIC_TREE_IN_OCTOMAPS[case] * value for value in native]
            report.add(
                speedup(f"{title}: against the SSMI tree", mine, derived, must=must, goal=goal,
                        note=f"derived: {SEMANTIC_TREE_IN_OCTOMAPS[case]:.1f} x OctoMap's time")
            )  # fmt: skip
    if bonxai is not None:
        must, goal = FASTER_THAN_BONXAI.get(case, (None, None))
        report.add(speedup(f"{title}: against Bonxai", mine, times["Bonxai"], must=must, goal=goal))
    if pyoctomap is not None:
        must, goal = FASTER_THAN_PYOCTOMAP
        theirs = times["pyoctomap discretize=True"]
        report.add(speedup(f"{title}: against pyoctomap", mine, theirs, must=must, goal=goal))


# --- exactness --------------------------------------------------------------------------------------------------------


def _add_exactness(
    report: Report, title: str, scene: Scene, resolution: float, clouds: Sequence[PointCloud], octomap: NativeOctomap
) -> None:
    """Cells that only one side hits, or only one side frees, of a few frames given to both as the same float32 points.

    OctoMap's two ray options are compared with ours; a cell that is hit counts as not freed on both sides, as OctoMap's
    own update does it. Where the free sets differ, the longest way of a ray through such a cell says who is right.
    """
    chosen = _exactness_clouds(scene, clouds)
    path = write_clouds(scenes.cache_folder() / "exactness.clouds", chosen)
    for rays, discretize in (("all", False), ("cells", True)):
        theirs = octomap.touched(path, resolution, -1.0, discretize=discretize)
        caster = ScanCaster(scene.sensor(rays), MapConfig(resolution=resolution), 1)
        counts = np.zeros(4, np.int64)
        our_chords, their_chords = [], []
        for cloud, (their_free, their_hits) in zip(chosen, theirs, strict=True):
            hits, free = _touched(caster, scene, cloud, resolution)
            other_hits = _packed(their_hits)
            other_free = np.setdiff1d(_packed(their_free), other_hits)
            only_ours, only_theirs = np.setdiff1d(free, other_free), np.setdiff1d(other_free, free)
            counts += (len(hits), len(np.setxor1d(hits, other_hits)), len(free), len(only_ours) + len(only_theirs))
            ends = cloud.points.astype(np.float64)
            if rays == "cells":
                ends = (scenes.distinct_keys(cloud.points, resolution) + 0.5) * resolution
            our_chords += [_longest_chord(key, cloud.origin, ends, resolution) for key in _unpacked(only_ours)]
            their_chords += [_longest_chord(key, cloud.origin, ends, resolution) for key in _unpacked(only_theirs)]
        option = f"{title}: rays '{rays}' and discretize={str(discretize).lower()}"
        report.add(Row(f"{option}: hit cells that differ", float(counts[1]), f"of {counts[0]:,}", must=0.0))
        note = f"{_chords('only ours', our_chords)}; {_chords('only OctoMap', their_chords)}"
        report.add(Row(f"{option}: free cells that differ", float(counts[3]), f"of {counts[2]:,}", note=note))
    path.unlink()


def _add_bonxai_cells(
    report: Report, title: str, scene: Scene, resolution: float, clouds: Sequence[PointCloud], bonxai: Bonxai
) -> None:
    """Cells of a few frames that only we or only Bonxai hit, and cells that only we or only Bonxai free."""
    chosen = _exactness_clouds(scene, clouds)
    path = write_clouds(scenes.cache_folder() / "exactness.clouds", chosen)
    caster = ScanCaster(scene.sensor(), MapConfig(resolution=resolution), 1)
    hit_counts, free_counts = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for cloud, (their_free, their_hits) in zip(chosen, bonxai.touched(path, resolution, scene.max_range), strict=True):
        hits, free = _touched(caster, scene, cloud, resolution)
        for counts, mine, theirs in ((hit_counts, hits, _packed(their_hits)), (free_counts, free, _packed(their_free))):
            counts += len(mine), len(np.setdiff1d(mine, theirs)), len(np.setdiff1d(theirs, mine))
    path.unlink()
    for kind, (total, only_ours, only_theirs) in (("hit", hit_counts), ("free", free_counts)):
        note = f"only Bonxai: {only_theirs:,}"
        report.add(Row(f"{title}: {kind} cells that Bonxai misses", 100 * only_ours / total, "%", note=note))


def _exactness_clouds(scene: Scene, clouds: Sequence[PointCloud]) -> list[PointCloud]:
    """The points within the range of a few frames."""
    return [_near(cloud, scene.max_range - 0.01) for cloud in clouds[:: max(1, len(clouds) // EXACTNESS_FRAMES)]]


def _near(cloud: PointCloud, reach: float) -> PointCloud:
    """The points within a range."""
    near = np.linalg.norm(cloud.points.astype(np.float64) - cloud.origin, axis=1) <= reach
    return PointCloud(cloud.origin, np.ascontiguousarray(cloud.points[near]), cloud.class_ids[near])


def _touched(caster: ScanCaster, scene: Scene, cloud: PointCloud, resolution: float) -> tuple[Int64Array, Int64Array]:
    """The cells that we hit and the cells that we free, packed, for the very float32 points that the peer gets.

    The pose only shifts, and in float64 the shift and its inverse are exact.
    """
    pose = np.eye(4)
    pose[:3, 3] = cloud.origin
    points = cloud.points.astype(np.float64) - pose[:3, 3]
    octree = SemanticOctree(resolution, 1)
    frame = CloudFrame("robot", 0, points, np.ones(len(points), np.uint8), pose)
    add_scan(octree, caster.cast(frame), clamped_increments(scene.sensor()), 0)
    leaves = octree.leaves()
    edges = np.rint(leaves.sizes / resolution).astype(np.int64)
    lows = np.rint(leaves.centers / resolution - edges[:, None] / 2).astype(np.int64)
    is_hit = leaves.log_odds[:, 0] > 0
    return _cells(lows[is_hit], edges[is_hit]), _cells(lows[~is_hit], edges[~is_hit])


def _cells(lows: Int64Array, edges: Int64Array) -> Int64Array:
    """All finest cells of leaves with lowest cells (L, 3) and edges (L,) in cells, packed."""
    parts = []
    for edge in np.unique(edges):
        offsets = np.stack(np.meshgrid(*[np.arange(edge)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        parts.append(_packed((lows[edges == edge][:, None] + offsets).reshape(-1, 3)))
    return np.unique(np.concatenate(parts)) if parts else np.empty(0, np.int64)


def _longest_chord(key: Int64Array, origin: Float32Array, ends: Float64Array, resolution: float) -> float:
    """The longest way [m] that any ray from ``origin`` (3,) to ``ends`` (n, 3) has inside a cell, by the slab test."""
    start = origin.astype(np.float64)
    ways = ends - start
    with np.errstate(divide="ignore", invalid="ignore"):
        walls = np.stack([(key * resolution - start) / ways, ((key + 1) * resolution - start) / ways])
    entry = np.fmax.reduce(walls.min(axis=0), axis=1).clip(0.0, 1.0)
    leave = np.fmin.reduce(walls.max(axis=0), axis=1).clip(0.0, 1.0)
    return float(((leave - entry) * np.linalg.norm(ways, axis=1)).max())


def _chords(who: str, chords: Sequence[float]) -> str:
    """Number of cells, and number of those that a ray passes by more than a micrometre."""
    crossed = [chord for chord in chords if chord > MICROMETRE]
    longest = f", by up to {1e3 * max(crossed):.2g} mm" if crossed else ""
    return f"{who}: {len(chords):,}, of them really crossed {len(crossed):,}{longest}"


def _unpacked(packed: Int64Array) -> Int64Array:
    """The keys (n, 3) of packed cells."""
    mask = (1 << 21) - 1
    return np.stack([packed >> 42, (packed >> 21) & mask, packed & mask], axis=1) - (1 << 20)


def _packed(keys: Int32Array | Int64Array) -> Int64Array:
    """One ascending integer per distinct key (n, 3)."""
    shifted = keys.astype(np.int64) + (1 << 20)
    return np.unique((shifted[:, 0] << 42) | (shifted[:, 1] << 21) | shifted[:, 2])


if __name__ == "__main__":
    main()
