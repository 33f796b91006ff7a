"""Logs whose container is whole and whose messages are not, and the whole way from a log to a map: for fuzzing."""

from __future__ import annotations

import dataclasses
import json
import random
import shutil
import struct
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import Message
from mcap.reader import make_reader
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from fixtures.make_streams import PALETTE
from octoreplay.config.consensus import ConsensusConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.time import TimeConfig
from octoreplay.errors import ConfigError, OctoreplayError
from octoreplay.io.containers.log_reader import normalise_type_name
from octoreplay.io.messages.ros_types import typestore
from octoreplay.io.robots.describe import describe
from octoreplay.io.robots.discover import discover, resolve
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.mapping.sensor import sensor_reach
from octoreplay.records import ClassTable, SemanticClass
from octoreplay.replay.run import replay_team
from support import room
from support.fixture_paths import FIXTURES
from support.log_damage import MUTATIONS, damage_log, reseal_chunk
from support.log_factory import Row, write_rows
from support.scan_maps import MAP, SENSOR, octree_of

LOGS = tuple(
    sorted(
        path.relative_to(FIXTURES).as_posix()
        for pattern in ("containers/*", "streams/*", "pair/*.mcap")
        for path in FIXTURES.glob(pattern)
    )
)
"""All committed logs."""

MCAP_LOGS = tuple(name for name in LOGS if name.endswith(".mcap"))
"""Those of them whose messages are rewritten."""

CLASSES = ClassTable(
    tuple(
        SemanticClass(index + 1, name, PALETTE[raw], (raw,), (PALETTE[raw],))
        for index, (raw, name) in enumerate(room.NAMES.items())
    )
)
"""Class table for logs without one."""


# --- messages --------------------------------------------------------------------------------------------------------


@cache
def rows_of(name: str) -> tuple[Row, ...]:
    """The messages of a committed MCAP log, by the mcap package."""
    with (FIXTURES / name).open("rb") as file:
        return tuple(
            Row(channel.topic, schema.name, schema.encoding, schema.data, channel.message_encoding, stored.data,
                stored.log_time)
            for schema, channel, stored in make_reader(file).iter_messages()
        )  # fmt: skip


@cache
def _types_of(definition: bytes, name: str) -> Any:
    """The types of a definition in ROS's own format."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition.decode(), name))
    return store


def _ros_codec(row: Row) -> tuple[Callable[..., Any], Callable[..., Any], str]:
    """Type store of a ROS type, and the type's long name."""
    name = normalise_type_name(row.schema_name)
    if row.encoding == "ros1":
        store = _types_of(row.schema, name)
        return store.deserialize_ros1, store.serialize_ros1, name
    store = typestore() if name in typestore().types else _types_of(row.schema, name)
    return store.deserialize_cdr, store.serialize_cdr, name


def value_of(row: Row) -> Any:
    """A message as an object whose fields can be set."""
    if row.encoding == "json":
        return json.loads(row.data)
    if row.encoding == "protobuf":
        schema = Schema(id=1, data=row.schema, encoding="protobuf", name=row.schema_name)
        return DecoderFactory().decoder_for("protobuf", schema)(row.data)
    read, _, name = _ros_codec(row)
    return read(row.data, name)


def bytes_of(row: Row, value: Any) -> bytes:
    """The bytes of that object."""
    if row.encoding == "json":
        return json.dumps(value).encode()
    if row.encoding == "protobuf":
        return bytes(value.SerializeToString())
    _, write, name = _ros_codec(row)
    return bytes(write(value, name))


# What writing a value raises that the type cannot hold.
_UNWRITABLE = (
    struct.error, SerdeError, OverflowError, ValueError, TypeError, IndexError, KeyError, AssertionError,
    AttributeError,
)  # fmt: skip

Place = tuple[str | int, ...]


def _parts(value: Any) -> Iterator[tuple[str | int, Any]]:
    """The fields or elements of a message, none of a leaf."""
    if isinstance(value, dict):
        yield from value.items()
    elif isinstance(value, Message):
        yield from ((field.name, getattr(value, field.name)) for field in value.DESCRIPTOR.fields)
    elif dataclasses.is_dataclass(value):
        names = (field.name for field in dataclasses.fields(value) if field.name != "__msgtype__")
        yield from ((name, getattr(value, name)) for name in names)
    elif not isinstance(value, str | bytes | np.ndarray) and hasattr(value, "__len__"):
        yield from enumerate(value)


def _places(value: Any, place: Place = ()) -> Iterator[Place]:
    """Paths of the leaves of a message; of long lists only the first few."""
    for key, part in _parts(value):
        if isinstance(key, int) and key > 20:
            return
        found = list(_places(part, (*place, key)))
        yield from found or [(*place, key)]


def _get(value: Any, key: str | int) -> Any:
    return getattr(value, key) if isinstance(key, str) and not isinstance(value, dict) else value[key]


def _set(value: Any, place: Place, leaf: Any) -> None:
    for key in place[:-1]:
        value = _get(value, key)
    if isinstance(place[-1], str) and not isinstance(value, dict):
        object.__setattr__(value, place[-1], leaf) if dataclasses.is_dataclass(value) else setattr(
            value, place[-1], leaf
        )
    else:
        value[place[-1]] = leaf


INTEGERS = (0, 1, 2, -1, 255, 1 << 15, (1 << 16) - 1, 1 << 20, 1 << 26, (1 << 31) - 1, -(1 << 31), (1 << 32) - 1)
FLOATS = (0.0, -1.0, 1.0, 1e-300, 1e-9, 1e4, 5e4, 1e6, 1e9, 1e18, 1e38, 1e200, -1e308, np.nan, np.inf, -np.inf)
STRINGS = ("", "x", "/", "odom", "base_link", "camera", "32FC1", "rgb8", "16UC1", "mono8", "png", "jpeg", "plumb_bob",
           "16UC1; compressedDepth rvl", "equidistant", "a\nb\x1b[2J", "\u00e9" * 5000, "{}", "%s")  # fmt: skip
GROUPS = (
    ("sec", "nanosec", "nsec", "nanos", "seconds"),
    ("height", "width", "step", "point_step", "point_stride", "row_step", "offset", "count", "datatype", "type",
     "binning_x", "roi"),
    ("frame_id", "child_frame_id", "parent_frame_id", "body_frame_id", "encoding", "format", "distortion_model"),
    ("position", "orientation", "translation", "rotation"),
    ("k", "K", "p", "P", "d", "D", "ranges", "angle_min", "angle_increment", "start_angle", "range_max"),
    ("data",), ("class_map",), (),
)  # fmt: skip
"""Names of fields that are changed together often; the empty group is all of them."""


def _hostile(leaf: Any, rng: random.Random) -> Any:
    """Another value of a leaf's type."""
    if isinstance(leaf, bool):
        return not leaf
    if isinstance(leaf, int | np.integer):
        number = int(leaf)
        return rng.choice([*INTEGERS, number // 2, number + 1, number - 1, 2 * number, number + 10, number - 86_400])
    if isinstance(leaf, float | np.floating):
        return rng.choice([*FLOATS, -float(leaf), 1e3 * float(leaf)])
    if isinstance(leaf, str):
        return rng.choice([*STRINGS, leaf[: len(leaf) // 2], f"/{leaf}", leaf + "_2"])
    if isinstance(leaf, bytes):
        return _damaged(leaf, rng)
    if isinstance(leaf, np.ndarray) and leaf.size:
        if leaf.dtype == np.uint8:
            return np.frombuffer(_damaged(leaf.tobytes(), rng), np.uint8)
        changed = leaf.copy()
        if leaf.dtype.kind == "f":
            changed[rng.randrange(leaf.size)] = rng.choice(FLOATS[:11] + FLOATS[-3:])
        return rng.choice([changed, changed, leaf[: leaf.size // 2], np.zeros_like(leaf)])
    return leaf


def _damaged(data: bytes, rng: random.Random) -> bytes:
    """Bytes damaged in one of the ways in which files are."""
    mutation = rng.choice([m for m in MUTATIONS if m is not reseal_chunk])
    return rng.choice([mutation(data, rng) if data else data, mutation(data, rng) if data else data, b""])


# --- ways to make a log hostile --------------------------------------------------------------------------------------


def _chosen(rows: list[Row], rng: random.Random) -> list[int]:
    """Some messages of one topic: one of them, some, the first, or all."""
    topic = rng.choice(sorted({row.topic for row in rows}))
    mine = [index for index, row in enumerate(rows) if row.topic == topic]
    return rng.choice([[rng.choice(mine)], sorted(rng.sample(mine, (len(mine) + 1) // 2)), mine[:1], mine, mine])


def change_fields(rows: list[Row], rng: random.Random) -> None:
    """A field of some messages of a topic gets another value: stamps, sizes, frames, poses, pixels, anything."""
    chosen = _chosen(rows, rng)
    value = value_of(rows[chosen[0]])
    places = list(_places(value))
    group = rng.choice(GROUPS)
    place = rng.choice([place for place in places if set(group) & set(place)] or places or [()])
    if not place:
        return
    leaf = value
    for key in place:
        leaf = _get(leaf, key)
    leaf = _hostile(leaf, rng)
    for index in chosen:
        value = value_of(rows[index])
        try:
            _set(value, place, leaf)
            rows[index] = rows[index]._replace(data=bytes_of(rows[index], value))
        except _UNWRITABLE:
            # A value that the type cannot hold cannot be written either.
            rows[index] = rows[index]._replace(data=_damaged(rows[index].data, rng))


def damage_payloads(rows: list[Row], rng: random.Random) -> None:
    """The bytes of some messages are damaged."""
    for index in _chosen(rows, rng):
        rows[index] = rows[index]._replace(data=_damaged(rows[index].data, rng))


def empty_payloads(rows: list[Row], rng: random.Random) -> None:
    """Some messages hold nothing, or a few bytes."""
    length = rng.choice([0, 0, 1, 4, 11])
    for index in _chosen(rows, rng):
        rows[index] = rows[index]._replace(data=rows[index].data[:length])


def swap_payloads(rows: list[Row], rng: random.Random) -> None:
    """Messages of two topics exchange what they hold."""
    for first, second in zip(_chosen(rows, rng), _chosen(rows, rng), strict=False):
        a, b = rows[first], rows[second]
        rows[first], rows[second] = a._replace(data=b.data), b._replace(data=a.data)


def replace_schemas(rows: list[Row], rng: random.Random) -> None:
    """Some messages of a topic claim the type of another topic."""
    other = rng.choice(rows)
    parts = {"schema_name": other.schema_name, "schema_encoding": other.schema_encoding, "schema": other.schema}
    for index in _chosen(rows, rng):
        rows[index] = rows[index]._replace(**parts)


def damage_definitions(rows: list[Row], rng: random.Random) -> None:
    """The definition of a type is damaged, or its name or format is another."""
    name = rng.choice(rows).schema_name
    chosen = [index for index, row in enumerate(rows) if row.schema_name == name]
    parts: dict[str, Any] = rng.choice([
        {"schema": _damaged(rows[chosen[0]].schema, rng)}, {"schema": b""}, {"schema": rng.choice(rows).schema},
        {"schema_encoding": rng.choice(["ros1msg", "ros2msg", "ros2idl", "protobuf", "jsonschema", ""])},
        {"encoding": rng.choice(["cdr", "ros1", "protobuf", "json", ""])},
    ])  # fmt: skip
    for index in chosen:
        rows[index] = rows[index]._replace(**parts)


def repeat_messages(rows: list[Row], rng: random.Random) -> None:
    """Some messages come several times, at their own time or later."""
    later, times = rng.choice([0, 0, 1, 50_000_000, 10**12]), rng.choice([1, 1, 30])
    again = [rows[index]._replace(log_time_ns=rows[index].log_time_ns + later) for index in _chosen(rows, rng)]
    rows += again * times


def rename_topics(rows: list[Row], rng: random.Random) -> None:
    """Some messages are on another topic, one that is there or a new one."""
    topics = sorted({row.topic for row in rows})
    name = rng.choice([*topics, *(f"{topic}_2" for topic in topics), "", "/", "a\nb\x1b[2J", "/tf", "/tf_static"])
    for index in _chosen(rows, rng):
        rows[index] = rows[index]._replace(topic=name)


def copy_topics(rows: list[Row], rng: random.Random) -> None:
    """A topic is there twice, as where there are two CameraInfos, and then one of them is changed."""
    topic = rng.choice(rows).topic
    rows += [row._replace(topic=f"{topic}_copy") for row in rows if row.topic == topic]
    change_fields(rows, rng)


def remove_topics(rows: list[Row], rng: random.Random) -> None:
    """A topic is not there."""
    topic = rng.choice(rows).topic
    rows[:] = [row for row in rows if row.topic != topic] or rows


def change_log_times(rows: list[Row], rng: random.Random) -> None:
    """The log's times are wrong: zero, huge, shifted, or backwards."""
    chosen = rng.choice([_chosen(rows, rng), list(range(len(rows)))])
    time = rng.choice([0, 1, 10**18, (1 << 63) - 1, 1 << 63, (1 << 64) - 1])
    shift = rng.choice([-(10**9), 10**9, 10**12, 10**17])
    new = {
        "same": lambda row: time,
        "shifted": lambda row: max(row.log_time_ns + shift, 0),
        "backwards": lambda row: max(2 * rows[0].log_time_ns - row.log_time_ns, 0),
    }[rng.choice(["same", "shifted", "backwards"])]
    for index in chosen:
        rows[index] = rows[index]._replace(log_time_ns=new(rows[index]))


MESSAGE_MUTATIONS: tuple[Callable[[list[Row], random.Random], None], ...] = (
    damage_payloads, empty_payloads, swap_payloads, replace_schemas, damage_definitions, repeat_messages, rename_topics,
    copy_topics, remove_topics, change_log_times, *(change_fields,) * 10,
)  # fmt: skip


def hostile_rows(name: str, rng: random.Random) -> tuple[list[Row], str]:
    """The messages of a committed MCAP log with one or two changes, and what was done."""
    rows, done = list(rows_of(name)), []
    for _ in range(rng.choice([1, 1, 2])):
        # What one change has broken, the next may be unable to read.
        mutation = rng.choice([m for m in MESSAGE_MUTATIONS if not (done and m in (change_fields, copy_topics))])
        mutation(rows, rng)
        done.append(mutation.__name__)
    return rows, f"{name}: {', '.join(done)}"


def write_hostile_log(name: str, folder: Path, rng: random.Random) -> tuple[Path, str]:
    """A copy of a committed log with damaged bytes, or with changed messages in a good MCAP, and what was done."""
    path = folder / Path(name).name
    if name in MCAP_LOGS and rng.random() < 0.7:
        rows, what = hostile_rows(name, rng)
        in_order = sorted(rows, key=lambda row: row.log_time_ns) if rng.random() < 0.9 else rows
        return write_rows(path, in_order), what
    if (FIXTURES / name).is_dir():
        shutil.rmtree(path, ignore_errors=True)
        shutil.copytree(FIXTURES / name, path)
    else:
        shutil.copyfile(FIXTURES / name, path)
    return path, damage_log(path, rng)


# --- the whole way ---------------------------------------------------------------------------------------------------


class MapOutcome(NamedTuple):
    """Outcome of a log: its frames or the reason for no map, and every sentence that a user would read."""

    num_frames: int
    refusal: str | None
    sentences: tuple[str, ...]


def map_of_log(path: Path, *, is_run: bool) -> MapOutcome:
    """A log the whole way to the maps of its robots, or with ``is_run`` through a run of them all.

    Whatever is no error of this package goes through, and so do sentences that are none (AssertionError).
    """
    sentences: list[str] = []
    num_frames, refusal = 0, None
    try:
        found = describe([path])
        for summary in (*found.logs, *found.robots):
            texts = (summary.damage, summary.error) if hasattr(summary, "damage") else summary.missing
            sentences += [text for text in texts if text]
        sentences += found.missing
        num_frames = _num_frames(_resolved(path), is_run=is_run)
    except OctoreplayError as error:
        refusal = str(error)
        sentences.append(refusal)
    for sentence in sentences:
        _check_sentence(sentence)
    return MapOutcome(num_frames, refusal, tuple(sentences))


def _resolved(path: Path) -> RunConfig:
    """The run of the robots in a log, with classes where the log does not name them."""
    config = RunConfig(discover([path]), consensus=ConsensusConfig(settle=5))
    try:
        return resolve(config)
    except ConfigError as error:
        if "no LabelInfo" not in str(error):
            raise
    return resolve(dataclasses.replace(config, classes=CLASSES))


def _num_frames(config: RunConfig, *, is_run: bool) -> int:
    """Number of frames in the maps."""
    assert config.classes is not None
    if is_run:
        summary = replay_team(config, None, num_threads=1)
        return sum(counts.used for counts in summary.frame_counts.values())
    num_frames = 0
    for robot in config.robots:
        with RobotLog(robot, TimeConfig(), config.classes, reach=sensor_reach(SENSOR, MAP)) as log:
            octree_of(log.frames(), config.classes.num_classes)
            num_frames += log.counts.used
    return num_frames


def _check_sentence(text: str) -> None:
    """Check that a message is one line of printable characters; only candidates follow on lines of their own."""
    lines = text.split("\n    ") if "put one of these lines" in text else [text]
    assert all(line.isprintable() for line in lines), text
    assert len(lines[0]) > 15, text
