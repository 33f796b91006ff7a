"""A second process that compiles kernels while the first replay on a machine compiles others.

Compiling them all one after the other takes 20 s. The second process takes those that a replay comes to last, and keeps
them in the folder where the replay looks whenever it meets a new signature. What both compile costs time, no more.
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
from octoreplay.mapping.octree import SemanticOctree, TreeStreams, leaf_list
from octoreplay.mapping.sensor import ScanCaster, add_scan, clamped_increments
from octoreplay.records import CameraModel, DepthFrame


@contextmanager
def second_compiler() -> Iterator[None]:
    """Compile kernels in a second process while the body runs, where there are none yet and there is a core for it."""
    process = _start() if _num_cores() > 1 and compiler.cache_is_empty() else None
    try:
        yield
    finally:
        if process is not None:
            process.kill()
            process.communicate()


def compile_kernels() -> None:
    """Do once, on next to nothing, what a replay does.

    First comes what needs none of the kernels that a replay begins with; when these are needed they are there.
    """
    sensor, map_config = SensorConfig(), MapConfig()
    depth, classes = np.full((8, 8), 3000, np.uint16), np.ones((8, 8), np.uint8)
    frame = DepthFrame("", 0, depth, 0.001, classes, CameraModel(8, 8, 4.0, 4.0, 4.0, 4.0), np.eye(4))
    cells = ScanCaster(sensor, map_config, 1).cast(frame)
    nothing = (np.empty(0, np.uint16), np.empty(0, np.float32), np.empty((0, 1), np.uint8), np.empty(0, np.float32))
    leaf_list(TreeStreams(*nothing))
    received, own, evidence = (SemanticOctree(map_config.resolution, 1) for _ in range(3))
    received.find_or_add(cells.codes)
    received.known[:] = 1
    team_step([Step(own, [received], [0.5], evidence, 0.5)], update=Update.GRADIENT, revision=0)
    add_scan(evidence, cells, clamped_increments(sensor), 0)


def _num_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _start() -> subprocess.Popen[bytes] | None:
    """Start the second process; None where this one is no Python interpreter, or the system starts no more."""
    if not sys.executable or getattr(sys, "frozen", False):
        return None
    # With -P nothing is imported from the working folder.
    command = [sys.executable, "-P", "-m", __name__]
    try:
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    except OSError:
        return None


def _end_with_the_replay() -> None:
    """End this process when its input ends, as it does with the process at the other end, however that ends."""
    os.read(0, 1)
    os._exit(0)


if __name__ == "__main__":
    threading.Thread(target=_end_with_the_replay, daemon=True).start()
    compile_kernels()
