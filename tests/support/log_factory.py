"""Messages and small robot logs for the tests of reading, in ROS 2 and ROS 1 types and Foxglove's schemas."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import foxglove.messages
import numpy as np
import numpy.typing as npt
from mcap.writer import Writer as PlainMcapWriter
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from octoreplay.io.containers.log_reader import Channel, RawMessage, normalise_type_name
from octoreplay.io.containers.mcap_writer import RosMcapWriter
from octoreplay.io.messages.ros_types import typestore
from support.foxglove_definitions import FOXGLOVE_ROS2

SECOND = 1_000_000_000
IDENTITY = (0.0, 0.0, 0.0, 1.0)
# The rotation from a body (x forward, z up) to an optical frame (z forward, y down), REP 103.
OPTICAL = (-0.5, 0.5, -0.5, 0.5)

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", "tf2_msgs/msg/TFMessage"))


TAG = "apriltag_ros/msg/AprilTagDetection"
ROS1.register(
    {
        **get_types_from_msg("int32[] id\nfloat64[] size\ngeometry_msgs/PoseWithCovarianceStamped pose\n", TAG),
        **get_types_from_msg("std_msgs/Header header\napriltag_ros/AprilTagDetection[] detections\n", f"{TAG}Array"),
    }
)


class Entry(NamedTuple):
    """One message of a log."""

    topic: str
    type_name: str
    value: Any
    log_time_ns: int


class Factory:
    """Makes messages of ROS 2 or ROS 1."""

    def __init__(self, *, ros1: bool = False) -> None:
        self.ros1 = ros1
        self.store = ROS1 if ros1 else typestore()

    def make(self, type_name: str, **fields: Any) -> Any:
        return self.store.types[type_name](**fields)

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", sec=stamp_ns // SECOND, nanosec=stamp_ns % SECOND)
        extra = {"seq": 7} if self.ros1 else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id, **extra)

    def image(
        self, stamp_ns: int, pixels: npt.NDArray[Any], encoding: str, *, frame_id: str = "camera", padding: int = 0,
        big_endian: bool = False,
    ) -> Any:  # fmt: skip
        stored = pixels.astype(pixels.dtype.newbyteorder(">" if big_endian else "<"))
        rows = stored.view(np.uint8).reshape(pixels.shape[0], -1)
        data = np.pad(rows, ((0, 0), (0, padding)), constant_values=171)
        return self.make(
            "sensor_msgs/msg/Image", header=self.header(stamp_ns, frame_id), height=pixels.shape[0],
            width=pixels.shape[1], encoding=encoding, is_bigendian=int(big_endian), step=data.shape[1],
            data=data.reshape(-1),
        )  # fmt: skip

    def camera_info(
        self, stamp_ns: int, size: tuple[int, int], *, k: Sequence[float] = (50, 0, 5.5, 0, 60, 3.5, 0, 0, 1),
        d: Sequence[float] = (), model: str = "plumb_bob", p: Sequence[float] = (0,) * 12,
        binning: tuple[int, int] = (0, 0), roi: tuple[int, int, int, int] = (0, 0, 0, 0),
    ) -> Any:  # fmt: skip
        """A CameraInfo; ``roi`` is (x, y, width, height)."""
        matrices = {"d": np.array(d, float), "k": np.array(k, float), "r": np.eye(3).ravel(), "p": np.array(p, float)}
        if self.ros1:
            matrices = {name.upper(): value for name, value in matrices.items()}
        region = self.make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=roi[0], y_offset=roi[1], width=roi[2], height=roi[3],
            do_rectify=False,
        )  # fmt: skip
        return self.make(
            "sensor_msgs/msg/CameraInfo", header=self.header(stamp_ns, "camera"), height=size[1], width=size[0],
            distortion_model=model, binning_x=binning[0], binning_y=binning[1], roi=region, **matrices,
        )  # fmt: skip

    def compressed_image(self, stamp_ns: int, data: bytes, form: str, *, frame_id: str = "camera") -> Any:
        return self.make(
            "sensor_msgs/msg/CompressedImage", header=self.header(stamp_ns, frame_id), format=form,
            data=np.frombuffer(data, np.uint8),
        )  # fmt: skip

    def scan(
        self, stamp_ns: int, ranges: Sequence[float], *, angle_min: float = 0.0, angle_increment: float = 0.25,
        limits: tuple[float, float] = (0.0, 100.0), frame_id: str = "lidar",
    ) -> Any:  # fmt: skip
        return self.make(
            "sensor_msgs/msg/LaserScan", header=self.header(stamp_ns, frame_id), angle_min=angle_min,
            angle_max=angle_min + angle_increment * (len(ranges) - 1), angle_increment=angle_increment,
            time_increment=0.0, scan_time=0.0, range_min=limits[0], range_max=limits[1],
            ranges=np.array(ranges, np.float32), intensities=np.zeros(0, np.float32),
        )  # fmt: skip

    def pose(self, position: Sequence[float], quaternion: Sequence[float] = IDENTITY) -> Any:
        return self.make(
            "geometry_msgs/msg/Pose",
            position=self.make("geometry_msgs/msg/Point", **dict(zip("xyz", map(float, position), strict=True))),
            orientation=self.make(
                "geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, quaternion), strict=True))
            ),
        )

    def odometry(
        self, stamp_ns: int, position: Sequence[float], quaternion: Sequence[float] = IDENTITY, *,
        frame_id: str = "map", child: str = "base_link",
    ) -> Any:  # fmt: skip
        zero = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        return self.make(
            "nav_msgs/msg/Odometry",
            header=self.header(stamp_ns, frame_id),
            child_frame_id=child,
            pose=self.make(
                "geometry_msgs/msg/PoseWithCovariance", pose=self.pose(position, quaternion), covariance=np.zeros(36)
            ),
            twist=self.make(
                "geometry_msgs/msg/TwistWithCovariance",
                twist=self.make("geometry_msgs/msg/Twist", linear=zero, angular=zero),
                covariance=np.zeros(36),
            ),
        )

    def pose_stamped(
        self, stamp_ns: int, position: Sequence[float], quaternion: Sequence[float] = IDENTITY, *, frame_id: str = "map"
    ) -> Any:
        return self.make(
            "geometry_msgs/msg/PoseStamped", header=self.header(stamp_ns, frame_id),
            pose=self.pose(position, quaternion),
        )  # fmt: skip

    def pose_with_covariance(self, stamp_ns: int, position: Sequence[float], *, frame_id: str = "map") -> Any:
        pose = self.make(
            "geometry_msgs/msg/PoseWithCovariance", pose=self.pose(position), covariance=np.zeros(36)
        )  # fmt: skip
        return self.make(
            "geometry_msgs/msg/PoseWithCovarianceStamped", header=self.header(stamp_ns, frame_id), pose=pose
        )

    def path(self, stamp_ns: int, poses: Sequence[Any], *, frame_id: str = "map") -> Any:
        """A path of stamped poses."""
        return self.make("nav_msgs/msg/Path", header=self.header(stamp_ns, frame_id), poses=list(poses))

    def tf(self, *edges: tuple[str, str, int, Sequence[float], Sequence[float]]) -> Any:
        transforms = []
        for parent, child, stamp_ns, translation, rotation in edges:
            value = self.make(
                "geometry_msgs/msg/Transform",
                translation=self.make(
                    "geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, translation), strict=True))
                ),
                rotation=self.make(
                    "geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, rotation), strict=True))
                ),
            )
            transforms.append(
                self.make(
                    "geometry_msgs/msg/TransformStamped",
                    header=self.header(stamp_ns, parent),
                    child_frame_id=child,
                    transform=value,
                )
            )
        return self.make("tf2_msgs/msg/TFMessage", transforms=transforms)

    def fix(
        self, stamp_ns: int, geodetic: Sequence[float], *, sigma: float | None = 1.0, status: int = 0,
        frame_id: str = "camera",
    ) -> Any:  # fmt: skip
        """A NavSatFix; the standard deviation of its height is twice ``sigma``."""
        latitude, longitude, altitude = map(float, geodetic)
        diagonal = (0.0,) * 3 if sigma is None else (sigma**2, sigma**2, 4 * sigma**2)
        return self.make(
            "sensor_msgs/msg/NavSatFix", header=self.header(stamp_ns, frame_id),
            status=self.make("sensor_msgs/msg/NavSatStatus", status=status, service=1), latitude=latitude,
            longitude=longitude, altitude=altitude, position_covariance=np.diag(diagonal).ravel(),
            position_covariance_type=0 if sigma is None else 2,
        )  # fmt: skip

    def imu(
        self, stamp_ns: int, angular_velocity: Sequence[float], acceleration: Sequence[float] = (0.0, 0.0, 9.81), *,
        frame_id: str = "imu", unmeasured: Sequence[str] = (),
    ) -> Any:  # fmt: skip
        """An Imu without orientation; ``unmeasured`` names fields with a covariance of -1."""

        def vector(xyz: Sequence[float]) -> Any:
            return self.make("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, xyz), strict=True)))

        covariances = {
            f"{name}_covariance": np.array([-1.0 if name in ("orientation", *unmeasured) else 0.0] + 8 * [0.0])
            for name in ("orientation", "angular_velocity", "linear_acceleration")
        }
        return self.make(
            "sensor_msgs/msg/Imu", header=self.header(stamp_ns, frame_id),
            orientation=self.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
            angular_velocity=vector(angular_velocity), linear_acceleration=vector(acceleration), **covariances,
        )  # fmt: skip

    def tags(self, stamp_ns: int, positions: Mapping[int, Sequence[float]], *, frame_id: str = "camera") -> Any:
        """Detected tags of ROS 1 at positions in the camera's frame, with the camera's rotation."""
        detections = [
            self.make(
                TAG, id=np.array([number], np.int32), size=np.array([0.2]),
                pose=self.pose_with_covariance(stamp_ns, position, frame_id=frame_id),
            )
            for number, position in positions.items()
        ]  # fmt: skip
        return self.make(f"{TAG}Array", header=self.header(stamp_ns, frame_id), detections=detections)

    def label_info(self, stamp_ns: int, names: Mapping[int, str]) -> Any:
        entries = [
            self.make("vision_msgs/msg/VisionClass", class_id=raw, class_name=name) for raw, name in names.items()
        ]
        return self.make(
            "vision_msgs/msg/LabelInfo", header=self.header(stamp_ns, "camera"), class_map=entries, threshold=0.0
        )

    def cloud(
        self, stamp_ns: int, columns: Mapping[str, npt.NDArray[Any]], *, frame_id: str = "lidar", gap: int = 0,
        height: int = 1, row_padding: int = 0, big_endian: bool = False,
    ) -> Any:  # fmt: skip
        """A cloud with the columns after ``gap`` unused bytes in every point, and padding after every row."""
        datatypes = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
        order = ">" if big_endian else "<"
        fields, offset, length = [], gap, len(next(iter(columns.values())))
        for name, column in columns.items():
            kind = column.dtype.str[1:]
            fields.append(
                self.make("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=datatypes[kind], count=1)
            )
            offset += column.dtype.itemsize
        points = np.zeros(
            length,
            dtype=np.dtype(
                {
                    "names": list(columns), "formats": [order + c.dtype.str[1:] for c in columns.values()],
                    "offsets": [f.offset for f in fields], "itemsize": offset,
                }
            ),
        )  # fmt: skip
        for name, column in columns.items():
            points[name] = column
        rows = points.view(np.uint8).reshape(height, -1)
        data = np.pad(rows, ((0, 0), (0, row_padding)))
        return self.make(
            "sensor_msgs/msg/PointCloud2", header=self.header(stamp_ns, frame_id), height=height,
            width=length // height, fields=fields, is_bigendian=big_endian, point_step=offset,
            row_step=data.shape[1], data=data.reshape(-1), is_dense=False,
        )  # fmt: skip


ros2 = Factory()


class Row(NamedTuple):
    """One message of a log as bytes, with the definition of its type."""

    topic: str
    schema_name: str
    schema_encoding: str
    schema: bytes
    encoding: str
    data: bytes
    log_time_ns: int

    def message(self, path: Path = Path("a.mcap")) -> RawMessage:
        """The message as a log that holds it would give it."""
        is_ros = self.schema_encoding.startswith("ros")
        name = normalise_type_name(self.schema_name) if is_ros else self.schema_name
        channel = Channel(self.topic, name, self.encoding, self.schema_encoding, self.schema)
        return RawMessage(path, channel, self.log_time_ns, self.data)


def ros_row(entry: Entry) -> Row:
    """A ROS 2 message as bytes."""
    definition, _ = typestore().generate_msgdef(entry.type_name, ros_version=2)
    data = bytes(typestore().serialize_cdr(entry.value, entry.type_name))
    return Row(entry.topic, entry.type_name, "ros2msg", definition.encode(), "cdr", data, entry.log_time_ns)


def ros1_row(entry: Entry) -> Row:
    """A ROS 1 message as bytes."""
    definition, _ = ROS1.generate_msgdef(entry.type_name, ros_version=1)
    data = bytes(ROS1.serialize_ros1(entry.value, entry.type_name))
    return Row(entry.topic, entry.type_name, "ros1msg", definition.encode(), "ros1", data, entry.log_time_ns)


FOXGLOVE_ENCODINGS = ("cdr", "protobuf", "json")
# The types of the fields that are messages, in the SDK and in foxglove_msgs.
_PARTS = {
    "timestamp": ("Timestamp", "builtin_interfaces/msg/Time"), "pose": ("Pose", "geometry_msgs/msg/Pose"),
    "position": ("Vector3", "geometry_msgs/msg/Point"), "orientation": ("Quaternion", "geometry_msgs/msg/Quaternion"),
    "translation": ("Vector3", "geometry_msgs/msg/Vector3"), "rotation": ("Quaternion", "geometry_msgs/msg/Quaternion"),
    "fields": ("PackedElementField", "foxglove_msgs/msg/PackedElementField"),
    "transforms": ("FrameTransform", "foxglove_msgs/msg/FrameTransform"),
}  # fmt: skip
_NUMERIC_TYPES = ("Unknown", "Uint8", "Int8", "Uint16", "Int16", "Uint32", "Int32", "Float32", "Float64")


def foxglove_row(topic: str, name: str, fields: Mapping[str, Any], log_time_ns: int, encoding: str) -> Row:
    """A message of Foxglove's schema ``name`` as foxglove_msgs in CDR, as protobuf by Foxglove's SDK, or as JSON.

    ``fields`` are named and nested as in Foxglove's JSON schemas, with bytes as bytes.
    """
    if encoding == "json":
        text = json.dumps(fields, default=lambda data: base64.b64encode(data).decode())
        return Row(topic, f"foxglove.{name}", "jsonschema", b"{}", "json", text.encode(), log_time_ns)
    if encoding == "protobuf":
        value = _foxglove_value(name, fields)
        schema = value.get_schema()
        return Row(topic, schema.name, schema.encoding, schema.data, "protobuf", value.encode(), log_time_ns)
    type_name = f"foxglove_msgs/msg/{name}"
    definition, _ = FOXGLOVE_ROS2.generate_msgdef(type_name, ros_version=2)
    data = bytes(FOXGLOVE_ROS2.serialize_cdr(_foxglove_msg(type_name, fields), type_name))
    return Row(topic, type_name, "ros2msg", definition.encode(), "cdr", data, log_time_ns)


def foxglove_stamp(stamp_ns: int) -> dict[str, int]:
    """A time as in Foxglove's JSON schemas."""
    return {"sec": stamp_ns // SECOND, "nsec": stamp_ns % SECOND}


def foxglove_pose(position: Sequence[float], quaternion: Sequence[float] = IDENTITY) -> dict[str, Any]:
    """A pose as in Foxglove's JSON schemas."""
    return {
        "position": dict(zip("xyz", map(float, position), strict=True)),
        "orientation": dict(zip("xyzw", map(float, quaternion), strict=True)),
    }


def foxglove_transform(
    parent: str, child: str, stamp_ns: int, translation: Sequence[float], rotation: Sequence[float] = IDENTITY
) -> dict[str, Any]:
    """A FrameTransform as in Foxglove's JSON schemas."""
    return {
        "timestamp": foxglove_stamp(stamp_ns), "parent_frame_id": parent, "child_frame_id": child,
        "translation": dict(zip("xyz", map(float, translation), strict=True)),
        "rotation": dict(zip("xyzw", map(float, rotation), strict=True)),
    }  # fmt: skip


def _foxglove_value(name: str, fields: Mapping[str, Any]) -> Any:
    """A message of Foxglove's SDK."""

    def convert(key: str, value: Any) -> Any:
        if name == "PackedElementField" and key == "type":
            return getattr(foxglove.messages.PackedElementFieldNumericType, _NUMERIC_TYPES[value])
        if key in _PARTS and isinstance(value, list):
            return [_foxglove_value(_PARTS[key][0], part) for part in value]
        return _foxglove_value(_PARTS[key][0], value) if key in _PARTS else value

    return getattr(foxglove.messages, name)(**{key: convert(key, value) for key, value in fields.items()})


def _foxglove_msg(type_name: str, fields: Mapping[str, Any]) -> Any:
    """A message of foxglove_msgs."""

    def convert(key: str, value: Any) -> Any:
        if key in _PARTS and isinstance(value, list):
            return [_foxglove_msg(_PARTS[key][1], part) for part in value]
        if key in _PARTS:
            return _foxglove_msg(_PARTS[key][1], value)
        if isinstance(value, bytes):
            return np.frombuffer(value, np.uint8)
        return np.array(value, np.float64) if isinstance(value, list) else value

    names = {"nsec": "nanosec"} if type_name.endswith("/Time") else {name: name.lower() for name in "DKRP"}
    values = {names.get(key, key): convert(key, value) for key, value in fields.items()}
    return FOXGLOVE_ROS2.types[type_name](**values)


def write_rows(path: Path, rows: Iterable[Row]) -> Path:
    """Write messages of any encoding as an MCAP, with the writer of the mcap package."""
    with path.open("wb") as file:
        writer = PlainMcapWriter(file)
        writer.start()
        channels: dict[tuple[str, str], int] = {}
        for row in rows:
            if (row.topic, row.schema_name) not in channels:
                schema = writer.register_schema(row.schema_name, row.schema_encoding, row.schema)
                channels[row.topic, row.schema_name] = writer.register_channel(row.topic, row.encoding, schema)
            channel = channels[row.topic, row.schema_name]
            writer.add_message(channel, row.log_time_ns, row.data, row.log_time_ns)
        writer.finish()
    return path


WIDTH, HEIGHT = 12, 8
NAMES = {1: "ground", 2: "tree", 7: "wall"}


def depth_pixels(index: int) -> npt.NDArray[np.uint16]:
    """The depth image with a number, in millimetres."""
    return (1000 + 10 * index + np.arange(WIDTH * HEIGHT)).reshape(HEIGHT, WIDTH).astype(np.uint16)


def label_pixels(index: int) -> npt.NDArray[np.uint8]:
    """The label image with a number: the raw labels 1, 2, 7 and 255 in turn."""
    return np.array([1, 2, 7, 255], np.uint8)[(np.arange(WIDTH * HEIGHT) + index) % 4].reshape(HEIGHT, WIDTH)


def robot_entries(
    *, num_frames: int = 6, period_ns: int = SECOND // 4, start_ns: int = 100 * SECOND, namespace: str = "",
    labels: bool = True, poses: str = "odometry", factory: Factory = ros2, camera_info: bool = True,
) -> list[Entry]:  # fmt: skip
    """The messages of a robot that drives along x at 1 m/s with a camera 0.5 m above its base.

    ``poses`` is 'odometry', 'tf' or 'none'. Frame i is at ``start_ns + i * period_ns``; poses come at twice that rate.
    """
    prefix = f"{namespace}/" if namespace else ""
    camera, base = f"{prefix}camera", f"{prefix}base_link"
    root = f"/{namespace}" if namespace else ""
    entries = [
        Entry(
            "/tf_static", "tf2_msgs/msg/TFMessage",
            factory.tf((base, camera, start_ns, (0.0, 0.0, 0.5), OPTICAL)), start_ns,
        )
    ]  # fmt: skip
    if labels and not factory.ros1:
        entries.append(
            Entry(f"{root}/label_info", "vision_msgs/msg/LabelInfo", ros2.label_info(start_ns, NAMES), start_ns)
        )
    for half in range(2 * num_frames - 1):
        stamp = start_ns + half * period_ns // 2
        x = (stamp - start_ns) / SECOND
        if poses == "odometry":
            odometry = factory.odometry(stamp, (x, 0, 0), child=base)
            entries.append(Entry(f"{root}/odom", "nav_msgs/msg/Odometry", odometry, stamp))
        elif poses == "tf":
            tf = factory.tf(("map", base, stamp, (x, 0, 0), IDENTITY))
            entries.append(Entry("/tf", "tf2_msgs/msg/TFMessage", tf, stamp))
        if half % 2:
            continue
        index = half // 2
        depth = factory.image(stamp, depth_pixels(index), "16UC1", frame_id=camera)
        entries.append(Entry(f"{root}/camera/depth/image_raw", "sensor_msgs/msg/Image", depth, stamp))
        if labels:
            image = factory.image(stamp, label_pixels(index), "mono8", frame_id=camera)
            entries.append(Entry(f"{root}/camera/labels/image_raw", "sensor_msgs/msg/Image", image, stamp))
        if camera_info:
            info = factory.camera_info(stamp, (WIDTH, HEIGHT))
            entries.append(Entry(f"{root}/camera/depth/camera_info", "sensor_msgs/msg/CameraInfo", info, stamp))
    return entries


def write_mcap(path: Path, entries: Iterable[Entry], *, chunk_size: int = 1 << 20) -> Path:
    """Write messages with the project's own writer."""
    path.unlink(missing_ok=True)
    with RosMcapWriter(path, chunk_size=chunk_size) as writer:
        for entry in entries:
            writer.write(entry.topic, entry.type_name, entry.value, entry.log_time_ns)
    return path


def write_bag(path: Path, entries: Iterable[Entry]) -> Path:
    """Write ROS 1 messages as a bag, with rosbags."""
    with Rosbag1Writer(path) as writer:
        connections: dict[str, Any] = {}
        for topic, type_name, value, log_time_ns in entries:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=ROS1)
            writer.write(connections[topic], log_time_ns, ROS1.serialize_ros1(value, type_name))
    return path


def write_rosbag2(path: Path, entries: Iterable[Entry], *, storage: str = "sqlite3") -> Path:
    """Write ROS 2 messages as a rosbag2 folder, with rosbags."""
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with Rosbag2Writer(path, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for topic, type_name, value, log_time_ns in entries:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=typestore())
            writer.write(connections[topic], log_time_ns, typestore().serialize_cdr(value, type_name))
    return path
