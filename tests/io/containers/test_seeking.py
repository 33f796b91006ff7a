"""Reading a part of a log gives the messages of the whole log in that part, and reads only that part of the file."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mcap.records import ChunkIndex
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer

from octoreplay.io.containers.db3_log import Db3Log
from octoreplay.io.containers.logs import open_log
from octoreplay.io.messages.ros_types import typestore
from support.log_factory import ROS1, SECOND, ros2
from support.long_suite import examples

FIXTURES = Path(__file__).parents[2] / "fixtures" / "containers"
STRING = "std_msgs/msg/String"
TOPICS = ("/a", "/b", "/c")
END = 100
"""Log times in ns are below this."""


def rows() -> list[tuple[str, int, bytes]]:
    """(topic, log time, random text): roughly in order, with equal times and some that are far too early or late."""
    rng = np.random.default_rng(5)
    times = np.clip(np.arange(80) + rng.integers(-6, 7, 80), 0, END - 1)
    times[[20, 21, 60]] = 90, 5, 0
    return [(TOPICS[rng.integers(3)], int(time), rng.bytes(60).hex().encode()) for time in times]


def string(data: bytes) -> bytes:
    return bytes(typestore().serialize_cdr(ros2.make(STRING, data=data.decode()), STRING))


def write_mcap(path: Path, messages=None, **options) -> Path:
    """An MCAP with the writer of the mcap package."""
    options = {"chunk_size": 900, "compression": CompressionType.NONE, **options}
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start(profile="ros2")
        schema = writer.register_schema(STRING, "ros2msg", b"string data\n")
        channels = {topic: writer.register_channel(topic, "cdr", schema) for topic in TOPICS}
        for topic, log_time, data in rows() if messages is None else messages:
            writer.add_message(channels[topic], log_time, string(data), log_time)
        writer.finish()
    return path


def write_bag(path: Path, compression=None) -> Path:
    """A ROS 1 bag of several chunks."""
    writer = Rosbag1Writer(path)
    writer.chunk_threshold = 900
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        connections = {topic: writer.add_connection(topic, STRING, typestore=ROS1) for topic in TOPICS}
        for topic, log_time, data in rows():
            value = ROS1.types[STRING](data=data.decode())
            writer.write(connections[topic], log_time, ROS1.serialize_ros1(value, STRING))
    return path


def write_db3(path: Path, num_copies: int = 1) -> Path:
    """A sqlite3 file of a rosbag2 folder; each text is repeated."""
    with Rosbag2Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections = {topic: writer.add_connection(topic, STRING, typestore=typestore()) for topic in TOPICS}
        for topic, log_time, data in rows():
            writer.write(connections[topic], log_time, string(data * num_copies))
    return next(path.glob("*.db3"))


def write_split(path: Path) -> Path:
    """A recording in five files whose times overlap."""
    path.mkdir()
    for index in range(5):
        write_mcap(path / f"part_{index}.mcap", rows()[16 * index : 16 * index + 16])
    return path


def write_negative_db3(path: Path) -> Path:
    """A sqlite3 recording whose times are before 1970."""
    with Rosbag2Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/a", STRING, typestore=typestore())
        for log_time in range(-50, -10, 3):
            writer.write(connection, log_time, string(b"data"))
    return next(path.glob("*.db3"))


def cut(path: Path, share: float) -> Path:
    """The first part of a file."""
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    return path


def overwrite(path: Path, share: float, length: int = 40) -> Path:
    """A file of which some bytes are noise."""
    data = bytearray(path.read_bytes())
    start = int(len(data) * share)
    data[start : start + length] = np.random.default_rng(1).bytes(length)
    path.write_bytes(data)
    return path


no_summary = {"use_statistics": False, "repeat_channels": False, "repeat_schemas": False, "use_summary_offsets": False}
LOGS: dict[str, Callable[[Path], Path]] = {
    "mcap": lambda folder: write_mcap(folder / "a.mcap"),
    "mcap zstd": lambda folder: write_mcap(folder / "a.mcap", compression=CompressionType.ZSTD),
    "mcap lz4": lambda folder: write_mcap(folder / "a.mcap", compression=CompressionType.LZ4),
    "mcap one chunk": lambda folder: write_mcap(folder / "a.mcap", chunk_size=1 << 20),
    "mcap no message index": lambda folder: write_mcap(folder / "a.mcap", index_types=IndexType.CHUNK),
    "mcap no summary": lambda folder: write_mcap(folder / "a.mcap", index_types=IndexType.NONE, **no_summary),
    "mcap loose": lambda folder: write_mcap(folder / "a.mcap", use_chunking=False),
    "mcap cut": lambda folder: cut(write_mcap(folder / "a.mcap"), 0.6),
    "mcap zstd cut": lambda folder: cut(write_mcap(folder / "a.mcap", compression=CompressionType.ZSTD), 0.5),
    "mcap loose cut": lambda folder: cut(write_mcap(folder / "a.mcap", use_chunking=False), 0.7),
    "mcap damaged": lambda folder: overwrite(write_mcap(folder / "a.mcap"), 0.4),
    "mcap damaged and cut": lambda folder: overwrite(cut(write_mcap(folder / "a.mcap"), 0.9), 0.4, 400),
    "bag": lambda folder: write_bag(folder / "a.bag"),
    "bag lz4": lambda folder: write_bag(folder / "a.bag", Rosbag1Writer.CompressionFormat.LZ4),
    "bag cut": lambda folder: cut(write_bag(folder / "a.bag"), 0.6),
    "bag damaged": lambda folder: overwrite(write_bag(folder / "a.bag", Rosbag1Writer.CompressionFormat.LZ4), 0.4, 400),
    "db3": lambda folder: write_db3(folder / "bag"),
    "db3 folder": lambda folder: write_db3(folder / "bag").parent,
    "db3 before 1970": lambda folder: write_negative_db3(folder / "bag"),
    "db3 cut": lambda folder: cut(write_db3(folder / "bag", 40), 0.6),
    "db3 damaged page": lambda folder: overwrite(write_db3(folder / "bag", 10), 0.5, 4096),
    "split folder": lambda folder: write_split(folder / "part"),
} | {f"fixture {p.name}": lambda _, p=p: p for p in sorted(FIXTURES.iterdir())}


@cache
def log_of(name: str) -> Path:
    """One of the logs above, written once."""
    folder = Path(mkdtemp(prefix="seeking"))
    FOLDERS.append(folder)
    return LOGS[name](folder)


FOLDERS: list[Path] = []


@pytest.fixture(scope="module", autouse=True)
def _logs_in_small_blocks():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("octoreplay.io.containers.mcap_pass._LOOSE_BLOCK_BYTES", 900)
        patch.setattr("octoreplay.io.containers.damaged_db3_log._BLOCK_BYTES", 9000)
        yield
    log_of.cache_clear()
    for folder in FOLDERS:
        shutil.rmtree(folder)


def messages_of(log, topics, *bounds) -> list[tuple[str, int, bytes]]:
    return [(m.topic, m.log_time_ns, bytes(m.data)) for m in log.messages(topics, *bounds)]


bounds = st.none() | st.floats(-0.1, 1.1)


@pytest.mark.parametrize("name", LOGS)
def test_every_log_of_the_suite_holds_messages(name):
    with open_log(log_of(name)) as log:
        assert len(messages_of(log, [topic.name for topic in log.topics])) > 3
        assert (log.damage is not None) == any(word in name for word in ("cut", "damaged"))


@pytest.mark.parametrize("name", LOGS)
@given(first=bounds, last=bounds, shift=st.integers(-1, 1), topics=st.sets(st.integers(0, 9)))
@example(first=None, last=None, shift=0, topics={0, 1, 2})
@example(first=0.5, last=0.5, shift=0, topics={0, 1, 2})
@example(first=1.0, last=None, shift=0, topics={0, 1, 2})
@example(first=None, last=0.0, shift=1, topics={0, 1, 2})
@example(first=0.7, last=0.3, shift=0, topics={0, 1, 2})
@examples(15)
def test_a_range_gives_the_messages_of_the_whole_log_in_it(name, first, last, shift, topics):
    with open_log(log_of(name)) as log:
        names = [topic.name for index, topic in enumerate(log.topics) if index in topics]
        span = log.end_ns - log.start_ns
        start, stop = (None if share is None else log.start_ns + round(share * span) + shift for share in (first, last))
        whole = messages_of(log, names)
        expected = [row for row in whole if (start is None or row[1] >= start) and (stop is None or row[1] < stop)]
        assert messages_of(log, names, start, stop) == expected
    # A log from which nothing else was read gives the same.
    with open_log(log_of(name)) as log:
        assert messages_of(log, names, start, stop) == expected


@given(st.lists(st.tuples(st.sampled_from(TOPICS), st.integers(0, 20)), max_size=30), st.integers(0, 20), st.data())
@settings(max_examples=60)
def test_any_mcap_gives_any_range(stamps, start, data):
    stop = data.draw(st.integers(start, 21))
    use_chunking = data.draw(st.booleans())
    index_types = data.draw(st.sampled_from([IndexType.ALL, IndexType.NONE, IndexType.CHUNK]))
    folder = Path(mkdtemp(prefix="seeking"))
    try:
        messages = [(topic, log_time, str(i).encode()) for i, (topic, log_time) in enumerate(stamps)]
        path = write_mcap(
            folder / "a.mcap", messages, chunk_size=120, use_chunking=use_chunking, index_types=index_types
        )
        expected = [(topic, time, string(data)) for topic, time, data in messages if start <= time < stop]
        with open_log(path) as log:
            assert messages_of(log, TOPICS, start, stop) == sorted(expected, key=lambda row: row[1])
    finally:
        shutil.rmtree(folder)


class CountedFile:
    """A file that remembers which bytes were read."""

    def __init__(self, file) -> None:
        self._file = file
        self.spans: list[tuple[int, int]] = []

    def seek(self, *where) -> int:
        return self._file.seek(*where)

    def read(self, size: int = -1) -> bytes:
        start = self._file.tell()
        data = self._file.read(size)
        self.spans.append((start, start + len(data)))
        return data

    def close(self) -> None:
        self._file.close()

    @property
    def num_bytes(self) -> int:
        return sum(end - start for start, end in self.spans)


def ordered_rows() -> list[tuple[str, int, bytes]]:
    rng = np.random.default_rng(6)
    return [(TOPICS[i % 3], i, rng.bytes(60).hex().encode()) for i in range(300)]


@pytest.mark.parametrize("name", ["mcap", "mcap zstd", "mcap no message index", "mcap no summary", "mcap loose", "bag"])
def test_only_overlapping_blocks_are_read(tmp_path, name, monkeypatch):
    monkeypatch.setitem(globals(), "rows", ordered_rows)
    with open_log(LOGS[name](tmp_path)) as log:
        log._file = counted = CountedFile(log._file)
        found = messages_of(log, TOPICS, 100, 130)
        assert [time for _, time, _ in found] == list(range(100, 130))
        blocks = [b for b in log._index.blocks if b.start_ns < 130 and b.end_ns >= 100]
        assert 3 < len(blocks) < len(log._index.blocks) / 3
        inside = [(b.offset, b.offset + b.length) for b in blocks]
        assert all(any(a <= start and end <= b for a, b in inside) for start, end in counted.spans)
        assert counted.num_bytes <= sum(b.length for b in blocks)
        counted.spans.clear()
        assert messages_of(log, TOPICS, 400) == messages_of(log, TOPICS, None, 0) == []
        assert counted.num_bytes == 0


def test_a_block_without_an_end_is_always_read(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", ordered_rows())
    with open_log(path) as log:
        log._index.blocks[:] = [
            type(b)(b.offset, b.length, b.start_ns, None, b.channel_ids, b.form) for b in log._index.blocks
        ]
        assert [time for _, time, _ in messages_of(log, TOPICS, 100, 130)] == list(range(100, 130))


def test_chunks_without_times_are_read(tmp_path, monkeypatch):
    original = ChunkIndex.write

    def write_without_times(index, stream) -> None:
        index.message_start_time = index.message_end_time = 0
        original(index, stream)

    monkeypatch.setattr(ChunkIndex, "write", write_without_times)
    path = write_mcap(tmp_path / "a.mcap", [(topic, time + 50, data) for topic, time, data in ordered_rows()])
    monkeypatch.undo()
    with open_log(path) as log:
        assert {b.end_ns for b in log._index.blocks} == {None}
        assert [time for _, time, _ in messages_of(log, TOPICS, 100, 130)] == list(range(100, 130))


def test_files_of_a_folder_outside_the_range_are_not_read(tmp_path):
    folder = tmp_path / "part"
    folder.mkdir()
    for index in range(5):
        write_mcap(folder / f"part_{index}.mcap", ordered_rows()[60 * index : 60 * index + 60])
    with open_log(folder) as log:
        for part in log._logs:
            part._file = CountedFile(part._file)
        found = messages_of(log, TOPICS, 70, 110)
        assert [time for _, time, _ in found] == list(range(70, 110))
        assert [part._file.num_bytes > 0 for part in log._logs] == [False, True, False, False, False]


def test_a_database_is_asked_for_the_range(tmp_path, monkeypatch):
    path = write_db3(tmp_path / "bag")
    with open_log(path) as log:
        assert isinstance(log, Db3Log)
        asked = []
        (reader,) = log._readers.values()
        original = reader.messages
        monkeypatch.setattr(reader, "messages", lambda *args: asked.append(args[1:]) or original(*args))
        for start, stop in ((10, 20), (None, 20), (10, None), (-(10**30), 10**30), (10**30, None), (None, -(10**30))):
            messages_of(log, TOPICS, start, stop)
        assert asked == [(10, 20), (None, 20), (10, None), (None, None)]
        assert log.damage is None


def test_a_range_in_seconds_of_a_fixture():
    with open_log(FIXTURES / "cdr_zstd.mcap") as log:
        middle = (log.start_ns + log.end_ns) // 2
        names = [topic.name for topic in log.topics]
        before, after = messages_of(log, names, None, middle), messages_of(log, names, middle)
        assert len(before) + len(after) == log.message_count
        assert before
        assert after
        assert log.end_ns - log.start_ns > SECOND
