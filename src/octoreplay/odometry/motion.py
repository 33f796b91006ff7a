"""Motions as rigid transforms: parts of a motion, speed, and accelerations."""

from __future__ import annotations

import numpy as np

from octoreplay.records import Float64Array


def part_of(motion: Float64Array, share: float) -> Float64Array:
    """Return a share of a motion (4, 4) at constant velocity: of its translation and of its rotation vector.

    Shares below 0 go back and those above 1 beyond the motion.
    """
    from scipy.spatial.transform import Rotation

    part = np.eye(4)
    part[:3, :3] = Rotation.from_rotvec(share * Rotation.from_matrix(motion[:3, :3]).as_rotvec()).as_matrix()
    part[:3, 3] = share * motion[:3, 3]
    return part


def proper(T: Float64Array) -> Float64Array:
    """Return a transform whose rotation is orthogonal again, the nearest to the given one (by SVD)."""
    left, _, right = np.linalg.svd(T[:3, :3])
    result = T.copy()
    result[:3, :3] = left @ right
    return result
