"""The peers: native OctoMap through a small C++ driver, and pyoctomap from PyPI."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scenes import PointCloud, cache_folder

from octoreplay.records import Int32Array

_SOURCE = Path(__file__).with_name("octomap_driver.cpp")
_FLAGS = ("-O3", "-march=native", "-std=c++17")


class MissingPeerError(Exception):
    """A peer that this machine does not have; the message says what to install."""


class NativeOctomap:
    """OctoMap's own C++ library (Debian: liboctomap-dev), in a process of its own for every call.

    Raises MissingPeerError where there is no compiler or no library.
    """

    def __init__(self) -> None:
        self._driver = _build()

    def insert(self, clouds: Path, resolution: float, max_range: float, *, discretize: bool) -> float:
        """Mean milliseconds of a frame's ``insertPointCloud`` into one growing OcTree; reading is not timed."""
        lines = self._run("insert", clouds, resolution, max_range, discretize).split()
        return float(np.mean([int(line) for line in lines])) / 1e6

    def touched(
        self, clouds: Path, resolution: float, max_range: float, *, discretize: bool
    ) -> list[tuple[Int32Array, Int32Array]]:
        """The cells (n, 3) that each cloud frees and the cells that it hits; some are in both."""
        words = np.frombuffer(self._run("keys", clouds, resolution, max_range, discretize), np.int32)
        sets: list[Int32Array] = []
        place = 0
        while place < words.size:
            end = place + 1 + 3 * int(words[place])
            sets.append(words[place + 1 : end].reshape(-1, 3))
            place = end
        return list(zip(sets[::2], sets[1::2], strict=True))

    def color_memory(
        self, clouds: Path, resolution: float, max_range: float, *, discretize: bool
    ) -> tuple[int, int, int, int]:
        """A ColorOcTree with all clouds, pruned: allocated bytes, ``memoryUsage()``, nodes, finest cells."""
        allocated, usage, nodes, cells = self._run("memory", clouds, resolution, max_range, discretize).split()
        return int(allocated), int(usage), int(nodes), int(cells)

    def _run(self, mode: str, clouds: Path, resolution: float, max_range: float, discretize: bool) -> bytes:
        """One run of the driver; it stays on the core that this process is pinned to."""
        command = [str(self._driver), mode, str(clouds), repr(resolution), str(int(discretize)), repr(max_range)]
        return subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout


class PyOctomap:
    """pyoctomap's OcTree, in this process. Raises MissingPeerError where it is not installed."""

    def __init__(self) -> None:
        try:
            import pyoctomap
        except ImportError:
            raise MissingPeerError("pyoctomap is left out: it is not installed (pip install pyoctomap)") from None
        self.module: Any = pyoctomap

    def insert(self, clouds: Sequence[PointCloud], resolution: float, max_range: float) -> float:
        """Mean milliseconds of a frame's ``insertPointCloud(discretize=True)``; points are ready as it takes them."""
        ready = [(np.asarray(c.points, np.float64), np.asarray(c.origin, np.float64)) for c in clouds]
        tree = self.module.OcTree(resolution)
        started = time.perf_counter()
        for points, origin in ready:
            tree.insertPointCloud(points, origin, max_range=max_range, discretize=True)
        return (time.perf_counter() - started) / len(ready) * 1e3


def write_clouds(path: Path, clouds: Sequence[PointCloud]) -> Path:
    """Write point clouds as the driver reads them (octomap_driver.cpp), and return the path."""
    with path.open("wb") as file:
        file.write(np.int64(len(clouds)).tobytes())
        for cloud in clouds:
            file.write(np.int64(len(cloud.points)).tobytes())
            for array in (cloud.origin, cloud.points, cloud.class_ids):
                file.write(np.ascontiguousarray(array).tobytes())
    return path


def _build() -> Path:
    """The compiled driver, built again when its source changes."""
    compiler = shutil.which("g++")
    if compiler is None:
        raise MissingPeerError("native OctoMap is left out: there is no g++")
    digest = hashlib.sha256(_SOURCE.read_bytes()).hexdigest()[:12]
    driver = cache_folder() / f"octomap_driver-{digest}"
    if not driver.exists():
        command = [compiler, *_FLAGS, str(_SOURCE), "-o", str(driver), "-loctomap", "-loctomath"]
        build = subprocess.run(command, check=False, capture_output=True, text=True)
        if build.returncode != 0:
            first = next((line for line in build.stderr.splitlines() if "error" in line), "unknown error")
            raise MissingPeerError(
                f"native OctoMap is left out: its driver cannot be built ({first.strip()}); "
                "on Debian and Ubuntu: apt-get install liboctomap-dev"
            )
    return driver
