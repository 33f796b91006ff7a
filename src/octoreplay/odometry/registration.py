"""Result of the registration of one scan, and how well a scene determines it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from octoreplay.records import Float64Array, Frame


@dataclass(frozen=True, eq=False)
class ScanPose:
    """Pose of one scan as registration gives it.

    Attributes
    ----------
    T_map_sensor : (4, 4) float64
        Pose ``offset`` seconds after the scan's stamp.
    overlap : float
        Share of the scan's points that have a counterpart in the map.
    residual : float
        Root mean square distance of these points from it [m].
    constraint : float
        Information about the least determined direction of motion, 0 to 1/3 (``least_information``); 1 where it is
        unknown.
    offset : float
        Time of the pose after the scan's stamp [s].
    """

    T_map_sensor: Float64Array
    overlap: float
    residual: float
    constraint: float
    offset: float = 0.0


class Odometer(Protocol):
    """Registration of scans to a local map of earlier ones."""

    def register(self, frame: Frame, motion: Float64Array, seconds: float) -> ScanPose:
        """Return the pose of a scan, ``seconds`` after the last one; ``motion`` (4, 4) is the expected motion."""

    def keep(self) -> None:
        """Add the scan that was registered last to the local map."""

    def leave_out(self) -> None:
        """Take the expected pose for the scan that was registered last, and do not add it to the local map."""

    def restart(self) -> None:
        """Begin a new local map with the scan that was registered last, at its expected pose."""


def least_information(points: Float64Array, normals: Float64Array) -> float:
    """Return the information about the least determined direction of motion, 0 to 1/3.

    It is the least eigenvalue of the mean of J^T J with J = [n, (p x n) / s], the derivative of the point-to-plane
    distance, where s is the root mean square distance of the points from their centre (Zhang, Kaess and Singh, On
    Degeneracy of Optimization-based State Estimation Problems, ICRA 2016). ``points`` and ``normals`` are (n, 3) in
    space, or (n, 2) in a plane. A flat wall or a smooth tunnel gives 0, a room about 0.05.
    """
    if len(points) < 6:
        return 0.0
    centred = points - points.mean(axis=0)
    scale = max(float(np.sqrt(np.square(centred).sum(axis=1).mean())), 1e-6)
    arms = centred / scale
    if points.shape[1] == 2:
        moments = (arms[:, 0] * normals[:, 1] - arms[:, 1] * normals[:, 0])[:, None]
    else:
        moments = np.cross(arms, normals)
    rows = np.concatenate([normals, moments], axis=1)
    return float(max(np.linalg.eigvalsh(rows.T @ rows / len(points))[0], 0.0))
