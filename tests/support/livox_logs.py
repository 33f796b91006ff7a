"""Livox messages as rosbags' serialisers write them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from support.log_factory import SECOND, Row

POINT = (
    "# Livox costom pointcloud format.\n\nuint32 offset_time      # offset time relative to the base time\n"
    "float32 x               # X axis, unit:m\nfloat32 y\nfloat32 z\nuint8 reflectivity      # reflectivity, 0~255\n"
    "uint8 tag               # livox tag\nuint8 line              # laser number in lidar\n"
)
MESSAGE = (
    "# Livox publish pointcloud msg format.\n\n{header} header    # ROS standard message header\nuint64 timebase\n"
    "uint32 point_num          # Total number of points\nuint8  lidar_id\nuint8[3]  rsvd            # Reserved use\n"
    "CustomPoint[] points      # Pointcloud data\n"
)


@cache
def livox_types(package: str, *, ros1: bool) -> Typestore:
    """A type store with Livox's types."""
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    store.register(
        {
            **get_types_from_msg(POINT, f"{package}/msg/CustomPoint"),
            **get_types_from_msg(MESSAGE.format(header="std_msgs/Header"), f"{package}/msg/CustomMsg"),
        }
    )
    return store


def livox_row(
    topic: str, points: Sequence[Sequence[float]], stamp_ns: int, *, package: str = "livox_ros_driver2",
    ros1: bool = False, frame_id: str = "livox_frame", log_time_ns: int | None = None,
) -> Row:  # fmt: skip
    """A CustomMsg with points (x, y, z), 10 us apart, recorded at its stamp unless given otherwise."""
    store = livox_types(package, ros1=ros1)

    def make(name: str, **fields: Any) -> Any:
        return store.types[name](**fields)

    stamp = make("builtin_interfaces/msg/Time", sec=stamp_ns // SECOND, nanosec=stamp_ns % SECOND)
    header = make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id, **({"seq": 3} if ros1 else {}))
    parts = [
        make(
            f"{package}/msg/CustomPoint", offset_time=10_000 * index, x=x, y=y, z=z, reflectivity=index % 256,
            tag=16, line=index % 4,
        )
        for index, (x, y, z) in enumerate(points)
    ]  # fmt: skip
    name = f"{package}/msg/CustomMsg"
    value = make(
        name, header=header, timebase=stamp_ns, point_num=len(parts), lidar_id=1, rsvd=np.zeros(3, np.uint8),
        points=parts,
    )  # fmt: skip
    definition, _ = store.generate_msgdef(name, ros_version=1 if ros1 else 2)
    write = store.serialize_ros1 if ros1 else store.serialize_cdr
    encoding = ("ros1msg", "ros1") if ros1 else ("ros2msg", "cdr")
    return Row(
        topic, name, encoding[0], definition.encode(), encoding[1], bytes(write(value, name)), log_time_ns or stamp_ns
    )
