"""Scans of a VLP-16 as the Velodyne driver records them, with packets by the VLP-16 User Manual (63-9243 Rev. E)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
import numpy.typing as npt
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from support.log_factory import SECOND, Row

SCAN, PACKET = "velodyne_msgs/msg/VelodyneScan", "velodyne_msgs/msg/VelodynePacket"
_PACKET_FIELDS = "# Raw Velodyne LIDAR packet.\n\n{time} stamp              # packet timestamp\nuint8[1206] data\n"
_SCAN_FIELDS = "# Velodyne LIDAR scan packets.\n\nstd_msgs/Header           header\nVelodynePacket[] packets\n"

# Elevations [degree] of the 16 lasers, and the heights [mm] of their centres, in the order of firing.
ELEVATIONS = np.array([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15], float)
OFFSETS = 1e-3 * np.array(
    [11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2]
)  # fmt: skip
_FIRING_US, _SEQUENCE_US = 2.304, 55.296
_PACKET_US = 24 * _SEQUENCE_US


def firing_times(num_packets: int) -> npt.NDArray[np.float64]:
    """Times (N, 24, 16) [us] of the firings of packets: 24 sequences of 16 lasers each."""
    packet, sequence, laser = np.ogrid[:num_packets, :24, :16]
    return packet * _PACKET_US + sequence * _SEQUENCE_US + laser * _FIRING_US


def rays_of_a_turn(num_packets: int) -> npt.NDArray[np.float64]:
    """Directions (N, 24, 16, 3) of the firings of one turn: x forward, y left, z up; the lidar turns clockwise."""
    azimuth = 2 * np.pi * firing_times(num_packets) / (num_packets * _PACKET_US)
    elevation = np.broadcast_to(np.deg2rad(ELEVATIONS), azimuth.shape)
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), -level * np.sin(azimuth), np.sin(elevation)], axis=-1)


def vlp16_packets(
    distances: npt.NDArray[np.float64], *, first_us: int = 0, reflectivity: int = 40, model: int = 0x22
) -> list[bytes]:
    """Packets of one turn from distances (N, 24, 16) [m], 0 for no return; ``first_us`` is the first packet's time."""
    num_packets = len(distances)
    packets = np.zeros(
        num_packets,
        [
            ("blocks", [("flag", "<u2"), ("azimuth", "<u2"), ("returns", [("range", "<u2"), ("value", "u1")], 32)], 12),
            ("micros", "<u4"), ("mode", "u1"), ("model", "u1"),
        ],
    )  # fmt: skip
    starts = firing_times(num_packets)[:, ::2, 0]
    packets["blocks"]["flag"] = 0xEEFF
    packets["blocks"]["azimuth"] = np.rint(36_000 * starts / (num_packets * _PACKET_US)).astype(int) % 36_000
    packets["blocks"]["returns"]["range"] = np.rint(distances / 0.002).reshape(num_packets, 12, 32)
    packets["blocks"]["returns"]["value"] = reflectivity
    packets["micros"] = (first_us + np.rint(starts[:, 0])) % 3_600_000_000
    packets["mode"], packets["model"] = 0x37, model
    return [packet.tobytes() for packet in packets]


def packets_of(look: Callable[[npt.NDArray[np.float64]], npt.NDArray[np.float64]], num_packets: int) -> list[bytes]:
    """Packets of one turn; ``look`` gives the distances (P,) along unit rays (P, 3), infinite for no return."""
    rays = rays_of_a_turn(num_packets)
    distances = look(rays.reshape(-1, 3)).reshape(rays.shape[:-1])
    return vlp16_packets(np.where(distances < 100.0, distances, 0.0))


@cache
def velodyne_types(*, ros1: bool) -> Typestore:
    """A type store with the driver's types and TF."""
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    time = "time" if ros1 else "builtin_interfaces/Time"
    fields = {**get_types_from_msg(_PACKET_FIELDS.format(time=time), PACKET), **get_types_from_msg(_SCAN_FIELDS, SCAN)}
    tf = get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", "tf2_msgs/msg/TFMessage")
    store.register({**fields, **tf} if ros1 else fields)
    return store


def velodyne_row(
    topic: str, packets: Sequence[bytes], stamp_ns: int, *, ros1: bool = False, frame_id: str = "velodyne",
    log_time_ns: int | None = None, stamped_first: bool = False,
) -> Row:  # fmt: skip
    """A VelodyneScan with the stamp of its last packet or of its first, by default recorded at this stamp."""
    store = velodyne_types(ros1=ros1)
    make = store.types
    gap = round(1000 * _PACKET_US)

    def time(index: int) -> object:
        ns = stamp_ns + gap * (index if stamped_first else index - len(packets) + 1)
        return make["builtin_interfaces/msg/Time"](sec=ns // SECOND, nanosec=ns % SECOND)

    extra = {"seq": 3} if ros1 else {}
    stamp = make["builtin_interfaces/msg/Time"](sec=stamp_ns // SECOND, nanosec=stamp_ns % SECOND)
    header = make["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id, **extra)
    parts = [make[PACKET](stamp=time(i), data=np.frombuffer(data, np.uint8)) for i, data in enumerate(packets)]
    definition, _ = store.generate_msgdef(SCAN, ros_version=1 if ros1 else 2)
    write, form = (store.serialize_ros1, ("ros1msg", "ros1")) if ros1 else (store.serialize_cdr, ("ros2msg", "cdr"))
    data = bytes(write(make[SCAN](header=header, packets=parts), SCAN))
    return Row(topic, SCAN, form[0], definition.encode(), form[1], data, log_time_ns or stamp_ns)
