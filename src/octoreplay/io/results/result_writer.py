"""Writer of a run's result: one self-contained MCAP file of ROS 2 messages (docs/result-format.md)."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from octoreplay import interrupts
from octoreplay.config.fields import path_problem
from octoreplay.config.resolved import ResolvedRun
from octoreplay.errors import ConfigError, OutputError
from octoreplay.io.containers.fingerprint import Fingerprint, fingerprint, log_files
from octoreplay.io.containers.mcap_writer import RosMcapWriter, Written
from octoreplay.io.messages.ros_types import header, message
from octoreplay.io.output_file import locked, publish, sync_folder, temporary_path, writing
from octoreplay.io.results import tile_files
from octoreplay.io.results.geometry_messages import (
    point,
    quaternion,
    static_transform,
    transform,
    vector,
)
from octoreplay.io.results.map_messages import CLOUD, GRID, OCTOMAP, cloud_message, grid_message, octomap_message
from octoreplay.io.results.markers import graph_markers, map_markers
from octoreplay.io.results.occupancy_grid import Grid
from octoreplay.io.results.result_metadata import description_of, difference, summary_values
from octoreplay.io.results.tile_files import TileFile, TileList
from octoreplay.io.results.topics import (
    CONTRADICTION_TOPIC,
    FRAMES_TOPIC,
    GRAPH_TOPIC,
    METRICS_TOPIC,
    STATIC_TF_TOPIC,
    TF_TOPIC,
    evidence_topic,
    grid_topic,
    map_state_topic,
    map_view_topic,
    markers_topic,
    octomap_topic,
    packet_topic,
    pose_topic,
)
from octoreplay.io.results.unfinished import PARTIAL_SUFFIX, has_messages
from octoreplay.records import TEAM, MapState, RobotPose
from octoreplay.run_metrics import PAIR_SHARES, RunSummary, TickMetrics
from octoreplay.transforms import transform_of


def partial_path(path: Path) -> Path:
    """Return the path of a result until it is complete: ``x.partial.mcap`` for ``x.mcap``."""
    stem = path.stem if path.suffix == ".mcap" else path.name
    return path.with_name(f"{stem}{PARTIAL_SUFFIX}")


def check_unstarted(path: Path) -> None:
    """Raise OutputError where an earlier run left an unfinished result of this output that holds messages.

    The same for a name that is too long for that of an unfinished result.
    """
    partial = partial_path(path)
    if path_problem(partial) is not None:
        raise OutputError(f"{path}: cannot be written: its name is too long for one ending in {PARTIAL_SUFFIX}")
    with writing(path):
        exists = partial.exists()
    if exists and has_messages(partial):
        raise OutputError(
            f"{partial}: an earlier run left this unfinished result; continue it with --resume, or remove it and start"
            " again with --restart"
        )


class ResultWriter:
    """Writes a result to ``x.partial.mcap``, which ``complete`` renames to ``x.mcap``; a context manager.

    After an error or a KeyboardInterrupt the partial file is finished and kept if it holds a tick, and a note of the
    exception names it; without a tick it is removed. ``config`` is resolved: all robots and topics are given. Equal
    calls give equal bytes: no wall-clock time and nothing machine-dependent is written.

    An existing partial file is an error, unless it holds no message or ``restart`` removes it. With ``continues`` it
    stays as it is until ``take_over`` has copied it. The lock of the output is held until the end. ``inputs`` are the
    fingerprints of the logs where they are known. Raises OutputError where the result cannot be written, is being
    written by another process, or would overwrite an input, and InputError where an input cannot be read for its
    fingerprint.
    """

    def __init__(
        self, path: Path, config: ResolvedRun, *, restart: bool = False, continues: bool = False,
        inputs: Mapping[str, Fingerprint] | None = None,
    ) -> None:  # fmt: skip
        self.path = path
        self.partial_path = partial_path(path)
        self._work_path = temporary_path(self.partial_path) if continues else self.partial_path
        self._config = config
        self._class_table = config.classes
        self._started = False
        self._has_ticks = False
        self._is_kept = False
        self._tiles: tuple[TileFile, ...] = ()
        self._check_path()
        with contextlib.ExitStack() as stack:
            stack.enter_context(locked(path))
            self.inputs = self._inputs() if inputs is None else inputs
            with interrupts.deferred():
                if not restart and not continues:
                    check_unstarted(path)
                with writing(self._work_path):
                    self._work_path.unlink(missing_ok=True)
                self._writer = RosMcapWriter(self._work_path, data_crc=True)
                stack.callback(self._discard)
                for name, values in description_of(config, self.inputs, path.parent.resolve()).items():
                    self._writer.write_metadata(name, values)
                # All that a reader needs besides chunks is safe before the first of them.
                self._writer.sync()
                with writing(path):
                    sync_folder(path.parent)
            self._at_exit = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if value is not None and self._has_ticks:
            self._keep(value)
        self._at_exit.close()

    def sync(self) -> Written:
        """Flush to disk what was written; return what ``take_over`` needs."""
        self._writer.sync()
        return self._writer.written

    def take_over(self, written: Written) -> None:
        """Continue the partial file of an earlier run after its ``sync``, before anything else is written.

        Raises ConfigError where the settings or the inputs of that run were different, and InputError where its file is
        damaged.
        """
        self.check_same(dict(written.metadata))
        self._writer.take_over(self.partial_path, written)
        self._started = self._has_ticks = True
        with interrupts.deferred(), writing(self.partial_path):
            publish(self._work_path, self.partial_path)
            self._work_path = self.partial_path

    @property
    def description(self) -> dict[str, dict[str, str]]:
        """Metadata that describe the run and its inputs, by name."""
        return dict(self._writer.written.metadata)

    def check_same(self, earlier: Mapping[str, Mapping[str, str]]) -> None:
        """Raise ConfigError where an ``earlier`` run, by its description, had other settings or inputs."""
        for name, values in self.description.items():
            if values != earlier[name]:
                raise ConfigError(f"{self.path}: cannot be continued: {difference(name, values, earlier[name])}")

    def write_tiles(self, tiles: TileList) -> None:
        """Write the list of the files that hold the maps, before the first tick."""
        self._writer.write_metadata(tile_files.RECORD, tiles.values())
        self._tiles = tiles.files

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
        self._has_ticks = True
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
        self._writer.write(map_view_topic(robot_id), CLOUD, cloud_message(points, stamp_ns, frame_id), stamp_ns)

    def write_grid(self, robot_id: str, stamp_ns: int, grid: Grid, frame_id: str = TEAM) -> None:
        """Write the occupancy grid of one robot's map to ``/<robot>/grid``."""
        self._start(stamp_ns)
        self._writer.write(grid_topic(robot_id), GRID, grid_message(grid, stamp_ns, frame_id), stamp_ns)

    def write_octomap(self, robot_id: str, stamp_ns: int, nodes: bytes, frame_id: str = TEAM) -> None:
        """Write the nodes of one robot's map as an OctoMap tree to ``/<robot>/octomap``."""
        self._start(stamp_ns)
        value = octomap_message(nodes, self._config.map.resolution, stamp_ns, frame_id)
        self._writer.write(octomap_topic(robot_id), OCTOMAP, value, stamp_ns)

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
        robot_ids = [robot.robot_id for robot in self._config.robots]
        self._write_markers(GRAPH_TOPIC, stamp_ns, graph_markers(stamp_ns, links, poses, robot_ids))

    def write_cubes(self, robot_id: str, stamp_ns: int, points: npt.NDArray[Any], frame_id: str = TEAM) -> None:
        """Write the ``view_points`` of one robot's map as cubes to ``/<robot>/markers``."""
        markers = map_markers(stamp_ns, points, self._class_table, frame_id)
        self._write_markers(markers_topic(robot_id), stamp_ns, markers)

    def _write_markers(self, topic: str, stamp_ns: int, markers: list[Any]) -> None:
        self._start(stamp_ns)
        type_name = "visualization_msgs/msg/MarkerArray"
        self._writer.write(topic, type_name, message(type_name, markers=markers), stamp_ns)

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
        """Write the summary of the run, finish the file and rename it to its final name.

        Files of tiles that only an earlier result of this name listed are removed.
        """
        interrupts.check()
        with interrupts.deferred():
            self._writer.write_metadata("summary", summary_values(summary, self._config, self.path.parent.resolve()))
            self._writer.finish()
            if not self._writer.is_at(self.partial_path):
                raise OutputError(
                    f"{self.path}: cannot be written: {self.partial_path.name} was removed during the run"
                )
            with writing(self.path):
                publish(self.partial_path, self.path)
            tile_files.remove_others(self.path, self._tiles)

    def _keep(self, error: BaseException) -> None:
        """Finish the file under its temporary name where that is possible, and note it in the exception."""
        with interrupts.deferred(), contextlib.suppress(OutputError):
            # After a failed write the file may have no chunk.
            is_of_use = self._writer.is_open or has_messages(self.partial_path)
            if is_of_use and self._writer.is_at(self.partial_path):
                self._is_kept = True
                error.add_note(f"the finished part is in {self.partial_path}")
            if self._writer.is_open:
                self._writer.write_metadata("summary", {"complete": "false", "stop_reason": _stop_reason(error)})
            self._writer.finish()

    def _discard(self) -> None:
        """Close the file, and remove it unless it has its final name or is kept."""
        with contextlib.suppress(OutputError):
            self._writer.finish()
        if not self._is_kept and self._writer.is_at(self._work_path):
            with contextlib.suppress(OSError):
                self._work_path.unlink()

    def _check_path(self) -> None:
        """Raise OutputError for a path that cannot be written, or that is an input of the run."""
        if self.path.name.endswith(PARTIAL_SUFFIX):
            raise OutputError(f"{self.path}: unfinished results end in {PARTIAL_SUFFIX}; name another output")
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
        """Return the fingerprints of all input files by absolute path or URL, in the order of the robots."""
        whole = self._config.output.hash
        files = [file for robot in self._config.robots for path in robot.files for file in log_files(path)]
        return {str(file.resolve()): fingerprint(file, whole=whole) for file in files}

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


def _stop_reason(error: BaseException) -> str:
    """Return the reason that an unfinished result gives for its end."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    return "out of memory" if isinstance(error, MemoryError) else f"error: {error}"
