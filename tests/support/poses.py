"""Poses for tests."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation


def pose(index: int) -> np.ndarray:
    """Return the transform (4, 4) of a pose that turns about z and moves along x with ``index``."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("zyx", [0.3 * index, 0.1, -0.2]).as_matrix()
    T[:3, 3] = index, -2.0, 0.5
    return T


def pose_of(numbers: Sequence[float]) -> np.ndarray:
    """Return the transform (4, 4) of a rotation vector [rad] and a translation [m], six numbers."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(numbers[:3]).as_matrix()
    T[:3, 3] = numbers[3:]
    return T
