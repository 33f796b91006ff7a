"""Maps of robots in a simulated village, made from its true cells, each in a frame of its own."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.records import Float64Array, Int64Array, UInt8Array
from octoreplay.registration.own_map import FREE, OwnMap
from octoreplay.simulate.village import make_village
from octoreplay.simulate.world import village_classes
from octoreplay.simulate.world_files import labelled_cells

RESOLUTION = 0.3
NUM_CLASSES = village_classes().num_classes
# Height of the free space above ground [cell].
_FREE_CELLS = 12


@functools.cache
def village_cells(seed: int = 5, size: float = 40.0) -> tuple[Int64Array, UInt8Array]:
    """Keys (n, 3) and states (n,) of a village: its surfaces, and free space above ground."""
    world = make_village(size, seed)
    keys, class_ids = labelled_cells(world, RESOLUTION)
    ground = keys[world.is_ground(class_ids)].astype(np.int64)
    lifts = np.stack([np.zeros(_FREE_CELLS), np.zeros(_FREE_CELLS), np.arange(1, _FREE_CELLS + 1)], axis=1)
    free = (ground[:, None] + lifts.astype(np.int64)).reshape(-1, 3)
    both = np.concatenate([keys.astype(np.int64), free])
    states = np.concatenate([class_ids, np.full(len(free), FREE, np.uint8)])
    # The first of equal keys is the surface.
    _, first = np.unique(both, axis=0, return_index=True)
    return both[first], states[first]


def village_map(center: Sequence[float], radius: float, *, turns: int = 0, seed: int = 5) -> OwnMap:
    """Map of the village around ``center`` (x, y) [m], in a frame at that place, turned by ``turns`` right angles."""
    keys, states = village_cells(seed)
    origin = np.round(np.asarray(center) / RESOLUTION).astype(np.int64)
    is_near = np.linalg.norm(keys[:, :2] - origin, axis=1) * RESOLUTION < radius
    near = keys[is_near].copy()
    near[:, :2] -= origin
    for _ in range(turns % 4):
        # The centre of a cell, key + 1/2, turns by -90 degrees.
        near[:, :2] = np.stack([near[:, 1], -near[:, 0] - 1], axis=1)
    return OwnMap.of_cells(near, states[is_near], RESOLUTION, NUM_CLASSES)


def T_village_map(center: Sequence[float], *, turns: int = 0) -> Float64Array:
    """True pose (4, 4) of such a map's frame in the village."""
    T = np.eye(4)
    for _ in range(turns % 4):
        T[:2, :2] = np.array([[0.0, -1.0], [1.0, 0.0]]) @ T[:2, :2]
    T[:2, 3] = np.round(np.asarray(center) / RESOLUTION) * RESOLUTION
    return T


def empty_map() -> OwnMap:
    """Map without a known cell."""
    return OwnMap.of_cells(np.empty((0, 3), np.int64), np.empty(0, np.uint8), RESOLUTION, NUM_CLASSES)


def team_config(*robots: RobotConfig | str) -> RunConfig:
    """Configuration of robots, given as such or by name."""
    return RunConfig(tuple(r if isinstance(r, RobotConfig) else RobotConfig(r, (Path(f"{r}.mcap"),)) for r in robots))
