"""Reader of result files: configuration, classes, metrics, map states and poses (docs/result-format.md)."""

from __future__ import annotations

import dataclasses
import math
import struct
import typing
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from rosbags.serde import SerdeError
from rosbags.typesys import TypesysError
from zstandard import ZstdError

from octoreplay.config.file_url import input_file
from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import parse_team
from octoreplay.config.yaml_file import load_json
from octoreplay.errors import ConfigError, InputError, OctoreplayError
from octoreplay.io.containers.fingerprint import fingerprint
from octoreplay.io.containers.mcap_records import CRC_KEY, metadata_crc
from octoreplay.io.containers.mcap_writer import RosMcapWriter
from octoreplay.io.messages.ros_types import stamp_to_ns, typestore_of
from octoreplay.io.results.json_records import value_of
from octoreplay.io.results.result_metadata import READABLE_VERSIONS
from octoreplay.io.results.stored_records import fields_of, frame_place, map_state, summary_from_metrics, tick_metrics
from octoreplay.io.results.tile_files import RECORD, TileList
from octoreplay.io.results.topics import (
    CONTRADICTION_TOPIC,
    FRAMES_TOPIC,
    METRICS_TOPIC,
    evidence_topic,
    map_state_topic,
    pose_topic,
)
from octoreplay.io.results.unfinished import UnfinishedReader, container_reader
from octoreplay.records import CENTRAL, ClassTable, Float64Array, MapState
from octoreplay.run_metrics import (
    FramePlace,
    PairMetrics,
    RunSummary,
    TickMetrics,
    log_sent_bytes,
)


class ResultReader:
    """One result file, read lazily; a context manager.

    ``config`` is the run's configuration; its relative log paths are resolved against the result's folder. Checksums
    are compared as ``CheckedReader`` says. An unfinished result (``x.partial.mcap``, or any file with
    ``is_unfinished``) gives what its intact chunks hold.
    Raises InputError for a file that is missing, cut, damaged or not an octoreplay result.
    """

    def __init__(self, path: Path, *, is_unfinished: bool = False) -> None:
        self.path = path
        try:
            self._file = path.open("rb")
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error
        try:
            self._unchecked: list[str] = []
            self._reader, self._metadata = self._open(is_unfinished)
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
    def stop_reason(self) -> str:
        """Reason for the end of the run; 'cut off' where the file was not finished."""
        return self._metadata.get("summary", {}).get("stop_reason", "cut off")

    @property
    def extent(self) -> str:
        """Clause on the last tick of an incomplete result and its log time."""
        last = self.last_tick()
        if last is None:
            return "holds no tick"
        number, stamp_ns, elapsed = last
        return f"ends at tick {number}, {elapsed:.3f} s after the start, at log time {stamp_ns / 1e9:.3f} s"

    def last_tick(self) -> tuple[int, int, float] | None:
        """Return number, stamp [ns] and time since the start [s] of the last tick; None without any."""
        for stamp_ns, value in self._messages(METRICS_TOPIC, reverse=True):
            number = int(value.tick)
            return number, stamp_ns, number * round(self.config.network.publish_period * 1e9) / 1e9
        return None

    @property
    def inputs(self) -> dict[str, tuple[int, str, str]]:
        """Size [bytes], method and fingerprint of each input file by path or URL, in the order of the robots."""
        found = {}
        for name, text in self._metadata.get("inputs", {}).items():
            entry = self._json("inputs", dict[str, Any], text)
            try:
                found[name] = (int(entry["size"]), str(entry["method"]), str(entry["fingerprint"]))
            except (LookupError, TypeError, ValueError, OverflowError) as error:
                raise self._wrong("inputs", error) from error
        return found

    @property
    def tiles(self) -> TileList | None:
        """Files that hold the maps; None where this one does."""
        values = self._metadata.get(RECORD)
        if values is None:
            return None
        try:
            return TileList.of(values)
        except (LookupError, ValueError) as error:
            raise self._wrong(RECORD, error) from error

    @property
    def topics(self) -> dict[str, str]:
        """Message type of each topic, by topic."""
        summary = self._reader.get_summary()
        assert summary is not None
        channels = sorted(summary.channels.values(), key=lambda channel: str(channel.topic))
        return {channel.topic: summary.schemas[channel.schema_id].name for channel in channels}

    @property
    def prior(self) -> float:
        """Log-odds of each occupied class in an unobserved cell, h_0."""
        return self._prior

    @property
    def damage(self) -> tuple[str, ...]:
        """Clauses on what is missing of an unfinished result; empty for a finished one."""
        return self._reader.damage if isinstance(self._reader, UnfinishedReader) else ()

    def copy_to(self, writer: RosMcapWriter) -> int:
        """Copy metadata and messages, in the order of the file, and return the number of messages.

        The copy is not complete, for the same reason. Raises InputError and OutputError.
        """
        for name, values in self._metadata.items():
            if name != "summary":
                writer.write_metadata(name, values)
        num_messages = 0
        try:
            for schema, channel, record in self._reader.iter_messages(log_time_order=False):
                writer.copy(schema, channel, record)
                num_messages += 1
        except _DAMAGE as error:
            raise InputError(f"{self.path}: damaged: {error}") from error
        writer.write_metadata("summary", {"complete": "false", "stop_reason": self.stop_reason})
        return num_messages

    def metrics(self) -> list[TickMetrics]:
        """Return the metrics of all ticks, in order; without pairs in results that do not hold them."""
        pairs = {
            int(value.tick): tuple(PairMetrics(**fields_of(PairMetrics, pair)) for pair in value.pairs)
            for _, value in self._messages(CONTRADICTION_TOPIC)
        }
        places = self.places()
        return [
            tick_metrics(value, pairs.get(int(value.tick), ()), places.get(int(value.tick), ()))
            for _, value in self._messages(METRICS_TOPIC)
        ]

    def places(self) -> dict[int, tuple[FramePlace, ...]]:
        """Return the frames of all robots by tick; empty where all maps are in the team's frame."""
        return {
            int(value.tick): tuple(frame_place(robot) for robot in value.robots)
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
            return summary_from_metrics(metrics, self.stop_reason)
        values: dict[str, Any] = {"wall_seconds": math.nan, "last": metrics[-1]}
        values["log_sent_bytes"] = log_sent_bytes(metrics)
        for item in dataclasses.fields(RunSummary):
            if item.name == "stop_reason":
                values[item.name] = self.stop_reason
            elif item.name in stored:
                values[item.name] = self._json("summary", _SUMMARY_TYPES[item.name], stored[item.name])
        try:
            return RunSummary(**values)
        except TypeError as error:
            raise self._wrong("summary", error) from error

    def state_times(self, robot_id: str, *, evidence: bool = False) -> list[tuple[int, int]]:
        """Return (tick, stamp_ns) of a robot's stored maps, or of its stored evidence, in order."""
        return [
            (int(value.tick), stamp_to_ns(value.header.stamp))
            for _, value in self._messages(self.state_topic(robot_id, evidence))
        ]

    def state_stamp(self, robot_id: str, tick: int, *, evidence: bool = False) -> int | None:
        """Return the stamp [ns] of a robot's map or evidence stored at a tick, or None. Raises as ``states``."""
        topic = self.state_topic(robot_id, evidence)
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
        for _, value in self._messages(self.state_topic(robot_id, evidence), end_ns=end, reverse=True):
            state = map_state(value)
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
                f"{self.path}: no evidence of robot '{robot_id}' is stored up to the time asked for; ask for the end,"
                " or run the logs again, with --evidence-every for evidence at earlier times"
            )
        if until_ns is None:
            raise InputError(f"{self.path}: no map of robot '{robot_id}' is stored; run the logs again")
        raise InputError(
            f"{self.path}: no map of robot '{robot_id}' is stored up to the time asked for; ask for the end, or run the"
            " logs again, with a shorter --state-every for maps at earlier times"
        )

    def all_states(self) -> Iterator[MapState]:
        """Yield all stored states of the robots and of the centralised map, in order of time."""
        for _, value in self._messages(*map(map_state_topic, (*self.robots, CENTRAL))):
            yield map_state(value)

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
            path = input_file(name, self.path.parent)
            if isinstance(path, Path) and not path.exists():
                sentences.append(f"{path}: input of {self.path.name} is missing")
                continue
            now = fingerprint(path, whole=stored[1] == "sha256")
            if (now.size, now.method, now.value) != stored:
                sentences.append(f"{path}: has changed since {self.path.name} was made from it")
        return sentences

    def _json(self, name: str, hint: Any, text: str) -> Any:
        """Return a value of the metadata record ``name``, which is JSON of the type ``hint``."""
        try:
            return value_of(hint, load_json(text, name))
        except (ConfigError, ValueError) as error:
            raise self._wrong(name, error) from error

    def _wrong(self, name: str, error: Exception) -> InputError:
        """Return the error for a metadata record that cannot be read."""
        return InputError(f"{self.path}: damaged: its metadata '{name}' cannot be read: {error}")

    def _open(self, is_unfinished: bool) -> tuple[SeekingReader, dict[str, dict[str, str]]]:
        """Return the container's reader and all metadata records by name, without their checksums."""
        metadata: dict[str, dict[str, str]] = {}
        try:
            reader = container_reader(self._file, self.path, is_unfinished=is_unfinished)
            for record in reader.iter_metadata():
                values = dict(record.metadata)
                crc = values.pop(CRC_KEY, None)
                if crc is None:
                    self._unchecked.append(record.name)
                elif crc != metadata_crc(record.name, values):
                    raise InputError(f"{self.path}: damaged: the checksum of its metadata does not match")
                metadata[record.name] = values
            if isinstance(reader, UnfinishedReader):
                # It may be written before the last chunk, which is missing.
                metadata.pop("summary", None)
        except _DAMAGE as error:
            raise InputError(f"{self.path}: not a finished MCAP file, or damaged; {_NOT_A_RESULT}") from error
        return reader, metadata

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
        if version not in READABLE_VERSIONS:
            raise InputError(
                f"{self.path}: result format {version}, this version reads {' and '.join(READABLE_VERSIONS)}; use"
                f" octoreplay {self.description.get('version')}, which wrote it"
            )
        if version != _WITHOUT_CHECKSUMS and self._unchecked:
            raise InputError(f"{self.path}: damaged: its metadata '{self._unchecked[0]}' has no checksum")
        try:
            self._prior = float(self.description["prior"])
        except (KeyError, ValueError) as error:
            raise self._wrong("octoreplay", error) from error
        if not math.isfinite(self._prior):
            raise self._wrong("octoreplay", ValueError("its prior is not finite"))

    def _known(self, robot_id: str) -> str:
        """Return the name of a robot or of the centralised map; raise InputError for any other."""
        if robot_id not in (*self.robots, CENTRAL):
            raise InputError(f"{self.path}: robot '{robot_id}' not found; robots: {', '.join(self.robots)}")
        return robot_id

    def state_topic(self, robot_id: str, evidence: bool) -> str:
        """Return the topic of a robot's maps or evidence. Raises InputError for an unknown robot."""
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


_WITHOUT_CHECKSUMS = "2"
"""Result format whose metadata have no checksums."""

_FORMER_DEFAULTS = {"packets": "full", "flow_bits": 4, "confidence_model": "hit"}
"""Parameters of results that do not name all of them, and were written before these defaults changed."""

_DAMAGE = (McapError, ZstdError, SerdeError, TypesysError, AssertionError, struct.error, LookupError, ValueError,
           TypeError, SyntaxError, OverflowError, MemoryError, RecursionError, OSError)  # fmt: skip
"""Exceptions raised by reading a damaged file."""

_SUMMARY_TYPES = typing.get_type_hints(RunSummary)


def is_result(path: Path) -> bool:
    """Return True for the file of a result, of any format version; False for other files and folders."""
    if path.suffix.lower() != ".mcap" or not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            names = {record.name for record in container_reader(file, path).iter_metadata()}
    except (OSError, OctoreplayError, *_DAMAGE):
        return False
    return {"octoreplay", "config"} <= names


_NOT_A_RESULT = "give the OUT.mcap of 'octoreplay run'"
