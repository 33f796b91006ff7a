"""Containers: messages written by independent writers are read, of cut files those before the cut."""

from __future__ import annotations

import io
import struct
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag1 import Writer as Rosbag1Writer

from octoreplay.errors import InputError
from octoreplay.io.containers.log_reader import RawMessage, normalise_type_name
from octoreplay.io.containers.logs import open_log
from octoreplay.io.messages.decoders import DamagedMessageError
from octoreplay.io.messages.ros_types import typestore
from support.log_factory import ROS1, SECOND, Entry, Factory, robot_entries, ros2, write_bag, write_mcap, write_rosbag2

CONTAINERS = Path(__file__).parents[2] / "fixtures" / "containers"


def first_message(log, topic: str) -> RawMessage | None:
    """Return the first message of a topic."""
    return next(log.messages((topic,)), None)


def contents(path: Path, topics=None) -> list[tuple[str, int, bytes]]:
    """Return all messages of a log as read by this package."""
    with open_log(path) as log:
        names = {topic.name for topic in log.topics} if topics is None else topics
        return [(m.topic, m.log_time_ns, bytes(m.data)) for m in log.messages(names)]


def expected_of(entries: list[Entry]) -> list[tuple[str, int, bytes]]:
    """Return the messages that were written, in order of log time."""
    rows = [(e.topic, e.log_time_ns, bytes(typestore().serialize_cdr(e.value, e.type_name))) for e in entries]
    return sorted(rows, key=lambda row: row[1])


def write_plain_mcap(path: Path, messages: list[tuple[str, int, bytes]], **options) -> Path:
    """Write an MCAP file with the writer of the mcap package."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start(profile="ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        channels: dict[str, int] = {}
        for topic, log_time, data in messages:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], log_time, data, log_time)
        writer.finish()
    return path


def text(value: str) -> bytes:
    return bytes(typestore().serialize_cdr(ros2.make("std_msgs/msg/String", data=value), "std_msgs/msg/String"))


@pytest.mark.parametrize("container", ["mcap", "small chunks", "rosbag2 sqlite3", "rosbag2 mcap", "db3 file"])
def test_messages_written_to_each_container_are_read(tmp_path, container):
    entries = robot_entries()
    if container in ("mcap", "small chunks"):
        path = write_mcap(tmp_path / "a.mcap", entries, chunk_size=300 if container == "small chunks" else 1 << 20)
    else:
        path = write_rosbag2(tmp_path / "bag", entries, storage="mcap" if container.endswith("mcap") else "sqlite3")
        path = next(path.glob("*.db3")) if container == "db3 file" else path
    assert sorted(contents(path)) == sorted(expected_of(entries))
    times = [row[1] for row in contents(path)]
    assert times == sorted(times)
    with open_log(path) as log:
        assert log.message_count == len(entries)
        assert (log.start_ns, log.end_ns) == (entries[0].log_time_ns, entries[-1].log_time_ns)
        assert log.damage is None
        topics = {topic.name: topic for topic in log.topics}
        assert list(topics) == sorted({entry.topic for entry in entries})
        odom = topics["/odom"]
        assert (odom.type_name, odom.encoding, odom.num_messages) == ("nav_msgs/msg/Odometry", "cdr", 11)
        message = first_message(log, "/odom")
        assert message.decode().pose.pose.position.x == 0.0
        assert message.decode().child_frame_id == "base_link"


def test_messages_written_to_a_ros1_bag_are_read(tmp_path):
    entries = robot_entries(factory=Factory(ros1=True))
    path = write_bag(tmp_path / "a.bag", entries)
    with open_log(path) as log:
        assert log.message_count == len(entries)
        assert (log.start_ns, log.end_ns) == (entries[0].log_time_ns, entries[-1].log_time_ns)
        messages = list(log.messages(["/camera/depth/image_raw"]))
        assert [m.channel.encoding for m in messages] == ["ros1"] * 6
        for index, message in enumerate(messages):
            assert message.header_stamp_ns() == 100 * SECOND + index * SECOND // 4
            assert message.header_frame_id() == "camera"
            assert message.decode().header.seq == 7


def test_topics_are_filtered_and_iterators_are_independent(tmp_path):
    path = write_plain_mcap(tmp_path / "a.mcap", [(f"/t{i % 3}", i, text(str(i))) for i in range(30)], chunk_size=100)
    with open_log(path) as log:
        first, second = log.messages(["/t0"]), log.messages(["/t1", "/t2"])
        pairs = [(next(first).log_time_ns, next(second).log_time_ns) for _ in range(10)]
        assert pairs == [(3 * i, i + i // 2 + 1) for i in range(10)]
        assert list(log.messages(["/nothing"])) == []


@given(
    st.lists(st.tuples(st.sampled_from(["/a", "/b"]), st.integers(0, 50)), max_size=40),
    st.sampled_from([CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD]),
    st.booleans(), st.booleans(), st.booleans(),
)  # fmt: skip
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
def test_messages_of_any_mcap_are_in_log_time_order(
    tmp_path, stamps, compression, use_chunking, has_index, has_summary
):
    messages = [(topic, log_time, text(str(i))) for i, (topic, log_time) in enumerate(stamps)]
    path = write_plain_mcap(
        tmp_path / "any.mcap", messages, chunk_size=150, compression=compression, use_chunking=use_chunking,
        index_types=IndexType.ALL if has_index else IndexType.NONE, use_statistics=has_summary,
        repeat_channels=has_summary, repeat_schemas=has_summary, use_summary_offsets=has_summary,
    )  # fmt: skip
    for topics in (["/a", "/b"], ["/b"]):
        wanted = [message for message in messages if message[0] in topics]
        assert contents(path, topics) == sorted(wanted, key=lambda message: message[1])
    with open_log(path) as log:
        assert log.damage is None
        assert log.message_count == len(messages)
        times = [log_time for _, log_time, _ in messages]
        assert (log.start_ns, log.end_ns) == ((min(times), max(times)) if times else (None, None))


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
@pytest.mark.parametrize("use_chunking", [True, False])
def test_all_complete_messages_before_the_cut_of_an_mcap_are_read(tmp_path, compression, use_chunking):
    rng = np.random.default_rng(1)
    messages = [("/a", i, text(rng.bytes(40).hex())) for i in range(60)]
    whole = write_plain_mcap(
        tmp_path / "whole.mcap", messages, chunk_size=1500, compression=compression, use_chunking=use_chunking
    )
    data = whole.read_bytes()
    cut = tmp_path / "cut.mcap"
    counts = []
    for size in sorted({*rng.integers(8, len(data) - 1, 40).tolist(), 8, len(data) - 1}):
        cut.write_bytes(data[:size])
        found = contents(cut)
        assert found == messages[: len(found)]
        counts.append(len(found))
        with open_log(cut) as log:
            assert log.damage is not None
            assert log.damage.startswith(f"{cut}: cut")
            assert log.message_count == len(found)
        # All messages that the mcap package finds in complete chunks are among them.
        assert len(found) >= count_whole(data[:size])
    assert counts == sorted(counts)
    assert counts[0] == 0
    assert counts[-1] == len(messages)


def count_whole(data: bytes) -> int:
    """Return the number of messages that the mcap package reads before it fails."""
    count = 0
    try:
        for _ in NonSeekingReader(io.BytesIO(data)).iter_messages(log_time_order=False):
            count += 1
    except Exception:
        return count
    return count


def test_complete_messages_of_a_cut_uncompressed_chunk_are_read(tmp_path):
    messages = [("/a", i, text("x" * 100)) for i in range(10)]
    path = write_plain_mcap(tmp_path / "a.mcap", messages, compression=CompressionType.NONE)
    path.write_bytes(path.read_bytes()[:900])
    found = contents(path)
    assert 4 <= len(found) < 10
    assert found == messages[: len(found)]


@given(st.binary(max_size=200), st.integers(0, 2000), st.integers(1, 40))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150)
def test_damaged_mcaps_raise_only_input_errors(tmp_path, noise, position, length):
    path = tmp_path / "damaged.mcap"
    data = bytearray(write_plain_mcap(path, [("/a", i, text(str(i))) for i in range(20)], chunk_size=200).read_bytes())
    position %= len(data)
    data[position : position + length] = noise
    path.write_bytes(data)
    refusal = ""
    try:
        contents(path)
    except InputError as error:
        refusal = str(error)
    assert refusal == "" or refusal.startswith(f"{path}: ")


def write_long_bag(path: Path, compression) -> Path:
    """Write a bag of several chunks."""
    writer = Rosbag1Writer(path)
    writer.chunk_threshold = 2000
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        connection = writer.add_connection("/a", "std_msgs/msg/String", typestore=ROS1)
        rng = np.random.default_rng(2)
        for index in range(60):
            value = ROS1.types["std_msgs/msg/String"](data=rng.bytes(100).hex())
            writer.write(connection, index + 1, ROS1.serialize_ros1(value, "std_msgs/msg/String"))
    return path


@pytest.mark.parametrize("compression", [None, *Rosbag1Writer.CompressionFormat])
def test_all_complete_messages_before_the_cut_of_a_bag_are_read(tmp_path, compression):
    whole = write_long_bag(tmp_path / "whole.bag", compression)
    messages, data = contents(whole), whole.read_bytes()
    assert len(messages) == 60
    cut = tmp_path / "cut.bag"
    counts = []
    for size in sorted([*np.random.default_rng(3).integers(len(data) // 2, len(data) - 1, 25).tolist(), len(data) - 1]):
        cut.write_bytes(data[:size])
        found = contents(cut)
        assert found == messages[: len(found)]
        counts.append(len(found))
        with open_log(cut) as log:
            rest = "everything else is used (log times 0.000 s to 0.000 s)"
            assert log.damage == f"{cut}: the bag has no index, as after a cut; {rest}"
            assert (log.start_ns, log.end_ns, log.message_count) == (1, len(found), len(found))
            assert first_message(log, "/a").decode().data
    assert counts == sorted(counts)
    assert 0 < counts[0] < counts[-1] == 60


@given(st.binary(max_size=60), st.integers(0, 20000), st.integers(1, 40))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150)
def test_damaged_bags_raise_only_input_errors(tmp_path, noise, position, length):
    path = tmp_path / "damaged.bag"
    path.unlink(missing_ok=True)
    data = bytearray(write_long_bag(path, None).read_bytes())
    position %= len(data)
    data[position : position + length] = noise
    path.write_bytes(data)
    refusal = ""
    try:
        contents(path)
    except InputError as error:
        refusal = str(error)
    assert refusal == "" or refusal.startswith(f"{path}: ")


def test_one_topic_on_two_channels_is_one_topic(tmp_path):
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        for log_time in range(4):
            channel = writer.register_channel("/a", "cdr", schema)
            writer.add_message(channel, log_time, text("x"), log_time)
        writer.finish()
    with open_log(path) as log:
        (topic,) = log.topics
        assert topic.num_messages == 4
        assert len(topic.channel_ids) == 4
        assert [message.log_time_ns for message in log.messages(["/a"])] == [0, 1, 2, 3]


def test_a_type_is_decoded_as_the_file_defines_it(tmp_path):
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        # A String that differs from ROS's, and a type that no type store has.
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"uint8 level\nstring data\n")
        other = writer.register_schema("my_msgs/msg/Pair", "ros2msg", b"int32 a\nint32 b\n")
        head = b"\x00\x01\x00\x00"
        data = head + struct.pack("<B3xI3s", 9, 3, b"hi\0")
        writer.add_message(writer.register_channel("/s", "cdr", schema), 0, data, 0)
        writer.add_message(writer.register_channel("/p", "cdr", other), 0, head + struct.pack("<ii", 4, -5), 0)
        writer.finish()
    with open_log(path) as log:
        string, pair = first_message(log, "/s").decode(), first_message(log, "/p").decode()
        assert (string.level, string.data) == (9, "hi")
        assert (pair.a, pair.b) == (4, -5)
    assert ros2.store.fielddefs["std_msgs/msg/String"][1][0][0] == "data"


def test_big_endian_messages_are_read(tmp_path):
    value = ros2.odometry(3 * SECOND + 5, (1, 2, 3), frame_id="odom")
    data = bytes(typestore().serialize_cdr(value, "nav_msgs/msg/Odometry", little_endian=False))
    definition, _ = typestore().generate_msgdef("nav_msgs/msg/Odometry", ros_version=2)
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("nav_msgs/msg/Odometry", "ros2msg", definition.encode())
        writer.add_message(writer.register_channel("/odom", "cdr", schema), 0, data, 0)
        writer.finish()
    with open_log(path) as log:
        message = first_message(log, "/odom")
        assert message.header_stamp_ns() == 3 * SECOND + 5
        assert message.header_frame_id() == "odom"
        assert message.decode().pose.pose.position.z == 3.0


def test_other_encodings_are_listed_and_refused_when_decoded(tmp_path):
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("foxglove.Log", "protobuf", b"\x0a\x03abc")
        writer.add_message(writer.register_channel("/log", "protobuf", schema), SECOND, b"data", SECOND)
        writer.add_message(writer.register_channel("/json", "json", 0), SECOND, b"{}", SECOND)
        writer.add_message(writer.register_channel("/cbor", "cbor", 0), SECOND, b"{}", SECOND)
        writer.finish()
    with open_log(path) as log:
        assert [(t.name, t.type_name, t.encoding) for t in log.topics] == [
            ("/cbor", "", "cbor"), ("/json", "", "json"), ("/log", "foxglove.Log", "protobuf"),
        ]  # fmt: skip
        assert first_message(log, "/json").decode() == SimpleNamespace()
        for topic, sentence in (
            ("/cbor", "message encoding 'cbor' is not supported; supported are cdr, ros1, protobuf, json"),
            ("/log", "the definition of type 'foxglove.Log' cannot be parsed"),
        ):
            with pytest.raises(InputError, match=rf"a\.mcap: topic '{topic}' at 1\.000 s: {sentence}$"):
                first_message(log, topic).decode()


@pytest.mark.parametrize("size", [0, 3, 7, 13, 25, 60])
def test_a_message_that_is_too_short_is_damage(tmp_path, size):
    entry = robot_entries(num_frames=1)[2]
    path = write_mcap(tmp_path / "a.mcap", [entry])
    with open_log(path) as log:
        whole = first_message(log, entry.topic)
        short = RawMessage(log.path, whole.channel, 0, whole.data[:size])
        with pytest.raises(DamagedMessageError, match=r"a\.mcap: topic '/odom' at 0\.000 s"):
            short.decode()
        if size < 12:
            with pytest.raises(DamagedMessageError, match="too short to hold a header"):
                short.header_stamp_ns()


def test_files_that_are_not_logs_are_input_errors(tmp_path):
    def refused(name: str, data: bytes | None) -> str:
        path = tmp_path / name
        if data is not None:
            path.write_bytes(data)
        with pytest.raises(InputError) as caught:
            open_log(path)
        assert str(caught.value).startswith(f"{path}: ")
        return str(caught.value)

    assert refused("missing.mcap", None).endswith("no such file")
    assert refused("empty.mcap", b"").endswith("the file is empty")
    assert "not a log" in refused("text.mcap", b"hello, this is some text")
    assert "not a log" in refused("short.mcap", b"\x89MCAP")
    assert "cannot be read" in refused("cut.bag", b"#ROSBAG V2.0\n" + b"\x00" * 40)
    assert "only ROS 1 bags of version 2.0" in refused("old.bag", b"#ROSBAG V1.2\n" + b"\x00" * 40)
    assert "must end in .db3" in refused("a.sqlite", b"SQLite format 3\0" + b"\0" * 100)
    assert "cannot be read" in refused("a.db3", b"SQLite format 3\0" + b"\0" * 100)
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "x.mcap").touch()
    assert "without metadata.yaml is not a rosbag2 recording; name the files in it; it holds x.mcap" in refused(
        "folder", None
    )
    (tmp_path / "folder" / "metadata.yaml").write_text("a: [")
    with pytest.raises(InputError, match="not the metadata of a rosbag2 recording"):
        open_log(tmp_path / "folder")


def test_an_unreadable_file_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="cannot be read: Not a directory"):
        open_log(write_mcap(tmp_path / "a.mcap", []) / "inside")


def test_type_names_are_normalised():
    assert normalise_type_name("tf2_msgs/TFMessage") == "tf2_msgs/msg/TFMessage"
    assert normalise_type_name("tf2_msgs/msg/TFMessage") == "tf2_msgs/msg/TFMessage"


@pytest.mark.parametrize("name", ["rosbag2_sqlite3", "humble.db3", "cdr_zstd.mcap", "lz4.bag", "rosbag2_mcap_split"])
def test_a_log_is_read_the_same_way_in_another_thread(name):
    with open_log(CONTAINERS / name) as log:
        expected = [(m.topic, m.log_time_ns, bytes(m.data)) for m in log.messages([t.name for t in log.topics])]
    with open_log(CONTAINERS / name) as log, ThreadPoolExecutor(1) as thread:
        topics = [topic.name for topic in log.topics]
        found = thread.submit(lambda: [(m.topic, m.log_time_ns, bytes(m.data)) for m in log.messages(topics)]).result()
        assert log.damage is None
        # The reader of damaged databases was not used.
        assert all(getattr(part, "_rows", None) is None for part in (log, *getattr(log, "_logs", ())))
    assert found == expected
