"""Small frames and configurations for calculations by hand: one pixel, one ray along +x, cells of 1 m."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.records import CameraModel, ClassTable, CloudFrame, DepthFrame, SemanticClass

START_NS = 5_000_000_000

FACING_X = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotation of a level camera with its optical axis along +x."""


def facing_x(x: float = 0.5, y: float = 0.5, z: float = 0.5) -> np.ndarray:
    """Return T_team_sensor (4, 4) of a camera at a point with its optical axis along +x."""
    pose = np.eye(4)
    pose[:3, :3] = FACING_X
    pose[:3, 3] = (x, y, z)
    return pose


def depth_frame(
    image: Any, classes: Any = None, *, robot_id: str = "a", seconds: float = 0.0, pose: Any = None, unit: float = 1.0
) -> DepthFrame:
    """Return a depth image with f = 1 pixel: the ray of pixel (u, v) is along (1, -u, -v) in the team's frame."""
    image = np.atleast_2d(image)
    return DepthFrame(
        robot_id=robot_id,
        stamp_ns=START_NS + round(seconds * 1e9),
        depth_image=image,
        depth_unit=unit,
        class_image=None if classes is None else np.atleast_2d(np.array(classes, dtype=np.uint8)),
        camera=CameraModel(image.shape[1], image.shape[0], 1.0, 1.0, 0.0, 0.0),
        T_team_sensor=facing_x() if pose is None else pose,
    )


def ray(robot_id: str, seconds: float, class_id: int, distance: float = 2.0) -> DepthFrame:
    """Return a frame of one ray from (0.5, 0.5, 0.5) along +x. With 2 m it frees cells 0 and 1 and hits cell 2."""
    return depth_frame(np.array([[distance]], dtype=np.float32), [[class_id]], robot_id=robot_id, seconds=seconds)


def cloud(points: Any, class_ids: Any, *, dtype: Any = np.float64) -> CloudFrame:
    """Return a cloud of a sensor at (0.5, 0.5, 0.5) without rotation."""
    pose = np.eye(4)
    pose[:3, 3] = 0.5
    ids = None if class_ids is None else np.array(class_ids, dtype=np.uint8)
    return CloudFrame("a", START_NS, np.array(points, dtype=dtype).reshape(-1, 3), ids, pose)


def team_config(robot_ids: str = "ab", num_classes: int = 2, **parameters: Any) -> RunConfig:
    """Return the configuration of a team with one-letter robots, cells of 1 m and ticks of 1 s."""
    table = ClassTable(tuple(SemanticClass(c, f"class_{c}", (c, c, c), (c,)) for c in range(1, num_classes + 1)))
    robots = tuple(RobotConfig(robot_id, (Path(f"{robot_id}.mcap"),)) for robot_id in robot_ids)
    return RunConfig(robots=robots, classes=table).with_parameters({"resolution": 1.0, **parameters})
