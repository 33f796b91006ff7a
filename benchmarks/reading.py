"""Reading logs: next to a bare loop over the same topics with the same decoders; parts; opening times; memory.

The logs are made on the spot and cached: a 640x480 depth camera at 30 Hz with label images and odometry at 50 Hz, and a
colour camera that a run does not need. Both sides read in one thread and give arrays to another.
"""

from __future__ import annotations

import argparse
import dataclasses
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import Queue
from threading import Thread
from typing import Any

import cv2
import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import Reader as Rosbag2Reader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore
from rounds import Report, Row, arguments, interleave, measured
from scenes import cache_folder

from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.io.messages.sensor_messages import convert
from octoreplay.io.robots.describe import describe
from octoreplay.io.robots.discover import resolve
from octoreplay.io.robots.read_ahead import NUM_AHEAD, ReadAhead
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.sensors.images import decode_depth, decode_labels
from octoreplay.io.sensors.labels import LabelLookup
from octoreplay.records import ClassTable, SemanticClass

PNG = "sensor_msgs/msg/CompressedImage"
SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
WIDTH, HEIGHT, RATE, ODOMETRY_RATE = 640, 480, 30, 50
PART_SECONDS, PART_RATE = 60.0, 1
"""Length of the part read from the middle of a log, and the camera's rate [Hz] in that log: it is long, not large."""
DEPTH, LABELS, COLOR, INFO, ODOM = "/camera/depth", "/camera/labels", "/camera/color", "/camera/camera_info", "/odom"
TYPES = {
    DEPTH: "sensor_msgs/msg/Image", LABELS: "sensor_msgs/msg/Image", COLOR: "sensor_msgs/msg/Image",
    INFO: "sensor_msgs/msg/CameraInfo", ODOM: "nav_msgs/msg/Odometry",
}  # fmt: skip
CLASSES = ClassTable(tuple(SemanticClass(i, f"class {i}", (i, i, i), (i,)) for i in range(1, 9)))
PART_FORMS = ("mcap-zstd", "mcap-none", "db3", "bag-lz4")
FORMS = ("mcap-zstd", "mcap-lz4", "mcap-none", "mcap-png", "db3", "bag-lz4", "bag-none")
READ_MEMORY = """
import resource, sys
sys.path.insert(0, sys.argv[2])
from pathlib import Path
import reading
from octoreplay.io.robots.read_ahead import NUM_AHEAD, ReadAhead
from octoreplay.io.robots.robot_log import RobotLog
config = reading.robot_of(Path(sys.argv[1]))
with RobotLog(config.robots[0], config.time, reading.CLASSES) as log, ReadAhead(log) as source:
    count = sum(1 for _ in source.frames())
print(count, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
"""
"""Reads a log in a fresh process: frames, and the peak of its memory in bytes."""


def main() -> None:
    """Reading next to the bare loop, then a part of a log, then opening times, then memory."""
    options = arguments(__doc__ or "", rounds=5, add=_add_options)
    report = Report("reading", vars(options))
    if not options.only_parts:
        for form in options.form or FORMS:
            _compare_reading(report, form, options)
    for form in options.form or PART_FORMS:
        _compare_parts(report, form, options)
    if not options.only_parts:
        _compare_opening(report, options)
        _measure_memory(report, options)
    report.save(options.json)


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=float, default=20.0, help="length of the logs (default: %(default)s)")
    parser.add_argument("--gigabytes", type=float, default=4.0, help="size of the large log (default: %(default)s)")
    parser.add_argument("--form", action="append", choices=FORMS, help="read only these")
    parser.add_argument(
        "--part-gigabytes", type=float, default=1.0, help="size of the logs read in part (default: %(default)s)"
    )
    parser.add_argument("--only-parts", action="store_true", help="only read parts of logs")


def _compare_reading(report: Report, form: str, options: Any) -> None:
    """Time of RobotLog next to two bare loops over the same file: with its decoders, and with views of the bytes."""
    path = make_log(form, options.seconds)
    config = robot_of(path)
    num_frames = round(options.seconds * RATE)

    def ours() -> float:
        started = time.perf_counter()
        with RobotLog(config.robots[0], config.time, CLASSES) as log, ReadAhead(log) as source:
            assert sum(1 for _ in source.frames()) == num_frames
        return time.perf_counter() - started

    def bare(decode: Callable[[str, Any], Any]) -> float:
        started = time.perf_counter()
        assert sum(1 for topic, _ in _in_a_thread(bare_loop(path, decode)) if topic == DEPTH) == num_frames
        return time.perf_counter() - started

    ours()
    contenders = {"ours": ours, "same": lambda: bare(Decoders()), "views": lambda: bare(_view)}
    times = interleave(contenders, options.rounds)
    for name, title, must in (("same", "the same decoders", 1.5), ("views", "views of the bytes only", None)):
        ratios = [a / b for a, b in zip(times["ours"], times[name], strict=True)]
        report.add(measured(f"{form}: time / bare loop with {title}", ratios, "x", must=must))
    report.add(measured(f"{form}: frames a second", [num_frames / t for t in times["ours"]], "Hz"))


def _compare_parts(report: Report, form: str, options: Any) -> None:
    """Bytes and processor time of a minute from the middle of a log, next to the whole log and the library's range."""
    seconds = options.part_gigabytes * 1e9 / _bytes_per_second(PART_RATE)
    path = make_log(form, seconds, PART_RATE)
    config = robot_of(path)
    first = round(seconds / 2 - PART_SECONDS / 2)
    part = dataclasses.replace(config.time, start=float(first), duration=PART_SECONDS)
    span = (START + first * SECOND, START + round(first + PART_SECONDS) * SECOND)
    num_bytes: dict[str, int] = {}

    def ours(name: str, time_config: Any, num_frames: int) -> float:
        before, started = _num_bytes_read(), time.process_time()
        with RobotLog(config.robots[0], time_config, CLASSES) as log, ReadAhead(log) as source:
            assert sum(1 for _ in source.frames()) == num_frames
        elapsed = time.process_time() - started
        num_bytes[name] = _num_bytes_read() - before
        return elapsed

    def library() -> float:
        before, started = _num_bytes_read(), time.process_time()
        items = _in_a_thread(bare_loop(path, Decoders(), *span))
        assert sum(1 for topic, _ in items if topic == DEPTH) == round(PART_SECONDS * PART_RATE)
        elapsed = time.process_time() - started
        num_bytes["library"] = _num_bytes_read() - before
        return elapsed

    times = interleave(
        {
            "part": lambda: ours("part", part, round(PART_SECONDS * PART_RATE)),
            "whole": lambda: ours("whole", config.time, round(seconds * PART_RATE)),
            "library": library,
        },
        options.rounds,
    )
    title = f"{form}, {_size_of(path) / 1e9:.2f} GB of {seconds:.0f} s, {PART_SECONDS:.0f} s from the middle"
    for name, what in (("part", "bytes read"), ("library", "bytes read by the library's own range")):
        note = f"the whole log: {num_bytes['whole'] / 1e6:.0f} MB"
        report.add(Row(f"{title}: {what}", num_bytes[name] / 1e6, "MB", note=note))
    report.add(measured(f"{title}: processor time", times["part"], "s"))
    for name, what in (("whole", "the whole log"), ("library", "the library's own range")):
        ratios = [a / b for a, b in zip(times["part"], times[name], strict=True)]
        must = 2.0 if name == "library" else 2.0 * (PART_SECONDS + 15.0) / seconds
        report.add(measured(f"{title}: processor time / {what}", ratios, "x", must=must))


def _num_bytes_read() -> int:
    """Bytes that this process has read from files so far (Linux)."""
    line = Path("/proc/self/io").read_text(encoding="ascii").splitlines()[0]
    return int(line.removeprefix("rchar: "))


def _compare_opening(report: Report, options: Any) -> None:
    """``info`` on the large MCAP, and next to the library's own opening on the other containers."""
    long = options.gigabytes * 1e9 / _bytes_per_second()
    large = make_log("mcap-none", long)
    size = large.stat().st_size / 1e9
    report.add(
        measured(
            f"describe a {size:.1f} GB MCAP with summary", [_seconds(lambda: describe([large]))] * 1, "s", must=1.0
        )
    )
    command = [str(Path(sys.executable).with_name("octoreplay")), "info", str(large)]
    seconds = [_seconds(lambda: subprocess.run(command, check=True, capture_output=True)) for _ in range(3)]
    report.add(measured(f"octoreplay info, {size:.1f} GB MCAP with summary, whole process", seconds, "s", must=1.0))
    for form, seconds in (
        ("db3", options.seconds), ("db3", long), ("bag-lz4", options.seconds), ("bag-none", long),
    ):  # fmt: skip
        path = make_log(form, seconds)
        contenders: dict[str, Callable[[], float]] = {
            "ours": lambda path=path: _seconds(lambda: describe([path])),  # type: ignore[misc]
            "library": lambda path=path: _seconds(lambda: _open_library(path)),  # type: ignore[misc]
        }
        times = interleave(contenders, options.rounds)
        extra = [a - b for a, b in zip(times["ours"], times["library"], strict=True)]
        ratios = [a / b for a, b in zip(times["ours"], times["library"], strict=True)]
        note = f"library {1e3 * min(times['library']):.1f} ms, ours {1e3 * min(extra):.1f} ms more"
        what = f"{form}, {_size_of(path) / 1e9:.1f} GB: describe / rosbags' opening"
        report.add(measured(what, ratios, "x", must=2.0, note=note))


def _measure_memory(report: Report, options: Any) -> None:
    """Peak memory of reading a short log and one of several gigabytes."""
    peaks = {}
    for seconds in (options.seconds, options.gigabytes * 1e9 / _bytes_per_second()):
        path = make_log("mcap-none", seconds)
        command = [sys.executable, "-c", READ_MEMORY, str(path), str(Path(__file__).parent)]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        peaks[path] = int(done.stdout.split()[1])
        title = f"peak memory of reading {path.stat().st_size / 1e9:.1f} GB"
        report.add(Row(title, peaks[path] / 1e6, "MB"))
    short, long = peaks.values()
    report.add(Row("the same, long / short", long / short, "x", must=1.1))


def _size_of(path: Path) -> int:
    """Bytes of a log, a folder or a file."""
    return sum(file.stat().st_size for file in (path.iterdir() if path.is_dir() else (path,)))


def _seconds(action: Callable[[], object]) -> float:
    started = time.perf_counter()
    action()
    return time.perf_counter() - started


def _open_library(path: Path) -> None:
    reader: Any = Rosbag1Reader(path) if path.suffix == ".bag" else Rosbag2Reader(path)
    with reader:
        assert reader.message_count


def _bytes_per_second(rate: int = RATE) -> float:
    """Size of one second of an uncompressed log."""
    return float(WIDTH * HEIGHT * (2 + 1 + 3) * rate)


def robot_of(path: Path) -> RunConfig:
    """The log's robot, with topics and frames found."""
    robot = RobotConfig("r", (path,), T_body_sensor=(0.0, 0.0, 0.0, -0.5, 0.5, -0.5, 0.5))
    return resolve(RunConfig((robot,), classes=CLASSES))


def bare_loop(
    path: Path, decode: Callable[[str, Any], Any], start: int | None = None, stop: int | None = None
) -> Iterator[tuple[str, Any]]:
    """The needed messages by the container's own library, in a range of log time: topic and the decoded message."""
    wanted = {DEPTH, LABELS, ODOM}
    store: Any = get_typestore(Stores.ROS1_NOETIC if path.suffix == ".bag" else Stores.ROS2_HUMBLE)
    if path.suffix == ".mcap":
        with path.open("rb") as stream:
            for schema, channel, message in make_reader(stream).iter_messages(
                wanted, starting_at=start, ending_before=stop
            ):
                assert schema is not None
                yield channel.topic, decode(channel.topic, store.deserialize_cdr(message.data, schema.name))
        return
    reader: Any = Rosbag1Reader(path) if path.suffix == ".bag" else Rosbag2Reader(path)
    deserialise = store.deserialize_ros1 if path.suffix == ".bag" else store.deserialize_cdr
    with reader:
        connections = [c for c in reader.connections if c.topic in wanted]
        for connection, _, data in reader.messages(connections, start, stop):
            yield connection.topic, decode(connection.topic, deserialise(data, connection.msgtype))


class Decoders:
    """Decode a message as octoreplay does: depth, class ids or a pose."""

    def __init__(self) -> None:
        self._labels = LabelLookup(CLASSES)

    def __call__(self, topic: str, message: Any) -> Any:
        """The array, or the pose, of a message."""
        if topic == ODOM:
            return convert(TYPES[ODOM], message)
        image: Any = convert(PNG if hasattr(message, "format") else TYPES[DEPTH], message)
        if topic == DEPTH:
            return decode_depth(image, topic)
        return self._labels.of_image(decode_labels(image, topic), topic)


def _view(_: str, message: Any) -> Any:
    """An image as an array, decompressed where it is a PNG; other messages as they are."""
    if hasattr(message, "format"):
        return cv2.imdecode(message.data, cv2.IMREAD_UNCHANGED)
    if hasattr(message, "encoding"):
        kind = np.uint16 if message.encoding == "16UC1" else np.uint8
        return message.data.view(kind).reshape(message.height, message.width)
    return message


def _in_a_thread(items: Iterator[Any]) -> Iterator[Any]:
    """Items made in a thread of their own, as many ahead as octoreplay reads."""
    queue: Queue[Any] = Queue(NUM_AHEAD)
    end = object()

    def run() -> None:
        for item in items:
            queue.put(item)
        queue.put(end)

    Thread(target=run, daemon=True).start()
    while (item := queue.get()) is not end:
        yield item


# --- logs ------------------------------------------------------------------------------------------------------------


def make_log(form: str, seconds: float, rate: int = RATE) -> Path:
    """The log of one robot in one form, made where it is not there yet; ``rate`` is the cameras' [Hz]."""
    suffix = {"db": "", "ba": ".bag"}.get(form[:2], ".mcap")
    at_rate = "" if rate == RATE else f"-{rate}Hz"
    path = cache_folder() / f"reading-{form}-{seconds:g}s{at_rate}{suffix}"
    if not path.exists():
        partial = path.with_name(f"partial-{path.name}")
        if partial.is_file():
            partial.unlink()
        writers = {"db": _write_folder, "ba": _write_bag}
        writers.get(form[:2], _write_mcap)(partial, form, seconds, rate)
        partial.rename(path)
    return path


def _write_mcap(path: Path, form: str, seconds: float, rate: int) -> None:
    """An MCAP file with chunks of rosbag2's size."""
    compression = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4}.get(form[5:], CompressionType.NONE)
    store = get_typestore(Stores.ROS2_HUMBLE)
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=786_432, compression=compression)
        writer.start(profile="ros2")
        channels = {}
        for topic, type_name, stamp, message in _messages(store, seconds, rate, as_png=form == "mcap-png"):
            if topic not in channels:
                definition = store.generate_msgdef(type_name, ros_version=2)[0].encode()
                schema = writer.register_schema(name=type_name, encoding="ros2msg", data=definition)
                channels[topic] = writer.register_channel(topic=topic, message_encoding="cdr", schema_id=schema)
            data = bytes(store.serialize_cdr(message, type_name))
            writer.add_message(channel_id=channels[topic], log_time=stamp, publish_time=stamp, data=data)
        writer.finish()


def _write_folder(path: Path, _: str, seconds: float, rate: int) -> None:
    """A rosbag2 folder with a sqlite3 file."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Rosbag2Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections = {}
        for topic, type_name, stamp, message in _messages(store, seconds, rate):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=store)
            writer.write(connections[topic], stamp, store.serialize_cdr(message, type_name))


def _write_bag(path: Path, form: str, seconds: float, rate: int) -> None:
    """A ROS 1 bag."""
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Rosbag1Writer(path)
    if form == "bag-lz4":
        writer.set_compression(Rosbag1Writer.CompressionFormat.LZ4)
    with writer:
        connections = {}
        for topic, type_name, stamp, message in _messages(store, seconds, rate, ros1=True):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=store)
            writer.write(connections[topic], stamp, store.serialize_ros1(message, type_name))


def _messages(
    store: Any, seconds: float, rate: int, *, ros1: bool = False, as_png: bool = False
) -> Iterator[tuple[str, str, int, Any]]:
    """Topic, type, stamp and message, in order of time."""
    pictures = [_pictures(k) for k in range(8)]
    times = [(k / ODOMETRY_RATE, False, k) for k in range(round(seconds * ODOMETRY_RATE) + 1)]
    times += [(k / rate, True, k) for k in range(round(seconds * rate))]
    for elapsed, is_picture, k in sorted(times):
        stamp = START + round(elapsed * SECOND)
        if not is_picture:
            yield ODOM, TYPES[ODOM], stamp, _odometry(store, stamp, elapsed, ros1=ros1)
            continue
        if k == 0:
            yield INFO, TYPES[INFO], stamp, _camera_info(store, stamp, ros1=ros1)
        depth, labels, color = pictures[k % len(pictures)]
        for topic, encoding, pixels in ((DEPTH, "16UC1", depth), (LABELS, "mono8", labels), (COLOR, "rgb8", color)):
            if as_png and topic != COLOR:
                yield topic, PNG, stamp, _png(store, stamp, pixels, ros1=ros1)
            else:
                yield topic, TYPES[topic], stamp, _image(store, stamp, encoding, pixels, ros1=ros1)


def _pictures(seed: int) -> tuple[Any, Any, Any]:
    """Depth with noise of millimetres, labels in patches, colours."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    depth = (2000 + 3 * u + 4 * v + rng.normal(0, 6, (HEIGHT, WIDTH))).astype(np.uint16)
    labels = (1 + (u // 90 + v // 80 + seed) % 8).astype(np.uint8)
    color = np.stack([u % 256, v % 256, labels * 20], axis=-1) + rng.integers(0, 6, (HEIGHT, WIDTH, 3))
    return depth, labels, (color % 256).astype(np.uint8)


def _header(store: Any, stamp: int, frame_id: str, *, ros1: bool) -> Any:
    time_message = store.types["builtin_interfaces/msg/Time"](sec=stamp // SECOND, nanosec=stamp % SECOND)
    return store.types["std_msgs/msg/Header"](stamp=time_message, frame_id=frame_id, **({"seq": 0} if ros1 else {}))


def _image(store: Any, stamp: int, encoding: str, pixels: Any, *, ros1: bool) -> Any:
    data = pixels.view(np.uint8).reshape(-1)
    return store.types[TYPES[DEPTH]](
        header=_header(store, stamp, "camera", ros1=ros1), height=HEIGHT, width=WIDTH, encoding=encoding,
        is_bigendian=0, step=data.size // HEIGHT, data=data,
    )  # fmt: skip


def _png(store: Any, stamp: int, pixels: Any, *, ros1: bool) -> Any:
    _, data = cv2.imencode(".png", pixels)
    header = _header(store, stamp, "camera", ros1=ros1)
    return store.types[PNG](header=header, format="png", data=data.reshape(-1))


def _camera_info(store: Any, stamp: int, *, ros1: bool) -> Any:
    matrices = {
        "d": np.zeros(5), "k": np.array([525.0, 0, 319.5, 0, 525.0, 239.5, 0, 0, 1]), "r": np.eye(3).ravel(),
        "p": np.zeros(12),
    }  # fmt: skip
    roi = store.types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return store.types[TYPES[INFO]](
        header=_header(store, stamp, "camera", ros1=ros1), height=HEIGHT, width=WIDTH, distortion_model="plumb_bob",
        binning_x=0, binning_y=0, roi=roi, **{name.upper() if ros1 else name: m for name, m in matrices.items()},
    )  # fmt: skip


def _odometry(store: Any, stamp: int, elapsed: float, *, ros1: bool) -> Any:
    make = store.types
    point = make["geometry_msgs/msg/Point"](x=0.3 * elapsed, y=0.0, z=1.0)
    pose = make["geometry_msgs/msg/Pose"](
        position=point, orientation=make["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    )
    zero = make["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    twist = make["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
    return make[TYPES[ODOM]](
        header=_header(store, stamp, "map", ros1=ros1), child_frame_id="base",
        pose=make["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
        twist=make["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
    )  # fmt: skip


if __name__ == "__main__":
    main()
