"""No input under 1 MB takes more than 1 GB or 10 s: packets, results, logs, images and files made to do so."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octoreplay.config.team_file import parse_team
from octoreplay.evaluate.truth import load_truth
from octoreplay.io.containers.logs import open_log
from octoreplay.io.datasets.cloud_files import read_cloud
from octoreplay.io.datasets.depth_files import read_png
from octoreplay.io.messages.sensor_messages import Cloud, CloudField, CompressedImage
from octoreplay.io.robots.describe import describe
from octoreplay.io.sensors.clouds import decode_cloud
from octoreplay.io.sensors.images import decode_depth, decode_labels
from octoreplay.mapping.codec import apply_delta, decode_packet
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.report.export import export_map
from octoreplay.result import open_result
from support import bombs
from support.bounded import outcome
from support.hostile_logs import CLASSES
from support.long_suite import long

LARGEST, SECONDS = 750_000_000, 60.0
"""Limits of what a call takes: Python with its libraries takes the rest of the gigabyte."""


def check(call: Callable[[], Any], *inputs: bytes | Path) -> None:
    """Check that a call ends in time, takes little memory and raises nothing but errors of octoreplay."""
    sizes = [len(entry) if isinstance(entry, bytes) else entry.stat().st_size for entry in inputs]
    assert sum(sizes) < 1_000_000
    done = outcome(call)
    assert not done.problem(SECONDS, LARGEST), done


def file(path: Path, content: bytes) -> Path:
    """A file."""
    path.write_bytes(content)
    return path


def read_all(path: Path) -> None:
    """Describe a log and read all of its messages."""
    describe([path])
    with open_log(path) as log:
        for _ in log.messages([topic.name for topic in log.topics]):
            pass


def use(path: Path) -> None:
    """Read all of a result."""
    with open_result(path) as result:
        kept = [dict(maps) for maps in result.history()]
        result.map("alpha").query(np.zeros((3, 3)))
        del kept
    export_map(path, path.with_suffix(".ply"))


@pytest.mark.parametrize("depth", [8, *(pytest.param(depth, marks=long) for depth in range(18) if depth != 8)])
def test_packets_of_a_few_bytes(depth: int) -> None:
    for num_classes in (2, 254):
        packet = bombs.packet(depth, num_classes=num_classes)
        check(lambda packet=packet: decode_packet(packet), packet)
    packet = bombs.packet(depth, kind=1)
    check(lambda: apply_delta(SemanticOctree(0.25, 2), packet), packet)


@pytest.mark.parametrize("count", [1 << 28, *(pytest.param(1 << bits, marks=long) for bits in (24, 31))])
def test_packets_that_declare_more_than_they_hold(count: int) -> None:
    packet = bombs.declared_packet(count)
    check(lambda: decode_packet(packet), packet)


@pytest.mark.parametrize("depth", [10, *(pytest.param(depth, marks=long) for depth in (8, 9, 11, 12))])
def test_results_with_such_packets(tmp_path: Path, depth: int) -> None:
    """Deltas of other regions add up."""
    packets = [bombs.packet(depth, resolution=0.2), *[bombs.packet(depth, kind=1, resolution=0.2)] * 20]
    path = bombs.result(tmp_path / "r", packets)
    check(lambda: use(path), path)


LOGS = {
    "zstd, one chunk": lambda: bombs.chunks_of_zeros("zstd", bombs.GIGABYTE, 1),
    "zstd": lambda: bombs.chunks_of_zeros("zstd", 1 << 27),
    "bz2": lambda: bombs.chunks_of_zeros("bz2", 1 << 27),
    "lz4": lambda: bombs.chunks_of_zeros("lz4", 1 << 27),
    "tiny messages": lambda: bombs.tiny_messages(1 << 26),
}


@long
@pytest.mark.parametrize("name", LOGS)
def test_logs(tmp_path: Path, name: str) -> None:
    path = file(tmp_path / "a.mcap", LOGS[name]())
    check(lambda: read_all(path), path)


@long
def test_nested_containers(tmp_path: Path) -> None:
    """A rosbag2 folder with a compressed file that holds compressed chunks; and a file of nothing but zeros."""
    inner = bombs.chunks_of_zeros("zstd", 1 << 26, 9_000_000)
    for number, content in enumerate((bombs.zeros("zstd", 2 * bombs.GIGABYTE), bombs.zstandard.compress(inner, 19))):
        folder = tmp_path / f"bag{number}"
        folder.mkdir()
        path = file(folder / "a.mcap.zstd", content)
        (folder / "metadata.yaml").write_text(
            "rosbag2_bagfile_information: {storage_identifier: mcap, compression_mode: FILE,"
            " compression_format: zstd, relative_file_paths: [a.mcap.zstd]}"
        )
        check(lambda folder=folder: read_all(folder), path)


@pytest.mark.parametrize("statement", [bombs.VIEW, pytest.param(bombs.GENERATED, marks=long)])
def test_databases_whose_rows_are_computed(tmp_path: Path, statement: str) -> None:
    path = bombs.database(tmp_path / "a.db3", statement)
    check(lambda: read_all(path), path)
    assert "views, triggers or generated columns" in outcome(lambda: open_log(path)).text


@pytest.mark.parametrize(
    "size", [(1 << 13, 1 << 12), *(pytest.param(s, marks=long) for s in ((1 << 14, 1 << 13), (9999, 9999)))]
)
def test_images(tmp_path: Path, size: tuple[int, int]) -> None:
    content = bombs.png(*size)
    image = CompressedImage(0, "f", "png", content)
    check(lambda: decode_depth(image, "here"), content)
    check(lambda: decode_labels(image, "here"), content)
    path = file(tmp_path / "a.png", content)
    check(lambda: read_png(path), path)


def test_images_that_declare_their_size(tmp_path: Path) -> None:
    path = file(tmp_path / "a.png", bombs.tiff(1 << 16, 1 << 15))
    check(lambda: read_png(path), path)


def test_clouds_that_declare_their_size() -> None:
    fields = tuple(CloudField(name, 0, "f4") for name in "xyz")
    for height, width, step, row in (
        (1, 2**32 - 1, 0, 0),
        (2**31, 2**31, 4, 0),
        (2**32 - 1, 1, 4, 0),
        (2**20, 1, 4, 0),
    ):
        cloud = Cloud(0, "f", height, width, fields, False, step, row, bytes(64))
        check(lambda cloud=cloud: decode_cloud(cloud, "here"))


def test_files_of_points(tmp_path: Path) -> None:
    repeat = b"\0\0" + b"\xe0\xff\0" * 300_000
    for name, content in {
        "a.pcd": bombs.pcd(10**9, repeat), "b.pcd": bombs.pcd(6_000_000, repeat),
        "a.ply": bombs.ply(10**12, is_text=False), "b.ply": bombs.ply(10**9, is_text=True),
    }.items():  # fmt: skip
        path = file(tmp_path / name, content)
        check(lambda path=path: read_cloud(path), path)


@long
def test_truth_of_zeros(tmp_path: Path) -> None:
    path = file(tmp_path / "world.npz", bombs.npz(900_000_000 // 3))
    check(lambda: load_truth(path, CLASSES, 0.25), path)


@pytest.mark.parametrize(
    "text", [bombs.aliases(), "[" * 990, "{a: " * 900, "a: " + "9" * 5000], ids=["aliases", "lists", "maps", "digits"]
)
def test_team_files(text: str) -> None:
    check(lambda: parse_team(text, name="team.yaml", folder=Path()), text.encode())
