"""Messages of logs of every container and encoding that are copied into an MCAP file as they are."""

from __future__ import annotations

from pathlib import Path

import pytest

from octoreplay.io.containers.logs import open_log
from octoreplay.io.containers.mcap_writer import RosMcapWriter
from octoreplay.io.messages.sensor_messages import kind_of
from support.fixture_paths import FIXTURES
from support.long_suite import long

NAMES = ("none.bag", "ros1.mcap", "humble.db3", "cdr_idl.mcap", "rosbag2_sqlite3", "foxglove_json.mcap",
         "foxglove_protobuf.mcap", "foxglove_cdr.mcap")  # fmt: skip


@pytest.mark.parametrize("name", [pytest.param(name, marks=long if "idl" in name else ()) for name in NAMES])
def test_copied_messages_have_the_same_bytes_types_and_contents(tmp_path: Path, name: str) -> None:
    copy = tmp_path / "copy.mcap"
    with open_log(FIXTURES / "containers" / name) as log:
        topics = {topic.name for topic in log.topics if kind_of(topic.type_name) is not None}
        assert topics
        with RosMcapWriter(copy, profile="") as writer:
            for message in log.messages(topics):
                writer.copy_raw(message)
        with open_log(copy) as copied:
            pairs = list(zip(log.messages(topics), copied.messages(topics), strict=True))
            assert [(t.name, t.type_name, t.encoding, t.num_messages) for t in copied.topics] == [
                (t.name, t.type_name, t.encoding, t.num_messages) for t in log.topics if t.name in topics
            ]
            for before, after in pairs:
                assert (before.topic, before.log_time_ns, bytes(before.data)) == (
                    after.topic, after.log_time_ns, bytes(after.data)
                )  # fmt: skip
                assert str(before.decode()) == str(after.decode())
