"""Reads a log's messages back with the mcap package and rosbags' types alone, to judge what octoreplay wrote."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader

from octoreplay.io.messages.ros_types import typestore

DEPTH_TYPES = {"16UC1": "<u2", "32FC1": "<f4"}
LABEL_TYPES = {"mono8": "<u1", "mono16": "<u2"}


def read_messages(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """(log time, message) of every message, by topic."""
    found: dict[str, list[tuple[int, Any]]] = defaultdict(list)
    with path.open("rb") as file:
        for schema, channel, stored in make_reader(file).iter_messages():
            assert schema is not None
            message = typestore().deserialize_cdr(stored.data, schema.name)
            found[channel.topic].append((stored.log_time, message))
    return dict(found)


def pixels(image: Any) -> np.ndarray:
    """The pixels of an image message, (H, W)."""
    kind = {**DEPTH_TYPES, **LABEL_TYPES}[image.encoding]
    assert image.step == image.width * np.dtype(kind).itemsize
    assert image.is_bigendian == 0
    return np.frombuffer(image.data.tobytes(), kind).reshape(image.height, image.width)


def stamp_ns(message: Any) -> int:
    """The header's stamp."""
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)


def matrix(position: Any, rotation: Any) -> np.ndarray:
    """The (4, 4) transform of a position and a quaternion message."""
    from scipy.spatial.transform import Rotation

    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([rotation.x, rotation.y, rotation.z, rotation.w]).as_matrix()
    T[:3, 3] = position.x, position.y, position.z
    return T
