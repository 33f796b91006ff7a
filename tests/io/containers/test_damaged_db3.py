"""Damaged sqlite3 recordings: all rows that can be read are read, once, and damage is reported."""

from __future__ import annotations

from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from octoreplay.io.containers.db3_log import Db3Log
from octoreplay.io.containers.logs import open_log
from octoreplay.io.messages.ros_types import typestore
from support.log_damage import read_all


def write_long_db3(folder: Path) -> Path:
    """Write 600 messages, some of them longer than a page of the database and several at each log time."""
    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/a", "std_msgs/msg/String", typestore=typestore())
        for index in range(600):
            value = typestore().types["std_msgs/msg/String"](data=f"{index:04}" * (20 if index % 50 else 4000))
            writer.write(connection, index // 7 + 1, typestore().serialize_cdr(value, "std_msgs/msg/String"))
    return next(folder.glob("*.db3"))


@pytest.mark.parametrize("share", [0.3, 0.5, 0.8, 0.95])
def test_all_rows_before_the_cut_of_a_database_are_read(tmp_path, share):
    path = write_long_db3(tmp_path / "bag")
    whole = read_all(path)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    outcome = read_all(path)
    assert set(outcome.messages) < set(whole.messages)
    # SQLite fills a page of rows from its end, so the cut page loses its first rows.
    assert len(outcome.messages) > share * 600 - 2 * 4096 / 100
    assert [m[1] for m in outcome.messages] == sorted(m[1] for m in outcome.messages)
    assert outcome.damage.startswith(f"{path}: cut before its end, and ")


def test_rows_outside_damaged_pages_of_a_database_are_read_once(tmp_path):
    path = write_long_db3(tmp_path / "bag")
    whole = read_all(path)
    data = path.read_bytes()
    num_pages = len(data) // 4096
    for page in range(8, num_pages, 3):
        path.write_bytes(data[: page * 4096] + b"\xff" * 4096 + data[(page + 1) * 4096 :])
        outcome = read_all(path)
        assert len(set(outcome.messages)) == len(outcome.messages)
        assert len(set(outcome.messages) & set(whole.messages)) > 500
        assert len(outcome.messages) == 600 or outcome.damage is not None


def test_a_database_with_inconsistent_pages_is_reported_as_damaged(tmp_path):
    path = write_long_db3(tmp_path / "bag")
    data = path.read_bytes()
    # The file's last page begins eight bytes later.
    path.write_bytes(data[:-4096] + bytes(8) + data[-4096:])
    assert read_all(path).damage is not None
    # The table of messages cannot be found without its row in the schema.
    path.write_bytes(data.replace(b"tablemessagesmessages", b"tablemess\xffgesmessages"))
    assert read_all(path).refusal == f"{path}: cannot be read: not a rosbag2 recording, or a damaged one"


def test_a_database_with_special_characters_in_its_name_is_read(tmp_path):
    path = write_long_db3(tmp_path / "bag").rename(tmp_path / "50%?a#b.db3")
    outcome = read_all(path)
    assert (len(outcome.messages), outcome.damage) == (600, None)


def test_rows_that_rosbags_cannot_read_are_skipped_and_the_others_read_once(tmp_path):
    path = write_long_db3(tmp_path / "bag")
    whole = read_all(path)
    data = path.read_bytes()
    # Pages that hold the middle of a long message begin with the number of the next such page.
    middles = [
        place for place in range(0, len(data), 4096)
        if data[place : place + 3] == bytes(3) and data[place + 3] and data[place + 4 : place + 12].isdigit()
    ]  # fmt: skip
    assert len(middles) > 5
    for place in middles[2], middles[4]:
        data = data[:place] + b"\xff\xff\xff\xff" + data[place + 4 :]
    path.write_bytes(data)
    with open_log(path) as log:
        assert isinstance(log, Db3Log)
        found = [(m.topic, m.log_time_ns, bytes(m.data)) for m in log.messages(["/a"])]
        assert ": 2 damaged parts with 2 messages were skipped;" in log.damage
        # A range gives the same rows, whether rosbags reads them or not.
        for start, stop in ((10, 20), (20, 70), (40, 41), (70, 200)):
            part = [(m.topic, m.log_time_ns, bytes(m.data)) for m in log.messages(["/a"], start, stop)]
            assert part == [message for message in found if start <= message[1] < stop]
    assert len(found) == 598
    assert [message for message in whole.messages if message in set(found)] == found
