"""Maps of scans for tests that compare what logs say by the map that comes of it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from octoreplay.config.sensor import MapConfig, SensorConfig
from octoreplay.mapping.codec import encode_packet
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.sensor import ScanCaster, add_scan, clamped_increments
from octoreplay.records import Frame

SENSOR, MAP = SensorConfig(), MapConfig(resolution=0.1)


def octree_of(frames: Iterable[Frame], num_classes: int, *, sensor: SensorConfig = SENSOR) -> SemanticOctree:
    """The octree of one robot after all its frames."""
    octree = SemanticOctree(MAP.resolution, num_classes)
    caster = ScanCaster(sensor, MAP, num_classes)
    for revision, frame in enumerate(frames):
        add_scan(octree, caster.cast(frame), clamped_increments(sensor), revision)
    return octree


def packet_of(frames: Iterable[Frame], num_classes: int) -> bytes:
    """The bytes of that octree as it is published."""
    return encode_packet(octree_of(frames, num_classes))


def states_of(octree: SemanticOctree) -> tuple[np.ndarray, np.ndarray]:
    """Every known cell in ascending order of its code: codes (n,) int64, and states (n,) int64.

    A state is the class that the cell is likeliest to be, negative where it is rather free.
    """
    table = octree.leaves()
    edges = np.rint(table.sizes / MAP.resolution).astype(np.int64)
    low = np.rint((table.centers - table.sizes[:, None] / 2) / MAP.resolution).astype(np.int64)
    likeliest = 1 + table.log_odds.argmax(axis=1)
    of_leaves = np.where(table.log_odds.max(axis=1) > 0, likeliest, -likeliest)
    codes, states = [], []
    for edge in np.unique(edges):
        is_meant = edges == edge
        keys = (low[is_meant, None] + np.argwhere(np.ones((edge, edge, edge)))).reshape(-1, 3) + (1 << 19)
        codes.append(keys @ np.array([1 << 40, 1 << 20, 1]))
        states.append(np.repeat(of_leaves[is_meant], edge**3))
    order = np.argsort(np.concatenate(codes))
    return np.concatenate(codes)[order], np.concatenate(states)[order]
