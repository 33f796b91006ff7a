"""Compilation of the kernels in a second process during the first replay on a machine.

Compiling all kernels in one process takes 20 s. The second process starts with the kernels that a replay needs last and
stores them in the cache folder, where the replay finds them. A kernel that both processes compile only costs time.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from octoreplay.config.sensor import MapConfig, SensorConfig
from octoreplay.mapping.consensus import Step, Update, team_step
from octoreplay.mapping.kernels import compiler
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.sensor import ScanCaster, add_scan, clamped_increments
from octoreplay.mapping.streams import TreeStreams, leaf_list
from octoreplay.records import CameraModel, DepthFrame


@contextmanager
def second_compiler() -> Iterator[None]:
    """Compile kernels in a second process while the body runs, if the cache is empty and there is a second core."""
    process = _start() if _num_cores() > 1 and compiler.cache_is_empty() else None
    try:
        yield
    finally:
        if process is not None:
            process.kill()
            process.communicate()


def compile_if_needed() -> None:
    """Compile the kernels if the cache is empty."""
    if compiler.cache_is_empty():
        compile_kernels()


def compile_kernels() -> None:
    """Compile the kernels of a replay by running its steps once on tiny input.

    The steps that come last in a replay come first here, so that both processes compile different kernels.
    """
    sensor, map_config = SensorConfig(), MapConfig()
    depth, classes = np.full((8, 8), 3000, np.uint16), np.ones((8, 8), np.uint8)
    frame = DepthFrame("", 0, depth, 0.001, classes, CameraModel(8, 8, 4.0, 4.0, 4.0, 4.0), np.eye(4))
    cells = ScanCaster(sensor, map_config, 1).cast(frame)
    empty = (np.empty(0, np.uint16), np.empty(0, np.float32), np.empty((0, 1), np.uint8), np.empty(0, np.float32))
    leaf_list(TreeStreams(*empty))
    received, own, evidence = (SemanticOctree(map_config.resolution, 1) for _ in range(3))
    received.find_or_add(cells.codes)
    received.known[:] = 1
    team_step([Step(own, [received], [0.5], evidence, 0.5)], update=Update.GRADIENT, revision=0)
    add_scan(evidence, cells, clamped_increments(sensor), 0)


def _num_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _start() -> subprocess.Popen[bytes] | None:
    """Start the second process; return None where there is no Python interpreter or the system starts no process."""
    if not sys.executable or getattr(sys, "frozen", False):
        return None
    # -P: import nothing from the working folder.
    command = [sys.executable, "-P", "-m", __name__]
    try:
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    except OSError:
        return None


def _exit_with_the_replay() -> None:
    """Exit when standard input closes, which happens when the replay ends for any reason."""
    os.read(0, 1)
    os._exit(0)


if __name__ == "__main__":
    threading.Thread(target=_exit_with_the_replay, daemon=True).start()
    compile_kernels()
