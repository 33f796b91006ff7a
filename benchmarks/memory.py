"""Memory: one robot's evidence and map for 8 classes, next to the ColorOcTree of the same scans.

All three are built from the same frames with one ray per distinct end cell.
"""

from __future__ import annotations

import argparse
import ctypes
import tracemalloc

import numpy as np
import scenes
from peers import MissingPeerError, NativeOctomap, PyOctomap, write_clouds
from rounds import Report, Row, arguments
from scenes import NUM_CLASSES, PointCloud, Scene

from octoreplay.config.sensor import MapConfig
from octoreplay.mapping.codec import decode_packet, encode_packet
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.sensor import ScanCaster, add_scan, clamped_increments

MEBIBYTE = 1 << 20


def main() -> None:
    """Every asked scene and resolution."""
    options = arguments(__doc__ or "", rounds=1, add=_add_options)
    report = Report("memory", vars(options))
    for name in options.scene or ["camera", "lidar"]:
        scene = scenes.load(name, options.frames)
        clouds = [scenes.point_cloud(frame) for frame in scene.frames]
        for resolution in options.resolution or [0.2, 0.1]:
            _compare(report, f"{name} {resolution:g} m", scene, clouds, resolution)
    report.save(options.json)


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scene", action="append", choices=("camera", "lidar"), help="default: both")
    parser.add_argument("--resolution", action="append", type=float, help="default: 0.2 and 0.1")
    parser.add_argument("--frames", type=int, default=100, help="default: %(default)s")


def _compare(report: Report, title: str, scene: Scene, clouds: list[PointCloud], resolution: float) -> None:
    """Our two octrees, then the peers'."""
    caster = ScanCaster(scene.sensor(), MapConfig(resolution=resolution), NUM_CLASSES)
    caster.cast(scene.frames[0])
    tracemalloc.start()
    evidence = SemanticOctree(resolution, NUM_CLASSES)
    for index, frame in enumerate(scene.frames):
        add_scan(evidence, caster.cast(frame), clamped_increments(scene.sensor()), index)
    before = tracemalloc.get_traced_memory()[0]
    team_map = evidence.copy()
    reserved = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    ours = evidence.memory_bytes + team_map.memory_bytes
    received = decode_packet(encode_packet(team_map))
    report.add(Row(f"{title}: known cells", float(evidence.num_cells), ""))
    report.add(Row(f"{title}: s + h", ours / MEBIBYTE, "MiB"))
    num_leaves = evidence.streams().num_leaves
    report.add(Row(f"{title}: leaves", float(num_leaves), ""))
    report.add(Row(f"{title}: s + h, for each million leaves", ours / num_leaves, "MB"))
    report.add(Row(f"{title}: s + h with room to grow", 2 * reserved / MEBIBYTE, "MiB"))
    report.add(Row(f"{title}: a received map, for each neighbour", received.memory_bytes / MEBIBYTE, "MiB"))
    try:
        octomap = NativeOctomap()
        path = write_clouds(scenes.cache_folder() / "memory.clouds", clouds)
        allocated, usage, nodes, cells = octomap.color_memory(path, resolution, scene.max_range, discretize=True)
        path.unlink()
        report.add(Row(f"{title}: ColorOcTree, cells", float(cells), "", note=f"in {nodes:,} nodes"))
        report.add(Row(f"{title}: ColorOcTree, memoryUsage()", usage / MEBIBYTE, "MiB"))
        report.add(Row(f"{title}: ColorOcTree, allocated", allocated / MEBIBYTE, "MiB"))
        report.add(Row(f"{title}: s + h / ColorOcTree", ours / allocated, "", must=0.5))
    except MissingPeerError as error:
        report.remark(str(error))
    try:
        allocated = _pyoctomap_bytes(PyOctomap(), clouds, resolution, scene.max_range)
        report.add(Row(f"{title}: pyoctomap ColorOcTree, allocated", allocated / MEBIBYTE, "MiB"))
        report.add(Row(f"{title}: s + h / pyoctomap ColorOcTree", ours / allocated, "", must=0.5))
    except MissingPeerError as error:
        report.remark(str(error))


def _pyoctomap_bytes(pyoctomap: PyOctomap, clouds: list[PointCloud], resolution: float, max_range: float) -> int:
    """Bytes that a ColorOcTree of pyoctomap with all clouds allocates, as counted by the C library."""
    before = _allocated_bytes()
    tree = pyoctomap.module.ColorOcTree(resolution)
    for cloud in clouds:
        shades = np.repeat(cloud.class_ids[:, None] * (30.0 / 255.0), 3, axis=1)
        points = np.ascontiguousarray(cloud.points, np.float64)
        tree.insertPointCloud(points, cloud.origin, max_range=max_range, discretize=True, colors=shades)
    tree.prune()
    del points, shades
    return _allocated_bytes() - before


class _MallocInfo(ctypes.Structure):
    """glibc's struct mallinfo2."""

    _fields_ = tuple(
        (name, ctypes.c_size_t)
        for name in ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks",
                     "keepcost")
    )  # fmt: skip


def _allocated_bytes() -> int:
    """Bytes that this process has from malloc. Raises MissingPeerError where the C library cannot say."""
    try:
        mallinfo2 = ctypes.CDLL(None).mallinfo2
    except (AttributeError, OSError):
        raise MissingPeerError("pyoctomap's memory is left out: it takes glibc 2.33 to measure it") from None
    mallinfo2.restype = _MallocInfo
    info = mallinfo2()
    return int(info.uordblks + info.hblkhd)


if __name__ == "__main__":
    main()
