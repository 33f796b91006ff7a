"""Decoding of velodyne_msgs/VelodyneScan, the raw packets of one turn of a Velodyne lidar.

velodyne-decoder is an optional dependency: ``pip install 'octoreplay[velodyne]'``. Sources: msg/VelodyneScan.msg and
msg/VelodynePacket.msg of https://github.com/ros-drivers/velodyne; Velodyne, VLP-16 User Manual 63-9243 Rev. E, ch. 9;
https://github.com/valgur/velodyne_decoder.
"""

from __future__ import annotations

import math
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from octoreplay.errors import ConfigError, InputError
from octoreplay.io.messages.decoders import DamagedMessageError
from octoreplay.io.messages.ros_types import stamp_to_ns
from octoreplay.records import Int64Array, UInt8Array

TYPE = "velodyne_msgs/msg/VelodyneScan"
"""Name of the type, the same in ROS 1 and ROS 2."""

PACKET_SIZE = 1206
"""Bytes of a packet: 12 blocks of 100 bytes, a time, the return mode and the model."""

MAX_PACKETS = 10_000
"""Greatest number of packets of a scan; a VLS-128 at 5 Hz sends about 1250 in a turn."""

_NUM_BLOCKS, _BLOCK_SIZE = 12, 100
# In dual-return mode the last blocks of a VLS-128 are empty.
_NUM_FULL_BLOCKS = 8
# Flags at the beginning of a block, by group of 32 lasers.
_BANKS = (0xEEFF, 0xDDFF, 0xCCFF, 0xBBFF)
_FULL_TURN = 36_000
_HOUR_US = 3_600_000_000
# Model numbers in packets. Two models share 0x23, and older HDL-32E have no number.
_MODELS = (0x21, 0x22, 0x24, 0x28, 0xA1)
_RETURN_MODES = (0x37, 0x38, 0x39)
# Fields of a point: name, offset in bytes, number of the type in sensor_msgs/PointField. The decoder pads points with
# bytes that it does not set.
_POINT_STEP, _PADDED_STEP = 24, 32
_POINT_FIELDS = tuple(
    SimpleNamespace(name=name, offset=offset, datatype=datatype, count=1)
    for name, offset, datatype in (
        ("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("time", 16, 7), ("column", 20, 4),
        ("ring", 22, 2), ("return_type", 23, 2),
    )
)  # fmt: skip
_DRIVER = "play the log into the driver velodyne_pointcloud, and record its point clouds together with the other topics"


def cloud_of(scan: Any) -> Any:
    """Return a VelodyneScan as an object with the fields of a sensor_msgs/PointCloud2, without points at range 0.

    The points are in the lidar's frame (x forward, y left, z up) [m]. The point field ``time`` is in seconds after the
    packet whose stamp is nearest to the header's: the first or the last one. The model (VLP-16, Puck Hi-Res, VLP-32C,
    HDL-32E, VLS-128) is the one that the packets name. Raises DamagedMessageError for damaged packets,
    InputError for other models, ConfigError where velodyne-decoder is missing.
    """
    packets = _packets(scan)
    micros = _micros(packets)
    decoder_package = _import_decoder()
    decoder = decoder_package.ScanDecoder(decoder_package.Config(min_range=0.0, max_range=math.inf))
    vector = decoder_package.PacketVector()
    # With times from 0 on, the decoder needs no stamp to tell the hour.
    packets[:, -6:-2] = micros.astype("<u4").view(np.uint8).reshape(-1, 4)
    for packet in packets:
        vector.append(decoder_package.VelodynePacket(0.0, packet.tobytes()))
    try:
        _, points = decoder.decode(vector, as_pcl_structs=True)
    except RuntimeError as error:
        raise DamagedMessageError(f"damaged {TYPE}: {error}") from error
    if _is_stamped_first(scan):
        points["time"] += np.float32((micros[-1] - micros[0]) * 1e-6)
    data = points.view(np.uint8).reshape(-1, _PADDED_STEP)[:, :_POINT_STEP].tobytes()
    return SimpleNamespace(
        header=scan.header, height=1, width=len(points), fields=_POINT_FIELDS, is_bigendian=False,
        point_step=_POINT_STEP, row_step=_POINT_STEP * len(points), data=data,
    )  # fmt: skip


def _packets(scan: Any) -> UInt8Array:
    """Packets (N, PACKET_SIZE) uint8 of a scan, after a check of their number, sizes, blocks and model."""
    if not 0 < len(scan.packets) <= MAX_PACKETS:
        raise DamagedMessageError(f"damaged {TYPE}: {len(scan.packets)} packets; 1 to {MAX_PACKETS} are expected")
    rows = [np.asarray(packet.data, dtype=np.uint8) for packet in scan.packets]
    wrong = next((row.size for row in rows if row.shape != (PACKET_SIZE,)), None)
    if wrong is not None:
        raise DamagedMessageError(f"damaged {TYPE}: a packet of {wrong} bytes; {PACKET_SIZE} are expected")
    packets = np.stack(rows)
    blocks = packets[:, : _NUM_BLOCKS * _BLOCK_SIZE].reshape(-1, _NUM_BLOCKS, _BLOCK_SIZE)[:, :_NUM_FULL_BLOCKS]
    heads = np.ascontiguousarray(blocks[:, :, :4]).view("<u2")
    banks, azimuths = heads[..., 0], heads[..., 1]
    if not np.isin(banks, _BANKS).all() or np.any(azimuths > _FULL_TURN):
        raise DamagedMessageError(f"damaged {TYPE}: a packet without the blocks of a Velodyne lidar")
    # At least a quarter of the blocks of an HDL-64E are of its lower lasers; one such block alone is damage.
    if np.mean(banks == _BANKS[1]) >= 0.125 and not np.isin(banks, _BANKS[2:]).any():
        raise InputError(f"the packets are those of an HDL-64E, which needs the sensor's own calibration; {_DRIVER}")
    _check_model(packets)
    return packets


def _check_model(packets: UInt8Array) -> None:
    """Raise DamagedMessageError for packets of different models, InputError for a model that cannot be decoded."""
    models, modes = np.unique(packets[:, -1]), packets[:, -2]
    if models.size > 1:
        raise DamagedMessageError(f"damaged {TYPE}: packets of {models.size} models")
    if models[0] not in _MODELS:
        raise InputError(f"the packets name the lidar model {int(models[0]):#04x}, which is not supported; {_DRIVER}")
    if not np.isin(modes, _RETURN_MODES).all():
        raise DamagedMessageError(f"damaged {TYPE}: a packet with an unknown return mode")


def _micros(packets: UInt8Array) -> Int64Array:
    """Times (N,) [us] of packets after the earliest one, from their microseconds after the full hour."""
    after_hour = np.ascontiguousarray(packets[:, -6:-2]).view("<u4")[:, 0].astype(np.int64)
    half = _HOUR_US // 2
    after_last = (after_hour - after_hour[-1] + half) % _HOUR_US - half
    micros: Int64Array = after_last - after_last.min()
    return micros


def _is_stamped_first(scan: Any) -> bool:
    """True where the header has the stamp of the first packet, an option of the driver, instead of the last one."""
    stamp, first, last = map(stamp_to_ns, (scan.header.stamp, scan.packets[0].stamp, scan.packets[-1].stamp))
    return abs(stamp - first) < abs(stamp - last)


def _import_decoder() -> ModuleType:
    """Import velodyne-decoder. Raises ConfigError where it is missing."""
    try:
        import velodyne_decoder
    except ImportError as error:
        raise ConfigError(
            f"packets of Velodyne lidars need velodyne-decoder ({error}); install it with: pip install "
            f"'octoreplay[velodyne]'"
        ) from error
    module: ModuleType = velodyne_decoder
    return module
