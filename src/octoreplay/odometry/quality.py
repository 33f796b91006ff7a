"""Quality of an estimated trajectory: registered share, overlap, residuals, jumps and breaks."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from octoreplay.errors import ConfigError
from octoreplay.odometry.registration import ScanPose
from octoreplay.records import Float64Array
from octoreplay.transforms import pose_difference


@dataclass(frozen=True)
class Limits:
    """Limits that the pose of a scan must keep to be used.

    ``max_speed`` [m/s], ``max_turn`` [rad/s] and ``max_acceleration`` [m/s^2] are those of the sensor;
    ``min_overlap`` and ``min_constraint`` those of ``ScanPose``. Raises ConfigError for values that are out of range.
    """

    max_speed: float = 40.0
    max_turn: float = math.radians(400.0)
    max_acceleration: float = 40.0
    min_overlap: float = 0.5
    min_constraint: float = 0.002

    def __post_init__(self) -> None:
        for name in ("max_speed", "max_acceleration"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"{name}: must be greater than 0")


@dataclass
class Quality:
    """Quality of the poses of a log's scans.

    - ``num_scans``, ``num_registered``: scans, and those with a pose.
    - ``num_low_overlap``, ``num_unconstrained``, ``num_jumps``: scans without a pose because too few points had a
      counterpart, because the scene leaves a direction open, and because of a limit of speed, turn or acceleration.
    - ``num_breaks``: places at which the local map began again, with the poses before and after joined by the expected
      motion alone.
    - ``num_by_wheels``, ``num_by_imu``: expected motions from wheel odometry, and those with the rotation of an IMU.
    - ``lost_spans``: stamps [ns] of the first and the last scan of each run of scans without a pose.
    - ``length`` [m]: way along the poses.
    """

    num_scans: int = 0
    num_registered: int = 0
    num_low_overlap: int = 0
    num_unconstrained: int = 0
    num_jumps: int = 0
    num_breaks: int = 0
    num_by_wheels: int = 0
    num_by_imu: int = 0
    length: float = 0.0
    lost_spans: list[tuple[int, int]] = field(default_factory=list)
    overlaps: list[float] = field(default_factory=list, repr=False)
    residuals: list[float] = field(default_factory=list, repr=False)

    @property
    def registered_share(self) -> float:
        """Share of the scans that have a pose, 0 to 1."""
        return self.num_registered / self.num_scans if self.num_scans else 0.0

    @property
    def median_overlap(self) -> float:
        """Median share of points with a counterpart, over the scans with a pose; NaN without any."""
        return float(np.median(self.overlaps)) if self.overlaps else math.nan

    @property
    def least_overlap(self) -> float:
        """Least share of points with a counterpart, over the scans with a pose; NaN without any."""
        return min(self.overlaps, default=math.nan)

    @property
    def median_residual(self) -> float:
        """Median of the scans' root mean square distances from the local map [m]; NaN without any."""
        return float(np.median(self.residuals)) if self.residuals else math.nan

    @property
    def largest_residual(self) -> float:
        """Largest of the scans' root mean square distances from the local map [m]; NaN without any."""
        return max(self.residuals, default=math.nan)

    def use(self, pose: ScanPose, distance: float) -> None:
        """Count a scan with a pose, ``distance`` metres from the last one."""
        self.num_scans += 1
        self.num_registered += 1
        self.length += distance
        if self.num_registered > 1:
            self.overlaps.append(pose.overlap)
            self.residuals.append(pose.residual)

    def lose(self, fault: str, stamp_ns: int, *, is_first: bool) -> None:
        """Count a scan without a pose; ``is_first`` begins a new run of them."""
        self.num_scans += 1
        setattr(self, fault, getattr(self, fault) + 1)
        if is_first:
            self.lost_spans.append((stamp_ns, stamp_ns))
        self.lost_spans[-1] = (self.lost_spans[-1][0], stamp_ns)


def fault_of(
    pose: ScanPose, motion: Float64Array, last_motion: Float64Array | None, seconds: float, limits: Limits
) -> str | None:
    """Return the name of the count of ``Quality`` for a pose that breaks a limit; None where it keeps all.

    ``motion`` (4, 4) is that since the last scan, in ``seconds``, and ``last_motion`` the one before, in 1 s; None
    where it is unknown.
    """
    if pose.constraint < limits.min_constraint:
        return "num_unconstrained"
    if pose.overlap < limits.min_overlap:
        return "num_low_overlap"
    distance, angle = pose_difference(np.eye(4), motion)
    if distance > limits.max_speed * seconds or angle > limits.max_turn * seconds:
        return "num_jumps"
    if last_motion is not None:
        change = float(np.linalg.norm(motion[:3, 3] / seconds - last_motion[:3, 3]))
        if change / seconds > limits.max_acceleration and change * seconds > _SMALL_JUMP:
            return "num_jumps"
    return None


_SMALL_JUMP = 0.3
"""Change of a step that is no jump at any acceleration [m]: short steps amplify the noise of the poses."""
