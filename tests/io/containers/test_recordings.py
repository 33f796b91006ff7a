"""Recordings of other projects are read completely, and as the libraries read them."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.reader import NonSeekingReader
from rosbags.rosbag1 import Reader as Rosbag1Reader

from octoreplay.io.containers.logs import open_log
from support.recordings import RECORDINGS, needs_recordings


def contents(path: Path) -> list[tuple[str, int, bytes]]:
    """Return all messages of a log as read by this package."""
    with open_log(path) as log:
        return [(m.topic, m.log_time_ns, bytes(m.data)) for m in log.messages([topic.name for topic in log.topics])]


@needs_recordings
@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("ros1/foxglove_example.bag", 8647), ("ros1/foxglove_example-bz2.bag", 8647),
        ("ros1/foxglove_example-lz4.bag", 8647), ("ros1/foxglove_no-messages.bag", 0),
        ("ros1/jsk_watercan.bag", 3533), ("db3/evo_tf_example", 518), ("db3/plotjuggler_rosbag2_test", 4695),
        ("db3/foxglove_chatter.db3", 7), ("db3/wyq_zero_messages.db3", 0), ("rosbag2_dirs/mcap_wbag", 6074),
        ("rosbag2_dirs/rosbags-rs_mcap", 188), ("rosbag2_dirs/rosbags-rs_sqlite3", 188),
        ("mcap_ros2/evo_nav2_turtlebot.mcap", 8197), ("mcap_ros2/rerun_supported_ros2_messages.mcap", 194),
        ("mcap_ros2/rosbag2_bag_with_topics_and_service_events.mcap", 10), ("mcap_other/keelson_test.mcap", 2172),
        ("mcap_other/lichtblick_example.mcap", 111), ("mcap_other/pointcloudset_test.mcap", 273),
        ("mcap_proto/rerun_simple-protobuf.mcap", 293), ("mcap_proto/rerun_foxglove_log.mcap", 6),
        ("ros1/plotjuggler_tilt_laser.bag", 4093),
    ],
)  # fmt: skip
def test_recordings_of_other_projects(name, count):
    with open_log(RECORDINGS / name) as log:
        messages = list(log.messages([topic.name for topic in log.topics]))
        assert len(messages) == log.message_count == sum(t.num_messages for t in log.topics) == count
        assert log.damage is None
        if messages:
            assert (messages[0].log_time_ns, messages[-1].log_time_ns) == (log.start_ns, log.end_ns)
        decoded = 0
        for message in messages:
            if message.channel.encoding in ("cdr", "ros1") and "/srv/" not in message.type_name:
                message.decode()
                decoded += 1
        assert decoded > 0 or not name.startswith(("ros1/foxglove_ex", "db3/evo", "mcap_ros2", "rosbag2_dirs"))


@needs_recordings
@pytest.mark.parametrize(
    "name", ["foxglove_example.bag", "foxglove_example-bz2.bag", "foxglove_example-lz4.bag", "jsk_watercan.bag"]
)
def test_bags_are_read_as_rosbags_reads_them(name):
    path = RECORDINGS / "ros1" / name
    with Rosbag1Reader(path) as reader:
        rows = [(connection.topic, time, data) for connection, time, data in reader.messages()]
        types = {(connection.topic, connection.msgtype) for connection in reader.connections}
    found = contents(path)
    assert [time for _, time, _ in found] == [time for _, time, _ in rows]
    assert sorted(found) == sorted(rows)
    with open_log(path) as log:
        assert {(topic.name, topic.type_name) for topic in log.topics} == types


@needs_recordings
@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("nav2_turtlebot_no_footer.mcap", "cut after its last message"),
        ("ros1_lidar_cut_60pct.mcap", "cut before its end"),
        ("turtles_cut_90pct.bag", "the bag has no index"),
        ("tf_example_cut_50pct.db3", "cut before its end"),
    ],
)
def test_intact_messages_of_damaged_recordings_are_read(name, sentence):
    with open_log(RECORDINGS / "derived_damaged" / name) as log:
        assert sentence in log.damage
        assert len(list(log.messages([t.name for t in log.topics]))) == log.message_count > 180


@needs_recordings
def test_every_conformance_file_is_read_as_the_mcap_package_reads_it():
    files = sorted((RECORDINGS / "mcap_conformance").rglob("*.mcap"))
    assert files
    for file in files:
        with file.open("rb") as stream:
            rows = [
                (channel.topic, message.log_time, message.data)
                for _, channel, message in NonSeekingReader(stream).iter_messages(log_time_order=False)
            ]
        assert sorted(contents(file)) == sorted(rows), file
        with open_log(file) as log:
            assert log.damage is None, file
