"""First pass over the logs of a run in tiles: which frames are used, and where their rays pass."""

from __future__ import annotations

import itertools
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from octoreplay.config.resolved import ResolvedRun
from octoreplay.config.sensor import SensorConfig
from octoreplay.errors import InputError
from octoreplay.io.output_file import writing
from octoreplay.mapping.scan_points import range_of
from octoreplay.records import BoolArray, CloudFrame, DepthFrame, Float64Array, Frame, FrameCounts, Int64Array
from octoreplay.replay.sources import TeamSources

_FRAMES = "frames.npz"


@dataclass(frozen=True, eq=False)
class RobotFrames:
    """Used frames of one robot, F in the order of their stamps.

    Attributes
    ----------
    stamps : (F,) int64 array
        Stamps on the team's clock [ns].
    sensors : (F,) int64 array
        Index of the sensor of each frame.
    poses : (F, 4, 4) float64 array
        Pose of the sensor in the team's frame.
    boxes : (F, 6) float64 array
        Least and largest x, y, z of the frame's rays in the team's frame [m].
    """

    stamps: Int64Array
    sensors: Int64Array
    poses: Float64Array
    boxes: Float64Array

    def elsewhere(self, bounds: Sequence[float], num_sensors: int) -> list[dict[int, Float64Array]]:
        """Return, for each sensor, the poses at the stamps of the frames without a ray in ``bounds`` (6,) [m]."""
        found: list[dict[int, Float64Array]] = [{} for _ in range(num_sensors)]
        for index in np.flatnonzero(~touching(self.boxes, bounds)):
            found[self.sensors[index]][int(self.stamps[index])] = self.poses[index]
        return found


class Survey:
    """First pass over the logs of a run. Raises InputError as a run does.

    Attributes
    ----------
    robots : tuple of RobotFrames
        Used frames of each robot, in the order of ``config.robots``.
    """

    def __init__(self, config: ResolvedRun) -> None:
        # A ray may end in the centre of its last cell instead of its point.
        margin = 2.0 * config.map.resolution
        with TeamSources(config) as self._team, ThreadPoolExecutor(len(config.robots)) as threads:
            self.robots = tuple(
                threads.map(lambda source: _frames_of(source.frames(), config.sensor, margin), self._team.sources)
            )

    @property
    def boxes(self) -> Float64Array:
        """Boxes (F, 6) of the rays of all frames."""
        return np.concatenate([robot.boxes for robot in self.robots])

    def save(self, folder: Path) -> None:
        """Write the frames to a folder for ``load_frames``. Raises OutputError."""
        arrays = {
            f"{name}_{index}": value for index, robot in enumerate(self.robots) for name, value in vars(robot).items()
        }
        with writing(folder / _FRAMES):
            np.savez(folder / _FRAMES, **arrays)

    def counts(self, num_frames_off: Sequence[Mapping[int, int]] = ()) -> dict[str, FrameCounts]:
        """Return the counts of each robot's messages by robot_id.

        ``num_frames_off`` are the frames that were left out because the robot was off, by robot and sensor.
        """
        if num_frames_off:
            self._team.leave_out(num_frames_off)
        return self._team.counts


def load_frames(folder: Path) -> tuple[RobotFrames, ...]:
    """Return the frames of each robot from the folder that ``Survey.save`` wrote them to. Raises InputError."""
    names = [item.name for item in fields(RobotFrames)]
    try:
        with np.load(folder / _FRAMES) as arrays:
            num_robots = len(arrays.files) // len(names)
            return tuple(RobotFrames(*(arrays[f"{name}_{index}"] for name in names)) for index in range(num_robots))
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"{folder / _FRAMES}: cannot be read: {error}; give --restart") from error


def _frames_of(frames: Iterator[Frame], sensor: SensorConfig, margin: float) -> RobotFrames:
    """Stamps, poses and boxes of one robot's frames; boxes are larger by ``margin`` [m] on each side."""
    rows = [(frame.stamp_ns, frame.sensor_index, frame.T_team_sensor, ray_box(frame, sensor)) for frame in frames]
    poses = np.array([pose for *_, pose, _ in rows], np.float64).reshape(-1, 4, 4)
    boxes = np.array([box for *_, box in rows], np.float64).reshape(-1, 6)
    boxes += np.repeat([-margin, margin], 3)
    stamps, sensors = np.array([row[:2] for row in rows], np.int64).reshape(-1, 2).T
    return RobotFrames(stamps, sensors, poses, boxes)


def ray_box(frame: Frame, sensor: SensorConfig) -> Float64Array:
    """Return least and largest x, y, z (6,) of the space that the rays of a frame may pass, in the team's frame [m]."""
    max_range = range_of(frame, sensor)[1]
    ends = _image_ends(frame, sensor, max_range) if isinstance(frame, DepthFrame) else _cloud_ends(frame, max_range)
    origin = frame.T_team_sensor[:3, 3]
    if ends is None:
        return np.concatenate([origin - max_range, origin + max_range])
    corners = np.vstack([origin, ends @ frame.T_team_sensor[:3, :3].T + origin])
    return np.concatenate([corners.min(axis=0), corners.max(axis=0)])


def _cloud_ends(frame: CloudFrame, max_range: float) -> Float64Array | None:
    """Points (P, 3) of a cloud that bound its rays; None where rays without an end have any direction."""
    points = frame.points[~np.isnan(frame.points).any(axis=1)].astype(np.float64)
    if not np.isfinite(points).all():
        return None
    # A ray beyond the range ends on the way to its point.
    norms = np.linalg.norm(points, axis=1)
    return np.asarray(points * np.minimum(1.0, max_range / np.maximum(norms, 1e-9))[:, None])


def _image_ends(frame: DepthFrame, sensor: SensorConfig, max_range: float) -> Float64Array | None:
    """Corners (4, 3) of the pyramid of an image's rays; None where the camera has no such pyramid."""
    camera = frame.camera
    if camera.slopes is not None:
        return None
    depth = max_range
    if not sensor.no_return_depth:
        values = frame.depth_image * float(frame.depth_unit)
        depth = min(max_range, float(np.nanmax(values, initial=0.0, where=np.isfinite(values))))
        if np.isinf(values).any():
            depth = max_range
    sides = itertools.product((-0.5, camera.width - 0.5), (-0.5, camera.height - 0.5))
    slopes = [((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy) for u, v in sides]
    return np.array([(x * depth, y * depth, depth) for x, y in slopes])


def touching(boxes: Float64Array, bounds: Sequence[float]) -> BoolArray:
    """Return True (F,) for the boxes (F, 6) that overlap ``bounds`` (xmin, ymin, zmin, xmax, ymax, zmax)."""
    low, high = np.array(bounds[:3]), np.array(bounds[3:])
    return np.asarray(((boxes[:, :3] <= high) & (boxes[:, 3:] >= low)).all(axis=1))
