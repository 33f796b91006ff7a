"""The peers: native OctoMap and Bonxai through small C++ drivers, and pyoctomap from PyPI."""

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

_HERE = Path(__file__).parent
_FLAGS = ("-O3", "-march=native", "-std=c++17")


class MissingPeerError(Exception):
    """A peer that this machine does not have; the message says what to install."""


class NativeOctomap:
    """OctoMap's own C++ library (Debian: liboctomap-dev), in a process of its own for every call.

    Raises MissingPeerError where there is no compiler or no library.
    """

    def __init__(self) -> None:
        self._driver = _build(
            "native OctoMap", "octomap_driver", ["-loctomap", "-loctomath"],
            remedy="on Debian and Ubuntu: apt-get install liboctomap-dev",
        )  # fmt: skip

    def insert(self, clouds: Path, resolution: float, max_range: float, *, discretize: bool) -> float:
        """Mean milliseconds of a frame's ``insertPointCloud`` into one growing OcTree; reading is not timed."""
        return _mean_ms(self._run("insert", clouds, resolution, max_range, discretize))

    def touched(
        self, clouds: Path, resolution: float, max_range: float, *, discretize: bool
    ) -> list[tuple[Int32Array, Int32Array]]:
        """The cells (n, 3) that each cloud frees and the cells that it hits; some are in both."""
        return _cell_sets(self._run("keys", clouds, resolution, max_range, discretize))

    def color_memory(
        self, clouds: Path, resolution: float, max_range: float, *, discretize: bool
    ) -> tuple[int, int, int, int]:
        """A ColorOcTree with all clouds, pruned: allocated bytes, ``memoryUsage()``, nodes, finest cells."""
        allocated, usage, nodes, cells = self._run("memory", clouds, resolution, max_range, discretize).split()
        return int(allocated), int(usage), int(nodes), int(cells)

    def _run(self, mode: str, clouds: Path, resolution: float, max_range: float, discretize: bool) -> bytes:
        return _output(self._driver, mode, clouds, repr(resolution), int(discretize), repr(max_range))


class Bonxai:
    """Bonxai's probabilistic map (github.com/facontidavide/Bonxai), built from the source in ``folder``.

    Every call runs in a process of its own. Raises MissingPeerError where no folder is given, or the folder holds no
    Bonxai, or there is no compiler or no Eigen.
    """

    def __init__(self, folder: Path | None) -> None:
        if folder is None:
            raise MissingPeerError("Bonxai is left out: no source folder is given (--bonxai FOLDER)")
        source = folder / "bonxai_map" / "src" / "probabilistic_map.cpp"
        if not source.exists():
            raise MissingPeerError(f"Bonxai is left out: {source} does not exist; give the root of Bonxai's source")
        includes = [f"-I{folder / room / 'include'}" for room in ("bonxai_core", "bonxai_map")]
        self._driver = _build(
            "Bonxai", "bonxai_driver", [str(source), *includes],
            remedy="on Debian and Ubuntu: apt-get install libeigen3-dev",
        )  # fmt: skip

    def insert(self, clouds: Path, resolution: float, max_range: float) -> float:
        """Mean milliseconds of a frame's ``insertPointCloud`` into one growing map; reading is not timed."""
        return _mean_ms(_output(self._driver, "insert", clouds, repr(resolution), repr(max_range)))

    def touched(self, clouds: Path, resolution: float, max_range: float) -> list[tuple[Int32Array, Int32Array]]:
        """The cells (n, 3) that each cloud frees in an empty map, and the cells that it hits."""
        return _cell_sets(_output(self._driver, "keys", clouds, repr(resolution), repr(max_range)))


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
        started = time.thread_time()
        for points, origin in ready:
            tree.insertPointCloud(points, origin, max_range=max_range, discretize=True)
        return (time.thread_time() - started) / len(ready) * 1e3


def write_clouds(path: Path, clouds: Sequence[PointCloud]) -> Path:
    """Write point clouds as the drivers read them (clouds.hpp), and return the path."""
    with path.open("wb") as file:
        file.write(np.int64(len(clouds)).tobytes())
        for cloud in clouds:
            file.write(np.int64(len(cloud.points)).tobytes())
            for array in (cloud.origin, cloud.points, cloud.class_ids):
                file.write(np.ascontiguousarray(array).tobytes())
    return path


def _build(peer: str, name: str, arguments: Sequence[str], *, remedy: str) -> Path:
    """The compiled driver ``name``, built again when its sources or its compiler's arguments change."""
    compiler = shutil.which("g++")
    if compiler is None:
        raise MissingPeerError(f"{peer} is left out: there is no g++")
    source = _HERE / f"{name}.cpp"
    digest = hashlib.sha256(" ".join(arguments).encode())
    sources = [source, _HERE / "clouds.hpp", *(Path(argument) for argument in arguments if argument.endswith(".cpp"))]
    for path in sources:
        digest.update(path.read_bytes())
    driver = cache_folder() / f"{name}-{digest.hexdigest()[:12]}"
    if not driver.exists():
        command = [compiler, *_FLAGS, str(source), "-o", str(driver), *arguments]
        build = subprocess.run(command, check=False, capture_output=True, text=True)
        if build.returncode != 0:
            first = next((line for line in build.stderr.splitlines() if "error" in line), "unknown error")
            raise MissingPeerError(f"{peer} is left out: its driver cannot be built ({first.strip()}); {remedy}")
    return driver


def _output(driver: Path, *arguments: Any) -> bytes:
    """Output of one run of a driver; it stays on the core that this process is pinned to."""
    return subprocess.run([str(driver), *map(str, arguments)], check=True, stdout=subprocess.PIPE).stdout


def _mean_ms(output: bytes) -> float:
    """Mean [ms] of the nanoseconds that a driver prints, one a line."""
    return float(np.mean([int(line) for line in output.split()])) / 1e6


def _cell_sets(output: bytes) -> list[tuple[Int32Array, Int32Array]]:
    """The freed and the hit cells (n, 3) of each cloud from a driver's output: count and keys in turn."""
    words = np.frombuffer(output, np.int32)
    sets: list[Int32Array] = []
    place = 0
    while place < words.size:
        end = place + 1 + 3 * int(words[place])
        sets.append(words[place + 1 : end].reshape(-1, 3))
        place = end
    return list(zip(sets[::2], sets[1::2], strict=True))
