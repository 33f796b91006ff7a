"""Reader of result files: configuration, classes, metrics, map states and poses (docs/result-format.md)."""

from __future__ import annotations

import dataclasses
import json
import math
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from rosbags.serde import SerdeError
from zstandard import ZstdError

from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import parse_team
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.containers.fingerprint import fingerprint
from octoreplay.io.messages.ros_types import stamp_to_ns, typestore_of
from octoreplay.io.results.result_writer import (
    CONTRADICTION_TOPIC,
    FORMAT_VERSION,
    FRAMES_TOPIC,
    METRICS_TOPIC,
    evidence_topic,
    map_state_topic,
    pose_topic,
)
from octoreplay.records import CENTRAL, ClassTable, Float64Array, FrameCounts, MapState
from octoreplay.run_metrics import (
    FramePlace,
    Join,
    LinkMetrics,
    LinkTotals,
    PairMetrics,
    RobotMetrics,
    RunSummary,
    TickMetrics,
)


class ResultReader:
    """One result file, read lazily; a context manager.

    ``config`` is the run's configuration; its relative log paths are resolved against the result's folder.
    Raises InputError for a file that is missing, cut, damaged or not an octoreplay result.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._file = path.open("rb")
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error
        try:
            self._reader, self._metadata = self._open()
            self._check_kind()
            self.config = self._read_config()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def description(self) -> dict[str, str]:
        """Metadata record ``octoreplay``: version, format_version, frame, robots, resolution, prior, rule."""
        return self._metadata["octoreplay"]

    @property
    def robots(self) -> tuple[str, ...]:
        """Names of the team's robots in their order."""
        return tuple(robot.robot_id for robot in self.config.robots)

    @property
    def class_table(self) -> ClassTable:
        """Occupied classes with their names and colours."""
        if self.config.classes is None:
            raise InputError(f"{self.path}: damaged: the stored configuration has no classes")
        return self.config.classes

    @property
    def is_complete(self) -> bool:
        """False for the result of an interrupted run."""
        return self._metadata.get("summary", {}).get("complete") == "true"

    @property
    def inputs(self) -> dict[str, tuple[int, str, str]]:
        """Size [bytes], method and fingerprint of each input file by its path, in the order of the robots."""
        stored = {name: json.loads(text) for name, text in self._metadata.get("inputs", {}).items()}
        return {name: (entry["size"], entry["method"], entry["fingerprint"]) for name, entry in stored.items()}

    @property
    def prior(self) -> float:
        """Log-odds of each occupied class in an unobserved cell, h_0."""
        return float(self.description["prior"])

    def metrics(self) -> list[TickMetrics]:
        """Return the metrics of all ticks, in order; without pairs in results that do not hold them."""
        pairs = {
            int(value.tick): tuple(PairMetrics(**_fields(PairMetrics, pair)) for pair in value.pairs)
            for _, value in self._messages(CONTRADICTION_TOPIC)
        }
        places = self.places()
        return [
            _tick_metrics(value, pairs.get(int(value.tick), ()), places.get(int(value.tick), ()))
            for _, value in self._messages(METRICS_TOPIC)
        ]

    def places(self) -> dict[int, tuple[FramePlace, ...]]:
        """Return the frames of all robots by tick; empty where all maps are in the team's frame."""
        return {
            int(value.tick): tuple(_frame_place(robot) for robot in value.robots)
            for _, value in self._messages(FRAMES_TOPIC)
        }

    def summary(self, metrics: Sequence[TickMetrics]) -> RunSummary:
        """Return the summary of the run. The wall time is not stored and is NaN.

        For an interrupted run the summary is computed from ``metrics``, without frame counts and warnings.
        Raises InputError where no tick is stored.
        """
        if not metrics:
            raise InputError(f"{self.path}: holds no tick; the run was interrupted before its first one")
        stored = self._metadata.get("summary", {})
        if not self.is_complete:
            return _summary_from_metrics(metrics, stored.get("stop_reason", "cut off"))
        names = {item.name for item in dataclasses.fields(RunSummary)}
        values: dict[str, Any] = {
            name: text if name == "stop_reason" else json.loads(text) for name, text in stored.items() if name in names
        }
        values["warnings"] = tuple(values["warnings"])
        values["joins"] = tuple(Join(**{**join, "moved": tuple(join["moved"])}) for join in values.get("joins", ()))
        values["links"] = tuple(LinkMetrics(**link) for link in values["links"])
        values["frame_counts"] = {robot: _frame_counts(count) for robot, count in values["frame_counts"].items()}
        return RunSummary(**values, wall_seconds=math.nan, last=metrics[-1])

    def state_times(self, robot_id: str, *, evidence: bool = False) -> list[tuple[int, int]]:
        """Return (tick, stamp_ns) of a robot's stored maps, or of its stored evidence, in order."""
        return [
            (int(value.tick), stamp_to_ns(value.header.stamp))
            for _, value in self._messages(self._state_topic(robot_id, evidence))
        ]

    def state_stamp(self, robot_id: str, tick: int, *, evidence: bool = False) -> int | None:
        """Return the stamp [ns] of a robot's map or evidence stored at a tick, or None. Raises as ``states``."""
        topic = self._state_topic(robot_id, evidence)
        for first_ns, first in self._messages(topic):
            # Ticks are one publish period apart, so only the chunks at the tick's time need be read.
            period_ns = round(self.config.network.publish_period * 1e9)
            expected_ns = first_ns + (tick - int(first.tick)) * period_ns
            for stamp_ns, value in self._messages(topic, start_ns=expected_ns, end_ns=expected_ns + 1):
                if value.tick == tick:
                    return stamp_ns
            break
        return dict(self.state_times(robot_id, evidence=evidence)).get(tick)

    def states(self, robot_id: str, until_ns: int | None = None, *, evidence: bool = False) -> list[MapState]:
        """Return the states of a robot's last map, or evidence, with a stamp up to ``until_ns`` (None: the last one).

        The first is a key frame, the others are the deltas from it to that map. Only the chunks that hold them are
        read. Raises InputError for an unknown robot, a time before the first stored map, and a missing state.
        """
        end = None if until_ns is None else until_ns + 1
        chain: list[MapState] = []
        for _, value in self._messages(self._state_topic(robot_id, evidence), end_ns=end, reverse=True):
            state = _map_state(value)
            if chain and state.sequence != chain[-1].base_sequence:
                continue
            chain.append(state)
            if state.is_key_frame:
                return chain[::-1]
        if chain:
            raise InputError(
                f"{self.path}: damaged: state {chain[-1].base_sequence} of robot '{robot_id}' is missing, on which"
                f" state {chain[-1].sequence} builds"
            )
        if robot_id == CENTRAL:
            raise InputError(f"{self.path}: holds no centralised map up to the time asked for; run the logs again")
        if evidence:
            raise InputError(
                f"{self.path}: no evidence of robot '{robot_id}' is stored up to the time asked for; run the logs again"
            )
        raise InputError(f"{self.path}: no map of robot '{robot_id}' is stored up to the time asked for")

    def all_states(self) -> Iterator[MapState]:
        """Yield all stored states of the robots and of the centralised map, in order of time."""
        for _, value in self._messages(*map(map_state_topic, (*self.robots, CENTRAL))):
            yield _map_state(value)

    def poses(self, robot_id: str) -> tuple[list[int], Float64Array]:
        """Return a robot's sensor poses: stamps [ns], and (P, 7) x, y, z, qx, qy, qz, qw in the team's frame."""
        stamps, rows = [], []
        for stamp_ns, value in self._messages(pose_topic(self._known(robot_id))):
            position, turn = value.pose.position, value.pose.orientation
            stamps.append(stamp_ns)
            rows.append((position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w))
        return stamps, np.array(rows, dtype=np.float64).reshape(-1, 7)

    def changed_inputs(self) -> list[str]:
        """Return a sentence for each input file that is missing or has changed since the run."""
        sentences = []
        for name, stored in self.inputs.items():
            path = self.path.parent / name
            if not path.exists():
                sentences.append(f"{path}: input of {self.path.name} is missing")
                continue
            now = fingerprint(path, whole=stored[1] == "sha256")
            if (now.size, now.method, now.value) != stored:
                sentences.append(f"{path}: has changed since {self.path.name} was made from it")
        return sentences

    def _open(self) -> tuple[SeekingReader, dict[str, dict[str, str]]]:
        """Return the container's reader and all metadata records by name."""
        try:
            reader = SeekingReader(self._file, validate_crcs=True)
            return reader, {record.name: dict(record.metadata) for record in reader.iter_metadata()}
        except _DAMAGE as error:
            raise InputError(f"{self.path}: not a finished MCAP file; {_NOT_A_RESULT}") from error

    def _read_config(self) -> RunConfig:
        """Parse the stored configuration."""
        try:
            return parse_team(
                self._metadata["config"]["team_file"], name=str(self.path), folder=self.path.parent,
                defaults={**_FORMER_DEFAULTS, "rule": self.description["rule"]},
            )  # fmt: skip
        except (ConfigError, KeyError) as error:
            raise InputError(f"{self.path}: damaged: its configuration cannot be read: {error}") from error

    def _check_kind(self) -> None:
        """Raise InputError for other MCAP files and for results of another format version."""
        if "octoreplay" not in self._metadata or "config" not in self._metadata:
            raise InputError(f"{self.path}: an MCAP file, but no result of octoreplay; {_NOT_A_RESULT}")
        version = self.description.get("format_version")
        if version != FORMAT_VERSION:
            raise InputError(
                f"{self.path}: result format {version}, this version reads {FORMAT_VERSION}; use octoreplay"
                f" {self.description.get('version')}, which wrote it"
            )

    def _known(self, robot_id: str) -> str:
        """Return the name of a robot or of the centralised map; raise InputError for any other."""
        if robot_id not in (*self.robots, CENTRAL):
            raise InputError(f"{self.path}: robot '{robot_id}' not found; robots: {', '.join(self.robots)}")
        return robot_id

    def _state_topic(self, robot_id: str, evidence: bool) -> str:
        """Return the topic of a robot's maps or evidence; raise InputError for an unknown robot."""
        if evidence and robot_id == CENTRAL:
            raise InputError(f"{self.path}: the centralised map has no evidence; robots: {', '.join(self.robots)}")
        return (evidence_topic if evidence else map_state_topic)(self._known(robot_id))

    def _messages(
        self, *topics: str, start_ns: int | None = None, end_ns: int | None = None, reverse: bool = False
    ) -> Iterator[tuple[int, Any]]:
        """Yield (log time, message) with ``start_ns`` <= log time < ``end_ns`` in order of log time, or in reverse."""
        try:
            for schema, _, record in self._reader.iter_messages(
                topics, starting_at=start_ns, ending_before=end_ns, reverse=reverse
            ):
                name, definition = ("", "") if schema is None else (schema.name, schema.data.decode())
                yield record.log_time, typestore_of(name, definition).deserialize_cdr(record.data, name)
        except _DAMAGE as error:
            raise InputError(f"{self.path}: damaged at topic '{topics[0]}': {error}") from error


_FORMER_DEFAULTS = {"packets": "full", "flow_bits": 4}
"""Parameters of results that do not name all of them, and were written before these defaults changed."""

_DAMAGE = (McapError, ZstdError, SerdeError, struct.error, LookupError, ValueError, OverflowError, MemoryError, OSError)
"""Exceptions raised by reading a damaged file."""


def is_result(path: Path) -> bool:
    """Return True for the file of a result, of any format version; False for other files and folders."""
    if path.suffix.lower() != ".mcap" or not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            names = {record.name for record in SeekingReader(file).iter_metadata()}
    except (OSError, *_DAMAGE):
        return False
    return {"octoreplay", "config"} <= names


_NOT_A_RESULT = "give the OUT.mcap of 'octoreplay run'"


def _frame_place(value: Any) -> FramePlace:
    """Return a FramePlace from its message."""
    position, turn = value.pose.position, value.pose.orientation
    numbers = (position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w)
    return FramePlace(value.robot_id, value.frame_id, tuple(float(number) for number in numbers))


def _tick_metrics(value: Any, pairs: tuple[PairMetrics, ...], places: tuple[FramePlace, ...]) -> TickMetrics:
    """Return TickMetrics from its message, the metrics of the pairs and the frames of the robots."""
    plain = ("tick", "settling", "total_distance", "total_distance_all", "distance_per_leaf",
             "distance_per_cell_and_link", "num_known_cells", "label_disagreement", "max_change")  # fmt: skip
    return TickMetrics(
        stamp_ns=stamp_to_ns(value.header.stamp),
        robots=tuple(RobotMetrics(**_fields(RobotMetrics, robot)) for robot in value.robots),
        links=tuple(LinkMetrics(**_fields(LinkMetrics, link)) for link in value.links),
        pairs=pairs,
        places=places,
        total_distance_published=getattr(value, "total_distance_published", math.nan),
        **{name: getattr(value, name) for name in plain},
    )


def _fields(kind: Any, value: Any) -> dict[str, Any]:
    """Return the fields of the dataclass ``kind`` from the fields of a message with the same names."""
    return {item.name: getattr(value, item.name) for item in dataclasses.fields(kind)}


def _map_state(value: Any) -> MapState:
    """Return a MapState from its message."""
    return MapState(
        robot_id=value.robot_id,
        stamp_ns=stamp_to_ns(value.header.stamp),
        tick=int(value.tick),
        sequence=int(value.sequence),
        base_sequence=int(value.base_sequence),
        is_key_frame=bool(value.is_key_frame),
        data=value.data.tobytes(),
        frame_id=value.header.frame_id,
        num_robots=getattr(value, "num_robots", None),
    )


def _frame_counts(stored: dict[str, Any]) -> FrameCounts:
    """Return FrameCounts from JSON, where keys are text; counts of older versions that are unknown are ignored."""
    by_number = {
        name: {int(number): count for number, count in stored.get(name, {}).items()}
        for name in ("unknown_label_pixels", "unknown_colors")
    }
    known = {item.name for item in dataclasses.fields(FrameCounts)}
    return FrameCounts(**{name: value for name, value in {**stored, **by_number}.items() if name in known})


def _summary_from_metrics(metrics: Sequence[TickMetrics], stop_reason: str) -> RunSummary:
    """Compute the summary of an interrupted run from its metrics."""
    published = [robot for tick in metrics for robot in tick.robots if robot.packet_bytes]

    def mean(name: str) -> float:
        return float(np.mean([getattr(robot, name) for robot in published])) if published else 0.0

    links = LinkTotals()
    for tick in metrics:
        links.add(tick.links)
    return RunSummary(
        num_ticks=len(metrics),
        num_settling_ticks=sum(tick.settling for tick in metrics),
        stop_reason=stop_reason,
        log_seconds=(metrics[-1].stamp_ns - metrics[0].stamp_ns) / 1e9,
        wall_seconds=math.nan,
        last=metrics[-1],
        peak_total_distance=max(tick.total_distance for tick in metrics),
        peak_total_distance_all=max(tick.total_distance_all for tick in metrics),
        mean_packet_bytes=mean("packet_bytes"),
        mean_octree_bytes=mean("octree_bytes"),
        mean_grid_bytes=mean("grid_bytes"),
        total_sent_bytes=sum(robot.sent_bytes for tick in metrics for robot in tick.robots),
        links=links.totals(),
        frame_counts={},
        warnings=(),
    )
