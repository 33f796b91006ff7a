"""Decoding of Livox's CustomMsg, a point cloud with a time for each point.

A message has tens of thousands of points, which a decoder that makes an object of each would read in a tenth of a
second. Source: msg/CustomMsg.msg and msg/CustomPoint.msg of https://github.com/Livox-SDK/livox_ros_driver and
livox_ros_driver2.
"""

from __future__ import annotations

import re
import struct
from types import SimpleNamespace
from typing import Any

TYPES = (
    "livox_ros_driver/msg/CustomMsg",
    "livox_ros_driver2/msg/CustomMsg",
    "livox_interfaces/msg/CustomMsg",
)
"""Names of the type: of the drivers for ROS 1, for ROS 1 and ROS 2, and of the first driver for ROS 2."""

_POINT_STEP = 19
# Fields of a point: name, offset in bytes, number of the type in sensor_msgs/PointField.
_POINT_FIELDS = tuple(
    SimpleNamespace(name=name, offset=offset, datatype=datatype, count=1)
    for name, offset, datatype in (
        ("x", 4, 7), ("y", 8, 7), ("z", 12, 7), ("offset_time", 0, 6), ("reflectivity", 16, 2), ("tag", 17, 2),
        ("line", 18, 2),
    )
)  # fmt: skip
# The fields of both messages by type and name, without comments.
_LAYOUT = (
    ("Header header", "uint64 timebase", "uint32 point_num", "uint8 lidar_id", "uint8[3] rsvd", "CustomPoint[] points"),
    ("uint32 offset_time", "float32 x", "float32 y", "float32 z", "uint8 reflectivity", "uint8 tag", "uint8 line"),
)


def check_definition(definition: str) -> None:
    """Raise ValueError for a definition with other fields than Livox's; an empty one is that of the drivers."""
    parts = re.split(r"^={3,}\s*$", definition, flags=re.MULTILINE)
    points = next((part for part in parts[1:] if re.match(r"\s*MSG: \S*CustomPoint\s", part)), None)
    given = (parts[0], points) if points is not None else ()
    for text, expected in zip(given, _LAYOUT, strict=False):
        lines = (" ".join(line.split("#")[0].split()) for line in text.splitlines())
        # Types may have the name of their package before them.
        fields = tuple(re.sub(r"^\w+/(msg/)?", "", line) for line in lines if line and not line.startswith("MSG:"))
        if fields != expected:
            raise ValueError(f"other fields than {', '.join(expected)}")


def decode_custom_msg(data: memoryview, *, is_ros1: bool) -> Any:
    """Return a CustomMsg as an object with the fields of a sensor_msgs/PointCloud2, with one point in each row.

    ``data`` is a view of the points. The point field ``offset_time`` is in nanoseconds after the stamp. Raises
    ValueError for bytes that do not fit the type.
    """
    try:
        is_big_endian = not is_ros1 and data[1] & 1 == 0
        order = ">" if is_big_endian else "<"
        # ROS 1 has a sequence number and no padding; positions in CDR count from the end of its 4-byte head.
        body, align, start = (data, 1, 4) if is_ros1 else (data[4:], 4, 0)
        seconds, nanoseconds, length = struct.unpack_from(f"{order}3I", body, start)
        position = start + 12 + length
        frame_id = bytes(body[start + 12 : position]).rstrip(b"\0").decode("utf-8", "replace")
        position = _aligned(position, 1 if is_ros1 else 8)
        _, _, _, num_points = struct.unpack_from(f"{order}QIII", body, position)
    except (struct.error, IndexError) as error:
        raise ValueError("the message is cut") from error
    position += 20
    # The last point has no padding after it, so that rows are longer than the points in them.
    row_step = _aligned(_POINT_STEP, align)
    needed = (num_points - 1) * row_step + _POINT_STEP if num_points else 0
    if position + needed > len(body):
        raise ValueError(f"{num_points} points do not fit into {len(data)} bytes")
    header = SimpleNamespace(stamp=SimpleNamespace(sec=seconds, nanosec=nanoseconds), frame_id=frame_id)
    return SimpleNamespace(
        header=header, height=num_points, width=1, fields=_POINT_FIELDS, is_bigendian=is_big_endian,
        point_step=_POINT_STEP, row_step=row_step, data=body[position : position + needed],
    )  # fmt: skip


def _aligned(position: int, align: int) -> int:
    """The next multiple of ``align``."""
    return -(-position // align) * align
