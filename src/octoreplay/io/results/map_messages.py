"""ROS messages of maps for viewers and planners: point cloud, occupancy grid, OctoMap tree."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.io.messages.ros_types import header, message, time_message
from octoreplay.io.results.map_views import VIEW_DTYPE, VIEW_FIELDS
from octoreplay.io.results.occupancy_grid import FREE, OCCUPIED, Grid

CLOUD, GRID, OCTOMAP = "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/OccupancyGrid", "octomap_msgs/msg/Octomap"
"""Types of the messages."""


def cloud_message(points: npt.NDArray[Any], stamp_ns: int, frame_id: str) -> Any:
    """Return a sensor_msgs/PointCloud2 of ``view_points`` (P,)."""
    fields = [
        message("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=datatype, count=1)
        for name, _, offset, datatype in VIEW_FIELDS
    ]
    return message(
        CLOUD, header=header(stamp_ns, frame_id), height=1, width=len(points), fields=fields, is_bigendian=False,
        point_step=VIEW_DTYPE.itemsize, row_step=VIEW_DTYPE.itemsize * len(points),
        data=points.view(np.uint8).reshape(-1), is_dense=True,
    )  # fmt: skip


def grid_message(grid: Grid, stamp_ns: int, frame_id: str) -> Any:
    """Return a nav_msgs/OccupancyGrid: 0 is free, 100 occupied, -1 unknown; rows along y, the lowest first."""
    cells = np.full(grid.cells.shape, -1, np.int8)
    cells[grid.cells == FREE] = 0
    cells[grid.cells == OCCUPIED] = 100
    x, y = grid.origin
    height, width = grid.cells.shape
    origin = message(
        "geometry_msgs/msg/Pose", position=message("geometry_msgs/msg/Point", x=x, y=y, z=0.0),
        orientation=message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
    )  # fmt: skip
    info = message(
        "nav_msgs/msg/MapMetaData", map_load_time=time_message(stamp_ns), resolution=grid.resolution, width=width,
        height=height, origin=origin,
    )  # fmt: skip
    return message(GRID, header=header(stamp_ns, frame_id), info=info, data=cells.reshape(-1))


def octomap_message(nodes: bytes, resolution: float, stamp_ns: int, frame_id: str) -> Any:
    """Return an octomap_msgs/Octomap of a binary OcTree; ``nodes`` are those of ``octomap_trees.binary_tree``."""
    return message(
        OCTOMAP, header=header(stamp_ns, frame_id), binary=True, id="OcTree", resolution=resolution,
        data=np.frombuffer(nodes, np.int8),
    )  # fmt: skip
