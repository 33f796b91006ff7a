"""ROS messages of transforms, poses and markers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from octoreplay.config.robot import RobotConfig
from octoreplay.io.messages.ros_types import header, message
from octoreplay.records import TEAM, Color, Float64Array
from octoreplay.transforms import rotation_to_quaternion

LINE_LIST, CUBE_LIST, TEXT_VIEW_FACING, ADD, DELETEALL = 5, 6, 9, 0, 3
"""visualization_msgs/Marker types and actions."""


def static_transform(stamp_ns: int, robot: RobotConfig) -> Any:
    """Return the transform from the team's frame to ``<robot>/map``, the frame of the poses in the robot's log."""
    x, y, z, *rotation = robot.T_team_map_or_identity
    turn = message("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", rotation, strict=True)))
    return transform(stamp_ns, TEAM, f"{robot.robot_id}/map", np.array([x, y, z]), turn)


def transform(stamp_ns: int, frame_id: str, child_frame: str, position: Float64Array, rotation: Any) -> Any:
    """Return a geometry_msgs/TransformStamped from a frame."""
    return message(
        "geometry_msgs/msg/TransformStamped", header=header(stamp_ns, frame_id), child_frame_id=child_frame,
        transform=message(
            "geometry_msgs/msg/Transform",
            translation=message("geometry_msgs/msg/Vector3", **_xyz(position)),
            rotation=rotation,
        ),
    )  # fmt: skip


def marker(
    stamp_ns: int,
    namespace: str,
    marker_id: int,
    kind: int,
    *,
    scale: tuple[float, float, float],
    action: int = ADD,
    points: Sequence[Any] = (),
    text: str = "",
    position: Float64Array | None = None,
    color: Color = (255, 255, 255),
    frame_id: str = TEAM,
) -> Any:
    """Return a visualization_msgs/Marker; fields unused by lines, cubes and texts are empty."""
    place = point(np.zeros(3) if position is None else position)
    red, green, blue = (value / 255 for value in color)
    identity = message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    empty_bytes = np.zeros(0, dtype=np.uint8)
    return message(
        "visualization_msgs/msg/Marker", header=header(stamp_ns, frame_id), ns=namespace, id=marker_id, type=kind,
        action=action, pose=message("geometry_msgs/msg/Pose", position=place, orientation=identity),
        scale=message("geometry_msgs/msg/Vector3", **_xyz(np.array(scale))),
        color=message("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=1.0),
        lifetime=message("builtin_interfaces/msg/Duration", sec=0, nanosec=0), frame_locked=False, points=list(points),
        colors=[], texture_resource="",
        texture=message("sensor_msgs/msg/CompressedImage", header=header(0, ""), format="", data=empty_bytes),
        uv_coordinates=[], text=text, mesh_resource="",
        mesh_file=message("visualization_msgs/msg/MeshFile", filename="", data=empty_bytes),
        mesh_use_embedded_materials=False,
    )  # fmt: skip


def _xyz(coords: Float64Array) -> dict[str, float]:
    """Fields of coordinates (3,)."""
    return {"x": float(coords[0]), "y": float(coords[1]), "z": float(coords[2])}


def point(coords: Float64Array) -> Any:
    """Return a geometry_msgs/Point of coordinates (3,)."""
    return message("geometry_msgs/msg/Point", **_xyz(coords))


def vector(T: Float64Array) -> Float64Array:
    """Return the translation (3,) of a transform (4, 4)."""
    return T[:3, 3]


def quaternion(T: Float64Array) -> Any:
    """Return the geometry_msgs/Quaternion of the rotation of a transform (4, 4)."""
    x, y, z, w = rotation_to_quaternion(T[:3, :3])
    return message("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
