"""Small logs of every container, ways to damage them, and what reading them must come to: for the tests of damage."""

from __future__ import annotations

import random
import struct
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import lz4.frame
import zstandard
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer

from octoreplay.errors import OctoreplayError
from octoreplay.io.containers.logs import open_log
from octoreplay.io.messages.ros_types import typestore
from support.log_factory import ROS1

STRING = "std_msgs/msg/String"
NUM_MESSAGES = 60


def text_of(index: int) -> str:
    """The text of the message with a number: long enough for chunks, and hard to compress."""
    return random.Random(index).randbytes(60).hex()


STRINGS = tuple((index + 1, text_of(index)) for index in range(NUM_MESSAGES))
"""Log time and text of each message."""


def write_strings_mcap(path: Path, *, times_and_texts: Sequence[tuple[int, str]] = STRINGS, **options: Any) -> Path:
    """An MCAP of strings on two topics in turn, by the mcap package."""
    with path.open("wb") as file:
        writer = McapWriter(file, **{"chunk_size": 1000, **options})
        writer.start(profile="ros2")
        schema = writer.register_schema(STRING, "ros2msg", b"string data\n")
        channels = [writer.register_channel(topic, "cdr", schema) for topic in ("/a", "/b")]
        for index, (time, text) in enumerate(times_and_texts):
            data = bytes(typestore().serialize_cdr(typestore().types[STRING](data=text), STRING))
            writer.add_message(channels[index % 2], time, data, time)
        writer.finish()
    return path


def write_strings_bag(path: Path, compression: Rosbag1Writer.CompressionFormat | None = None) -> Path:
    """The same as a ROS 1 bag of several chunks, by rosbags."""
    writer = Rosbag1Writer(path)
    writer.chunk_threshold = 1000
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        connections = [writer.add_connection(topic, STRING, typestore=ROS1) for topic in ("/a", "/b")]
        for index, (time, text) in enumerate(STRINGS):
            value = ROS1.types[STRING](data=text)
            writer.write(connections[index % 2], time, ROS1.serialize_ros1(value, STRING))
    return path


def write_strings_rosbag2(
    path: Path, *, storage: str = "sqlite3", mode: CompressionMode = CompressionMode.NONE, version: int = 9
) -> Path:
    """The same as a rosbag2 folder, by rosbags."""
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    writer = Rosbag2Writer(path, version=version, storage_plugin=plugin)
    if mode is not CompressionMode.NONE:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = [writer.add_connection(topic, STRING, typestore=typestore()) for topic in ("/a", "/b")]
        for index, (time, text) in enumerate(STRINGS):
            value = typestore().types[STRING](data=text)
            writer.write(connections[index % 2], time, typestore().serialize_cdr(value, STRING))
    return path


def _db3_file(folder: Path) -> Path:
    return next(write_strings_rosbag2(folder / "plain").glob("*.db3"))


_NO_SUMMARY = {
    "index_types": IndexType.NONE, "use_statistics": False, "repeat_channels": False, "repeat_schemas": False,
    "use_summary_offsets": False,
}  # fmt: skip
CONTAINERS: dict[str, Callable[[Path], Path]] = {
    "mcap zstd": lambda d: write_strings_mcap(d / "a.mcap", compression=CompressionType.ZSTD),
    "mcap lz4": lambda d: write_strings_mcap(d / "a.mcap", compression=CompressionType.LZ4),
    "mcap none": lambda d: write_strings_mcap(d / "a.mcap", compression=CompressionType.NONE),
    "mcap without checksums": lambda d: write_strings_mcap(d / "a.mcap", enable_crcs=False),
    "mcap without summary": lambda d: write_strings_mcap(d / "a.mcap", **_NO_SUMMARY),
    "mcap without chunks": lambda d: write_strings_mcap(d / "a.mcap", use_chunking=False),
    "bag none": lambda d: write_strings_bag(d / "a.bag"),
    "bag bz2": lambda d: write_strings_bag(d / "a.bag", Rosbag1Writer.CompressionFormat.BZ2),
    "bag lz4": lambda d: write_strings_bag(d / "a.bag", Rosbag1Writer.CompressionFormat.LZ4),
    "db3": _db3_file,
    "rosbag2 sqlite3": lambda d: write_strings_rosbag2(d / "bag"),
    "rosbag2 mcap": lambda d: write_strings_rosbag2(d / "bag", storage="mcap"),
    "rosbag2 sqlite3, files": lambda d: write_strings_rosbag2(d / "bag", mode=CompressionMode.FILE),
    "rosbag2 mcap, files": lambda d: write_strings_rosbag2(d / "bag", storage="mcap", mode=CompressionMode.FILE),
    "rosbag2 sqlite3, messages": lambda d: write_strings_rosbag2(d / "bag", mode=CompressionMode.MESSAGE),
    "rosbag2 mcap, messages": lambda d: write_strings_rosbag2(
        d / "bag", storage="mcap", mode=CompressionMode.MESSAGE
    ),
}  # fmt: skip


# --- damage ----------------------------------------------------------------------------------------------------------


def flip_bits(data: bytes, rng: random.Random) -> bytes:
    """One to a hundred bits turned over."""
    result = bytearray(data)
    for _ in range(rng.choice([1, 1, 4, 100])):
        result[rng.randrange(len(result))] ^= 1 << rng.randrange(8)
    return bytes(result)


def cut(data: bytes, rng: random.Random) -> bytes:
    """The end is missing."""
    return data[: rng.randrange(len(data))]


def insert(data: bytes, rng: random.Random) -> bytes:
    """Foreign bytes, zeros, or a copy of another part in between."""
    place, length = rng.randrange(len(data) + 1), rng.choice([1, 8, 100, 5000])
    start = rng.randrange(len(data))
    piece = rng.choice([rng.randbytes(length), bytes(length), data[start : start + length]])
    return data[:place] + piece + data[place:]


def remove(data: bytes, rng: random.Random) -> bytes:
    """A part in between is missing."""
    place = rng.randrange(len(data))
    return data[:place] + data[place + rng.choice([1, 8, 100, 2000]) :]


def overwrite(data: bytes, rng: random.Random) -> bytes:
    """A part is zeros or noise."""
    place, length = rng.randrange(len(data)), rng.choice([1, 8, 100, 2000])
    length = min(length, len(data) - place)
    return data[:place] + rng.choice([bytes(length), rng.randbytes(length)]) + data[place + length :]


def zero_page(data: bytes, rng: random.Random) -> bytes:
    """A page of 4096 bytes is zero, as after a crash."""
    start = 4096 * rng.randrange(len(data) // 4096 + 1)
    end = min(start + 4096, len(data))
    return data[:start] + bytes(end - start) + data[end:]


def lie_about_sizes(data: bytes, rng: random.Random) -> bytes:
    """Numbers in the file become huge ones."""
    result = bytearray(data)
    for _ in range(rng.choice([1, 3])):
        number = rng.choice([0, 1 << 20, (1 << 30) + 1, (1 << 31) - 1, (1 << 32) - 1, 1 << 60, (1 << 64) - 1])
        piece = struct.pack("<Q", number)[: rng.choice([4, 8])]
        places = [rng.randrange(len(data)), data.find(rng.choice([b"\x06", b"\x08", b"size=", b"\x05"])) + 1]
        place = rng.choice(places)
        result[place : place + len(piece)] = piece
    return bytes(result)


def reseal_chunk(data: bytes, rng: random.Random) -> bytes:
    """An MCAP's chunk with flipped bits inside, compressed again with a checksum that fits; flipped bits elsewhere."""
    chunks = list(mcap_chunks(data))
    if not chunks:
        return flip_bits(data, rng)
    chunk = rng.choice(chunks)
    return data[: chunk.start] + chunk.sealed(flip_bits(chunk.records, rng)) + data[chunk.end :]


MUTATIONS: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    flip_bits, cut, insert, remove, overwrite, zero_page, lie_about_sizes, reseal_chunk,
)  # fmt: skip


class Chunk(NamedTuple):
    """A chunk of an MCAP: its record's start and end in the file, its head's fields, and its records."""

    start: int
    end: int
    start_ns: int
    end_ns: int
    compression: str
    records: bytes

    def sealed(self, records: bytes) -> bytes:
        """The chunk's record with other records in it, sizes and checksum right."""
        pack = {"zstd": zstandard.ZstdCompressor().compress, "lz4": lz4.frame.compress}.get(self.compression, bytes)
        data, name = pack(records), self.compression.encode()
        head = struct.pack("<QQQII", self.start_ns, self.end_ns, len(records), zlib.crc32(records), len(name))
        body = head + name + struct.pack("<Q", len(data)) + data
        return struct.pack("<BQ", 6, len(body)) + body


def mcap_chunks(data: bytes) -> list[Chunk]:
    """The chunks of a good MCAP; none for any other file."""
    chunks, place = [], 8
    while data.startswith(b"\x89MCAP") and place + 9 <= len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, place)
        start, place = place, place + 9 + length
        if opcode == 6:
            start_ns, end_ns, size, _, name_length = struct.unpack_from("<QQQII", data, start + 9)
            name = data[start + 41 : start + 41 + name_length].decode()
            packed = data[start + 49 + name_length : place]
            records = {
                "zstd": lambda packed=packed, size=size: zstandard.ZstdDecompressor().decompress(packed, size),
                "lz4": lambda packed=packed: lz4.frame.decompress(packed),
            }.get(name, lambda packed=packed: packed)()
            chunks.append(Chunk(start, place, start_ns, end_ns, name, records))
    return chunks


def damage_log(path: Path, rng: random.Random) -> str:
    """Damage a log, or a file of a folder, in one or two ways; returns what was done."""
    files = sorted(path.iterdir(), key=lambda file: (file.suffix == ".yaml", file.name)) if path.is_dir() else [path]
    # Without the metadata a folder is refused, so it is damaged more seldom.
    file = rng.choices(files, [0.1 if file.suffix == ".yaml" else 0.9 for file in files])[0]
    done = []
    for _ in range(rng.choice([1, 1, 2])):
        data = file.read_bytes()
        # Only a chunk that is still good can be sealed again.
        mutation = rng.choice([m for m in MUTATIONS if not (done and m is reseal_chunk)])
        file.write_bytes(mutation(data, rng) if data else data)
        done.append(mutation.__name__)
    return f"{file.name}: {', '.join(done)}"


# --- reading ---------------------------------------------------------------------------------------------------------


class Outcome(NamedTuple):
    """Outcome of reading a whole log: its content, and its damage or the refusal."""

    messages: list[tuple[str, int, bytes]]
    damage: str | None
    refusal: str | None


def read_all(path: Path) -> Outcome:
    """Every message of every topic; whatever is no error of this package goes through."""
    try:
        with open_log(path) as log:
            topics = [topic.name for topic in log.topics]
            messages = [(m.topic, m.log_time_ns, bytes(m.data)) for m in log.messages(topics)]
            return Outcome(messages, log.damage, None)
    except OctoreplayError as error:
        return Outcome([], None, str(error))
