"""ROS 2 message types that octoreplay reads and writes, and their CDR encoding (rosbags' typestore)."""

from __future__ import annotations

from functools import cache
from typing import Any

from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

VISION_MSGS = {
    "vision_msgs/msg/VisionClass": "uint16 class_id\nstring class_name\n",
    "vision_msgs/msg/LabelInfo": ("std_msgs/Header header\nvision_msgs/VisionClass[] class_map\nfloat32 threshold\n"),
}
"""Definitions of vision_msgs 4 that are missing from rosbags' type stores."""

OCTOMAP_MSGS = {
    "octomap_msgs/msg/Octomap": ("std_msgs/Header header\nbool binary\nstring id\nfloat64 resolution\nint8[] data\n"),
}
"""Definition of octomap_msgs, which rosbags' type stores do not have."""

VELODYNE_MSGS = {
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data\n",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets\n",
}
"""Definitions of velodyne_msgs, which rosbags' type stores do not have."""

OCTOREPLAY_MSGS = {
    "octoreplay_msgs/msg/MapState": """\
# One robot's map or evidence after the tick at header.stamp, as a packet of the map codec (docs/packet-format.md).
std_msgs/Header header
string robot_id
uint32 tick
# Counts the states of this robot from 0. A delta replaces the bricks it holds in the state base_sequence.
uint32 sequence
uint32 base_sequence
bool is_key_frame
# N, the number of robots of whose evidence the map is the mean; 1 where it is no mean.
uint32 num_robots
uint8[] data
""",
    "octoreplay_msgs/msg/Packet": """\
# One packet as it went over the air (only with --keep-packets).
std_msgs/Header header
string sender
uint32 tick
uint8[] data
""",
    "octoreplay_msgs/msg/RobotMetrics": """\
string robot_id
bool active
uint32 num_scans
uint32 num_iterations
# Share of the cells known to any robot whose label equals the oracle's: all cells; cells the oracle calls occupied.
float64 agreement
float64 agreement_occupied
uint64 num_leaves
uint64 num_cells
# Cubic metres.
float64 observed_volume
# Mean over observed cells, in bits.
float64 entropy_bits
uint64 memory_bytes
# All that its radio sent in this tick, acknowledgements too.
uint64 sent_bytes
# The map published in this tick: as sent, as uncompressed octree, as uniform grid, as octree without pruning.
uint64 packet_bytes
uint64 octree_bytes
uint64 grid_bytes
uint64 unpruned_bytes
uint64 unpruned_compressed_bytes
""",
    "octoreplay_msgs/msg/LinkMetrics": """\
string sender
string receiver
uint32 num_sent
uint64 sent_bytes
uint32 num_delivered
uint64 delivered_bytes
# Never arrived: lost on the air; thrown out of a queue.
uint32 num_lost
uint32 num_dropped
# Delivered in a later tick than they were sent in; older than what was there; deltas that did not fit; damaged.
uint32 num_late
uint32 num_stale
uint32 num_gaps
uint32 num_damaged
float64 bytes_per_second
""",
    "octoreplay_msgs/msg/PairMetrics": """\
# Contradiction of the evidence of two robots that share known cells.
string first
string second
uint64 overlap_cells
# Cells that one calls occupied and the other occupied or free; the share that the other calls free, and the share
# that it calls firmly free without an occupied cell beside.
uint64 occupied_cells
float64 contradiction
float64 clear_contradiction
float64 contradiction_of_first
float64 contradiction_of_second
# Cells that both call occupied, and the share with different labels.
uint64 both_occupied_cells
float64 label_contradiction
""",
    "octoreplay_msgs/msg/Contradiction": """\
# Contradiction of evidence after one tick; the definitions are in docs/metrics.md. NaN: nothing to compare.
std_msgs/Header header
uint32 tick
# The largest of a pair with enough cells.
float64 contradiction
float64 clear_contradiction
float64 label_contradiction
octoreplay_msgs/PairMetrics[] pairs
""",
    "octoreplay_msgs/msg/RobotFrame": """\
# Frame of a robot's map and poses after one tick, and the pose of the robot's own map frame in it.
string robot_id
string frame_id
geometry_msgs/Pose pose
""",
    "octoreplay_msgs/msg/Frames": """\
# Frames of robots that find them during the run, after one tick.
std_msgs/Header header
uint32 tick
octoreplay_msgs/RobotFrame[] robots
""",
    "octoreplay_msgs/msg/TickMetrics": """\
# The team after one consensus tick; the definitions are in docs/metrics.md.
std_msgs/Header header
uint32 tick
bool settling
# Phi: over the tick's links, of the maps as published and after the iterations; over all pairs of robots.
float64 total_distance_published
float64 total_distance
float64 total_distance_all
float64 distance_per_leaf
float64 distance_per_cell_and_link
uint64 num_known_cells
float64 label_disagreement
# Largest change of any log-odds in this tick.
float64 max_change
octoreplay_msgs/RobotMetrics[] robots
octoreplay_msgs/LinkMetrics[] links
""",
}
"""octoreplay's own messages; docs/result-format.md explains them."""


@cache
def typestore() -> Typestore:
    """Return the types of ROS 2 Humble, vision_msgs, octomap_msgs, velodyne_msgs and octoreplay_msgs."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, definition in {**VISION_MSGS, **OCTOMAP_MSGS, **VELODYNE_MSGS, **OCTOREPLAY_MSGS}.items():
        store.register(get_types_from_msg(definition, name))
    return store


@cache
def typestore_of(type_name: str, definition: str) -> Typestore:
    """Return the types of a message as a file defines them, which may be an older version of octoreplay's messages.

    ``definition`` is the text of a ros2msg schema with all types that it needs. Older versions have fewer fields.
    Raises ValueError for a text that cannot be read, and for fields that the present types do not have.
    """
    try:
        defined = get_types_from_msg(definition, type_name)
    except TypesysError as error:
        raise ValueError(f"the definition of '{type_name}' cannot be read") from error
    present = typestore().fielddefs
    for name, (_, fields) in defined.items():
        unknown = [field for field, kind in fields if (field, kind) not in present[name][1]]
        if unknown:
            raise ValueError(f"'{name}' has the unknown field '{unknown[0]}'")
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(defined)
    return store


def message(type_name: str, **fields: Any) -> Any:
    """Return a message of a registered type from its fields."""
    return typestore().types[type_name](**fields)


def stamp_to_ns(stamp: Any) -> int:
    """Return nanoseconds of a builtin_interfaces/Time (ROS 2), time (ROS 1), google.protobuf.Timestamp or JSON time.

    Raises AttributeError, TypeError or ValueError for other values and for times outside int64.
    """
    if hasattr(stamp, "nanosec"):
        seconds, nanoseconds = stamp.sec, stamp.nanosec
    elif hasattr(stamp, "nanos"):
        seconds, nanoseconds = stamp.seconds, stamp.nanos
    else:
        seconds, nanoseconds = stamp.sec, stamp.nsec
    try:
        stamp_ns = int(seconds) * 1_000_000_000 + int(nanoseconds)
    except OverflowError as error:
        raise ValueError("an infinite time") from error
    if abs(stamp_ns) >= 1 << 63:
        raise ValueError("a time beyond 64 bits")
    return stamp_ns


def time_message(stamp_ns: int) -> Any:
    """Return a builtin_interfaces/Time from nanoseconds."""
    return message("builtin_interfaces/msg/Time", sec=stamp_ns // 1_000_000_000, nanosec=stamp_ns % 1_000_000_000)


def header(stamp_ns: int, frame_id: str) -> Any:
    """Return a std_msgs/Header with a stamp [ns] and a frame id."""
    return message("std_msgs/msg/Header", stamp=time_message(stamp_ns), frame_id=frame_id)
