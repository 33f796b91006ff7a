"""Writer of a run's result: one self-contained MCAP file of ROS 2 messages (docs/result-format.md)."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from octoreplay._version import __version__
from octoreplay.config.resolved import ResolvedRun
from octoreplay.config.team_file import dump_team
from octoreplay.errors import OutputError
from octoreplay.io.containers.fingerprint import Fingerprint, fingerprint, log_files
from octoreplay.io.containers.mcap_writer import RosMcapWriter
from octoreplay.io.messages.ros_types import header, message
from octoreplay.io.results.geometry_messages import (
    ADD,
    DELETE,
    LINE_LIST,
    TEXT_VIEW_FACING,
    marker,
    point,
    quaternion,
    static_transform,
    transform,
    vector,
)
from octoreplay.log_odds import best_labels, label_probabilities
from octoreplay.records import TEAM, ClassTable, LeafTable, MapState, RobotPose
from octoreplay.run_metrics import PAIR_SHARES, RunSummary, TickMetrics
from octoreplay.transforms import transform_of

FORMAT_VERSION = "2"
"""Version of the result format; it increases with each incompatible change."""
METRICS_TOPIC = "/metrics"
CONTRADICTION_TOPIC = "/contradiction"
FRAMES_TOPIC = "/frames"
GRAPH_TOPIC = "/graph"
TF_TOPIC = "/tf"
STATIC_TF_TOPIC = "/tf_static"

_FLOAT32, _UINT8 = 7, 2
"""sensor_msgs/PointField datatypes."""
VIEW_FIELDS = (
    ("x", "<f4", 0, _FLOAT32),
    ("y", "<f4", 4, _FLOAT32),
    ("z", "<f4", 8, _FLOAT32),
    ("rgb", "<u4", 12, _FLOAT32),
    ("label", "u1", 24, _UINT8),
    ("size", "<f4", 16, _FLOAT32),
    ("probability", "<f4", 20, _FLOAT32),
)
"""Fields of a point in a map view: name, NumPy format, offset, PointField datatype. ``rgb`` holds the integer
0x00RRGGBB and is declared as float32, a convention of PCL that viewers follow."""
VIEW_DTYPE = np.dtype(
    {
        "names": [name for name, *_ in VIEW_FIELDS],
        "formats": [number_format for _, number_format, *_ in VIEW_FIELDS],
        "offsets": [offset for *_, offset, _ in VIEW_FIELDS],
        "itemsize": 28,
    }
)


def map_state_topic(robot_id: str) -> str:
    """Return the topic of a robot's stored map states."""
    return f"/{robot_id}/map_state"


def evidence_topic(robot_id: str) -> str:
    """Return the topic of a robot's stored evidence."""
    return f"/{robot_id}/evidence"


def map_view_topic(robot_id: str) -> str:
    """Return the topic of a robot's map for viewers."""
    return f"/{robot_id}/map"


def pose_topic(robot_id: str) -> str:
    """Return the topic of a robot's sensor pose."""
    return f"/{robot_id}/pose"


def packet_topic(robot_id: str) -> str:
    """Return the topic of the packets that a robot sent."""
    return f"/{robot_id}/packet"


def partial_path(path: Path) -> Path:
    """Return the path of a result until it is complete: ``x.partial.mcap`` for ``x.mcap``."""
    stem = path.stem if path.suffix == ".mcap" else path.name
    return path.with_name(f"{stem}.partial.mcap")


class ResultWriter:
    """Writes a result to a temporary file, which ``complete`` renames; a context manager.

    Without ``complete`` the file is removed at exit. After a KeyboardInterrupt it is finished instead and kept as
    ``x.partial.mcap``. ``config`` is resolved: all robots and topics are given. Equal calls give equal bytes: no
    wall-clock time and nothing machine-dependent is written.

    Raises OutputError where the result cannot be written or would overwrite an input, and InputError where an input
    cannot be read for its fingerprint.
    """

    def __init__(self, path: Path, config: ResolvedRun) -> None:
        self.path = path
        self.partial_path = partial_path(path)
        self._config = config
        self._class_table = config.classes
        self._started = False
        self._open = True
        self._check_path()
        inputs = self._inputs()
        self._writer = RosMcapWriter(self.partial_path)
        try:
            self._write_description(inputs)
        except BaseException:
            self.discard()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._open:
            return
        if kind is not None and issubclass(kind, KeyboardInterrupt):
            self.keep_partial()
        else:
            self.discard()

    def write_state(self, state: MapState) -> None:
        """Write one robot's map, a key frame or a delta, to ``/<robot>/map_state``."""
        self._write_state(map_state_topic(state.robot_id), state)

    def write_evidence(self, state: MapState) -> None:
        """Write one robot's evidence, a key frame or a delta, to ``/<robot>/evidence``."""
        self._write_state(evidence_topic(state.robot_id), state)

    def _write_state(self, topic: str, state: MapState) -> None:
        self._start(state.stamp_ns)
        type_name = "octoreplay_msgs/msg/MapState"
        value = message(
            type_name, header=header(state.stamp_ns, state.frame_id), robot_id=state.robot_id, tick=state.tick,
            sequence=state.sequence, base_sequence=state.base_sequence, is_key_frame=state.is_key_frame,
            num_robots=state.num_robots, data=np.frombuffer(state.data, dtype=np.uint8),
        )  # fmt: skip
        self._writer.write(topic, type_name, value, state.stamp_ns)

    def write_metrics(self, metrics: TickMetrics) -> None:
        """Write the team's metrics after one tick to ``/metrics``, those of pairs to ``/contradiction``."""
        self._start(metrics.stamp_ns)
        fields = {item.name: getattr(metrics, item.name) for item in dataclasses.fields(metrics)}
        del fields["stamp_ns"], fields["pairs"], fields["places"]
        fields["robots"] = [message("octoreplay_msgs/msg/RobotMetrics", **vars(robot)) for robot in metrics.robots]
        fields["links"] = [message("octoreplay_msgs/msg/LinkMetrics", **vars(link)) for link in metrics.links]
        type_name = "octoreplay_msgs/msg/TickMetrics"
        value = message(type_name, header=header(metrics.stamp_ns, TEAM), **fields)
        self._writer.write(METRICS_TOPIC, type_name, value, metrics.stamp_ns)
        pairs = [message("octoreplay_msgs/msg/PairMetrics", **vars(pair)) for pair in metrics.pairs]
        type_name = "octoreplay_msgs/msg/Contradiction"
        value = message(
            type_name, header=header(metrics.stamp_ns, TEAM), tick=metrics.tick,
            **{name: getattr(metrics, name) for name in PAIR_SHARES}, pairs=pairs,
        )  # fmt: skip
        self._writer.write(CONTRADICTION_TOPIC, type_name, value, metrics.stamp_ns)
        if metrics.places:
            self._write_places(metrics)

    def _write_places(self, metrics: TickMetrics) -> None:
        """Write the frames of all robots to ``/frames``, and those of joined robots to ``/tf``."""
        robots, transforms = [], []
        for place in metrics.places:
            T = transform_of(place.T_frame_map)
            position, rotation = vector(T), quaternion(T)
            pose = message("geometry_msgs/msg/Pose", position=point(position), orientation=rotation)
            robots.append(
                message("octoreplay_msgs/msg/RobotFrame", robot_id=place.robot_id, frame_id=place.frame_id, pose=pose)
            )
            own = f"{place.robot_id}/map"
            if place.frame_id != own:
                transforms.append(transform(metrics.stamp_ns, place.frame_id, own, position, rotation))
        type_name = "octoreplay_msgs/msg/Frames"
        value = message(type_name, header=header(metrics.stamp_ns, TEAM), tick=metrics.tick, robots=robots)
        self._writer.write(FRAMES_TOPIC, type_name, value, metrics.stamp_ns)
        if transforms:
            self._write_transforms(TF_TOPIC, metrics.stamp_ns, transforms)

    def write_view(self, robot_id: str, stamp_ns: int, points: npt.NDArray[Any], frame_id: str = TEAM) -> None:
        """Write the ``view_points`` of one robot's map as a point cloud for viewers to ``/<robot>/map``."""
        self._start(stamp_ns)
        type_name = "sensor_msgs/msg/PointCloud2"
        fields = [
            message("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=datatype, count=1)
            for name, _, offset, datatype in VIEW_FIELDS
        ]
        value = message(
            type_name, header=header(stamp_ns, frame_id), height=1, width=len(points), fields=fields,
            is_bigendian=False, point_step=VIEW_DTYPE.itemsize, row_step=VIEW_DTYPE.itemsize * len(points),
            data=points.view(np.uint8).reshape(-1), is_dense=True,
        )  # fmt: skip
        self._writer.write(map_view_topic(robot_id), type_name, value, stamp_ns)

    def write_poses(self, stamp_ns: int, poses: Sequence[RobotPose]) -> None:
        """Write the robots' sensor poses to ``/<robot>/pose`` and ``/tf`` (frame -> ``<robot>/sensor``)."""
        self._start(stamp_ns)
        transforms = []
        for pose in poses:
            position, rotation = vector(pose.T_team_sensor), quaternion(pose.T_team_sensor)
            type_name = "geometry_msgs/msg/PoseStamped"
            value = message(
                type_name,
                header=header(stamp_ns, pose.frame_id),
                pose=message("geometry_msgs/msg/Pose", position=point(position), orientation=rotation),
            )
            self._writer.write(pose_topic(pose.robot_id), type_name, value, stamp_ns)
            transforms.append(transform(stamp_ns, pose.frame_id, f"{pose.robot_id}/sensor", position, rotation))
        if transforms:
            self._write_transforms(TF_TOPIC, stamp_ns, transforms)

    def write_graph(self, stamp_ns: int, links: Sequence[tuple[str, str]], poses: Sequence[RobotPose]) -> None:
        """Write the tick's links (pairs of robots, each once) as lines and the robots' names to ``/graph``."""
        self._start(stamp_ns)
        positions = {pose.robot_id: vector(pose.T_team_sensor) for pose in poses}
        frames = {pose.robot_id: pose.frame_id for pose in poses}
        lines = []
        # A link joins robots in one frame; a frame without links deletes the lines of an earlier tick.
        for number, frame_id in enumerate(dict.fromkeys(frames.values()) or [TEAM]):
            ends = [end for link in links if positions.keys() >= set(link) for end in link if frames[end] == frame_id]
            lines.append(
                marker(
                    stamp_ns,
                    "links",
                    number,
                    LINE_LIST,
                    action=ADD if ends else DELETE,
                    points=[point(positions[end]) for end in ends],
                    scale=(0.08, 0.0, 0.0),
                    frame_id=frame_id,
                )
            )
        names = [
            marker(
                stamp_ns, "robots", index, TEXT_VIEW_FACING, text=robot_id, scale=(0.0, 0.0, 0.6),
                position=positions[robot_id] + (0.0, 0.0, 0.8), frame_id=frames[robot_id],
            )
            for index, robot_id in enumerate(robot.robot_id for robot in self._config.robots)
            if robot_id in positions
        ]  # fmt: skip
        type_name = "visualization_msgs/msg/MarkerArray"
        self._writer.write(GRAPH_TOPIC, type_name, message(type_name, markers=[*lines, *names]), stamp_ns)

    def write_packet(self, robot_id: str, stamp_ns: int, tick: int, data: bytes) -> None:
        """Write one packet as sent to ``/<robot>/packet``."""
        self._start(stamp_ns)
        type_name = "octoreplay_msgs/msg/Packet"
        value = message(
            type_name, header=header(stamp_ns, TEAM), sender=robot_id, tick=tick,
            data=np.frombuffer(data, dtype=np.uint8),
        )  # fmt: skip
        self._writer.write(packet_topic(robot_id), type_name, value, stamp_ns)

    def complete(self, summary: RunSummary) -> None:
        """Write the summary of the run, finish the file and rename it to its final name."""
        try:
            self._writer.write_metadata("summary", _summary_values(summary))
            self._writer.finish()
            self.partial_path.replace(self.path)
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written: {error.strerror}") from error
        self._open = False

    def keep_partial(self) -> None:
        """Finish the file under its temporary name, so that it can be opened, without replacing the final file."""
        self._writer.write_metadata("summary", {"complete": "false", "stop_reason": "interrupted"})
        self._writer.finish()
        self._open = False

    def discard(self) -> None:
        """Remove the unfinished file."""
        self._open = False
        with contextlib.suppress(OutputError):
            self._writer.finish()
        with contextlib.suppress(OSError):
            self.partial_path.unlink()

    def _check_path(self) -> None:
        """Raise OutputError for a path that cannot be written, or that is an input of the run."""
        if self.path.is_dir():
            raise OutputError(f"{self.path}: is a folder; give a file name such as {self.path / 'out.mcap'}")
        if not self.path.parent.is_dir():
            raise OutputError(f"{self.path}: the folder '{self.path.parent}' does not exist")
        for robot in self._config.robots:
            for path in robot.files:
                for file in log_files(path):
                    if file.resolve() in (self.path.resolve(), self.partial_path.resolve()):
                        raise OutputError(f"{self.path}: is an input of robot '{robot.robot_id}'; name another output")

    def _inputs(self) -> dict[str, Fingerprint]:
        """Return the fingerprints of all input files by absolute path, in the order of the robots."""
        whole = self._config.output.hash
        files = [file for robot in self._config.robots for path in robot.files for file in log_files(path)]
        return {str(file.resolve()): fingerprint(file, whole=whole) for file in files}

    def _write_description(self, inputs: dict[str, Fingerprint]) -> None:
        """Write the metadata: format, configuration, classes and fingerprints of the inputs."""
        config, folder = self._config, self.path.parent.resolve()
        robots = tuple(robot.with_absolute_paths() for robot in config.robots)
        self._writer.write_metadata(
            "octoreplay",
            {
                "version": __version__,
                "format_version": FORMAT_VERSION,
                "frame": TEAM,
                "robots": json.dumps([robot.robot_id for robot in robots]),
                "resolution": repr(config.map.resolution),
                "prior": repr(config.map.prior(self._class_table.num_classes)),
                "rule": config.consensus.rule,
            },
        )
        used = dataclasses.replace(config, robots=robots, sensor=config.effective_sensor)
        self._writer.write_metadata("config", {"team_file": dump_team(used, folder, with_defaults=True)})
        classes = [{"id": 0, "name": "free", "color": None}]
        classes += [{"id": c.class_id, "name": c.name, "color": list(c.color)} for c in self._class_table.classes]
        self._writer.write_metadata("classes", {"classes": json.dumps(classes)})
        self._writer.write_metadata(
            "inputs",
            {
                _relative(path, folder): json.dumps(
                    {"size": entry.size, "method": entry.method, "fingerprint": entry.value}
                )
                for path, entry in inputs.items()
            },
        )

    def _start(self, stamp_ns: int) -> None:
        """Before the first message, write the robots' map frames, which viewers need at or before other messages."""
        if self._started:
            return
        self._started = True
        if not self._config.alignment.is_on_air:
            transforms = [static_transform(stamp_ns, robot) for robot in self._config.robots]
            self._write_transforms(STATIC_TF_TOPIC, stamp_ns, transforms)

    def _write_transforms(self, topic: str, stamp_ns: int, transforms: list[Any]) -> None:
        type_name = "tf2_msgs/msg/TFMessage"
        self._writer.write(topic, type_name, message(type_name, transforms=transforms), stamp_ns)


def view_points(leaves: LeafTable, classes: ClassTable) -> npt.NDArray[Any]:
    """Return the occupied leaves of a map as an array of ``VIEW_DTYPE``, with the colours of the classes."""
    label = best_labels(leaves.log_odds)
    occupied = np.flatnonzero(label)
    label = label[occupied]
    points = np.zeros(len(occupied), dtype=VIEW_DTYPE)
    for axis, name in enumerate("xyz"):
        points[name] = leaves.centers[occupied, axis]
    color = classes.colors.astype(np.uint32)[label.astype(np.intp) - 1]
    points["rgb"] = (color[:, 0] << 16) | (color[:, 1] << 8) | color[:, 2]
    points["label"] = label
    points["size"] = leaves.sizes[occupied]
    points["probability"] = label_probabilities(leaves.log_odds[occupied])
    return points


def _relative(path: str, folder: Path) -> str:
    """Return a path as in the stored team file: relative to the result's folder if it lies below it."""
    return str(Path(path).relative_to(folder)) if Path(path).is_relative_to(folder) else path


def _summary_values(summary: RunSummary) -> dict[str, str]:
    """Return a summary as metadata, with numbers and lists as JSON; without the wall time, which differs by run."""
    values = {"complete": "true"}
    for item in dataclasses.fields(summary):
        if item.name in ("wall_seconds", "last", "links", "frame_counts", "joins"):
            continue
        value = getattr(summary, item.name)
        values[item.name] = value if isinstance(value, str) else json.dumps(value)
    if summary.joins:
        values["joins"] = json.dumps([dataclasses.asdict(join) for join in summary.joins])
    values["links"] = json.dumps([dataclasses.asdict(link) for link in summary.links])
    counts = {robot_id: dataclasses.asdict(count) for robot_id, count in summary.frame_counts.items()}
    values["frame_counts"] = json.dumps(counts)
    return values
